#!/usr/bin/env bash
# The paper's first figure: four tasks, four algorithms, three seeds, a million steps each; about an hour on two idle cores.
# Finished runs are skipped, broken ones go on.
set -euo pipefail
cd "$(dirname "$0")/../.."
target/release/nearl sweep --tasks HalfCheetah-v5,Hopper-v5,Walker2d-v5,Ant-v5 --algos ppo,nearl,pid2-gan,pid2-ib --seeds 0-2 --steps 1e6 --out runs/first_figure
.venv/bin/python results/curves.py runs/first_figure results/first_figure
