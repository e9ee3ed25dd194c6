#!/usr/bin/env bash
# Every hard kind of limit under attack, alone and combined, on two robots that are not bundled: z1.md, ur10.md and summary.md.
# All of it takes an hour of one core; PART=100 is a hundredth of the ticks and goes into results/attack/part-100. The URDFs are of the Python package
# example-robot-data 6.0.0.
set -euo pipefail
cd "$(dirname "$0")/../.."
part=${PART:-1} out=results/attack
[ "$part" = 1 ] || out=$out/part-$part
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip download --quiet --no-deps --dest "$folder" example-robot-data==6.0.0
robots=cmeel.prefix/share/example-robot-data/robots
unzip -q -j -d "$folder" "$folder"/example_robot_data-*.whl "$robots/z1_description/urdf/z1.urdf" \
    "$robots/ur_description/urdf/ur10_joint_limited_robot.urdf"
cargo build --release --locked -p nearl-constraints --example attack
# Ticks of each of the twelve lines of a kind: what is quick has more.
kinds="joints=1500000 locked=1100000 velocity_profile=1100000 jerk=400000 torque=50000 torque_speed=50000 rows=50000 mixed_rows=50000 frame=20000
    frame_speed=20000 energy=20000 collision=10000 all=3000 jerk+all=3000 torque+frame_speed=10000 torque+energy=10000 torque+frame=10000
    torque+collision=5000 torque+rows=20000"
attack() {
    for kind in $kinds; do
        target/release/examples/attack "$folder/$1" "$2" $((${kind#*=} / part)) "${kind%=*}"
    done | awk 'NR < 3 || !/^\|(---| limits )/'
}
attack z1.urdf link06 > "$folder/z1.md" &
attack ur10_joint_limited_robot.urdf tool0 > "$folder/ur10.md"
for job in $(jobs -p); do wait "$job"; done
mkdir -p "$out"
cp "$folder/z1.md" "$folder/ur10.md" "$out/"
python3 results/attack/summary.py "$out"
