#!/usr/bin/env bash
# The same training with environments of its own and with those of a rollout server, in turns; three rounds, median of the ratio. The
# weights must be equal, bit for bit.
set -euo pipefail
cd "$(dirname "$0")/../.."
nearl=target/release/nearl out=runs/collect
rm -rf "$out"
for task in ${TASKS:-HalfCheetah-v5 Hopper-v5 Walker2d-v5 Ant-v5}; do
    "$nearl" train "$task" --algo ppo --steps 8192 --out "$out/$task/served" --json > /dev/null
    "$nearl" serve "$out/$task/served" --name "collect-$$" --json > "$out/$task/server.json" &
    server=$!
    trap 'kill $server' EXIT
    for round in 1 2 3; do
        "$nearl" train "$task" --algo ppo --seed 1 --steps "${STEPS:-204800}" --out "$out/$task/here_$round" --json | tail -1
        "$nearl" train "$task" --algo ppo --seed 1 --steps "${STEPS:-204800}" --collect "collect-$$" --out "$out/$task/there_$round" --json | tail -1
        cmp "$out/$task/"{here,there}"_$round/checkpoints/final.safetensors"
    done > "$out/$task/rounds.jsonl"
    kill $server
    wait $server
    trap - EXIT
    python3 - "$task" "$out/$task/rounds.jsonl" <<'PYTHON'
import json, sys
task, file = sys.argv[1:]
rounds = [json.loads(line) for line in open(file)]
rate = [r["steps"] / r["seconds"] for r in rounds]
ratio = sorted(there / here for here, there in zip(rate[::2], rate[1::2]))
middle = lambda x: sorted(x)[len(x) // 2]
paired = " | ".join(f"{100 * share:.0f} %" for share in (middle(ratio), ratio[0], ratio[-1]))
print(f"| {task} | {middle(rate[::2]) / 1e3:.1f} k | {middle(rate[1::2]) / 1e3:.1f} k | {paired} |")
PYTHON
done
