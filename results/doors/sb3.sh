#!/bin/sh
# Learners of Stable-Baselines3 with and without the limits: results/doors/sb3.sh [PPO_STEPS] [SAC_STEPS] [SEEDS] [PLACES] adds what is missing to
# sb3_learners.csv and writes sb3_learners.md.
set -eu
cd "$(dirname "$0")/../.."
ppo=${1:-6144}
sac=${2:-1200}
seeds=${3:-"0 1 2"}
places=${4:-"pendulum pendulum-guard"}
python=${PYTHON:-.venv/bin/python}
out=results/doors/sb3_learners
export OMP_NUM_THREADS=1
[ -e $out.csv ] || echo "learner,place,steps,seed,outside,ticks,asked,probe_outside,probe_ticks,before,after,seconds" > $out.csv
one() {
    grep -q "^$1,$2,$3,$4," $out.csv || "$python" results/doors/sb3.py learner "$1" "$2" "$3" "$4" >> $out.csv
}
for seed in $seeds; do
    for place in $places; do
        one ppo "$place" "$ppo" "$seed"
        one sac "$place" "$sac" "$seed"
    done
done
"$python" results/doors/sb3.py table > $out.md
