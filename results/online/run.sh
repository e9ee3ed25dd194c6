#!/usr/bin/env bash
# Learning from a running loop, seed by seed: a loop in lockstep (faster than real time), and a trainer that pushes snapshots back. Everything goes into OUT
# (runs/online, with other STEPS than 100000 a folder of their number in it); before.json and after.json of a seed have the returns.
set -euo pipefail
cd "$(dirname "$0")/../.."
nearl=${NEARL:-target/release/nearl}
task=${TASK:-HalfCheetah-v5}
steps=${STEPS:-100000}
out=${OUT:-runs/online}
[ "$steps" = 100000 ] || out=$out/$steps
mkdir -p "$out"
for seed in ${SEEDS:-0 1}; do
    dir=$out/$seed
    # A policy that has learned nothing: the first batch only fills the statistics.
    "$nearl" train "$task" --steps 2048 --seed "$seed" --out "$dir/first" >/dev/null
    name=online-$seed-$$
    "$nearl" plant "$task" --name "$name" --lockstep --seed "$seed" --json >"$dir/plant.json" & plant=$!
    "$nearl" run "$dir/first/checkpoints/final.safetensors" --plant "$name" --explore "$seed" --rollback-window 0 --json >"$dir/run.json" & loop=$!
    "$nearl" train "$task" --from "$name" --steps "$steps" --seed "$seed" --threads 1 --json --out "$dir/train" >"$dir/train.jsonl"
    kill $loop; wait $loop
    kill $plant; wait $plant
    "$nearl" eval "$dir/first" --episodes 5 --json >"$dir/before.json"
    "$nearl" eval "$dir/train" --episodes 5 --json >"$dir/after.json"
done
