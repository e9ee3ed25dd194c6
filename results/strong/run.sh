#!/usr/bin/env bash
# PPO and PID2-IB with the preset `strong`: four tasks, five seeds, ten million steps; on two idle cores about five hours. Finished runs are
# skipped, broken ones go on. The table is printed as JSON and drawn with the curves.
set -euo pipefail
cd "$(dirname "$0")/../.."
tasks=HalfCheetah-v5,Hopper-v5,Walker2d-v5,Ant-v5
runs=runs/strong

target/release/nearl sweep --tasks $tasks --algos ppo,pid2-ib --seeds 0-4 --steps 10M --preset strong --out $runs --json > results/strong/summary.json
.venv/bin/python results/curves.py $runs results/strong
