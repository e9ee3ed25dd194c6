"""The examples for Ray on a local one: what its workers make is what one process makes, bit for bit."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT

import nearl

SMALL = {"train.n_envs": 8, "train.n_steps": 64, "train.ppo.batch_size": 512}


def run(example: str, *arguments: object) -> str:
    """What an example prints. Its workers find the package where this process does."""
    pytest.importorskip("ray", reason=f"{example} needs Ray: pip install ray")
    path = os.pathsep.join([p for p in (str(Path(nearl.__file__).parents[1]), os.environ.get("PYTHONPATH")) if p])
    environment = {**os.environ, "PYTHONPATH": path, "RAY_USAGE_STATS_ENABLED": "0", "RAY_TRAIN_ENABLE_CONTROLLER_STRUCTURED_LOGGING": "0"}
    command = [sys.executable, str(ROOT / "examples" / example), *map(str, arguments)]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-3000:]
    return done.stdout


def test_a_sweep_trains_what_one_process_trains(tmp_path: Path) -> None:
    told = run(
        "ray_sweep.py", "--tasks", "Hopper-v5", "--algos", "ppo,pid2-ib", "--seeds", "0,1", "--steps", 1024, "--out", tmp_path,
        *(word for key, value in SMALL.items() for word in ("--set", f"{key}={value}")),
    )  # fmt: skip
    runs = sorted(p.name for p in (tmp_path / "Hopper-v5").iterdir())
    assert runs == ["pid2-ib_0", "pid2-ib_1", "ppo_0", "ppo_1"] and all(name in told for name in runs)
    for name in ("ppo_1", "pid2-ib_0"):
        algo, seed = name.split("_")
        nearl.PID2("Hopper-v5", algo, seed=int(seed), threads=1, settings=SMALL, run=tmp_path / name).learn(1024)
        files = [folder / "checkpoints" / "final.safetensors" for folder in (tmp_path / name, tmp_path / "Hopper-v5" / name)]
        assert files[0].read_bytes() == files[1].read_bytes()


def test_rollouts_are_the_same_whoever_plays_them(tmp_path: Path) -> None:
    snapshot = ROOT / "examples/snapshots/panda-reach.safetensors"
    files = [tmp_path / f"{workers}.npz" for workers in (1, 2)]
    for workers, file in enumerate(files, 1):
        told = run("ray_rollouts.py", snapshot, "--workers", workers, "--episodes", 3, "--out", file)
        assert "3 episodes" in told and " 0 targets outside" in told
    one, two = (np.load(file) for file in files)
    assert set(one.files) == {"observations", "actions", "rewards", "lengths"}
    assert all((one[name] == two[name]).all() for name in one.files) and one["rewards"].shape == (one["lengths"].sum(),)


def test_two_workers_of_ray_train_learn_the_weights_of_one_process(tmp_path: Path) -> None:
    pytest.importorskip("torch", reason="ray_train.py needs torch: pip install 'ray[train]' torch")
    run(
        "ray_train.py", "Hopper-v5", "--workers", 2, "--steps", 2048, "--n-envs", 8, "--n-steps", 64, "--batch-size", 512,
        "--out", tmp_path / "two",
    )  # fmt: skip
    nearl.PID2("Hopper-v5", "pid2-ib", threads=1, settings=SMALL, run=tmp_path / "one").learn(2048)
    one, two = (tmp_path / name / "checkpoints" / "final.safetensors" for name in ("one", "two"))
    assert one.read_bytes() == two.read_bytes()
