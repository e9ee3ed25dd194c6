#!/usr/bin/env bash
# Policies of actions behind the guard, on a Panda in MuJoCo, attacked for NEARL_TICKS ticks (a million): writes guard.md. Minutes on two cores.
#     results/doors/guard.sh      # another number, NEARL_TICKS=50000 say, goes into results/doors/50000
set -euo pipefail
cd "$(dirname "$0")/../.."
export NEARL_TICKS=${NEARL_TICKS:-1000000}
folder=results/doors
[ "$NEARL_TICKS" = 1000000 ] || folder=$folder/$NEARL_TICKS
mkdir -p "$folder"
out=$folder/guard.md
{
    echo "| what | guard every | ticks | of them changed | positions over | speeds over | torques over | worst, rad, rad/s or N m |"
    echo "|---|---|---|---|---|---|---|---|"
} > "$out.part"
cargo test --release --locked -p nearl-tests --test suite -- guard::a_random guard::targets_of_drives --nocapture --test-threads 2 \
    | grep '^|' | sort >> "$out.part"
mv "$out.part" "$out"
cat "$out"
