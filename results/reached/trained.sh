#!/bin/sh
# Hopper without the simulator's guard and trained behind it, 0.05 rad before the joints' soft stops: results/reached/trained.sh [STEPS] [TICKS] adds
# what is missing to trained.csv. Other steps than 200000, or other ticks than 2000, go into results/reached/STEPS-TICKS. RUNS may hold the trainings.
# What has its lines there is neither trained nor measured again, which in a fresh clone is both: move trained.csv away for that.
set -eu
cd "$(dirname "$0")/../.."
steps=${1:-200000}
ticks=${2:-2000}
runs=${RUNS:-$(mktemp -d)}
nearl=${NEARL:-target/release/nearl}
python=${PYTHON:-.venv/bin/python}
folder=results/reached
[ "$steps-$ticks" = 200000-2000 ] || folder=$folder/$steps-$ticks
[ "$steps" = 200000 ] || runs=$runs/$steps
out=$folder/trained.csv
mkdir -p "$folder"
counts=ticks,outside,unavoidable,began_inside,outside_from_inside,unavoidable_from_inside
[ -e "$out" ] || echo "trained,task,guard,$counts,mean_return,episodes,steps_per_second" > "$out"
mkdir -p "$runs"
train() {
    name=$1
    shift
    ! grep -q "^$name," "$out" || { echo "$out has '$name': not trained and not measured again"; return 0; }
    [ -d "$runs/$name" ] || "$nearl" train Hopper-v5 --algo pid2-ib --steps "$steps" --seed 1 "$@" --out "$runs/$name" > "$runs/$name.log" 2>&1
}
train without
train behind --set 'constraints.guard="simulator"' --set constraints.position.margin=0.05
for name in without behind; do
    grep -q "^$name," "$out" && continue
    "$python" results/reached/measure.py Hopper-v5 "$runs/$name/checkpoints/final.safetensors" "$ticks" 0.05 | sed "s/^/$name,/" >> "$out"
done
"$python" results/reached/table.py "$folder"
