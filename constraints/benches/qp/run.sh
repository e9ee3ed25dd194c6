#!/usr/bin/env bash
# Our stages beside other solvers on the same problems, in turns, in thread CPU time; writes the table of results/qp/README.md.
# Needs Python 3.11, a C compiler and the network: the other solvers are fetched for this comparison alone, into target/qp.
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
root=$(cd "$here/../../.." && pwd)
work=${QP_WORK:-$root/target/qp}
rounds=${ROUNDS:-3}
mkdir -p "$work"
cd "$work"

[ -x venv/bin/python ] || "${PYTHON:-python3.11}" -m venv venv
venv/bin/python -m pip install --quiet --disable-pip-version-check --requirement "$here/requirements.txt"
[ -f hum29.bin ] || venv/bin/python "$here/gen.py" .

# DAQP in C, from its source distribution, with the flags of its own setup.py and with those of this processor.
version=0.11.0 sha256=2f27baf18d2acca14186498e651b34e0bed455627e777d3fd8ba655e7e40f920
if [ ! -d "daqp-$version" ]; then
  venv/bin/python -m pip download --quiet --no-deps --no-build-isolation --no-binary daqp --dest . "daqp==$version"
  echo "$sha256  daqp-$version.tar.gz" | sha256sum --check --quiet
  tar xf "daqp-$version.tar.gz"
fi
flags="-O3 -fassociative-math -fno-signed-zeros -fno-trapping-math"
sources=daqp-$version/csrc
gcc $flags -I"$sources/include" "$here/daqp.c" "$sources"/src/*.c -lm -o daqp
gcc $flags -march=native -I"$sources/include" "$here/daqp.c" "$sources"/src/*.c -lm -o daqp-native

cd "$root"
cargo bench --no-run --quiet -p nearl-constraints --bench qp
for round in $(seq "$rounds"); do
  out=$work/round$round
  rm -rf "$out" && mkdir -p "$out"
  cargo bench --quiet -p nearl-constraints --bench qp -- --out "$out" "$work"/{arm7,quad12,hum29}.bin
  for file in arm7 quad12 hum29; do
    "$work/daqp" "$work/$file.bin" "$out/$file.DAQP (C, warm).txt"
    "$work/daqp-native" "$work/$file.bin" "$out/$file.DAQP (C, warm, -march=native).txt"
  done
  "$work/venv/bin/python" "$here/peers.py" "$out" "$work"/{arm7,quad12,hum29}.bin
done
"$work/venv/bin/python" "$here/table.py" "$work" "$root/results/qp/README.md"
