#!/usr/bin/env bash
# A Panda and an xArm7 bring their hand to a goal, trained on the robot of the file and on random ones, then evaluated on plants that differ.
#     results/transfer/run.sh [SEEDS [STEPS]]      e.g. 0-4 1M, which goes into results/transfer/1M
# Finished runs are skipped, broken ones go on. Seeds that are not run stay what they are in the data.
set -euo pipefail
cd "$(dirname "$0")/../.."
seeds=${1:-0-4} steps=${2:-600k}
runs=runs/transfer tasks=results/transfer folder=results/transfer
[ "$steps" = 600k ] || { runs=$runs/$steps folder=$folder/$steps; }

# What differs grows with what an environment has learned.
random=(--set 'curriculum={ step = 0.1, up = "reward.near > 0.01", down = "reward.near < 0.005" }'
    --set 'random={ mass = "1 + 0.3 * level * uniform", strength = { all = "1 + level * (0.15 * uniform - 0.1)" } }'
    --set 'noise={ q = "0.005 * level * normal", v = "0.05 * level * normal" }' --set 'delay={ action = "level * (1.5 + 1.5 * uniform)" }')
history=(--set 'policy.observation=[{ term = "joint_pos", history = 3 }, { term = "joint_vel", history = 3 },
    { term = "observed", entries = ["command.x - x.link_eef", "command.y - y.link_eef", "command.z - z.link_eef"], history = 3 },
    { term = "last_action", history = 3 }]')

# sweep KIND TASK ALGORITHM [SETTINGS...]
sweep() {
    target/release/nearl sweep --tasks "$tasks/$2.toml" --algos "$3" --seeds "$seeds" --steps "$steps" --jobs "${JOBS:-2}" --out "$runs/$1" "${@:4}"
}
sweep plain panda pid2-ib
sweep plain xarm7 ppo
sweep random panda pid2-ib "${random[@]}"
sweep random xarm7 ppo "${random[@]}"
sweep history xarm7 ppo "${random[@]}" "${history[@]}"
.venv/bin/python "$tasks/table.py" "$runs" "$folder"
