#!/usr/bin/env bash
# Each repair of PID2-IB that is a setting, by itself, beside what the task files set: a million steps each, some 25 minutes on two idle cores.
# Finished runs are skipped. RUNS is the folder of runs. The policy does not keep its actions, as in the figure (run.sh), whose runs stand beside these.
set -euo pipefail
cd "$(dirname "$0")/../.."
runs=${RUNS:-runs/first_figure_switches}

go() { # name, task, algorithm, seeds, then what is set
    local name=$1 task=$2 algo=$3 seeds=$4
    shift 4
    target/release/nearl sweep --tasks "$task" --algos "$algo" --seeds "$seeds" --steps 1e6 --set train.pid2.keep_actions=false --out "$runs/$name" "$@"
}

for task in HalfCheetah-v5 Hopper-v5; do
    go stale_fakes $task pid2-ib 0-2 --set train.pid2.fresh_fakes=false
    go matched_noise $task pid2-ib 0-2 --set train.pid2.match_noise=true
    go own_optimiser $task pid2-ib 0-2 --set train.pid2.generator_lr=3e-4
    go gradient_penalty $task pid2-ib 0-2 --set train.pid2.gradient_penalty=1.0
    go row_threshold $task pid2-ib 0-2 --set 'train.pid2.idm_threshold_per="row"'
done
go stale_fakes Walker2d-v5 pid2-ib 0-4 --set train.pid2.fresh_fakes=false
go slow_discriminator Walker2d-v5 pid2-ib 0-2 --set train.pid2.discriminator_lr=1e-4
for task in HalfCheetah-v5 Hopper-v5 Walker2d-v5 Ant-v5; do
    go both_networks $task ppo-combined 0-2
done
.venv/bin/python results/first_figure/switches.py "$runs" results/first_figure
