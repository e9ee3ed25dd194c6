#!/usr/bin/env bash
# Flights under attack on three robots, recorded and verified from their logs: a line each in flights.jsonl, then table.md. ROUNDS of all of them, each
# with seeds of its own, from SEED on. ur10_joint_limited_robot.urdf is of the Python package example-robot-data 6.0.0.
set -euo pipefail
cd "$(dirname "$0")/../.."
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip download --quiet --no-deps --dest "$folder" example-robot-data==6.0.0
unzip -q -j -d "$folder" "$folder"/example_robot_data-*.whl cmeel.prefix/share/example-robot-data/robots/ur_description/urdf/ur10_joint_limited_robot.urdf
cargo build --release --locked -p nearl-runtime --bin nearl-runtime --example recorded
seed=${SEED:-1}
for _ in $(seq "${ROUNDS:-1}"); do
    while read -r robot sub_steps dt kind ticks; do
        file=examples/robots/$robot/$robot.urdf
        [ "$robot" = ur10 ] && file=$folder/ur10_joint_limited_robot.urdf
        mkdir "$folder/flight"
        target/release/examples/recorded "$file" "$ticks" "$folder/flight" "$sub_steps" "$dt" "$seed" "$kind" > /dev/null
        target/release/nearl-runtime verify "$folder/flight/attack.mcap" --json > "$folder/found.json" || true
        python3 results/verify/table.py --add "$folder/found.json" "$robot" "$sub_steps" "$dt" "$kind" "$seed"
        rm -r "$folder/flight"
        seed=$((seed + 1))
    done < results/verify/flights.txt
done
python3 results/verify/table.py
