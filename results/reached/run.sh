#!/bin/sh
# Reached states outside the limits with and without the simulator's guard: results/reached/run.sh adds what is missing to reached.csv and writes
# table.md. The policies are the experts of results/imitation (PPO without any limit), and of pid2-ib those of RUNS, which it trains where they are missing.
# What has its lines in reached.csv is neither trained nor measured again, which in a fresh clone is all: move reached.csv away for that.
set -eu
cd "$(dirname "$0")/../.."
runs=${RUNS:-runs/reached}
nearl=${NEARL:-target/release/nearl}
python=${PYTHON:-.venv/bin/python}
out=results/reached/reached.csv
header="policy,task,guard,ticks,outside,unavoidable,began_inside,outside_from_inside,unavoidable_from_inside,mean_return,episodes,steps_per_second"
[ -e $out ] || echo $header > $out
missing() {
    ! grep -q "^$1,$2," $out || { echo "$out has $1 on $2: not measured again"; return 1; }
}
measure() {
    case $2 in # what costs most is 400 samples in each tick outside
        HalfCheetah-v5) ticks=8000 ;;
        Ant-v5) ticks=1000 ;;
        *) ticks=2000 ;;
    esac
    "$python" results/reached/measure.py "$2" "$3" "$ticks" | sed "s/^/$1,/" >> $out
}
for task in HalfCheetah-v5 Walker2d-v5 Ant-v5 Hopper-v5 HalfCheetah-velocity Walker2d-velocity Hopper-velocity; do
    of=${task%-*}-v5 # the same policy under both sets of limits
    ! missing PPO "$task" || measure PPO "$task" "results/imitation/experts/$of.safetensors"
done
for task in HalfCheetah-v5 HalfCheetah-velocity; do
    of=${task%-*}-v5
    missing PID2-IB "$task" || continue
    [ -d "$runs/$of" ] || "$nearl" train "$of" --algo pid2-ib --preset strong --steps 1M --seed 0 --threads 1 --out "$runs/$of" > /dev/null
    measure "PID2-IB" "$task" "$runs/$of/checkpoints/final.safetensors"
done
"$python" results/reached/table.py results/reached
