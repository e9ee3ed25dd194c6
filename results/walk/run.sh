#!/usr/bin/env bash
# ANYmal C learns to follow commands, is evaluated, and walks on a plant as a process of its own.
#     results/walk/run.sh [SEED [STEPS]]      0 20M unless given; other steps, 5M say, have runs of their own, in runs/walk/5M
# A run that stopped goes on. All of it stays in the run's folder; what is committed here is a copy of those of seed 0.
set -euo pipefail
cd "$(dirname "$0")/../.."
seed=${1:-0} steps=${2:-20M}
nearl=target/release/nearl runs=runs/walk
[ "$steps" = 20M ] || runs=$runs/$steps
run=$runs/$seed
if [ -f "$run/task.toml" ]; then
    $nearl train examples/tasks/anymal-walk.toml --resume "$run" --steps "$steps" --threads 2
else
    $nearl train examples/tasks/anymal-walk.toml --algo ppo --steps "$steps" --threads 2 --seed "$seed" --out "$run"
fi
.venv/bin/python results/walk/evaluate.py "$run" "$run/checkpoints/final.safetensors"
results/walk/plant.sh "$run/checkpoints/final.safetensors" "$run/walk.mcap" 20
