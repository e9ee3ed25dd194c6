#!/usr/bin/env bash
# Flights under attack on two robots, recorded by a real loop and verified from their logs; TICKS each (a million unless given), into this folder.
set -euo pipefail
cd "$(dirname "$0")/../.."
ticks=${TICKS:-1000000}
cargo build --release --locked -p nearl-runtime --bin nearl-runtime --example recorded
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
for robot in panda/panda xarm7/xarm7; do
    name=$(basename "$robot")
    for sub_steps in 1 0; do
        target/release/examples/recorded "examples/robots/$robot.urdf" "$ticks" "$folder" "$sub_steps" > "$folder/recorded.txt"
        log=$(ls -t "$folder"/*.mcap | head -n 1)
        target/release/nearl-runtime verify "$log" --json > "results/verify/$name-$sub_steps.json" || true
        target/release/nearl-runtime verify "$log" | tail -n +1 | sed "s|$log|$name, $sub_steps physics steps|" > "results/verify/$name-$sub_steps.txt" || true
        rm -f "$log"
    done
done
