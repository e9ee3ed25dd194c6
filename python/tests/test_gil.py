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


def share_of_ticks(starts: np.ndarray, held: list[tuple[int, int]]) -> float:
    """Ticks a second while the lock was held, as a share of those in the pause after it: the median over the turns."""
    shares = []
    for (begin, finish), (following, _) in zip(held, [*held[1:], (starts[-1], 0)], strict=True):
        inside = ((starts >= begin) & (starts < finish)).sum() / (finish - begin)
        outside = ((starts >= finish) & (starts < following)).sum() / (following - finish)
        shares.append(inside / outside)
    return float(np.median(shares))


def keeps_pace(starts: np.ndarray, held: list[tuple[int, int]]) -> bool:
    """A loop that loses one tick in twenty only while the lock is held does not."""
    return share_of_ticks(starts, held) > 0.95


def test_a_loop_that_loses_a_tenth_of_its_ticks_under_the_lock_is_found() -> None:
    millisecond = 1_000_000
    grid = np.arange(2000) * millisecond
    held = [(k * 500 * millisecond, (k * 500 + 250) * millisecond) for k in range(4)]
    under = np.any([(grid >= begin) & (grid < finish) for begin, finish in held], axis=0)
    lost = under & (np.cumsum(under) % 10 == 0)
    assert under.sum() == 1000
    assert lost.sum() == 100
    assert keeps_pace(grid, held)
    assert not keeps_pace(grid[~lost], held)


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
    # How many ticks a second the machine makes is its own affair; that they are as many with the lock as without, not.
    assert keeps_pace(starts, held), f"{share_of_ticks(starts, held):.3f} of the ticks a second without the lock"
    assert report["modes"]["fault"] == 0 and report["counters"]["target_violations"] == 0, report
    assert moved["violations"]["torque"] == 0, moved
