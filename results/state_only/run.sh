#!/usr/bin/env bash
# Imitation of states alone and without the reward of the task, four demonstrations: PID2-IL, GAIfO and BCO, share of the expert's return.
#     results/state_only/run.sh [SEEDS [STEPS [TASKS]]]      e.g. 0-2 1M, which goes into results/state_only/1M
# The discriminators learn at a tenth of the usual rate: at that, returns on the way are lost again.
# Demonstrations are those of results/imitation, the first four. Finished runs are skipped, broken ones go on. A part of the seeds that are there alone is
# measured into the folder of the runs: the committed tables have means over all of them.
set -euo pipefail
cd "$(dirname "$0")/../.."
seeds=${1:-0-2} steps=${2:-300k} tasks=${3:-Hopper-v5 HalfCheetah-v5 Walker2d-v5 Ant-v5}
runs=runs/state_only folder=results/state_only
[ "$steps" = 300k ] || { runs=$runs/$steps folder=$folder/$steps; }
common=(--seeds "$seeds" --steps "$steps" --set train.n_envs=64 --set train.n_steps=64 --set train.ppo.batch_size=128 --set train.ppo.log_std=-1.0
    --set train.nets.policy=[64,64] --set train.nets.value=[64,64] --set train.nets.discriminator=[64,64] --set train.demos.episodes=4
    --set train.pid2.discriminator_lr=3e-5
    --set train.eval_every=20000 --set train.eval_episodes=3 --out $runs --jobs "${JOBS:-2}")

mkdir -p $runs runs/imitation
for task in $tasks; do
    demos=runs/imitation/$task.npz
    [ -f $demos ] || target/release/nearl demos record results/imitation/experts/$task.safetensors --out $demos
    target/release/nearl sweep --tasks $task --algos gaifo,bco --demos $demos "${common[@]}"
    target/release/nearl sweep --tasks $task --algos pid2-il --demos $demos --set 'train.demos.reward="likeness"' --set train.nets.idm=[32,32] \
        --set train.nets.idm_residual=true --set train.pid2.idm_threshold=0.1 "${common[@]}"
done
.venv/bin/python results/imitation/figure.py $runs $folder --experts results/imitation/experts
