"""A video of a trained policy, through MuJoCo's own renderer, on a machine without a screen.

    python -m nearl.video runs/HalfCheetah-v5/pid2-ib_0 cheetah.mp4
"""

import argparse
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nearl import _core
from nearl.pid2 import PID2

Frame = NDArray[np.uint8]


class VideoError(RuntimeError):
    """No video can be made here; the message says what is missing."""


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
) -> int:
    """Writes episodes without exploration as a video.

    Args:
        run: Run folder or snapshot file.
        out: ``.mp4`` (needs imageio-ffmpeg) or ``.gif``.
        episodes: Number of episodes.
        seconds: Cuts each episode after so much simulated time [s].
        fps: Frames per second at most; the video plays in real time.
        size: Width and height [pixel].
        camera: A camera of the robot file; by default its ``track``, else one that follows the robot.
        seed: Of the first initial state.

    Returns:
        Number of frames.

    Raises:
        VideoError: no renderer, or no encoder.
        OSError: the run cannot be read.
    """
    agent, env = PID2.load(run), _core.Env.of_snapshot(run)
    stride = max(1, round(1.0 / (fps * env.dt)))
    frames = _frames(agent, env, episodes, seconds, stride, size, camera, seed)
    try:
        import imageio

        options: dict[str, Any] = {"loop": 0} if Path(out).suffix == ".gif" else {"macro_block_size": 2}
        with imageio.get_writer(out, fps=1.0 / (stride * env.dt), **options) as writer:
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


def _frames(
    agent: PID2, env: _core.Env, episodes: int, seconds: float | None, stride: int, size: tuple[int, int], camera: str | None, seed: int
) -> Iterator[Frame]:
    model, scene, renderer = _renderer(env, size)
    import mujoco

    if seconds is not None and seconds <= 0:
        raise ValueError(f"seconds is {seconds}; give a time above 0")
    limit = env.max_episode_steps if seconds is None else min(env.max_episode_steps, round(seconds / env.dt))
    view = _camera(mujoco, model, camera)
    try:
        for episode in range(episodes):
            obs, state, start = env.reset(seed + episode), None, True
            for step in range(limit):
                if step % stride == 0:
                    scene.qpos[:], scene.qvel[:] = env.qpos, env.qvel
                    mujoco.mj_forward(model, scene)
                    renderer.update_scene(scene, view)
                    if model.ngeom == 0:
                        _skeleton(mujoco, model, scene, renderer.scene)
                    yield renderer.render()
                action, state = agent.predict(obs, state, start)
                obs, _, _, terminated, _ = env.step(action)
                start = False
                if terminated:
                    break
    finally:
        renderer.close()


def _renderer(env: _core.Env, size: tuple[int, int]) -> tuple[Any, Any, Any]:
    os.environ.setdefault("MUJOCO_GL", "egl")
    backend = os.environ["MUJOCO_GL"]
    try:
        import mujoco

        model = mujoco.MjModel.from_xml_string(env.model_text)
        model.vis.global_.offwidth, model.vis.global_.offheight = size
        return model, mujoco.MjData(model), mujoco.Renderer(model, size[1], size[0])
    except Exception as error:  # each missing library fails in its own way, from AttributeError to EGLError
        words = str(error).strip().splitlines() or [type(error).__name__]
        advice = "on Debian: apt install libegl1 libegl-mesa0 libgl1-mesa-dri" if backend == "egl" else "try MUJOCO_GL=egl"
        raise VideoError(f"MuJoCo cannot render with MUJOCO_GL={backend} ({words[0]}); {advice}") from error


def _camera(mujoco: Any, model: Any, name: str | None) -> Any:
    names = [model.camera(i).name for i in range(model.ncam)]
    if name is not None and name not in names:
        raise VideoError(f"the robot has no camera '{name}'; it has {', '.join(names) or 'none'}")
    if name is not None or "track" in names:
        return name or "track"
    view = mujoco.MjvCamera()
    view.type, view.trackbodyid = mujoco.mjtCamera.mjCAMERA_TRACKING, min(1, model.nbody - 1)
    view.distance, view.azimuth, view.elevation = 2.0 * model.stat.extent, 120.0, -15.0
    return view


def _skeleton(mujoco: Any, model: Any, state: Any, scene: Any) -> None:
    """A robot file without shapes (a URDF stripped of its meshes) is drawn as capsules between its bodies."""
    for body in range(2, model.nbody):
        ends = state.xpos[model.body_parentid[body]], state.xpos[body]
        if scene.ngeom < scene.maxgeom and np.linalg.norm(ends[1] - ends[0]) > 1e-6:
            geom = scene.geoms[scene.ngeom]
            colour = np.array([0.85, 0.45, 0.2, 1.0], np.float32)
            mujoco.mjv_initGeom(geom, mujoco.mjtGeom.mjGEOM_CAPSULE, np.zeros(3), np.zeros(3), np.zeros(9), colour)
            mujoco.mjv_connector(geom, mujoco.mjtGeom.mjGEOM_CAPSULE, 0.03, *ends)
            scene.ngeom += 1


def main(arguments: list[str] | None = None) -> int:
    """0 on success, 1 with one sentence on standard error otherwise."""
    parser = argparse.ArgumentParser(prog="python -m nearl.video", description="A video of a trained policy.")
    parser.add_argument("run", metavar="RUN", help="run folder or snapshot file")
    parser.add_argument("out", metavar="FILE", help=".mp4 or .gif")
    parser.add_argument("--episodes", type=int, default=1)
    parser.add_argument("--seconds", type=float, help="cut each episode after so much simulated time")
    parser.add_argument("--fps", type=float, default=50.0, help="at most; the video plays in real time")
    parser.add_argument("--size", type=int, nargs=2, default=(640, 480), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--camera", help="a camera of the robot file")
    parser.add_argument("--seed", type=int, default=0)
    given = vars(parser.parse_args(arguments))
    try:
        n = record(given.pop("run"), given["out"], **{k: tuple(v) if k == "size" else v for k, v in given.items() if k != "out"})
    except (VideoError, OSError, ValueError) as error:
        print(f"nearl.video: {error}", file=sys.stderr)
        return 1
    print(f"{given['out']}: {n} frames")
    return 0


if __name__ == "__main__":
    sys.exit(main())
