#!/bin/sh
# Reached states outside the limits with and without the simulator's guard: results/reached/run.sh [STEPS] [TICKS] trains the policies (or takes
# those of RUNS) and writes reached.csv and table.md.
set -eu
cd "$(dirname "$0")/../.."
steps=${1:-200000}
ticks=${2:-4000}
runs=${RUNS:-$(mktemp -d)}
nearl=${NEARL:-target/release/nearl}
python=${PYTHON:-.venv/bin/python}
out=results/reached/reached.csv
echo "task,guard,ticks,outside,unavoidable,began_inside,outside_from_inside,unavoidable_from_inside,mean_return,episodes,steps_per_second" > "$out"
for task in HalfCheetah-v5 Hopper-v5 Walker2d-v5 Ant-v5 HalfCheetah-velocity Hopper-velocity; do
    of=${task%-*}-v5 # the same policy under both sets of limits
    run=$runs/$of/pid2-ib_1
    [ -d "$run" ] || "$nearl" train "$of" --algo pid2-ib --steps "$steps" --seed 1 --out "$run" > "$runs/$of.log" 2>&1
    "$python" results/reached/measure.py "$task" "$run/checkpoints/final.safetensors" "$ticks" >> "$out"
done
"$python" results/reached/table.py
