#!/usr/bin/env bash
# PPO and PID2-IB with the preset `strong`: four tasks, a million steps, seeds by which nothing was chosen; on two idle cores two hours. Finished runs
# are skipped, broken ones go on. Other steps, seeds, preset or tasks: results/strong/run.sh 10M 0-4 long "HalfCheetah-v5 Walker2d-v5", which goes to
# runs/strong/10M-long and writes its data there.
set -euo pipefail
cd "$(dirname "$0")/../.."
steps=${1:-1M} seeds=${2:-} preset=${3:-strong} tasks=${4:-HalfCheetah-v5 Hopper-v5 Walker2d-v5 Ant-v5}
runs=runs/strong/$steps folder=results/strong
[ "$preset" = strong ] || runs=$runs-$preset
[ "$runs" = runs/strong/1M ] || folder=$runs

go() { # task, its seeds, then what it sets
    local task=$1 own=$2
    shift 2
    [[ " $tasks " == *" $task "* ]] || return 0
    target/release/nearl sweep --tasks "$task" --algos ppo,pid2-ib --seeds "${seeds:-$own}" --steps "$steps" --preset "$preset" --out "$runs" "$@"
}

# the rate of PID2 that the preset strong has is for a million steps
rate=()
[ "$steps" = 1M ] || [ "$preset" = long ] || rate=(--set train.pid2.lr=3e-4)
go HalfCheetah-v5 10-19,30-34,40-64 "${rate[@]}"
go Hopper-v5 5-9,30-34
go Walker2d-v5 5-9,30-34
go Ant-v5 5-9
.venv/bin/python results/strong/table.py "$folder" "$runs"
