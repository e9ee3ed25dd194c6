#!/bin/sh
# Every URDF of example-robot-data 6.0.0 by our reader and by Pinocchio's own: which load, and whether the numbers are equal.
# Run from the repository root after 'make setup package', with any Python from 3.10 on (PYTHON=python3.12 results/robots/run.sh).
# The packages it compares with go into a folder of their own and away again.
set -e
here=$(dirname "$0")
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
"${PYTHON:-python3}" -m venv "$work/venv"
python="$work/venv/bin/python"
"$python" -m pip install --quiet --disable-pip-version-check example-robot-data==6.0.0 pin==4.1.0
site=$("$python" -c 'import sysconfig; print(sysconfig.get_paths()["purelib"])')
robots="$site/cmeel.prefix/share/example-robot-data/robots"
[ -d "$robots" ] || { echo "$robots is not there: does example-robot-data 6.0.0 still keep its robots in it?" >&2; exit 1; }
"$python" "$here/reference.py" "$robots" > "$work/reference.jsonl"
.venv/bin/python "$here/compare.py" "$robots" "$work/reference.jsonl"
