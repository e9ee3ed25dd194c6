#!/usr/bin/env bash
# Every hard kind of limit under attack, alone and combined, on two robots that are not bundled: z1.md and ur10.md. TICKS for each line of the tables.
# Their URDFs are of the Python package example-robot-data 6.0.0.
set -euo pipefail
cd "$(dirname "$0")/../.."
ticks=${TICKS:-4000}
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip download --quiet --no-deps --dest "$folder" example-robot-data==6.0.0
robots=cmeel.prefix/share/example-robot-data/robots
unzip -q -j -d "$folder" "$folder"/example_robot_data-*.whl "$robots/z1_description/urdf/z1.urdf" \
    "$robots/ur_description/urdf/ur10_joint_limited_robot.urdf"
cargo build --release --locked -p nearl-constraints --example attack
kinds="joints torque torque_speed velocity_profile locked frame frame_speed energy collision rows all jerk jerk+all
    torque+frame_speed torque+energy torque+frame torque+collision torque+rows"
# shellcheck disable=SC2086
target/release/examples/attack "$folder/z1.urdf" link06 "$ticks" $kinds > results/attack/z1.md
# shellcheck disable=SC2086
target/release/examples/attack "$folder/ur10_joint_limited_robot.urdf" tool0 "$ticks" $kinds > results/attack/ur10.md
python3 results/attack/summary.py
