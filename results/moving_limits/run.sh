#!/usr/bin/env bash
# Limits that move, under attack: writes table.csv. Nothing of it is a timing.
#     results/moving_limits/run.sh [SECONDS]      10 of each line unless given; 60, some ten minutes of one core, go into results/moving_limits/60
set -euo pipefail
cd "$(dirname "$0")/../.."
seconds=${1:-10} folder=results/moving_limits
[ "$seconds" = 10 ] || folder=$folder/$seconds
mkdir -p "$folder"
cargo run --release --locked -p nearl-constraints --example moving_limits -- "$seconds" > "$folder/table.csv.part"
mv "$folder/table.csv.part" "$folder/table.csv"
