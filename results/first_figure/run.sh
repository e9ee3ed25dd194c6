#!/usr/bin/env bash
# The paper's first figure: four tasks, four algorithms, three seeds, a million steps each; about an hour on two idle cores. Then the
# three algorithms with targets again without the task's limits in training, beside the same PPO; about forty minutes.
# Then PID2-IB with an affine inverse model on Ant and Walker2d, five seeds, beside the same PPO; twenty minutes.
# Finished runs are skipped, broken ones go on.
set -euo pipefail
cd "$(dirname "$0")/../.."
tasks=HalfCheetah-v5,Hopper-v5,Walker2d-v5,Ant-v5
with=runs/first_figure without=runs/first_figure_without_prior affine=runs/first_figure_affine
nets=train.nets.idm=[32,32] # the same networks for all

draw() { # of the sweep $1, beside the same PPO, into the folder $2
    for task in "$1"/*/; do
        cp -rn "$with/$(basename "$task")"/ppo_* "$task"
    done
    .venv/bin/python results/curves.py "$1" "$2"
}

target/release/nearl sweep --tasks $tasks --algos ppo,nearl,pid2-gan,pid2-ib --seeds 0-2 --steps 1e6 --set "$nets" --out $with
.venv/bin/python results/curves.py $with results/first_figure

target/release/nearl sweep --tasks $tasks --algos nearl,pid2-gan,pid2-ib --seeds 0-2 --steps 1e6 --set "$nets" --set train.project_in_training=false --out $without
draw $without results/first_figure/without_prior

target/release/nearl sweep --tasks Walker2d-v5,Ant-v5 --algos pid2-ib --seeds 0-4 --steps 1e6 --set train.nets.idm=[] --out $affine
draw $affine results/first_figure/affine_inverse
