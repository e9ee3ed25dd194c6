#!/bin/sh
# Dry friction under attack: results/friction/run.sh ROBOT.urdf [TICKS] writes table.md. The committed table is of Unitree's z1 (unitree_ros,
# robots/z1_description/xacro/z1.urdf) and 2000 ticks; another file's goes into results/friction/ROBOT, other ticks into a folder of their number.
set -eu
[ $# -ge 1 ] || { echo "usage: results/friction/run.sh ROBOT.urdf [TICKS]" >&2; exit 2; }
robot=$(realpath "$1") ticks=${2:-2000}
cd "$(dirname "$0")/../.."
name=$(basename "$robot" .urdf) folder=results/friction
[ -f "$robot" ] || { echo "results/friction/run.sh: '$robot' is no file" >&2; exit 1; }
[ "$name" = z1 ] || folder=$folder/$name
[ "$ticks" = 2000 ] || folder=$folder/$ticks
mkdir -p "$folder"
NEARL_ROBOT=$robot NEARL_TICKS=$ticks cargo test --release --locked -p nearl-tests --test suite friction::table -- --ignored --nocapture |
    grep '^|' > "$folder/table.md.part"
mv "$folder/table.md.part" "$folder/table.md"
