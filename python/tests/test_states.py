"""nearl.Link against a running loop: a MuJoCo arm and its runtime as processes."""

import subprocess
import uuid
from collections.abc import Iterator

import numpy as np
import pytest
from conftest import ROOT

import nearl

SNAPSHOT = ROOT / "examples" / "snapshots" / "panda-reach.safetensors"
NEARL = ROOT / "target" / "release" / "nearl"


@pytest.fixture(scope="module")
def arm() -> Iterator[str]:
    if not NEARL.exists():
        pytest.fail(f"{NEARL} was not built: run 'make build'")
    name = f"py-{uuid.uuid4().hex[:12]}"
    start = lambda *words: subprocess.Popen([NEARL, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)  # noqa: E731
    plant = start("plant", "Panda-reach", "--name", name, "--lockstep", "--json")
    runtime = start("run", SNAPSHOT, "--plant", name, "--explore", "3", "--json")
    yield name
    for process in (runtime, plant):
        process.terminate()
        out, error = process.communicate(timeout=30)
        assert process.returncode == 0, out + error


def ticks(link: nearl.Link, n: int) -> list:
    parts = [link.states()]
    while sum(map(len, parts)) < n:
        parts.append(link.states())
    return parts


def test_states_are_ticks_in_order_within_the_limits(arm: str) -> None:
    controller = nearl.Controller.load(SNAPSHOT)
    with nearl.Link(arm, patience=30.0) as link:
        parts = ticks(link, 500)
    tick = np.concatenate([p.tick for p in parts]).astype(int)
    assert (np.diff(tick) >= 1).all() and set(np.concatenate([p.mode for p in parts])) <= {"active", "degraded"}
    last = parts[-1]
    assert last.q.shape == last.target_q.shape == (len(last), 7) and last.obs.shape == (len(last), len(controller.obs_names))
    assert last.action.shape == (len(last), 7) and np.isfinite(last.action).all()
    assert not any(p.target_violations.any() for p in parts) and any(p.raw_violations.any() for p in parts)
    for p in parts:
        follows = (p.next_sequence[:-1] == p.sequence[1:]) & ~p.reset[:-1]
        # Analytic inverse dynamics: the state reached is the target.
        assert np.allclose(p.q[1:][follows], p.target_q[:-1][follows], atol=1e-6)
        assert np.array_equal(p.obs[:, :7], p.q) and (p.version == controller.version).all()


def test_a_push_is_answered_with_the_reason(arm: str) -> None:
    data = SNAPSHOT.read_bytes()
    with nearl.Link(arm, patience=30.0) as link:
        broken = link.push(data[:-1] + bytes([data[-1] ^ 1]))
        assert not broken.accepted and broken.code == "corrupt" and "digest" in broken.text and broken.tick == 0
        before = link.states().tick[-1]
        good = link.push(SNAPSHOT)
        assert good.accepted and good.code == "accepted" and good.tick > 0
        assert ticks(link, 50)[-1].tick[-1] > before
        with pytest.raises(FileNotFoundError):
            link.push("no-such-file.safetensors")
        with nearl.Link(arm, patience=30.0) as second, pytest.raises(ConnectionError, match="already has a trainer"):
            second.push(SNAPSHOT)


def test_no_loop_is_named_with_what_to_start() -> None:
    name = f"none-{uuid.uuid4().hex[:8]}"
    with pytest.raises(ConnectionError, match=f"nearl run SNAPSHOT --plant {name}"):
        nearl.Link(name, patience=0.05).states()
    with pytest.raises(ValueError, match="letters, digits"):
        nearl.Link("a/b").push(SNAPSHOT)
