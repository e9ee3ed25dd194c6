"""A Python that does nothing but hold its lock, with a controller and a rollout under way, does not hold up the loop."""

import ctypes
import json
import subprocess
import threading
import time
import uuid
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT
from mcap.reader import make_reader

import nearl

SNAPSHOT = ROOT / "examples" / "snapshots" / "panda-reach.safetensors"
NEARL = ROOT / "target" / "release" / "nearl"


STARTED: list[subprocess.Popen] = []


@pytest.fixture(autouse=True)
def nothing_is_left() -> Iterator[None]:
    """Processes end with the test, however it ends."""
    yield
    for process in STARTED:
        process.kill()
        process.wait()


def start(*arguments: str) -> subprocess.Popen:
    STARTED.append(subprocess.Popen([NEARL, *map(str, arguments)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True))
    return STARTED[-1]


def end(process: subprocess.Popen) -> str:
    process.terminate()
    out, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    return out


def hold_the_lock(seconds: float) -> tuple[int, int]:
    """Sleeps inside a C call that keeps the lock; monotonic begin and end [ns]."""
    begin = time.monotonic_ns()
    ctypes.PyDLL(None).usleep(int(seconds * 1e6))
    return begin, time.monotonic_ns()


# Seconds the lock is held, and left, in turns.
HELD, TURNS = 0.25, 8


def goes_on(starts: np.ndarray, held: list[tuple[int, int]]) -> bool:
    """Whether ticks begin late in the holds, by the median: a loop that a tick made wait for the lock has none there."""
    return bool(np.median([((starts > (begin + finish) // 2) & (starts < finish)).sum() for begin, finish in held]) > 0)


def test_a_loop_that_waits_for_the_lock_in_one_tick_of_many_is_found() -> None:
    millisecond = 1_000_000
    grid = np.arange(4000) * millisecond
    held = [(k * 500 * millisecond, (k * 500 + 250) * millisecond) for k in range(8)]
    assert goes_on(grid, held)
    # A tick that needs the lock ends with the hold, and those after it wait with it.
    waits = np.any([(grid >= begin + 7 * millisecond) & (grid < finish) for begin, finish in held], axis=0)
    assert not goes_on(grid[~waits], held)


def test_the_loop_runs_on_while_python_holds_its_lock(tmp_path: Path) -> None:
    if not NEARL.exists():
        pytest.fail(f"{NEARL} was not built: run 'make build'")
    name, log = f"gil-{uuid.uuid4().hex[:8]}", tmp_path / "flight.mcap"
    plant = start("plant", "Panda-reach", "--name", name, "--endless", "--json")
    server = start("serve", SNAPSHOT, "--name", f"{name}-s", "--threads", "1")
    server.stdout.readline()
    runtime = start("run", SNAPSHOT, "--plant", name, "--log", log, "--json")
    controller = nearl.Controller.load(SNAPSHOT)
    with nearl.Link(f"{name}-s") as link:
        rollout = link.rollout(seed=0, n_steps=100_000)
        first = next(rollout)
        turns, over = [], threading.Event()

        def count() -> None:
            while not over.is_set():
                turns.append(time.monotonic_ns())
                time.sleep(0.001)

        counter = threading.Thread(target=count)
        counter.start()
        while not log.exists() or log.stat().st_size < 1_000_000:  # the loop runs
            assert runtime.poll() is None, runtime.communicate()
            time.sleep(0.01)
        held = []
        for _ in range(TURNS):
            held.append(hold_the_lock(HELD))
            time.sleep(HELD)
        over.set()
        counter.join()
        assert len(first) > 0 and np.isfinite(next(rollout).obs).all() and controller is not None
        rollout.close()
    margin = 50_000_000
    for begin, finish in held:
        assert not [t for t in turns if begin + margin < t < finish - margin], "no Python thread ran: the lock was held"
    report, moved = json.loads(end(runtime)), json.loads(end(plant))
    end(server)
    with log.open("rb") as file:
        messages = make_reader(file).iter_messages(topics=["tick"])
        ticks = [json.loads(message.data) for _, _, message in messages]
    starts = np.array([tick["begin_ns"] for tick in ticks])
    # How many ticks a second the machine makes is its own affair; that none waits for the lock, not.
    assert goes_on(starts, held), "no tick began late in the holds"
    assert report["modes"]["fault"] == 0 and report["counters"]["target_violations"] == 0, report
    assert moved["violations"]["torque"] == 0, moved
