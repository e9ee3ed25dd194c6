#!/usr/bin/env bash
# PPO and PID^2-IB on HalfCheetah and Hopper, one million steps, three seeds; about ten minutes on two cores.
# Finished runs are skipped. Then: .venv/bin/python results/first_million/curves.py
set -euo pipefail
cd "$(dirname "$0")/../.."
nearl=${NEARL:-target/release/nearl}
for task in HalfCheetah-v5 Hopper-v5; do
  for algo in ppo pid2-ib; do
    for seed in 0 1 2; do
      out=runs/first_million/$task/${algo}_$seed
      [ -f "$out/checkpoints/final.safetensors" ] && continue
      rm -rf "$out"
      "$nearl" train "$task" --algo "$algo" --steps 1000000 --seed "$seed" --out "$out"
    done
  done
done
