#!/usr/bin/env bash
# Flights under attack on two robots, recorded and verified from their logs; TICKS each (a million unless given), into this folder.
set -euo pipefail
cd "$(dirname "$0")/../.."
ticks=${TICKS:-1000000}
cargo build --release --locked -p nearl-runtime --bin nearl-runtime --example recorded
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
for flight in "panda 1" "xarm7 0"; do
    read -r robot sub_steps <<< "$flight"
    mkdir "$folder/$robot"
    target/release/examples/recorded "examples/robots/$robot/$robot.urdf" "$ticks" "$folder/$robot" "$sub_steps"
    log=$folder/$robot/attack.mcap
    target/release/nearl-runtime verify "$log" | sed "s|$log|$robot|" > "results/verify/$robot.txt" || true
    rm "$log"
done
