#!/bin/sh
# Learners of Stable-Baselines3 with and without the limits: results/doors/sb3.sh [SEEDS_OF_PPO] [SEEDS_OF_SAC] adds what is missing to sb3_learners.csv
# and writes sb3_learners.md. About an hour of one core; a seed of PPO alone ("0" "") a quarter of one.
set -eu
cd "$(dirname "$0")/../.."
python=${PYTHON:-.venv/bin/python}
out=results/doors/sb3_learners
export OMP_NUM_THREADS=1
head="learner,place,steps,seed,outside,ticks,asked,probe_outside,probe_ticks,before,after,seconds,targets"
[ -e $out.csv ] || echo $head > $out.csv
some() { # LEARNER STEPS SEED PLACES
    for place in $4; do
        grep -q "^$1,$place,$2,$3," $out.csv || "$python" results/doors/sb3.py learner "$1" "$place" "$2" "$3" >> $out.csv
    done
}
cheetah="cheetah cheetah-guard"
arm="arm arm-raw torque torque-guard"
for seed in ${1-0 1 2}; do
    some ppo 6144 "$seed" "pendulum pendulum-guard"
    some ppo 100000 "$seed" "$cheetah"
    some ppo 40000 "$seed" "$arm"
done
for seed in ${2-0}; do
    some sac 1200 "$seed" "pendulum pendulum-guard"
    some sac 10000 "$seed" "$cheetah"
    some sac 4000 "$seed" "arm arm-raw"
done
"$python" results/doors/sb3.py table > $out.md
