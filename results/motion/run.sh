#!/usr/bin/env bash
# A clip of a G1 tracked by PID2-IL without a reward, torque limits on: joint error, share of the clip survived, largest force, a film.
#     results/motion/run.sh [STEPS [SEED]]
# The clip comes from holosoma's package at the time of the run and is not kept. A run that was broken off goes on.
set -euo pipefail
cd "$(dirname "$0")/../.."
steps=${1:-10M} seed=${2:-0}
runs=runs/motion run=runs/motion/g1-motion/pid2-il_$seed
clip=holosoma/data/motions/g1_29dof/whole_body_tracking/sub3_largebox_003_mj.npz

if [ ! -f $runs/g1.toml ]; then
    mkdir -p $runs
    .venv/bin/python -m pip download --quiet --no-deps --only-binary :all: --dest $runs holosoma==0.0.3
    .venv/bin/python -m zipfile -e $runs/holosoma-0.0.3-py3-none-any.whl $runs/package
    .venv/bin/python results/motion/clip.py $runs/package/$clip $runs 152
    rm -r $runs/package
fi
if [ -d $run ]; then
    [ -f $run/checkpoints/final.safetensors ] || target/release/nearl train $runs/g1.toml --resume $run
else
    target/release/nearl train $runs/g1.toml --algo pid2-il --demos $runs/clip.npz --steps "$steps" --seed "$seed" --out $run
fi
MUJOCO_GL=egl .venv/bin/python results/motion/table.py $run $runs/clip.npz results/motion
