#!/usr/bin/env bash
# A snapshot walks on a plant as a process of its own: two programs over shared memory, a flight log, and the log computed again.
#     results/walk/plant.sh [SNAPSHOT [LOG [SECONDS]]]
set -euo pipefail
cd "$(dirname "$0")/../.."
snapshot=${1:-examples/snapshots/anymal-walk.safetensors} log=${2:-runs/walk.mcap} seconds=${3:-20}
nearl=${NEARL:-target/release/nearl}
mkdir -p "$(dirname "$log")"
rm -f "$log"
$nearl plant "$snapshot" --name anymal --seconds "$((seconds + 4))" &
$nearl run "$snapshot" --plant anymal --seconds "$seconds" --log "$log"
wait
$nearl replay "$log"
