#!/bin/sh
# Reached states outside the limits with and without the simulator's guard: results/reached/run.sh [STEPS] writes reached.csv and table.md.
set -eu
cd "$(dirname "$0")/../.."
steps=${1:-1000000}
ticks=${2:-10000}
runs=${RUNS:-$(mktemp -d)}
nearl=${NEARL:-target/release/nearl}
out=results/reached/reached.csv
cargo build --release --locked -p nearl-trainer --bin nearl --example reached
: > "$out.part"
for task in HalfCheetah-v5 Hopper-v5 Walker2d-v5 Ant-v5 HalfCheetah-velocity Hopper-velocity Walker2d-velocity Ant-velocity; do
    [ -d "$runs/$task" ] || "$nearl" train "$task" --algo pid2-ib --steps "$steps" --seed 1 --out "$runs" > "$runs/$task.log" 2>&1
    target/release/examples/reached "$runs/$task/pid2-ib_1/checkpoints/final.safetensors" "$ticks" 3 >> "$out.part"
done
awk 'NR == 1 || !/^task,/' "$out.part" > "$out"
rm "$out.part"
python3 results/reached/table.py
