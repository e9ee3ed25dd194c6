#!/usr/bin/env bash
# The paper's first figure: four tasks, four algorithms, five seeds, a million steps each, as the bundled task files set them; some 55 minutes
# on two cores. Finished runs are skipped, broken ones go on. With 8e6 as the first argument it is the paper's budget, into runs/.
#     results/first_figure/run.sh [STEPS]
set -euo pipefail
cd "$(dirname "$0")/../.."
steps=${1:-1e6} folder=results/first_figure
runs=runs/first_figure_$steps
[ "$steps" = 1e6 ] || folder=$runs

target/release/nearl sweep --tasks HalfCheetah-v5,Hopper-v5,Walker2d-v5,Ant-v5 --algos ppo,nearl,pid2-gan,pid2-ib --seeds 0-4 --steps "$steps" --out "$runs"
.venv/bin/python results/curves.py "$runs" "$folder"
