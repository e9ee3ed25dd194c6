#!/bin/sh
# Dry friction under attack: results/friction/run.sh ROBOT.urdf [TICKS] writes table.md. The committed table is of Unitree's z1 (unitree_ros,
# robots/z1_description/xacro/z1.urdf).
set -eu
cd "$(dirname "$0")/../.."
NEARL_ROBOT=$(realpath "$1") NEARL_TICKS=${2:-2000} cargo test --release --locked -p nearl-tests --test suite friction::table -- --ignored --nocapture |
    grep '^|' > results/friction/table.md
