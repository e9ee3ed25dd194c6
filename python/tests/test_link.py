"""nearl.Link against a server in another process: the same bits again, what a chunk holds, refusals, cancelling."""

import os
import subprocess
import sys
import uuid
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT

import nearl
from nearl.link import LARGEST_SNAPSHOT, RolloutRefused

SNAPSHOT = ROOT / "examples" / "snapshots" / "panda-reach.safetensors"
NEARL = ROOT / "target" / "release" / "nearl"


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    if not NEARL.exists():
        pytest.fail(f"{NEARL} was not built: run 'make build'")
    name = f"py-{uuid.uuid4().hex[:12]}"
    command = [NEARL, "serve", SNAPSHOT, "--name", name, "--requests", "2", "--max-steps", "100000", "--threads", "2"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert "Panda-reach" in process.stdout.readline()
    yield name
    process.terminate()
    out, _ = process.communicate(timeout=30)
    assert process.returncode == 0, out


def rows(link: nearl.Link, **request) -> np.ndarray:
    chunks = list(link.rollout(**request))
    assert [c.sequence for c in chunks] == list(range(len(chunks)))
    assert [c.first_step for c in chunks] == list(np.cumsum([0] + [len(c) for c in chunks[:-1]]))
    return np.concatenate([np.column_stack([c.obs, c.proposal, c.target, c.action, c.reward, c.log_prob_proposal]) for c in chunks])


def test_the_same_request_gives_the_same_bits_whoever_asks(server: str) -> None:
    with nearl.Link(server) as link:
        first = rows(link, seed=4, n_steps=300)
        other = link.rollout(seed=9, n_steps=100_000)
        next(other)
        assert rows(link, seed=4, n_steps=300).tobytes() == first.tobytes()
        other.close()
        assert rows(link, seed=5, n_steps=300).tobytes() != first.tobytes()
    program = f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r}); import nearl, test_link; "
    program += f"sys.stdout.buffer.write(test_link.rows(nearl.Link({server!r}), seed=4, n_steps=300).tobytes())"
    assert subprocess.run([sys.executable, "-c", program], capture_output=True, check=True).stdout == first.tobytes()


def test_a_chunk_is_what_the_controller_does(server: str) -> None:
    """The first proposal, target and action, computed here by the snapshot's own controller."""
    controller = nearl.Controller.load(SNAPSHOT)
    with nearl.Link(server) as link:
        chunk = next(link.rollout(seed=1, n_steps=50, noise=False))
    n, n_obs = len(chunk), len(controller.obs_names)
    assert chunk.obs.shape == chunk.next_obs.shape == (n, n_obs)
    assert chunk.target.shape == chunk.proposal.shape == (n, len(controller.state_names))
    going = ~(chunk.terminated | chunk.truncated)[:-1]
    assert np.array_equal(chunk.obs[1:][going], chunk.next_obs[:-1][going])
    action = controller.act(chunk.obs[0])
    assert np.allclose(controller.proposal, chunk.proposal[0], atol=1e-9)
    assert action.shape == chunk.action[0].shape and np.isfinite(chunk.action).all()
    assert (chunk.ledger["ticks"] >= 1).all() and not chunk.ledger["target_violations"].any()
    assert chunk.version == controller.version and len(chunk.ledger) == 11


def test_without_constraints_the_targets_break_them(server: str) -> None:
    with nearl.Link(server) as link:
        own = list(link.rollout(seed=2, n_steps=400))
        off = list(link.rollout(seed=2, n_steps=400, constraints=False))
        same = list(link.rollout(seed=2, n_steps=400, constraints=own[0].constraints))
    assert sum(c.ledger["target_violations"].sum() for c in own) == 0
    assert sum(c.ledger["target_violations"].sum() for c in off) > 0
    assert all(np.array_equal(a.action, b.action) for a, b in zip(own, same, strict=True))


def test_refusals_say_why(server: str) -> None:
    refused = [
        ({"n_steps": 100_001}, "limit-exceeded", "100001 steps"),
        ({"n_steps": 1, "version": 987}, "bad-request", "not 987"),
        ({"n_steps": 1, "constraints": 5}, "bad-request", "constraint set"),
    ]
    with nearl.Link(server) as link:
        for request, answer, words in refused:
            with pytest.raises(RolloutRefused, match=words) as error:
                next(link.rollout(seed=0, **request))
            assert error.value.answer == answer
        for request in ({"seed": -1, "n_steps": 1}, {"seed": 0, "n_steps": 0}, {"seed": 0, "n_steps": 1, "constraints": -3}):
            with pytest.raises(ValueError, match="give"):
                link.rollout(**request)
        held = [link.rollout(seed=i, n_steps=100_000) for i in range(2)]
        for rollout in held:
            next(rollout)
        with pytest.raises(RuntimeError, match="read or cancel one"):
            link.rollout(seed=0, n_steps=1)
        with nearl.Link(server) as other, pytest.raises(RolloutRefused, match="rollout-busy"):
            next(other.rollout(seed=0, n_steps=1))
        for rollout in held:
            rollout.cancel()
            assert sum(len(chunk) for chunk in rollout) < 100_000
        assert len(rows(link, seed=0, n_steps=10)) == 10


def test_no_server_is_named_with_what_to_start() -> None:
    name = f"none-{uuid.uuid4().hex[:8]}"
    with pytest.raises(ConnectionError, match=f"nearl serve SNAPSHOT --name {name}"):
        nearl.Link(name, patience=0.05).rollout(seed=0, n_steps=1)
    with pytest.raises(ValueError, match="letters, digits"):
        nearl.Link("a/b").rollout(seed=0, n_steps=1)


def test_a_server_that_is_killed_is_gone_and_not_silent() -> None:
    name = f"py-{uuid.uuid4().hex[:12]}"
    process = subprocess.Popen([NEARL, "serve", SNAPSHOT, "--name", name], stdout=subprocess.PIPE, text=True)
    assert "Panda-reach" in process.stdout.readline()
    with nearl.Link(name, patience=60.0) as link:
        rollout = iter(link.rollout(seed=0, n_steps=1_000_000))
        next(rollout)
        process.kill()
        with pytest.raises(ConnectionError, match=f"the rollout server `{name}` is gone"):
            list(rollout)
    process.communicate(timeout=30)


def test_a_push_of_what_no_snapshot_can_be_is_refused_unread(tmp_path) -> None:
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "endless").symlink_to("/dev/zero")
    with open(tmp_path / "large", "wb") as file:
        file.truncate(LARGEST_SNAPSHOT + 1)
    link = nearl.Link(f"none-{uuid.uuid4().hex[:8]}", patience=0.05)
    odd, too_large = "it is not a regular file", f"it has {2**28 + 1} bytes, more than the limit of {2**28}"
    for name, why in (("fifo", odd), ("endless", odd), ("large", too_large)):
        with pytest.raises(OSError, match=f"^cannot read snapshot '{tmp_path / name}': {why}; give a snapshot file or a run folder$"):
            link.push(tmp_path / name)
    with pytest.raises(ConnectionError):
        link.push(SNAPSHOT)
