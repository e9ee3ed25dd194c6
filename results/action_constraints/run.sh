#!/usr/bin/env bash
# Limits on actions of the literature, kept exactly while training and after it: return, excess and, with TIMES=yes, microseconds.
#     results/action_constraints/run.sh [SEEDS [STEPS [ALGOS]]]      e.g. 0-4 1M ppo,pid2-ib
# Finished runs are skipped, broken ones go on. RUNS is the folder of all runs, NEARL the program. What they stand beside, the same settings without a set, is
# results/strong/runs.csv. Times are worth something on a quiet machine only.
set -euo pipefail
cd "$(dirname "$0")/../.."
seeds=${1:-0-4} steps=${2:-1M} algos=${3:-ppo,pid2-ib}
nearl=${NEARL:-target/release/nearl} runs=${RUNS:-runs}/action_constraints

times() { # name of the set, task, then what it sets
    [ "${TIMES:-no}" = yes ] || return 0
    local name=$1 task=$2
    shift 2
    mkdir -p "$runs/$name"
    "$nearl" bench update "$task" --json "$@" > "$runs/$name/update.json"
}

go() { # the same
    local name=$1 task=$2
    shift 2
    "$nearl" sweep --tasks "$task" --algos "$algos" --seeds "$seeds" --steps "$steps" --preset strong --jobs "${JOBS:-2}" --out "$runs/$name" "$@"
    times "$name" "$task" "$@"
}

for task in HalfCheetah-v5 Hopper-v5 Walker2d-v5 Ant-v5; do times free-$task $task; done
go HC+O HalfCheetah-v5 --set constraints.action.power=20.0
go HC+rate HalfCheetah-v5 --set 'constraints.action.rate={bthigh=0.2,bshin=0.2,bfoot=0.2,fthigh=0.5,fshin=0.5,ffoot=0.5}'
go H+M Hopper-v5 --set constraints.action.delivered=10.0
go H+rate Hopper-v5 --set 'constraints.action.rate={thigh_joint=0.2,leg_joint=0.5,foot_joint=0.5}'
go W+M Walker2d-v5 --set constraints.action.delivered=10.0
go Ant+S Ant-v5 --set constraints.action.square=2.0
.venv/bin/python results/action_constraints/table.py "$runs" results/action_constraints
