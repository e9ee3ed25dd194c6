#!/bin/sh
# A robot and a trainer on two hosts, shown on one machine: each host is a network namespace with shared memory and temporary
# files of its own, so that nothing but the tunnel connects them. Needs root, `make build`, and the tunnel of iceoryx2:
#
#     cargo install --locked --version 0.10.0 iceoryx2-integrations-zenoh-link-tunnel-cli
#
# On two real machines, run the lines after "robot" on one and those after "trainer" on the other.
set -eu
cd "$(dirname "$0")/../.."
nearl=$PWD/target/release/nearl
out=$PWD/runs/two_hosts
pace=${PACE:---lockstep} # PACE="--priority 40": in real time, where the system allows a real-time priority
seconds=${SECONDS_OF_FLIGHT:-60} # of flight; learning takes about half of it
command -v iox2-link-tunnel-zenoh >/dev/null || {
    echo "iox2-link-tunnel-zenoh was not found: install it as the head of this file says, and put it on the PATH" >&2
    exit 1
}
[ "$(id -u)" = 0 ] || { echo "namespaces need root: run this with sudo" >&2; exit 1; }
rm -rf "$out"
mkdir -p "$out"

host() { # a namespace that lives until the script ends
    unshare --net --mount --pid --fork --kill-child \
        sh -c 'mount -t tmpfs tmpfs /dev/shm && mount -t tmpfs tmpfs /tmp && ip link set lo up && exec sleep 100000' >/dev/null 2>&1 &
}
host; holder_a=$!
host; holder_b=$!
trap 'kill -KILL $holder_a $holder_b' EXIT # `unshare` waits through SIGTERM; with it ends whatever runs in its namespaces
sleep 1
a=$(pgrep -P $holder_a) b=$(pgrep -P $holder_b)
ip link add nearl-a netns "$a" type veth peer name nearl-b netns "$b"
robot() { nsenter -t "$a" -n -m -p --wd="$PWD" env TMPDIR=/tmp "$@"; }
trainer() { nsenter -t "$b" -n -m -p --wd="$PWD" env TMPDIR=/tmp "$@"; }
robot ip addr add 10.77.0.1/24 dev nearl-a; robot ip link set nearl-a up
trainer ip addr add 10.77.0.2/24 dev nearl-b; trainer ip link set nearl-b up

# robot: the arm, its loop, and the tunnel that waits
robot "$nearl" plant Panda-reach --name arm $pace --json > "$out/plant.json" &
plant=$!
robot "$nearl" run examples/snapshots/panda-reach.safetensors --plant arm --explore 0 --rollback-factor 5 --seconds "$seconds" --json > "$out/loop.json" &
loop=$!
robot "$nearl" tunnel arm --listen tcp/0.0.0.0:7447 --out "$out/robot" > "$out/tunnel-robot.log" 2>&1 &

# trainer: the tunnel that connects, and learning from the loop
trainer "$nearl" tunnel arm --connect tcp/10.77.0.1:7447 --out "$out/trainer" > "$out/tunnel-trainer.log" 2>&1 &
trainer "$nearl" train Panda-reach --from arm --steps 1024 --set train.n_steps=8 --set train.ppo.batch_size=64 --out "$out/train" \
    || echo "the training ended early" >&2

wait $loop
pkill -TERM -P "$(pgrep -P $plant)" # shell, nsenter, plant; in lockstep the plant's time stands still without a loop
wait $plant
python3 - "$out" <<'PYTHON'
import csv, json, sys
out = sys.argv[1]
loop = json.load(open(f"{out}/loop.json"))
rows = list(csv.DictReader(open(f"{out}/train/metrics.csv")))
plant = json.load(open(f"{out}/plant.json"))
print(json.dumps({"loop": loop, "plant": plant, "iterations": len(rows), "last": rows[-1]}, indent=1))
PYTHON
