#!/usr/bin/env bash
# Velocity tasks of Safety-Gymnasium: three tasks, four ways to learn, three seeds, a million steps each; about half an hour on two
# idle cores. Finished runs are skipped, broken ones go on.
set -euo pipefail
cd "$(dirname "$0")/../.."
sweep() { # name, then what is different
    target/release/nearl sweep --tasks HalfCheetah-velocity,Hopper-velocity,Walker2d-velocity --seeds 0-2 --steps 1e6 --out "runs/velocity/$1" "${@:2}"
}
sweep ppo --algos ppo
sweep free --algos pid2-ib --set train.project_in_training=false
sweep prior --algos pid2-ib
sweep tight --algos pid2-ib --set train.pid2.idm_threshold=0.02
.venv/bin/python results/velocity/table.py runs/velocity results/velocity
