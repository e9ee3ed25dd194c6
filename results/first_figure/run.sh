#!/usr/bin/env bash
# The paper's first figure: four tasks, four algorithms, five seeds, a million steps each, as the bundled task files set them, but for the policy that keeps its
# actions, which PID2 had not yet (kept.sh has it); some 55 minutes on two cores. Finished runs are skipped, broken ones go on.
#     results/first_figure/run.sh [STEPS]      1e6 unless given; 8e6, the paper's budget, goes into results/first_figure/8e6
# Writes figure.png, curves.csv, runs.csv and table.md.
set -euo pipefail
cd "$(dirname "$0")/../.."
steps=${1:-1e6} folder=results/first_figure
runs=${RUNS:-runs}/first_figure_$steps
[ "$steps" = 1e6 ] || folder=$folder/$steps
mkdir -p "$folder"

target/release/nearl sweep --tasks HalfCheetah-v5,Hopper-v5,Walker2d-v5,Ant-v5 --algos ppo,nearl,pid2-gan,pid2-ib --seeds 0-4 --steps "$steps" \
    --set train.pid2.keep_actions=false --jobs "${JOBS:-2}" --out "$runs"
.venv/bin/python results/curves.py "$runs" "$folder"
