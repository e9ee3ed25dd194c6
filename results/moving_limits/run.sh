#!/usr/bin/env bash
# Limits that move, under attack: writes table.csv. About ten minutes on one core; nothing of it is a timing.
set -euo pipefail
cd "$(dirname "$0")/../.."
cargo run --release --locked -p nearl-constraints --example moving_limits -- "${1:-60}" > results/moving_limits/table.csv
