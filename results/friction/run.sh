#!/bin/sh
# Dry friction under attack: results/friction/run.sh ROBOT.urdf [TICKS] writes friction.csv and table.md. The committed data are of Unitree's z1
# (unitree_ros, robots/z1_description/xacro/z1.urdf).
set -eu
cd "$(dirname "$0")/../.."
"${PYTHON:-.venv/bin/python}" results/friction/attack.py "$@"
