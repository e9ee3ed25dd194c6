"""One training on several ranks: the weights of one rank, whoever carries the bytes."""

import os
import socket
import subprocess
import sys
import threading
from pathlib import Path

import pytest

import nearl
from nearl import ranks

SETTINGS = {"train.n_envs": 8, "train.n_steps": 128, "train.ppo.batch_size": 512, "train.ppo.n_epochs": 2}
STEPS = 5 * 1024


class Round:
    """Ranks that are threads of this process; after ``last`` calls they reach each other no more."""

    def __init__(self, size: int, last: int | None = None):
        self.size, self.last = size, last
        self.places: list[bytes] = [b""] * size
        self.barrier = threading.Barrier(size)

    def of(self, rank: int) -> "Seat":
        return Seat(self, rank)


class Seat:
    def __init__(self, ring: Round, rank: int):
        self.ring, self.rank, self.size, self.calls = ring, rank, ring.size, 0

    def gather(self, mine: bytes) -> bytes:
        self.calls += 1
        if self.ring.last is not None and self.calls > self.ring.last:
            raise ConnectionError("the cable is out")
        self.ring.places[self.rank] = mine
        self.ring.barrier.wait(60)
        everything = b"".join(self.ring.places)
        self.ring.barrier.wait(60)
        return everything


def agent(**more: object) -> nearl.PID2:
    return nearl.PID2("HalfCheetah-v5", "pid2-ib", seed=3, threads=1, settings=SETTINGS, **more)  # type: ignore[arg-type]


def saved(one: nearl.PID2, path: Path) -> bytes:
    one.save(path)
    return path.read_bytes()


def together(size: int, work) -> list:
    found: list = [None] * size

    def run(rank: int) -> None:
        try:
            found[rank] = work(rank)
        except Exception as error:
            found[rank] = error

    threads = [threading.Thread(target=run, args=(rank,)) for rank in range(size)]
    [thread.start() for thread in threads]
    [thread.join() for thread in threads]
    return found


@pytest.fixture(scope="module")
def alone(tmp_path_factory) -> bytes:
    return saved(agent().learn(STEPS), tmp_path_factory.mktemp("alone") / "one.safetensors")


def test_two_ranks_learn_the_weights_of_one(alone: bytes, tmp_path: Path) -> None:
    ring = Round(2)
    weights = together(2, lambda rank: saved(agent(ranks=ring.of(rank)).learn(STEPS), tmp_path / f"{rank}.safetensors"))
    assert weights[0] == alone and weights[1] == alone, weights


def test_a_rank_that_is_left_alone_stops_with_a_checkpoint_that_goes_on(alone: bytes, tmp_path: Path) -> None:
    ring, run = Round(2, last=20), tmp_path / "run"

    def work(rank: int) -> None:
        agent(ranks=ring.of(rank), run=run if rank == 0 else None).learn(STEPS)

    ends = together(2, work)
    assert all(isinstance(end, ValueError) and "the cable is out" in str(end) for end in ends), ends
    rest = nearl.PID2.load(run, threads=1)
    assert 0 < rest.num_timesteps < STEPS
    assert saved(rest.learn(STEPS - rest.num_timesteps), tmp_path / "rest.safetensors") == alone


def test_ranks_that_do_not_do_the_same_are_refused() -> None:
    ring = Round(2)

    def work(rank: int) -> None:
        nearl.PID2("HalfCheetah-v5", "ppo", seed=rank, threads=1, settings=SETTINGS, ranks=ring.of(rank)).learn(STEPS)

    for end in together(2, work):
        assert "ranks" in str(end) and "seed" in str(end), end


def test_a_missing_variable_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("torch", reason="two ranks need torch: pip install torch")
    for name in ("WORLD_SIZE", "SLURM_PROCID"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(ValueError, match="WORLD_SIZE"):
        nearl.Ranks()


SCRIPT = """
import os, sys, nearl
settings, steps, out, dies = eval(sys.argv[1]), int(sys.argv[2]), sys.argv[3], int(sys.argv[4])
ranks = nearl.Ranks(timeout=120)
run = f"{out}/run"
if os.path.isdir(run) and dies < 0:
    agent = nearl.PID2.load(run, threads=1, ranks=ranks)
else:
    agent = nearl.PID2("HalfCheetah-v5", "pid2-ib", seed=3, threads=1, settings=settings, run=run, ranks=ranks)
def killed(agent, metrics):
    if ranks.rank == 1 and agent.num_timesteps == dies:
        os.kill(os.getpid(), 9)
agent.learn(steps - agent.num_timesteps, callback=killed).save(f"{out}/{ranks.rank}.safetensors")
"""


def free_port() -> str:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return str(free.getsockname()[1])


def by_variables(rank: int, port: str) -> dict[str, str]:
    return {"WORLD_SIZE": "2", "RANK": str(rank), "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port}


def by_slurm(rank: int, port: str) -> dict[str, str]:
    """As `srun --ntasks 2` sets them on one host; the port is told, as two tests may run at once."""
    return {
        "SLURM_PROCID": str(rank), "SLURM_LOCALID": str(rank), "SLURM_NTASKS": "2", "SLURM_STEP_NODELIST": "localhost", "SLURM_JOB_ID": "4711",
        "SLURM_JOB_NODELIST": "localhost", "MASTER_PORT": port,
    }  # fmt: skip


def start(folder: Path, dies: int, variables=by_variables) -> list[tuple[int, str]]:
    """Exit code and last words of two ranks by torch, the second of which may die after so many steps."""
    port = free_port()
    command = [sys.executable, "-c", SCRIPT, repr(SETTINGS), str(STEPS), str(folder), str(dies)]
    processes = [subprocess.Popen(command, env={**os.environ, **variables(rank, port)}, stderr=subprocess.PIPE, text=True) for rank in range(2)]
    said = [process.communicate(timeout=300)[1] for process in processes]
    return [(process.returncode, words) for process, words in zip(processes, said)]


@pytest.mark.parametrize("variables", [by_variables, by_slurm])
def test_torch_hands_the_bytes_round(variables, alone: bytes, tmp_path: Path) -> None:
    pytest.importorskip("torch", reason="two ranks need torch: pip install torch")
    ends = start(tmp_path, -1, variables)
    assert [code for code, _ in ends] == [0, 0], ends
    assert {(tmp_path / f"{rank}.safetensors").read_bytes() for rank in range(2)} == {alone}


def test_torchrun_starts_two_ranks(alone: bytes, tmp_path: Path) -> None:
    pytest.importorskip("torch", reason="two ranks need torch: pip install torch")
    program = tmp_path / "train.py"
    program.write_text(SCRIPT)
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", "2", "--master-addr", "127.0.0.1", "--master-port", free_port()]
    subprocess.run([*torchrun, program, repr(SETTINGS), str(STEPS), tmp_path, "-1"], check=True, timeout=300)
    assert {(tmp_path / f"{rank}.safetensors").read_bytes() for rank in range(2)} == {alone}


@pytest.mark.parametrize(
    "hosts, first",
    [("node[01-03,07],gpu5", "node01"), ("a,b", "a"), ("localhost", "localhost"), ("rack[2,4]n[11-12]", "rack2n11"), ("n[3-7]-ib,m", "n3-ib")],
)
def test_the_first_host_of_a_list_of_slurms(hosts: str, first: str) -> None:
    assert ranks.first_host(hosts) == first


def test_what_is_set_stays_where_slurm_says_otherwise() -> None:
    told = {**by_slurm(1, "29500"), "MASTER_ADDR": "10.0.0.1"}
    ranks.take_slurm(told)
    assert [told[k] for k in ("RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT")] == ["1", "2", "10.0.0.1", "29500"]
    del told["MASTER_PORT"]
    ranks.take_slurm(told)
    assert told["MASTER_PORT"] == "19711", "15000 and the last digits of the job"
    nothing: dict[str, str] = {}
    ranks.take_slurm(nothing)
    assert nothing == {}


def test_a_killed_rank_leaves_a_checkpoint_that_two_ranks_go_on_from(alone: bytes, tmp_path: Path) -> None:
    pytest.importorskip("torch", reason="two ranks need torch: pip install torch")
    (first, words), (second, _) = start(tmp_path, dies=2048)
    assert (first, second) == (1, -9) and "rank 0 of 2 was left alone after" in words, (first, second, words)
    ends = start(tmp_path, dies=-1)
    assert [code for code, _ in ends] == [0, 0], ends
    assert {(tmp_path / f"{rank}.safetensors").read_bytes() for rank in range(2)} == {alone}
