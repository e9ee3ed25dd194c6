#!/usr/bin/env bash
# PID2-IB of the first figure with a policy that keeps its actions, as the bundled task files set it today: four tasks, five seeds, a million steps each.
# Finished runs are skipped, broken ones go on.
#     results/first_figure/kept.sh [STEPS]      1e6 unless given; 8e6, say, goes into results/first_figure/8e6
# Writes kept.csv.
set -euo pipefail
cd "$(dirname "$0")/../.."
steps=${1:-1e6} folder=results/first_figure
runs=${RUNS:-runs}/first_figure_kept_$steps
[ "$steps" = 1e6 ] || folder=$folder/$steps
mkdir -p "$folder"

target/release/nearl sweep --tasks HalfCheetah-v5,Hopper-v5,Walker2d-v5,Ant-v5 --algos pid2-ib --seeds 0-4 --steps "$steps" --jobs "${JOBS:-2}" --out "$runs"
.venv/bin/python results/first_figure/kept.py "$runs" "$folder"
