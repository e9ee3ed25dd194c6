#!/bin/sh
# Every URDF of example-robot-data 6.0.0 by our reader and by Pinocchio's own: which load, and whether the numbers are equal.
# Run from the repository root after 'make setup package'; the packages it compares with go into a folder of their own and away again.
set -e
here=$(dirname "$0")
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet --disable-pip-version-check example-robot-data==6.0.0 pin==4.1.0
robots="$work/venv/lib/python3.11/site-packages/cmeel.prefix/share/example-robot-data/robots"
"$work/venv/bin/python" "$here/reference.py" "$robots" > "$work/reference.jsonl"
.venv/bin/python "$here/compare.py" "$robots" "$work/reference.jsonl"
