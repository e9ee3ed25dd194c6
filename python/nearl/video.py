"""A video of a trained policy or of demonstrations, through MuJoCo's own renderer, on a machine without a screen.

    nearl video runs/HalfCheetah-v5/pid2-ib_0 cheetah.mp4
    nearl video demos.npz demos.mp4 --task HalfCheetah-v5
"""

import argparse
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from nearl import _core
from nearl.arguments import task_of
from nearl.pid2 import PID2
from nearl.render import Frame, Renderer, VideoError


def record(
    run: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    episodes: int = 1,
    seconds: float | None = None,
    fps: float = 50.0,
    size: tuple[int, int] = (640, 480),
    camera: str | None = None,
    seed: int = 0,
    task: str | os.PathLike[str] | None = None,
) -> int:
    """Writes episodes without exploration, or demonstrated ones, as a video.

    Args:
        run: Run folder, snapshot file, or demonstrations (``.npz``).
        out: ``.mp4`` (needs imageio-ffmpeg) or ``.gif``.
        episodes: Number of episodes.
        seconds: Cuts each episode after so much simulated time [s].
        fps: Frames per second at most; the video plays in real time.
        size: Width and height [pixel].
        camera: A camera of the robot file; by default its ``track``, else one that follows the robot.
        seed: Of the first initial state.
        task: Of the demonstrations, name or file.

    Returns:
        Number of frames.

    Raises:
        VideoError: no renderer, no encoder, or no place to write to.
        OSError: the run cannot be read.
        ValueError: demonstrations without their task, or of another robot.
    """
    _check_writable(Path(out))
    if Path(run).suffix == ".npz":
        if task is None:
            raise ValueError(f"'{run}' are demonstrations; say of which task with task= (--task)")
        frames, period = _demonstrated(run, _core.Env(task_of(task)), episodes, seconds, fps, size, camera)
    else:
        controller, env = PID2.load(run).controller, _core.Env.of_snapshot(run)
        stride = max(1, round(1.0 / (fps * env.dt)))
        frames, period = _frames(controller, env, episodes, seconds, stride, size, camera, seed), stride * env.dt
    try:
        import imageio

        options: dict[str, Any] = {"loop": 0} if Path(out).suffix == ".gif" else {"macro_block_size": 2}
        with imageio.get_writer(out, fps=1.0 / period, **options) as writer:
            n = 0
            for frame in frames:
                writer.append_data(frame)
                n += 1
    except ImportError as error:
        raise VideoError(f"writing a video needs imageio and imageio-ffmpeg: pip install 'nearl[video]' ({error})") from error
    except ValueError as error:
        if "Could not find a backend" in str(error) or "backend" in str(error):
            raise VideoError(f"'{out}' cannot be written: for .mp4 do pip install 'nearl[video]', or write a .gif") from error
        raise
    return n


def _check_writable(out: Path) -> None:
    """Before anything is drawn: an encoder that cannot write says so in words of its own."""
    is_new = not out.exists()
    try:
        with out.open("ab"):
            pass
    except OSError as error:
        raise VideoError(f"cannot write '{out}': {error.strerror}; give another place") from error
    if is_new:
        out.unlink()


def _frames(
    controller: _core.Controller, env: _core.Env, episodes: int, seconds: float | None, stride: int, size: tuple[int, int], camera: str | None, seed: int
) -> Iterator[Frame]:
    renderer = Renderer(env, size, camera)
    if seconds is not None and seconds <= 0:
        raise ValueError(f"seconds is {seconds}; give a time above 0")
    limit = env.max_episode_steps if seconds is None else min(env.max_episode_steps, round(seconds / env.dt))
    try:
        for episode in range(episodes):
            obs = env.reset(seed + episode)
            controller.reset()
            for step in range(limit):
                if step % stride == 0:
                    yield renderer.frame(env.qpos, env.qvel)
                action, _ = controller.update(*env.state(), obs)
                obs, _, _, terminated, _ = env.step(action)
                if terminated:
                    break
    finally:
        renderer.close()


def _demonstrated(
    file: str | os.PathLike[str], env: _core.Env, episodes: int, seconds: float | None, fps: float, size: tuple[int, int], camera: str | None
) -> tuple[Iterator[Frame], float]:
    """States of the first episodes of a file, and the time between two frames [s]."""
    with np.load(file, allow_pickle=False) as data:
        qpos, qvel, lengths, dt = data["qpos"], data["qvel"], data["lengths"].astype(int), float(data["dt"])
    if (qpos.shape[1], qvel.shape[1]) != (env.nq, env.nv):
        raise ValueError(f"'{file}' has {qpos.shape[1]} positions and {qvel.shape[1]} velocities a state; the robot of '{env.task}' has {env.nq} and {env.nv}")
    stride = max(1, round(1.0 / (fps * dt)))
    firsts = np.concatenate([[0], np.cumsum(lengths + 1)[:-1]])[:episodes]
    most = max(lengths) + 1 if seconds is None else round(seconds / dt)

    def frames() -> Iterator[Frame]:
        renderer = Renderer(env, size, camera)
        try:
            for first, length in zip(firsts, lengths):
                for row in range(first, first + min(length + 1, most), stride):
                    yield renderer.frame(qpos[row], qvel[row])
        finally:
            renderer.close()

    return frames(), stride * dt


def check() -> None:
    """Draws one picture and asks for the encoder.

    Raises:
        VideoError: no renderer, or no encoder.
    """
    try:
        import imageio
        import imageio_ffmpeg

        imageio_ffmpeg.get_ffmpeg_exe()
        assert imageio
    except (ImportError, RuntimeError) as error:
        raise VideoError(f"writing a video needs imageio and imageio-ffmpeg: pip install 'nearl[video]' ({error})") from error
    renderer = Renderer(_core.Env("HalfCheetah-v5"), (64, 48))
    renderer.close()


def main(arguments: list[str] | None = None) -> int:
    """0 on success, 1 with one sentence on standard error otherwise."""
    parser = argparse.ArgumentParser(prog="nearl video", description="A video of a trained policy, or of demonstrations.")
    parser.add_argument("run", metavar="RUN", nargs="?", help="run folder, snapshot file, or demonstrations (.npz)")
    parser.add_argument("out", metavar="FILE", nargs="?", help=".mp4 or .gif")
    parser.add_argument("--check", action="store_true", help="write none, and say what is missing for one")
    parser.add_argument("--episodes", type=int, default=1, help="how many, one after the other (default 1)")
    parser.add_argument("--seconds", type=float, help="cut each episode after so much simulated time")
    parser.add_argument("--fps", type=float, default=50.0, help="at most; the video plays in real time")
    parser.add_argument("--size", type=int, nargs=2, default=(640, 480), metavar=("WIDTH", "HEIGHT"), help="in pixels (default 640 480)")
    parser.add_argument("--camera", help="a camera of the robot file")
    parser.add_argument("--seed", type=int, default=0, help="of the resets (default 0)")
    parser.add_argument("--task", help="of the demonstrations, name or file")
    given: dict[str, Any] = vars(parser.parse_args(arguments))
    given["size"] = tuple(given["size"])
    is_check = given.pop("check")
    if not is_check and given["out"] is None:
        parser.error("give RUN and FILE")
    try:
        if is_check:
            check()
            return 0
        n = record(given["run"], given["out"], **{k: v for k, v in given.items() if k not in ("run", "out")})
    except (VideoError, OSError, ValueError) as error:
        print(f"nearl video: {error}", file=sys.stderr)
        return 1
    print(f"{given['out']}: {n} frames")
    return 0


if __name__ == "__main__":
    sys.exit(main())
