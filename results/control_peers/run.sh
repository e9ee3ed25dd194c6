#!/usr/bin/env bash
# Everything of this folder: attack-ROBOT.md and compare-ROBOT.md. Nothing else should run beside compare.py. TICKS (3000) and ATTACKED (5000) choose other
# numbers of ticks, which go into folders of their own, results/control_peers/1000 for 1000.
# Needs a Python of 3.11 or newer (klimits and placo have no wheels for some others) and, for NEARL itself, `make wheel`.
set -euo pipefail
cd "$(dirname "$0")"
PYTHON=${PYTHON:-python3}
HERE=${PEERS:-$PWD/.peers}
if [ ! -d "$HERE" ]; then
    "$PYTHON" -m venv "$HERE/main"
    "$HERE/main/bin/python" -m pip install --quiet pin==4.1.0 mujoco==3.17.0 pin-pink==4.4.0 mink==1.3.0 quadprog==0.1.14 klimits==1.1.3 \
        cbfpy==0.1.0 example-robot-data==6.0.0
    "$HERE/main/bin/python" -m pip install --quiet --no-deps ../../target/wheel/nearl-*.whl
    # placo has another Pinocchio.
    "$PYTHON" -m venv "$HERE/placo"
    "$HERE/placo/bin/python" -m pip install --quiet placo==0.10.2 mujoco==3.17.0
    "$HERE/placo/bin/python" -m pip install --quiet --no-deps example-robot-data==6.0.0
fi
export PLACO_PYTHON=$HERE/placo/bin/python OPENBLAS_NUM_THREADS=1 PYTHONWARNINGS=ignore
ticks=${TICKS:-3000} attacked=${ATTACKED:-5000} compared=. attacks=.
[ "$ticks" = 3000 ] || compared=$ticks
[ "$attacked" = 5000 ] || attacks=$attacked
mkdir -p "$compared" "$attacks"
for robot in panda z1; do
    "$HERE/main/bin/python" compare.py $robot "$ticks" > "$compared/compare-$robot.md"
    "$HERE/main/bin/python" attack.py $robot "$attacked" > "$attacks/attack-$robot.md"
done
