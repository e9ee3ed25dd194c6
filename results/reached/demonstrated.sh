#!/bin/sh
# HalfCheetah behind the simulator's guard from the first step, begun with what a policy without limits can do within them:
# results/reached/demonstrated.sh [TICKS] adds what is missing to trained.csv. RUNS may hold the trainings.
set -eu
cd "$(dirname "$0")/../.."
ticks=${1:-2000}
runs=${RUNS:-runs/reached}
nearl=${NEARL:-target/release/nearl}
python=${PYTHON:-.venv/bin/python}
task=HalfCheetah-v5
mkdir -p "$runs"
# of a policy that was trained without limits, the episodes behind the guard that still go well
[ -e "$runs/$task.npz" ] || "$nearl" demos record results/imitation/experts/$task.safetensors --set 'constraints.guard="simulator"' --episodes 40 \
    --at-least 6000 --out "$runs/$task.npz"
for seed in ${SEEDS:-0 1 2}; do
    run=$runs/$task-demonstrated-$seed
    [ -d "$run" ] || "$nearl" train $task --algo dapg --demos "$runs/$task.npz" --preset strong --steps 1M --seed "$seed" --threads 1 \
        --set 'constraints.guard="simulator"' --out "$run" > /dev/null
    grep -q "^demonstrated $seed,$task," results/reached/trained.csv ||
        "$python" results/reached/measure.py $task "$run/checkpoints/final.safetensors" "$ticks" | sed "s/^/demonstrated $seed,/" >> results/reached/trained.csv
done
"$python" results/reached/table.py
