#!/bin/sh
# Trains pid2-ib with the preset strong on HalfCheetah without `constraints.reached` and with 10, 5 and 1 %, and measures each; see README.md.
#     results/reached/dialled.sh [STEPS] [SEEDS] [RUNS]      e.g. 1M "0 1"; other steps than 1M, 300k say, go into results/reached/300k
# Runs that are in RUNS are skipped. Seeds that are not run stay what they are in dialled.csv.
set -eu
cd "$(dirname "$0")/../.."
steps=${1:-1M} seeds=${2:-0} runs=${3:-$(mktemp -d)} nearl=${NEARL:-target/release/nearl} folder=results/reached
[ "$steps" = 1M ] || { runs=$runs/$steps folder=$folder/$steps; }
for seed in $seeds; do
    for asked in none 0.1 0.05 0.01; do
        set=${asked#none}
        run=$runs/${asked}_$seed
        test -e "$run" || "$nearl" train HalfCheetah-v5 --algo pid2-ib --preset strong --steps "$steps" --seed "$seed" --threads 1 \
            ${set:+--set constraints.reached=$set} --out "$run"
    done
done
.venv/bin/python results/reached/dialled.py "$nearl" "$runs" "$folder" $seeds
