"""A task file to start from, made of a Gymnasium MuJoCo environment."""

import os
import warnings
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from nearl import _core
from nearl.arguments import unwritten
from nearl.gymnasium_tasks import as_toml, own_sections

# What is written where the reward is not known.
EMPTY = """\
[reward]
nothing_yet = 0.0

[termination]

[reset]"""
TEMPLATE = """\
# {env_id} as a task file. Robot, times, actions and episode length are Gymnasium's; {about}
name = "{name}"

[model]
mjcf = "{robot}"

[time]
dt = {dt!r}
sim_dt = {sim_dt!r}
{steps}
[state]
controllable = [{joints}]

{sections}

[constraints]
consistency = "free"

[idm]
kind = "learned"
input = "full"
"""


def from_gymnasium(env_id: str | gymnasium.Env[Any, Any], folder: str | os.PathLike[str], **kwargs: Any) -> Path:
    """Writes ``<name>.toml`` and its robot file into ``folder`` for a Gymnasium environment that is built on ``MujocoEnv``.

    The task steps the same physics as Gymnasium, bit for bit for the same state and action, and observes all joint positions and
    velocities. Reward, start and end of an episode come along for all eleven MuJoCo tasks of Gymnasium (v5), with the arguments given. For
    other environments they are code: write them as expressions, which trains everywhere, or pass functions to
    ``nearl.make_vec(file, n, reward=..., termination=...)``.

    An environment whose ``step`` changes the action or the state leads elsewhere than its model: one step of both is compared, and a warning says
    by how much.

    Not supported: robots with meshes, actuators that do not drive a single joint within a range, wrappers, environments that move
    their goal or model while they run. Training with constraints also needs the robot to be one tree of bodies.

    Args:
        env_id: Name known to ``gymnasium.make``, or an environment that it made, of which wrappers are left out.
        folder: Where to write; created if it does not exist.
        **kwargs: For ``gymnasium.make``.

    Returns:
        The task file.

    Raises:
        ValueError: not a MuJoCo environment, or one that no name was registered for.
        FileExistsError: the task file is there already.
    """
    import mujoco

    if not isinstance(folder, str | os.PathLike):
        raise ValueError(f"folder is {folder!r}; give the path of a folder to write into")
    if not isinstance(env_id, str):
        spec = env_id.spec if isinstance(env_id, gymnasium.Env) else None
        if spec is None:
            raise ValueError(f"{env_id!r} was not made by a name; register it with gymnasium.register and give that name, as 'Hopper-v5'")
        length = {} if spec.max_episode_steps is None else {"max_episode_steps": spec.max_episode_steps}
        env_id, kwargs = spec.id, {**spec.kwargs, **length, "render_mode": None, **kwargs}
    env = gymnasium.make(env_id, **kwargs)
    steps = env.spec.max_episode_steps if env.spec is not None else None
    inner: Any = env.unwrapped
    if not (hasattr(inner, "fullpath") and hasattr(inner, "frame_skip") and hasattr(inner, "model")):
        raise ValueError(f"'{env_id}' is not built on Gymnasium's MujocoEnv, so it has no robot file; write a task file by hand")
    model, name = inner.model, env_id.split("/")[-1].rsplit("-v", 1)[0]
    driven, folder = _driven(mujoco, model, env_id), Path(folder)
    elsewhere = _elsewhere(mujoco, env)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise unwritten(error, folder) from error
    file, robot = folder / f"{name}.toml", folder / Path(inner.fullpath).name
    if file.exists():
        raise FileExistsError(f"'{file}' is there already; give another folder or remove it")
    text = Path(inner.fullpath).read_text()
    if "<include" in text:
        mujoco.mj_saveLastXML(str(robot), mujoco.MjModel.from_xml_path(inner.fullpath))
    else:
        robot.write_text(text)
    timestep = float(model.opt.timestep)
    euler = _core.makes_euler_steps(inner.fullpath)
    joints = ", ".join(f'"{joint}"' for joint in dict.fromkeys(driven))
    dt = round(timestep * inner.frame_skip, 12)
    own = own_sections(inner)
    about = (
        "so are reward, start and end of an episode."
        if own
        else "the reward, the start and the end of an\n# episode are Python there and must be written here, or given to nearl.make_vec as functions."
    )
    limit = f"max_episode_steps = {steps}\n" if steps else ""  # without a time limit there: the usual length here
    times = {"dt": dt, "sim_dt": timestep if euler else 0.0, "steps": limit}
    sections = as_toml(own) if own else EMPTY
    file.write_text(TEMPLATE.format(env_id=env_id, name=name, robot=robot.name, joints=joints, about=about, sections=sections, **times))
    env.close()
    if elsewhere > 0:
        warnings.warn(
            f"after one step '{env_id}' is {elsewhere:.2g} rad, m, rad/s or m/s away from where its MuJoCo model goes with that action: its step() changes "
            f"actions or states, and '{file}' does not; put a scale of actions into the gears of '{robot}'",
            stacklevel=2,
        )
    return file


def _elsewhere(mujoco: Any, env: gymnasium.Env[Any, Any]) -> float:
    """How far a step of the environment ends from one of its model with the same action; 0 where they are the same."""
    inner: Any = env.unwrapped
    env.reset(seed=0)
    data, state = mujoco.MjData(inner.model), mujoco.mjtState.mjSTATE_INTEGRATION
    before = np.empty(mujoco.mj_stateSize(inner.model, state))
    mujoco.mj_getState(inner.model, inner.data, before, state)
    mujoco.mj_setState(inner.model, data, before, state)
    env.action_space.seed(0)
    action = env.action_space.sample()
    if np.shape(action) != (inner.model.nu,):
        raise ValueError(f"the actions of '{env.spec and env.spec.id}' have shape {np.shape(action)}, and its model has {inner.model.nu} actuators")
    env.step(action)
    data.ctrl[:] = action
    mujoco.mj_step(inner.model, data, nstep=inner.frame_skip)
    return float(max(np.abs(data.qpos - inner.data.qpos).max(), np.abs(data.qvel - inner.data.qvel).max()))


def _driven(mujoco: Any, model: Any, env_id: str) -> list[str]:
    """The joint of each actuator; of a tendon's or a site's there is none that a task could command."""
    direct = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
    for i in range(model.nu):
        if int(model.actuator_trntype[i]) not in direct:
            raise ValueError(
                f"actuator '{model.actuator(i).name}' of '{env_id}' drives no joint, and the actions of a task are those of joints; "
                "give its joints motors in the robot file, or write a task file by hand that leaves it out of state.controllable"
            )
    return [model.joint(int(model.actuator_trnid[i, 0])).name for i in range(model.nu)]
