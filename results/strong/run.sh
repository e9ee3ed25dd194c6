#!/usr/bin/env bash
# PPO and PID2-IB with the preset `strong`: four tasks, a million steps, seeds by which nothing was chosen; on two idle cores an hour and a half. Finished runs
# are skipped, broken ones go on. Other steps or seeds: results/strong/run.sh 10M 0-4, which goes to runs/strong/10M and writes its data there.
set -euo pipefail
cd "$(dirname "$0")/../.."
steps=${1:-1M} seeds=${2:-}
runs=runs/strong/$steps folder=results/strong
[ "$steps" = 1M ] || folder=$runs

go() { # task, its seeds
    target/release/nearl sweep --tasks "$1" --algos ppo,pid2-ib --seeds "${seeds:-$2}" --steps "$steps" --preset strong --out "$runs"
}

go HalfCheetah-v5 10-19,30-34
go Hopper-v5 5-9,30-34
go Walker2d-v5 5-9
go Ant-v5 5-9
.venv/bin/python results/strong/table.py "$folder" "$runs"
