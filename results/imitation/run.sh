#!/usr/bin/env bash
# Speed of learning with demonstrations (the paper's figure 4): DAPG, PID2-IL, SOIL and PPO, noise-free return from ordinary resets.
#     results/imitation/run.sh [SEEDS [STEPS [TASKS]]]      e.g. 0-4 1M "Hopper-v5 HalfCheetah-v5", which goes into results/imitation/1M
# Finished runs are skipped, broken ones go on. Other steps than 300k have runs of their own too. A part of the seeds 0 to 4 alone is measured into the folder
# of the runs: the committed table has means over all five.
set -euo pipefail
cd "$(dirname "$0")/../.."
seeds=${1:-0-4} steps=${2:-300k} tasks=${3:-Hopper-v5 HalfCheetah-v5 Walker2d-v5 Ant-v5}
runs=runs/imitation folder=results/imitation
demos=$runs
[ "$steps" = 300k ] || { runs=$runs/$steps folder=$folder/$steps; }
common=(--seeds "$seeds" --steps "$steps" --set train.n_envs=64 --set train.n_steps=64 --set train.ppo.batch_size=128 --set train.ppo.log_std=-1.0
    --set train.nets.policy=[64,64] --set train.nets.value=[64,64] --set train.nets.discriminator=[64,64]
    --set train.eval_every=20000 --set train.eval_episodes=3 --out $runs --jobs "${JOBS:-2}")

mkdir -p $runs
for task in $tasks; do
    [ -f $demos/$task.npz ] ||
        target/release/nearl demos record results/imitation/experts/$task.safetensors --out $demos/$task.npz --json > results/imitation/experts/$task.json
    target/release/nearl sweep --tasks $task --algos ppo "${common[@]}"
    target/release/nearl sweep --tasks $task --algos pid2-il,soil,dapg --demos $demos/$task.npz "${common[@]}"
done
.venv/bin/python results/imitation/figure.py $runs $folder --experts results/imitation/experts
