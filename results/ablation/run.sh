#!/usr/bin/env bash
# What prior knowledge is worth (the paper's figure 5) and what each part of PID2-IL is worth.
#     results/ablation/run.sh [SEEDS [STEPS [TASKS]]]      e.g. 0-4 1M, which goes into results/ablation/1M
# The demonstrations are those of results/imitation. Finished runs are skipped, broken ones go on. RUNS is the folder of all runs, NEARL
# the program. A part of the seeds 0 to 4 alone is measured into the folder of the runs: the committed table has means over all five.
set -euo pipefail
cd "$(dirname "$0")/../.."
seeds=${1:-0-4} steps=${2:-300k} tasks=${3:-Hopper-v5 HalfCheetah-v5 Walker2d-v5 Ant-v5}
nearl=${NEARL:-target/release/nearl} runs=${RUNS:-runs}
demos=$runs/imitation variants=$runs/ablation folder=results/ablation
[ "$steps" = 300k ] || { variants=$variants/$steps folder=$folder/$steps; }

# half of the controllable joints of each task, the ones that matter left out
declare -A half=(
    [Hopper-v5]='["q.foot_joint","v.foot_joint"]'
    [HalfCheetah-v5]='["q.bfoot","v.bfoot","q.ffoot","v.ffoot","q.fshin","v.fshin"]'
    [Walker2d-v5]='["q.foot_joint","v.foot_joint","q.foot_left_joint","v.foot_left_joint","q.leg_left_joint","v.leg_left_joint"]'
    [Ant-v5]='["q.ankle_1","v.ankle_1","q.ankle_2","v.ankle_2","q.ankle_3","v.ankle_3","q.ankle_4","v.ankle_4"]')

go() { # name of the variant, then what it sets
    local name=$1 task=$2
    shift 2
    "$nearl" sweep --tasks $task --algos pid2-il --demos $demos/$task.npz --seeds "$seeds" --steps "$steps" --set train.n_envs=64 \
        --set train.n_steps=64 --set train.ppo.batch_size=128 --set train.ppo.log_std=-1.0 --set train.nets.policy=[64,64] \
        --set train.nets.value=[64,64] --set train.nets.discriminator=[64,64] --set train.eval_every=20000 --set train.eval_episodes=3 \
        --jobs "${JOBS:-2}" --out $variants/$name "$@"
}

for task in $tasks; do
    for threshold in 0.5 0.05; do
        go right_$threshold $task --set train.pid2.idm_threshold=$threshold
        go full_$threshold $task --set train.pid2.idm_threshold=$threshold --set 'idm.input="full"'
        go missing_$threshold $task --set train.pid2.idm_threshold=$threshold --set "idm.input=${half[$task]}"
    done
    go no_cloning $task --set train.demos.epochs=0
    go no_frames $task --set train.demos.resets=0.0
    go not_in_discriminator $task --set train.demos.in_discriminator=false
    go one_demo $task --set train.demos.episodes=1
    go four_demos $task --set train.demos.episodes=4
done
.venv/bin/python results/imitation/figure.py $variants $folder --experts results/imitation/experts --variants
for of in $folder $variants; do [ ! -e $of/curves.csv ] || .venv/bin/python results/ablation/ranks.py $of; done
