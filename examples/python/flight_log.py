"""A plant and a loop for half a second, with a flight log, and what the log says: Foxglove opens the same file. Needs `pip install mcap`."""

import json
import os
import subprocess
import sys
from collections import Counter

try:
    from mcap.reader import make_reader
except ImportError as error:
    raise SystemExit(f"flight_log.py needs mcap, but {error}: pip install mcap") from None

file = sys.argv[1] if len(sys.argv) > 1 else "runs/arm.mcap"
nearl = [sys.executable, "-m", "nearl"]
name = f"example{os.getpid()}"
os.makedirs(os.path.dirname(file) or ".", exist_ok=True)
plant = subprocess.Popen([*nearl, "plant", "Panda-reach", "--name", name, "--lockstep", "--seconds", "5"], stdout=subprocess.DEVNULL)
try:
    run = ["run", "examples/snapshots/panda-reach.safetensors", "--plant", name, "--seconds", "0.5", "--log", file]
    subprocess.run([*nearl, *run], check=True)
finally:
    plant.terminate()
    plant.wait()

with open(file, "rb") as log:
    reader = make_reader(log)
    facts = {key: value for record in reader.iter_metadata() for key, value in record.metadata.items()}
    ticks = [json.loads(message.data) for _, _, message in reader.iter_messages(topics=["tick"])]
statuses = json.loads(facts["statuses"])
print(len(ticks), "ticks:", dict(Counter(statuses[str(tick["ledger"]["status"])] for tick in ticks if tick["action"])))
assert not any(tick["ledger"]["target_violations"] for tick in ticks if tick["action"])
subprocess.run([*nearl, "replay", file], check=True)  # every one computed again, bit for bit
