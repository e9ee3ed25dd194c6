#!/usr/bin/env bash
# The paper's first figure: four tasks, four algorithms, a million steps each, as the bundled task files set them. PPO and PID2-IB with five
# seeds (twenty on Walker2d, where runs differ most), the others with three; an hour and a half on two idle cores. Then eight million steps:
# the four on HalfCheetah and Hopper, PPO and PID2-IB on Walker2d and Ant, three hours. Finished runs are skipped, broken ones go on.
set -euo pipefail
cd "$(dirname "$0")/../.."
tasks=HalfCheetah-v5,Hopper-v5,Walker2d-v5,Ant-v5
runs=runs/first_figure long=runs/first_figure_8M

target/release/nearl sweep --tasks $tasks --algos ppo,pid2-ib --seeds 0-4 --steps 1e6 --out $runs
target/release/nearl sweep --tasks Walker2d-v5 --algos ppo,pid2-ib --seeds 5-19 --steps 1e6 --out $runs
target/release/nearl sweep --tasks $tasks --algos nearl,pid2-gan --seeds 0-2 --steps 1e6 --out $runs
.venv/bin/python results/curves.py $runs results/first_figure

target/release/nearl sweep --tasks HalfCheetah-v5,Hopper-v5 --algos ppo,nearl,pid2-gan,pid2-ib --seeds 0-2 --steps 8e6 --out $long
target/release/nearl sweep --tasks Walker2d-v5,Ant-v5 --algos ppo,pid2-ib --seeds 0-2 --steps 8e6 --out $long
.venv/bin/python results/curves.py $long results/first_figure/eight_million
