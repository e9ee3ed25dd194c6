"""What is made of finished runs: the figure of a sweep, TensorBoard's files, videos; and the same sweep with Ray."""

import importlib.util
import json
import os
import re
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic
from conftest import ROOT

import nearl
import nearl.tensorboard
import nearl.video
from nearl import curves, report
from nearl.report import sweep
from nearl.report.read import ReadError, read_run

CART_POLE = str(ROOT / "examples" / "tasks" / "cart-pole.toml")
ANYMAL = ROOT / "examples" / "snapshots" / "anymal-walk.safetensors"
PANDA = ROOT / "examples" / "snapshots" / "panda-reach.safetensors"


@pytest.fixture(scope="module")
def swept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("sweep")
    for task in ("Hopper-v5", "HalfCheetah-v5"):
        for algo, top in (("pid2-ib", 4000), ("ppo", 3000), ("nearl", 1000)):
            for seed in range(3):
                synthetic.run_folder(root, task, algo, seed, top)
    (root / "Hopper-v5" / "ppo_3").mkdir()
    (root / "Hopper-v5" / "ppo_3" / "metrics.csv").write_text("time/total_timesteps,rollout/ep_rew_mean\n")  # just begun
    return root


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = tmp_path_factory.mktemp("run") / "ppo_0"
    nearl.PID2(CART_POLE, algo="ppo", run=run).learn(20_000)
    return run


def test_the_figure_has_every_task_algorithm_and_seed(swept: Path) -> None:
    import matplotlib.pyplot as plt

    runs = sweep.read_sweep(swept)
    assert len(runs) == 18 and sweep.algorithms(runs) == ["ppo", "nearl", "pid2-ib"], "the paper's order"
    figure = sweep.figure(runs)
    panels = np.array(figure.axes).reshape(3, 2)  # no cost, no fourth row
    assert {axes.get_title(loc="left") for axes in panels[0]} == {"Hopper-v5", "HalfCheetah-v5"}
    for axes in panels[0]:
        assert len(axes.lines) == 3 * (3 + 1), "a thin line a seed and one for their mean"
        assert len({line.get_color() for line in axes.lines}) == 3
    for axes in panels[1]:
        assert axes.get_yscale() == "log" and any(line.get_linestyle() != "-" for line in axes.lines), "the threshold"
    found = [run.column("rollout/ep_rew_mean") for run in runs if (run.task, run.algo) == ("Hopper-v5", "ppo")]
    hopper = next(panel for panel in panels[0] if panel.get_title(loc="left") == "Hopper-v5")
    thick = next(line for line in hopper.lines if line.get_alpha() is None)
    np.testing.assert_allclose(thick.get_ydata(), curves.over_seeds(found).centre)
    plt.close(figure)


def test_the_command_writes_a_page_and_a_picture(swept: Path, tmp_path: Path) -> None:
    out = tmp_path / "first.html"
    subprocess.run([sys.executable, "-m", "nearl.report", str(swept), "--out", str(out)], check=True, capture_output=True)
    page = out.read_text()
    assert page.count("data:image/png") == 1 and not re.search(r"(src|href)=\"(?!data:)", page)
    assert out.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    row = next(r for r in sweep.table(sweep.read_sweep(swept)) if r[0] == "Hopper-v5, pid2-ib")
    found = [r.column("rollout/ep_rew_mean") for r in sweep.read_sweep(swept) if (r.task, r.algo) == ("Hopper-v5", "pid2-ib")]
    assert row[1] == "3" and float(row[3]) == pytest.approx(curves.over_seeds(found).centre[-1], abs=0.06) and row[3] in page
    assert row[7] == "0.00 %", "no target of the synthetic runs is outside"
    with pytest.raises(ReadError, match="holds no run with metrics"):
        report.build(out, sweeps=[tmp_path])


def test_the_mean_over_seeds_is_one_number_for_the_command_and_the_figures(tmp_path: Path) -> None:
    """It is written twice: in Rust for the table of `nearl sweep`, in Python for curves. Five seeds, so that values count in part."""
    command = [ROOT / "target" / "release" / "nearl", "sweep", "--tasks", CART_POLE, "--algos", "ppo", "--seeds", "0-4", "--steps", "2048", "--json"]
    told = json.loads(subprocess.run([*command, "--out", tmp_path], check=True, capture_output=True, text=True).stdout)
    (line,), runs = told["summary"], told["runs"]
    for key in ("return", "idm_loss", "steps_per_s"):
        assert line[key] == pytest.approx(curves.interquartile_mean([run[key] for run in runs]), rel=1e-12), key


def test_costs_have_their_own_row(tmp_path: Path) -> None:
    import matplotlib.pyplot as plt

    for task in ("with", "without"):
        run = tmp_path / task / "ppo_0"
        run.mkdir(parents=True)
        rows = "\n".join(f"{1000 * i},{i},{i if task == 'with' else 0}" for i in range(1, 5))
        (run / "metrics.csv").write_text(f"time/total_timesteps,rollout/ep_rew_mean,rollout/ep_cost_mean\n{rows}\n")
    figure = sweep.figure(sweep.read_sweep(tmp_path))
    assert len(figure.axes) == 4 and [len(axes.lines) for axes in figure.axes[2:]] == [1, 0]
    assert sweep.table(sweep.read_sweep(tmp_path))[0][-1] == "4.0", "where the curve ends"
    plt.close(figure)


def events(folder: Path) -> dict[str, list[tuple[int, float]]]:
    """The scalars in TensorBoard's record format, read by hand: length, its checksum, the message, its checksum."""
    from tensorboardX.proto.event_pb2 import Event

    (file,) = folder.glob("events.out.tfevents.*")
    content, at, found = file.read_bytes(), 0, {}
    while at < len(content):
        (length,) = struct.unpack_from("<Q", content, at)
        event: Any = Event.FromString(content[at + 12 : at + 12 + length])
        for value in event.summary.value:
            found.setdefault(value.tag, []).append((event.step, value.simple_value))
        at += length + 16
    return found


def test_tensorboard_sees_what_the_csv_holds(trained: Path) -> None:
    pytest.importorskip("tensorboardX")
    for _ in range(2):  # the second time replaces the first
        assert nearl.tensorboard.main([str(trained)]) == 0
        scalars = events(trained)
    metrics = read_run(trained).metrics
    assert {"rollout/ep_rew_mean", "time/fps", "train/approx_kl"} <= scalars.keys()
    for tag, values in scalars.items():
        good = np.isfinite(metrics[tag])
        assert [step for step, _ in values] == metrics["time/total_timesteps"][good].tolist()
        np.testing.assert_allclose([value for _, value in values], metrics[tag][good], rtol=1e-6)


def test_tensorboard_follows_a_training(tmp_path: Path) -> None:
    pytest.importorskip("tensorboardX")
    with nearl.tensorboard.Writer(tmp_path) as writer:
        nearl.PID2(CART_POLE, algo="ppo").learn(5_000, callback=writer)
    assert [step for step, _ in events(tmp_path)["train/approx_kl"]] == [2048, 3072, 4096, 5120]


def test_tensorboard_goes_along_with_a_run_folder(tmp_path: Path) -> None:
    """Rows that come later are written too, each once, and the last before it ends."""
    pytest.importorskip("tensorboardX")
    run, final = tmp_path / "ppo_0", tmp_path / "ppo_0" / "checkpoints" / "final.safetensors"
    final.parent.mkdir(parents=True)
    (run / "metrics.csv").write_text("time/total_timesteps,train/loss\n10,1\n20,2\n")

    def train() -> None:
        time.sleep(0.5)
        with (run / "metrics.csv").open("a") as rows:
            rows.write("30,3\n")
        time.sleep(0.3)
        with (run / "metrics.csv").open("a") as rows:
            rows.write("40,4\n")
        final.touch()

    trainer = threading.Thread(target=train)
    trainer.start()
    assert nearl.tensorboard.follow(run, every=0.1, seconds=60.0) == 4
    trainer.join()
    assert events(run)["train/loss"] == [(10, 1.0), (20, 2.0), (30, 3.0), (40, 4.0)]


def test_a_sentence_where_tensorboard_x_is_missing(trained: Path) -> None:
    code = f"import sys; sys.modules['tensorboardX'] = None; import nearl.tensorboard; sys.exit(nearl.tensorboard.main([{str(trained)!r}]))"
    failed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert failed.returncode == 1 and "pip install 'nearl[tensorboard]'" in failed.stderr and failed.stderr.count("\n") == 1


def video(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "nearl.video", *arguments]
    return subprocess.run(command, capture_output=True, text=True, env={**os.environ, "MUJOCO_GL": "egl", **environment})


@pytest.mark.parametrize("suffix", [".mp4", ".gif"])
def test_a_video_shows_the_robot_moving(trained: Path, tmp_path: Path, suffix: str) -> None:
    import imageio.v3 as imageio

    out = tmp_path / f"cart{suffix}"
    done = video(str(trained), str(out), "--seconds", "1", "--size", "160", "128")
    assert done.returncode == 0, done.stderr
    frames = np.stack([frame[..., :3] for frame in imageio.imiter(out)])
    assert done.stdout.strip() == f"{out}: 50 frames" and frames.shape[1:] == (128, 160, 3)
    assert len(frames) == 50 or suffix == ".gif", "50 frames of 20 ms; a GIF joins equal ones"
    assert frames[0].std() > 5 and np.abs(frames[0].astype(int) - frames[-1]).max() > 30


def test_a_robot_that_floats_is_filmed_on_its_floor(tmp_path: Path) -> None:
    """The policy sees the base's velocity, which is in no observation of the plant."""
    done = video(str(ANYMAL), str(tmp_path / "walk.gif"), "--seconds", "0.2", "--size", "160", "128")
    assert (done.returncode, done.stdout.strip()) == (0, f"{tmp_path}/walk.gif: 10 frames"), done.stderr


def test_a_robot_without_shapes_is_drawn_as_a_skeleton(tmp_path: Path) -> None:
    import imageio.v3 as imageio

    done = video(str(PANDA), str(tmp_path / "arm.mp4"), "--seconds", "0.1", "--size", "160", "128")
    assert done.returncode == 0, done.stderr
    assert imageio.imread(tmp_path / "arm.mp4", index=0).max() > 60, "not a black picture"


def test_a_sentence_where_nothing_can_render(trained: Path, tmp_path: Path) -> None:
    failed = video(str(trained), str(tmp_path / "x.mp4"), MUJOCO_EGL_DEVICE_ID="99")
    words = failed.stderr.strip().splitlines()[-1]
    assert failed.returncode == 1 and "MuJoCo cannot render with MUJOCO_GL=egl" in words and "apt install libegl1" in words
    assert "Traceback" not in failed.stderr
    (tmp_path / "file").touch()
    for place in ("/proc/x.mp4", str(tmp_path / "file/x.mp4")):
        failed = video(str(trained), place, "--seconds", "0.1")
        assert failed.returncode == 1 and failed.stderr.startswith(f"nearl video: cannot write '{place}': "), failed.stderr
        assert failed.stderr.endswith("; give another place\n") and failed.stderr.count("\n") == 1
    failed = video(str(trained), str(tmp_path / "x.mp4"), "--camera", "side")
    assert failed.returncode == 1 and "the robot has no camera 'side'; it has track" in failed.stderr


def test_a_training_ends_with_a_video_in_its_run_folder(tmp_path: Path) -> None:
    import imageio.v3 as imageio

    program = ROOT / "target" / "release" / "nearl"
    train = [str(program), "train", CART_POLE, "--algo", "ppo", "--steps", "4096", "--video", "--out"]
    done = subprocess.run([*train, str(tmp_path / "run")], capture_output=True, text=True, env={**os.environ, "NEARL_PYTHON": sys.executable})
    assert done.returncode == 0 and f"video {tmp_path / 'run' / 'video.mp4'}" in done.stdout, done.stderr
    assert imageio.imread(tmp_path / "run" / "video.mp4", index=0).std() > 5
    # what is missing is said before the training
    failed = subprocess.run([*train, str(tmp_path / "none")], capture_output=True, text=True, env={**os.environ, "NEARL_PYTHON": "/no/python"})
    assert failed.returncode == 1 and "cannot start '/no/python'" in failed.stderr and not (tmp_path / "none").exists()
    check = video("--check", MUJOCO_EGL_DEVICE_ID="99")
    assert check.returncode == 1 and "MuJoCo cannot render" in check.stderr and video("--check").returncode == 0


def ray_example() -> Any:
    spec = importlib.util.spec_from_file_location("ray_sweep", ROOT / "examples" / "ray_sweep.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_ray_example_trains_skips_and_repairs(tmp_path: Path) -> None:
    """The function that Ray calls, without Ray."""
    train = ray_example().train
    run, mean = train(CART_POLE, "ppo", 1, 4096, str(tmp_path), {"train.gamma": 0.98})
    snapshot = Path(run) / "checkpoints" / "final.safetensors"
    assert Path(run) == tmp_path / "cart-pole" / "ppo_1" and mean > 10
    written, digest = snapshot.stat().st_mtime_ns, nearl.Controller.load(snapshot).digest
    assert train(CART_POLE, "ppo", 1, 4096, str(tmp_path), {})[1] == pytest.approx(mean) and snapshot.stat().st_mtime_ns == written
    snapshot.unlink()
    train(CART_POLE, "ppo", 1, 4096, str(tmp_path), {"train.gamma": 0.98})
    assert nearl.Controller.load(snapshot).digest == digest


def test_the_ray_example_says_what_it_needs() -> None:
    if importlib.util.find_spec("ray"):
        pytest.skip("Ray is installed")
    command = [sys.executable, str(ROOT / "examples" / "ray_sweep.py"), "--tasks", "Hopper-v5", "--out", "x"]
    failed = subprocess.run(command, capture_output=True, text=True)
    assert failed.returncode == 1 and failed.stderr.strip() == "ray_sweep.py needs Ray: pip install ray"


@pytest.mark.parametrize("command", ["view", "report", "video", "tensorboard"])
def test_what_is_python_is_a_command_of_the_program(command: str, tmp_path: Path) -> None:
    """The program hands everything on, `--help` too; where a Python lacks the package it says what to do."""
    program = ROOT / "target" / "release" / "nearl"
    asked = [program, command, "--help"]
    told = subprocess.run(asked, env={**os.environ, "NEARL_PYTHON": sys.executable}, capture_output=True, text=True, timeout=120)
    assert told.returncode == 0 and told.stdout.startswith(f"usage: nearl {command}"), told.stdout + told.stderr
    bare = tmp_path / "python"
    bare.write_text(f'#!/bin/sh\nexec "{sys.executable}" -I -S "$@"\n')
    bare.chmod(0o755)
    refused = subprocess.run(asked, env={**os.environ, "NEARL_PYTHON": str(bare)}, capture_output=True, text=True, timeout=120)
    assert refused.returncode == 1 and "the Python package 'nearl' is not in it" in refused.stderr and "make package" in refused.stderr, refused.stderr
