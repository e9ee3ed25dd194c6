#!/usr/bin/env bash
# Limits on actions of the literature, kept exactly while training and after it: return, excess and, with TIMES=yes, microseconds.
#     results/action_constraints/run.sh [SEEDS [STEPS [ALGOS]]]      e.g. 0-4 300k ppo,pid2-ib, which goes into results/action_constraints/300k
# Finished runs are skipped, broken ones go on. RUNS is the folder of all runs, NEARL the program. What they stand beside, the same settings without a set, is
# results/strong/runs.csv, of a million steps; other steps stand alone. The sets are those of sets.txt: name, task, limit. Times are worth something on a
# quiet machine only.
set -euo pipefail
cd "$(dirname "$0")/../.."
seeds=${1:-0-4} steps=${2:-1M} algos=${3:-ppo,pid2-ib}
nearl=${NEARL:-target/release/nearl} runs=${RUNS:-runs}/action_constraints folder=results/action_constraints
[ "$steps" = 1M ] || { runs=$runs/$steps folder=$folder/$steps; }

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
while read -r name task limit; do go "$name" "$task" --set "constraints.action.$limit" < /dev/null; done < results/action_constraints/sets.txt
.venv/bin/python results/action_constraints/table.py "$runs" "$folder"
