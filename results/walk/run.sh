#!/usr/bin/env bash
# ANYmal C learns to follow commands, is evaluated, and walks on a plant as a process of its own.
#     results/walk/run.sh [SEED [STEPS]]      0 20M unless given
# A run that stopped goes on.
set -euo pipefail
cd "$(dirname "$0")/../.."
seed=${1:-0} steps=${2:-20M}
nearl=target/release/nearl run=runs/walk/$seed
if [ -f "$run/task.toml" ]; then
    $nearl train examples/tasks/anymal-walk.toml --resume "$run" --steps "$steps" --threads 2
else
    $nearl train examples/tasks/anymal-walk.toml --algo ppo --steps "$steps" --threads 2 --seed "$seed" --out "$run"
fi
.venv/bin/python results/walk/evaluate.py "$run" "$run/checkpoints/final.safetensors"
results/walk/plant.sh "$run/checkpoints/final.safetensors" "$run/walk.mcap" 20
