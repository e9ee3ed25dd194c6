"""Demonstrations of others as a file for the algorithms that learn from them: CSV, Minari, LeRobot, robomimic and motion clips.

Every source is a table of joint positions and velocities by name, ``q.<joint>`` and ``v.<joint>`` as the task's observation has them. The observations
of the file are those of the task's own environment in these states, so that they are always of it::

    nearl.demos.from_csv("task.toml", "walk.csv", "walk.npz", dt=0.02)

What the robot was asked to do is a column too, ``command.<name>`` (of Panda-reach ``goal.x``), which a task that observes it does not go without. A
position that the task does not observe (where a planar runner is) may be missing and is 0; a velocity that is missing is the difference of positions,
central within an episode and one-sided at its ends.
"""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nearl import _core
from nearl.arguments import task_of, unwritten
from nearl.recorded import (
    SAME,
    BadDemonstrations,
    Rows,
    check_others,
    check_period,
    check_turns,
    check_units,
    check_velocities,
    column,
    controller,
    goal_names,
    is_episode,
    numbers,
    observations,
)
from nearl.sources import (
    FilePath,
    check_entries,
    csv_table,
    feature_names,
    hdf5_column,
    hdf5_parts,
    lerobot_column,
    lerobot_rows,
    minari_dataset,
    npz_arrays,
    once,
    regular,
    renamed,
    seconds_between,
    split,
    text,
    unbraced,
)

Floats = NDArray[np.float64]
_BASE_Q = ("x", "y", "z", "qw", "qx", "qy", "qz")
_TURN = (".qw", ".qx", ".qy", ".qz")
_BASE_V = ("x", "y", "z", "wx", "wy", "wz")


def from_columns(
    task: FilePath,
    episodes: Iterable[Mapping[str, ArrayLike]],
    out: FilePath,
    *,
    dt: float,
    actions: Sequence[str] = (),
    period: float | None = None,
    overwrite: bool = False,
    source: str = "the columns",
) -> Path:
    """Writes one file of demonstrations from columns by name.

    Args:
        task: Name of a bundled task, or a task file.
        episodes: For each episode a column (n) by name: ``q.<joint>``, and ``v.<joint>`` where it is known [rad or m, per s]. The base of a robot that floats
            is ``q.<joint>.x y z qw qx qy qz`` and ``v.<joint>.x y z wx wy wz`` (rotation in the body's frame). What was asked for is ``command.<name>``,
            or as the task's observation calls it (``goal.x``); what it observes and no state gives is a column of the entry's name. A column of times is
            held against ``dt``, one of episode numbers must say the same in every row, and columns of other names are left out with a warning.
        out: File to write (``.npz``).
        dt: Time between two rows [s]. Of a period of several rows the first is taken; otherwise states are interpolated, and what was asked for holds until
            the next row.
        actions: Columns of actions, in the order of the task's actuators; none by default. Their last row is left out.
        period: Policy period [s], where it will not be the task file's (``dt`` times ``policy_every``).
        overwrite: Writes over a file that is there already, which is refused otherwise.
        source: What messages call the source.

    Returns:
        ``out``.

    Raises:
        BadDemonstrations: a column is missing, not finite or of another length, an episode has less than two rows, numbers that are in other units, or
            ``out`` has another name than ``*.npz``.
        FileExistsError: ``out`` is there already.
    """
    stem, suffix = os.path.splitext(os.fspath(out))
    if suffix.lower() != ".npz":
        raise BadDemonstrations(f"out is '{os.fspath(out)}', and demonstrations are written as NumPy's .npz; give '{stem}.npz'")
    if not overwrite and os.path.exists(out):
        raise FileExistsError(f"'{os.fspath(out)}' is there already; give another file, remove it, or give overwrite=True")
    if hasattr(episodes, "keys"):
        raise BadDemonstrations(f"{source}: episodes is one table of columns; give a list of them, [table], one for each episode")
    if not isinstance(episodes, Iterable):
        raise BadDemonstrations(f"{source}: episodes is {episodes!r}; give a list of tables of columns by name, one for each episode")
    env = _core.Env(task_of(task))
    of_task = controller(env, task)
    period = of_task.dt * of_task.policy_every if period is None else period
    check_period(dt, period, source)
    if actions and abs(dt - period) > SAME * period:
        raise BadDemonstrations(
            f"{source}: its rows are {dt} s apart and the policy period of the task is {period:g} s; actions cannot be interpolated: leave them out, or "
            f"give one row for each policy period"
        )
    if actions and (isinstance(actions, str) or len(actions) != len(env.actuator_names)):
        raise BadDemonstrations(f"{source}: actions is {actions!r}; give one column for each actuator, {', '.join(env.actuator_names)}")
    _check_once(actions, env, source)
    parts: dict[str, list[Floats]] = {name: [] for name in ("observations", "qpos", "qvel", "actions")}
    lengths: list[int] = []
    told: set[str] = set()
    used = {*_known(env), *(actions or ())}
    for i, columns in enumerate(episodes):
        where = f"{source}, episode {i}"
        if not hasattr(columns, "keys"):
            raise BadDemonstrations(f"{where}: it is of {type(columns).__name__}; give a table of columns by name, as {{'q.<joint>': values}}")
        once([unbraced(name) for name in columns.keys()], where)  # noqa: SIM118 (a table of another library)
        columns = {unbraced(name): columns[name] for name in columns.keys()}  # noqa: SIM118
        qpos, qvel, rates = _states(env, columns, dt, where)
        if (n := len(qpos)) < 2:
            raise BadDemonstrations(f"{where}: {n} rows make no transition; give at least 2")
        check_others(columns, used, n, dt, where, told)
        check_units(of_task, _entries(env), qpos, qvel, rates, dt, where, told)
        check_velocities(columns, _entries(env)[1], qvel, rates, dt, where, told)
        rows = Rows(n, dt, period)
        known = [name for name in (*env.obs_names, *goal_names(env)) if name in columns]
        recorded = {name: column(columns, name, n, where) for name in known}
        qpos, qvel = rows.states(qpos), rows.states(qvel)
        if not rows.whole:
            _unit(env, qpos)
        if len(qpos) < 2:
            raise BadDemonstrations(f"{where}: {n} rows {dt:g} s apart make no transition of the policy's {period:g} s; give more rows, and dt in seconds")
        state = dict(zip([*_entries(env)[0], *_entries(env)[1]], [*qpos.T, *qvel.T]))
        parts["observations"].append(observations(env, recorded, rows, state, qpos, qvel, period, where, told))
        parts["qpos"].append(qpos)
        parts["qvel"].append(qvel)
        if actions:
            parts["actions"].append(np.stack([column(columns, name, n, where) for name in actions], 1)[:-1])
        lengths.append(len(qpos) - 1)
    if not lengths:
        raise BadDemonstrations(f"{source}: it has no episode")
    arrays = {name: np.ascontiguousarray(np.concatenate(rows)) for name, rows in parts.items() if rows}
    try:
        Path(out).parent.mkdir(parents=True, exist_ok=True)
        with open(out, "wb") as file:
            np.savez(file, lengths=np.array(lengths), dt=np.array(period), names=np.array(env.obs_names), **arrays)  # type: ignore[arg-type]
    except OSError as error:
        raise unwritten(error, out) from error
    return Path(out)


def from_csv(
    task: FilePath,
    file: FilePath,
    out: FilePath,
    *,
    dt: float,
    episode: str | None = None,
    columns: Mapping[str, str] | None = None,
    actions: Sequence[str] = (),
    period: float | None = None,
    overwrite: bool = False,
) -> Path:
    """Reads a CSV file with a heading.

    Rows of one episode have the same value in the column ``episode``: by default the one that is called so in any spelling (``Episode``,
    ``episode_index``, ``demo``); where there is none all rows are one. ``columns`` says how the heading calls what the task calls otherwise:
    ``{"q.shoulder": "Shoulder angle"}``. A column of times (``time``, ``timestamp``) is held against ``dt``. The rest is as in :func:`from_columns`.
    """
    source = f"'{os.fspath(file)}'"
    table = renamed(csv_table(file), columns, source)
    if episode is None:
        known = {*_known(_core.Env(task_of(task))), *(actions or ())}
        named = [name for name in table if name not in known and is_episode(name)]
        if len(named) > 1:
            raise BadDemonstrations(f"{source}: columns {', '.join(named)} may all say of which episode a row is; give episode=, the one that does")
        episode = named[0] if named else None
    of = None if episode is None else column(table, episode, len(next(iter(table.values()))), source)
    kept = {name: values for name, values in table.items() if name != episode}
    return from_columns(task, split(kept, of, source), out, dt=dt, actions=actions, period=period, overwrite=overwrite, source=source)


def from_minari(
    task: FilePath,
    dataset: Any,
    out: FilePath,
    *,
    dt: float | None = None,
    names: Sequence[str] | None = None,
    actions: Sequence[str] | None = None,
    period: float | None = None,
    overwrite: bool = False,
) -> Path:
    """Reads a Minari dataset, or the one of that name on this machine, whose observations are those of the task, or have the columns ``names``.

    Minari has neither names of entries nor a period: without ``names`` the order is taken to be that of the task's observation, and without
    ``dt`` the time between two rows to be its ``time.dt``. Its actions come along; ``actions=()`` leaves them out.
    """
    env = _core.Env(task_of(task))
    source = f"Minari dataset '{dataset}'" if isinstance(dataset, str) else "Minari dataset"
    if isinstance(dataset, str):
        dataset = minari_dataset(dataset)
    if not hasattr(dataset, "iterate_episodes"):
        raise BadDemonstrations(f"{source}: {dataset!r} is none; give its name, or what minari.load_dataset returns")
    names = env.obs_names if names is None else names
    once(names, source)
    actions = env.actuator_names if actions is None else actions
    episodes = []
    for i, e in enumerate(dataset.iterate_episodes()):
        where = f"{source}, episode {i}"
        if isinstance(e.observations, Mapping):
            raise BadDemonstrations(f"{where}: its observations are tables of {', '.join(e.observations)}; give their columns to nearl.demos.from_columns")
        observations = numbers(e.observations, "array 'observations'", where)
        if observations.ndim != 2 or observations.shape[1] != len(names):
            raise BadDemonstrations(f"{where}: observations of shape {observations.shape} where {len(names)} columns have names")
        columns = dict(zip(names, observations.T))
        if actions:
            given, want = numbers(e.actions, "array 'actions'", where), (len(observations) - 1, len(env.actuator_names))
            if given.shape != want:
                raise BadDemonstrations(f"{where}: actions of shape {given.shape} where the task's are {want}; give actions=() to leave them out")
            columns |= dict(zip(env.actuator_names, np.vstack([given, given[-1:]]).T))
        episodes.append(columns)
    dt = env.dt if dt is None else dt
    return from_columns(task, episodes, out, dt=dt, actions=actions, period=period, overwrite=overwrite, source=source)


def from_robomimic(
    task: FilePath,
    file: FilePath,
    out: FilePath,
    *,
    dt: float,
    columns: Mapping[str, tuple[str, int]],
    actions: Sequence[str | tuple[str, int]] = (),
    period: float | None = None,
    overwrite: bool = False,
) -> Path:
    """Reads robomimic's HDF5; ``columns`` says which entry of which observation each name is: ``{"q.panda_joint1": ("robot0_joint_pos", 0)}``.

    A key that is no observation is a dataset of the demonstration itself, as ``actions`` is. ``actions`` are such entries in the order of the task's
    actuators, ``[("actions", 0), ("actions", 1)]``, or names in ``columns``.
    """
    try:
        import h5py
    except ImportError as error:
        raise ImportError("reading robomimic's HDF5 needs h5py: pip install 'nearl[demos]'") from error
    source = f"'{os.fspath(file)}'"
    check_entries(columns, source)
    pairs = {f"actions[{i}]": of for i, of in enumerate(actions) if not isinstance(of, str)}
    check_entries(pairs, source)
    columns = {**{unbraced(name): of for name, of in columns.items()}, **pairs}
    acted = actions if isinstance(actions, str) else [of if isinstance(of, str) else f"actions[{i}]" for i, of in enumerate(actions)]
    if pairs:
        _check_once(actions, _core.Env(task_of(task)), source)
    regular(file, "the HDF5 file that robomimic wrote")
    episodes = []
    try:
        data = h5py.File(file)
    except OSError as error:
        raise BadDemonstrations(f"{source} cannot be read as HDF5 ({error}); give the file that robomimic wrote") from None
    with data:
        demos = hdf5_parts(data, source).get("data")
        if not isinstance(demos, h5py.Group):
            raise BadDemonstrations(f"{source}: no group 'data', in which robomimic has its demonstrations; it has {', '.join(data) or 'nothing'}")
        if odd := [name for name in demos if not name.rpartition("_")[2].isdecimal()]:
            raise BadDemonstrations(f"{source}: 'data/{odd[0]}' has not the name of a demonstration, demo_0 and on; give the file that robomimic wrote")
        parts = hdf5_parts(demos, source)
        for i, demo in enumerate(sorted(parts, key=lambda name: int(name.rpartition("_")[2]))):
            where = f"{source}, episode {i} ({demo})"
            arrays = hdf5_parts(parts[demo], where)
            arrays |= hdf5_parts(arrays["obs"], where) if "obs" in arrays else {}
            for name, (key, k) in columns.items():
                shape: tuple[int, ...] = getattr(arrays.get(key), "shape", ())
                if len(shape) != 2 or k >= shape[1]:
                    has = ", ".join(f"{name} {of.shape}" for name, of in arrays.items() if hasattr(of, "shape")) or "nothing"
                    raise BadDemonstrations(f"{where}: no observation '{key}' with entry {k} for '{name}'; it has {has}")
            episodes.append({name: hdf5_column(arrays[key], k, f"'{key}'", where) for name, (key, k) in columns.items()})
    return from_columns(task, episodes, out, dt=dt, actions=acted, period=period, overwrite=overwrite, source=source)


def from_lerobot(
    task: FilePath,
    folder: FilePath,
    out: FilePath,
    *,
    names: Sequence[str] | None = None,
    key: str = "observation.state",
    actions: Sequence[str] = (),
    period: float | None = None,
    overwrite: bool = False,
) -> Path:
    """Reads a LeRobot dataset (v3) from its folder: ``key`` frame by frame, at the rate of ``meta/info.json``, against which its timestamps are held.

    A dataset in which frames or files are missing is refused: its data is held against the numbers of episodes and frames in ``meta/info.json``, the lengths
    in ``meta/episodes`` and the column ``frame_index``.

    ``names`` are the entries of ``key``, by default the dataset's own. Of either ``shoulder.pos`` and ``shoulder`` are the joint ``shoulder`` and
    ``shoulder.vel`` is its velocity; columns of the task are meant by their own names, as ``q.shoulder``. Entries that the task has no place for are left
    out with a warning. ``actions`` are entries of the feature ``action`` by the dataset's names, in the order of the task's actuators; where it has no names
    they are ``action.0``, ``action.1`` and on.
    """
    try:
        import pyarrow  # noqa: F401 (is asked for here, so that its absence is said first)
    except ImportError as error:
        raise ImportError("reading a LeRobot dataset needs pyarrow: pip install 'nearl[demos]'") from error
    source, meta = f"'{os.fspath(folder)}'", Path(folder) / "meta" / "info.json"
    os.stat(folder)  # a folder that is not there is said by the system
    if not meta.is_file():
        raise BadDemonstrations(
            f"{source} is no LeRobot dataset, which is a folder with meta/info.json and data/*/*.parquet; give that folder, and a single parquet file by "
            f"nearl.demos.from_columns: [table for _, table in pandas.read_parquet(file).groupby('episode_index')], with columns called as the task's"
        )
    regular(meta, "the dataset's folder")
    try:
        info = json.loads(meta.read_text())
        features, dt = info["features"], seconds_between(info["fps"], f"'{meta}'")
    except (KeyError, TypeError, json.JSONDecodeError, UnicodeDecodeError, RecursionError, MemoryError) as error:
        raise BadDemonstrations(f"'{meta}' describes no LeRobot dataset of version 3 ({error!r}); give the dataset's folder") from None
    if key not in features:
        raise BadDemonstrations(f"{source}: no feature '{key}'; it has {', '.join(features)}")
    env = _core.Env(task_of(task))
    used = _known(env)
    if isinstance(names, str):
        raise BadDemonstrations(f"{source}: names is {names!r}; give a list, one name for each entry of '{key}'")
    given = [unbraced(name) for name in (feature_names(features[key]) if names is None else names)]
    names = [name if name in used else lerobot_column(name) for name in given]
    wanted = [key]
    if actions:
        if "action" not in features:
            raise BadDemonstrations(f"{source}: no feature 'action' for actions={actions!r}; it has {', '.join(features)}")
        wanted.append("action")
    if "timestamp" in features:
        wanted.append("timestamp")  # held against the rate
    parts = lerobot_rows(folder, info, wanted)
    values = numbers(parts[key], f"'{key}'", source)
    if values.ndim != 2 or values.shape[1] != len(names):
        raise BadDemonstrations(
            f"{source}: '{key}' has shape {values.shape} and {len(names)} names; give names=, one for each entry: <joint>, "
            f"<joint>.pos, <joint>.vel, or a column of the task ({', '.join(_entries(env)[0])})"
        )
    once(names, source)
    columns = dict(zip(names, values.T))
    if actions:
        acted = numbers(parts["action"], "'action'", source)
        acted = acted[:, None] if acted.ndim == 1 else acted  # a single number is no list
        of_action = feature_names(features["action"]) or [f"action.{k}" for k in range(acted.shape[1])]
        if acted.ndim != 2 or acted.shape[1] != len(of_action):
            raise BadDemonstrations(f"{source}: 'action' has shape {acted.shape} and {len(of_action)} names; correct names in '{meta}'")
        once(of_action, source)
        if isinstance(actions, str) or (unknown := [name for name in actions if name not in of_action]):
            said = actions if isinstance(actions, str) else unknown[0]
            raise BadDemonstrations(f"{source}: actions has '{said}', which is no entry of 'action'; give a list of {', '.join(of_action)}")
        _check_once(actions, env, source)
        # of its own, because a target is often called as the position is
        columns |= {f"action of {name}": acted[:, of_action.index(name)] for name in actions}
        actions = [f"action of {name}" for name in actions]
    if left := [said for said, name in zip(given, names) if name not in used]:
        warnings.warn(
            f"{source}: of '{key}' {', '.join(left)} {'is' if len(left) == 1 else 'are'} left out, because the task has no such column; give names= if they "
            f"are joints of other names ({', '.join(_entries(env)[0])})",
            stacklevel=2,
        )
        columns = {name: of for name, of in columns.items() if name in used or name in actions} if len(left) < len(names) else columns
    if "timestamp" in parts:
        columns |= {"timestamp": np.array(parts["timestamp"], float).ravel()}
    episodes = split(columns, np.array(parts["episode_index"]), source)
    return from_columns(task, episodes, out, dt=dt, actions=actions, period=period, overwrite=overwrite, source=source)


def from_motion(
    task: FilePath,
    file: FilePath,
    out: FilePath,
    *,
    joints: Sequence[str] | None = None,
    base: str = "root",
    period: float | None = None,
    overwrite: bool = False,
) -> Path:
    """Reads a motion clip (``.npz``) as retargeting tools write it: ``fps``, ``joint_pos`` (n x joints) and ``joint_names``.

    A base that floats is seven entries before the joints in ``joint_pos``, or the first body of ``body_pos_w`` and ``body_quat_w``.
    """
    source = f"'{os.fspath(file)}'"
    clip = npz_arrays(file, ["fps", "joint_pos"], ["joint_names", "body_pos_w", "body_quat_w"])
    if joints is None:
        if "joint_names" not in clip:
            raise BadDemonstrations(f"{source}: no array 'joint_names'; give joints=, the joints in the order of 'joint_pos'")
        joints = list(np.ravel(clip["joint_names"]))
    joints = [text(name, "'joint_names'", source) for name in joints]
    once([f"q.{name}" for name in joints], source)
    q = numbers(clip["joint_pos"], "array 'joint_pos'", source)
    if q.ndim != 2:
        raise BadDemonstrations(f"{source}: 'joint_pos' has shape {q.shape}; give one row a frame, (n, {len(joints)})")
    extra = q.shape[1] - len(joints)
    if extra not in (0, 7):
        raise BadDemonstrations(f"{source}: 'joint_pos' has {q.shape[1]} columns for {len(joints)} joints; 7 more would be the base")
    columns = {f"q.{name}": q[:, extra + k] for k, name in enumerate(joints)}
    if extra == 7:
        columns |= {f"q.{base}.{entry}": q[:, k] for k, entry in enumerate(_BASE_Q)}
    elif "body_pos_w" in clip and "body_quat_w" in clip:
        pose = []
        for name, width in (("body_pos_w", 3), ("body_quat_w", 4)):
            of = numbers(clip[name], f"array '{name}'", source)
            if of.ndim != 3 or of.shape[0] != len(q) or of.shape[1] == 0 or of.shape[2] != width:
                raise BadDemonstrations(f"{source}: '{name}' has shape {of.shape} where 'joint_pos' has {len(q)} rows; give ({len(q)}, bodies, {width})")
            pose += list(of[:, 0].T)
        columns |= {f"q.{base}.{entry}": of for entry, of in zip(_BASE_Q, pose)}
    return from_columns(task, [columns], out, dt=seconds_between(clip["fps"], source), period=period, overwrite=overwrite, source=source)


def _check_once(actions: Sequence[str | tuple[str, int]] | None, env: _core.Env, source: str) -> None:
    """Refuses a column that is to be the action of two actuators."""
    given = actions or ()
    for k, name in enumerate(given):
        if name in given[:k]:
            raise BadDemonstrations(f"{source}: actions has {name!r} twice; give one column for each actuator, {', '.join(env.actuator_names)}")


def _known(env: _core.Env) -> set[str]:
    """Names of all columns that the task has a place for."""
    return {*_entries(env)[0], *_entries(env)[1], *env.obs_names, *goal_names(env)}


def _entries(env: _core.Env) -> tuple[list[str], list[str]]:
    """Names of the entries of qpos and qvel."""
    floats = [joint for joint in env.joint_names if any(name.startswith(f"q.{joint}.") for name in env.obs_names)]
    if not floats and env.nq == len(env.joint_names) + 6:
        floats = env.joint_names[:1]
    q = [f"q.{joint}{entry}" for joint in env.joint_names for entry in ([f".{e}" for e in _BASE_Q] if joint in floats else [""])]
    v = [f"v.{joint}{entry}" for joint in env.joint_names for entry in ([f".{e}" for e in _BASE_V] if joint in floats else [""])]
    if (len(q), len(v)) != (env.nq, env.nv):
        raise BadDemonstrations(f"the robot of '{env.task}' has joints that turn about a point; write its file with numpy.savez")
    return q, v


def _states(env: _core.Env, columns: Mapping[str, ArrayLike], dt: float, where: str) -> tuple[Floats, Floats, Floats]:
    """qpos (n x nq) and qvel (n x nv) of an episode, and what positions change by from row to row (n - 1 x nv) [rad or m, per s]."""
    q_names, v_names = _entries(env)
    given = [name for name in (*q_names, *v_names) if name in columns]
    if not given:
        raise BadDemonstrations(f"{where}: none of the task's columns ({', '.join(q_names)}); it has {', '.join(columns) or 'nothing'}")
    n = len(np.atleast_1d(numbers(columns[given[0]], f"column '{given[0]}'", where)))
    # a place that the task does not observe is of no matter; a joint's angle is, and so is how the base is turned, for which there is no 0
    of_no_matter = lambda name: not name.endswith(_TURN) and not any(name in observed for observed in env.obs_names)  # noqa: E731
    qpos = np.stack([np.zeros(n) if name not in columns and of_no_matter(name) else column(columns, name, n, where) for name in q_names], 1)
    check_turns(q_names, qpos, where)
    _unit(env, qpos)
    rates = _rates(q_names, v_names, qpos, dt)
    qvel = _central(rates) if n > 1 else np.zeros((n, len(v_names)))
    for k, name in enumerate(v_names):
        if name in columns:
            qvel[:, k] = column(columns, name, n, where)
    return qpos, qvel, rates


def _unit(env: _core.Env, qpos: Floats) -> None:
    """Quaternions of length one, each on the side of the one before, so that between two of them lies a rotation."""
    for k, name in enumerate(_entries(env)[0]):
        if name.endswith(".qw"):
            turn = qpos[:, k : k + 4]
            turn /= np.maximum(np.linalg.norm(turn, axis=1, keepdims=True), 1e-12)
            flips = np.sum(turn[1:] * turn[:-1], axis=1) < 0
            turn[1:][np.cumsum(flips) % 2 == 1] *= -1


def _rates(q_names: Sequence[str], v_names: Sequence[str], qpos: Floats, dt: float) -> Floats:
    """Mean velocities (n - 1 x nv) from each row to the next."""
    rates = np.zeros((max(len(qpos) - 1, 0), len(v_names)))
    for k, name in enumerate(v_names):
        if (place := "q" + name[1:]) in q_names:
            rates[:, k] = np.diff(qpos[:, q_names.index(place)]) / dt
        elif name.endswith(".wx"):
            at = q_names.index("q" + name[1:].removesuffix("wx") + "qw")
            rates[:, k : k + 3] = _turned(qpos[:-1, at : at + 4], qpos[1:, at : at + 4]) / dt
    return rates


def _central(rates: Floats) -> Floats:
    """Velocities (n x nv) in the rows: central differences, one-sided at both ends."""
    return np.concatenate([rates[:1], (rates[1:] + rates[:-1]) / 2, rates[-1:]])


def _turned(a: Floats, b: Floats) -> Floats:
    """Rotation vectors, in the body's frame, from the unit quaternions ``a`` to ``b`` (w first)."""
    w = np.sum(a * b, axis=1)
    xyz = a[:, :1] * b[:, 1:] - b[:, :1] * a[:, 1:] - np.cross(a[:, 1:], b[:, 1:])
    xyz, w = np.where(w[:, None] < 0, -xyz, xyz), np.abs(w)
    sine = np.linalg.norm(xyz, axis=1)
    return xyz * (2 * np.arctan2(sine, w) / np.maximum(sine, 1e-12))[:, None]
