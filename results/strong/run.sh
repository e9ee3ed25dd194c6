#!/usr/bin/env bash
# PPO and PID2-IB with the preset `strong`: four tasks, five seeds, a million steps; on two idle cores about an hour. Finished runs are skipped,
# broken ones go on. More steps or fewer seeds: results/strong/run.sh 0-1 10M, which goes to runs/strong/10M and writes its data there.
set -euo pipefail
cd "$(dirname "$0")/../.."
seeds=${1:-0-4} steps=${2:-1M}
runs=runs/strong/$steps folder=results/strong
[ "$steps" = 1M ] || folder=$runs

target/release/nearl sweep --tasks HalfCheetah-v5,Hopper-v5,Walker2d-v5,Ant-v5 --algos ppo,pid2-ib --seeds "$seeds" --steps "$steps" --preset strong --out $runs
.venv/bin/python results/strong/table.py $folder $runs
