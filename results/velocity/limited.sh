#!/usr/bin/env bash
# Velocity tasks with a limit of 25 on the cost of an episode (train.cost.limit), preset `strong`, beside the same without it.
#     results/velocity/limited.sh [SEEDS [STEPS [WAYS [TASKS]]]]      e.g. "0 1 2" 1M "free limited prior both" "HalfCheetah Hopper Walker2d Ant"
# Finished runs are skipped, and runs that have their line in limited.csv: in a fresh clone that is every one of the table. To train and measure them again,
# move limited.csv away. Then limited.csv and limited.md are written from all that is there.
set -euo pipefail
cd "$(dirname "$0")/../.."
seeds=${1:-0 1 2 3 4} steps=${2:-10M} ways=${3:-free limited prior both} tasks=${4:-HalfCheetah Hopper Walker2d Ant}
runs=${RUNS:-runs/velocity/limited} nearl=${NEARL:-target/release/nearl}

train() { # way, then what it sets
    local out=$runs/$steps/$task-$1-$seed
    if grep -qs "^$steps,$task,$1,$seed," results/velocity/limited.csv; then
        echo "results/velocity/limited.csv has $steps $task $1 $seed: not trained and not measured again"
        return
    fi
    shift
    [ -e "$out/checkpoints/final.safetensors" ] && return 0
    rm -rf "$out"
    "$nearl" train "$task-velocity" --preset strong --steps "$steps" --seed "$seed" --threads 1 --out "$out" "$@" > /dev/null
}

for task in $tasks; do for way in $ways; do for seed in $seeds; do
    case $way in
        free) train free --algo ppo ;;
        limited) train limited --algo ppo --set train.cost.limit=25 ;;
        prior) train prior --algo pid2-ib ;;
        both) train both --algo pid2-ib --set train.cost.limit=25 ;;
    esac
done; done; done
.venv/bin/python results/velocity/limited.py "$runs" results/velocity
