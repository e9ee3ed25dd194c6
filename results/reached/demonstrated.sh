#!/bin/sh
# HalfCheetah behind the simulator's guard from the first step, begun with what a policy without limits can do within them:
# results/reached/demonstrated.sh [TICKS] adds what is missing to trained.csv. Other ticks than 2000 go into results/reached/demonstrated-TICKS. RUNS may hold
# the trainings.
# A seed that has its lines there is neither trained nor measured again, which in a fresh clone is all of 0 to 2: move trained.csv away for that, or give other
# SEEDS.
set -eu
cd "$(dirname "$0")/../.."
ticks=${1:-2000}
runs=${RUNS:-runs/reached}
nearl=${NEARL:-target/release/nearl}
python=${PYTHON:-.venv/bin/python}
task=HalfCheetah-v5
mkdir -p "$runs"
folder=results/reached
[ "$ticks" = 2000 ] || folder=$folder/demonstrated-$ticks
out=$folder/trained.csv
mkdir -p "$folder"
counts=ticks,outside,unavoidable,began_inside,outside_from_inside,unavoidable_from_inside
[ -e "$out" ] || echo "trained,task,guard,$counts,mean_return,episodes,steps_per_second" > "$out"
missing=
for seed in ${SEEDS:-0 1 2}; do
    if grep -q "^demonstrated $seed,$task," "$out"; then echo "$out has seed $seed: not trained and not measured again"; else missing="$missing $seed"; fi
done
[ -n "$missing" ] || exit 0
# of a policy that was trained without limits, the episodes behind the guard that still go well
[ -e "$runs/$task.npz" ] || "$nearl" demos record results/imitation/experts/$task.safetensors --set 'constraints.guard="simulator"' --episodes 40 \
    --at-least 6000 --out "$runs/$task.npz"
for seed in $missing; do
    run=$runs/$task-demonstrated-$seed
    [ -d "$run" ] || "$nearl" train $task --algo dapg --demos "$runs/$task.npz" --preset strong --steps 1M --seed "$seed" --threads 1 \
        --set 'constraints.guard="simulator"' --out "$run" > /dev/null
    "$python" results/reached/measure.py $task "$run/checkpoints/final.safetensors" "$ticks" | sed "s/^/demonstrated $seed,/" >> "$out"
done
"$python" results/reached/table.py "$folder"
