"""Converters of demonstrations: what other tools write becomes states of the task, or is refused by file, column and episode."""

import json
import os
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT

import nearl
from nearl import _core, demos

UNNAMED = ["action.1", "action.2", "action.0"]
NEARL = ROOT / "target" / "release" / "nearl"


def episode(n: int = 30, seed: int = 0) -> dict[str, np.ndarray]:
    """States of Hopper's own simulation, by column, with its actions."""
    env, rng = _core.Env("Hopper-v5"), np.random.default_rng(seed)
    env.reset(seed)
    rows = []
    for _ in range(n):
        action = rng.uniform(-0.3, 0.3, 3)
        rows.append([*env.qpos, *env.qvel, *action])
        env.step(action)
    q = [f"q.{joint}" for joint in env.joint_names]
    return dict(zip([*q, *("v" + name[1:] for name in q), "a", "b", "c"], np.array(rows).T))


def checked(file: Path, task: str = "Hopper-v5") -> dict[str, np.ndarray]:
    """The arrays, once the trainer itself has found them to be of the task."""
    told = subprocess.run([NEARL, "demos", "check", file, "--task", task], capture_output=True, text=True)
    assert told.returncode == 0, told.stderr
    with np.load(file) as data:
        return dict(data)


def test_braces_around_the_name_of_a_column_are_no_part_of_it(tmp_path: Path) -> None:
    columns = episode()
    plain = checked(demos.from_columns("Hopper-v5", [columns], tmp_path / "plain.npz", dt=0.008))
    braced = checked(demos.from_columns("Hopper-v5", [{f"{{{name}}}": of for name, of in columns.items()}], tmp_path / "braced.npz", dt=0.008))
    assert all(np.array_equal(plain[name], braced[name]) for name in plain)
    with pytest.raises(demos.BadDemonstrations, match="column 'q.leg_joint' is there twice"):
        demos.from_columns("Hopper-v5", [columns | {"{q.leg_joint}": columns["q.leg_joint"]}], tmp_path / "twice.npz", dt=0.008)


def test_names_of_columns_may_be_bytes(tmp_path: Path) -> None:
    columns = episode()
    files = [
        demos.from_columns("Hopper-v5", [table], tmp_path / name, dt=0.008, actions=("a", "b", "c"))
        for name, table in (("text.npz", columns), ("bytes.npz", {np.bytes_(name.encode()): of for name, of in columns.items()}))
    ]
    text, same = (checked(file) for file in files)
    assert all(np.array_equal(text[name], same[name]) for name in text)
    np.savez(tmp_path / "names.npz", **text | {"names": np.array([str(name).encode() for name in text["names"]])})
    shown = pytest.importorskip("nearl.report.demonstrations").read_demonstrations(tmp_path / "names.npz")
    assert shown.names == list(text["names"])


def test_columns_become_states_bit_for_bit(tmp_path: Path) -> None:
    first, second = episode(), episode(20, 1)
    out = demos.from_columns("Hopper-v5", [first, second], tmp_path / "a.npz", dt=0.008, actions=("a", "b", "c"))
    data = checked(out)
    assert data["lengths"].tolist() == [29, 19] and data["actions"].shape == (48, 3)
    assert np.array_equal(data["qvel"][30:, 5], second["v.foot_joint"]) and np.array_equal(data["qpos"][:30, 2], first["q.rooty"])
    env = _core.Env("Hopper-v5")
    assert np.array_equal(data["observations"][7], env.set_state(data["qpos"][7], data["qvel"][7]))


def test_what_is_not_observed_may_be_missing_and_velocities_are_differences(tmp_path: Path) -> None:
    columns = {name: column for name, column in episode().items() if name.startswith("q.") and name != "q.rootx"}
    data = checked(demos.from_columns("Hopper-v5", [columns], tmp_path / "a.npz", dt=0.008))
    assert not data["qpos"][:, 0].any()
    np.testing.assert_allclose(data["qvel"][:, 4], np.gradient(columns["q.leg_joint"], 0.008), rtol=0, atol=1e-12)
    with pytest.raises(demos.BadDemonstrations, match="episode 0: no column 'q.leg_joint'"):
        demos.from_columns("Hopper-v5", [{k: v for k, v in columns.items() if k != "q.leg_joint"}], tmp_path / "b.npz", dt=0.008)


def test_another_period_is_interpolated_and_a_turning_base_has_the_right_velocity(tmp_path: Path) -> None:
    t = np.arange(40) * 0.02
    rate = 1.5  # rad/s about the body's own z axis
    columns = {f"q.{joint}": 0.1 * t for joint in _core.Env("Ant-v5").joint_names[1:]}
    columns |= {f"q.root.{e}": x for e, x in zip(("x", "y", "z", "qx", "qy"), (0.3 * t, 0 * t, 0.75 + 0 * t, 0 * t, 0 * t))}
    columns |= {"q.root.qw": -np.cos(rate * t / 2), "q.root.qz": -np.sin(rate * t / 2)}  # the other sign is the same rotation
    columns["q.root.qw"][20:] *= -1
    columns["q.root.qz"][20:] *= -1
    data = checked(demos.from_columns("Ant-v5", [columns], tmp_path / "a.npz", dt=0.02), "Ant-v5")
    assert float(data["dt"]) == 0.05 and data["lengths"].tolist() == [15]
    assert np.allclose(data["qvel"][:, :6], [0.3, 0, 0, 0, 0, rate], atol=1e-9)
    assert np.allclose(np.linalg.norm(data["qpos"][:, 3:7], axis=1), 1) and np.allclose(data["qvel"][:, 6:], 0.1)


def test_differences_are_numpys_and_know_the_ends_of_episodes(tmp_path: Path) -> None:
    parts = [{name: column for name, column in episode(n, seed).items() if name.startswith("q.")} for n, seed in ((30, 0), (3, 1), (2, 2))]
    data = checked(demos.from_columns("Hopper-v5", parts, tmp_path / "a.npz", dt=0.008))
    expected = [np.gradient(np.stack(list(part.values()), 1), 0.008, axis=0) for part in parts]
    np.testing.assert_allclose(data["qvel"], np.concatenate(expected), rtol=0, atol=1e-11)


def test_a_base_that_turns_ever_faster_has_the_velocity_of_each_row(tmp_path: Path) -> None:
    """Of an angle of the second order central differences are exact, about an axis that is none of the frame's."""
    t, axis = np.arange(40) * 0.05, np.array([2.0, -1.0, 2.0]) / 3
    angle = 0.8 * t**2
    columns = {f"q.{joint}": (0.0 if joint.startswith("hip") else 0.9) + 0 * t for joint in _core.Env("Ant-v5").joint_names[1:]}
    columns |= {f"q.root.{e}": x for e, x in zip(("x", "y", "z"), (0.3 * t**2, 0 * t, 0.75 + 0 * t))} | {"q.root.qw": np.cos(angle / 2)}
    columns |= {f"q.root.{e}": a * np.sin(angle / 2) for e, a in zip(("qx", "qy", "qz"), axis)}
    data = checked(demos.from_columns("Ant-v5", [columns], tmp_path / "a.npz", dt=0.05), "Ant-v5")
    inner = slice(1, -1)
    np.testing.assert_allclose(data["qvel"][inner, 3:6], 1.6 * t[inner, None] * axis, atol=1e-9)
    np.testing.assert_allclose(data["qvel"][inner, 0], 0.6 * t[inner], atol=1e-9)


def turning(n: int = 20, dt: float = 0.05) -> dict[str, np.ndarray]:
    """Ant turns about its z axis at 0.4 rad/s, and its joints stand."""
    t = np.arange(n) * dt
    columns = {f"q.{joint}": (0.0 if joint.startswith("hip") else 0.9) + 0 * t for joint in _core.Env("Ant-v5").joint_names[1:]}
    columns |= {f"q.root.{entry}": value + 0 * t for entry, value in zip(("x", "y", "z", "qx", "qy"), (0, 0, 0.75, 0, 0))}
    return columns | {"q.root.qw": np.cos(0.2 * t), "q.root.qz": np.sin(0.2 * t)}


@pytest.mark.parametrize("norm", [0.0, 1e-9, 0.1, 0.84, 1.16, 2.0])
def test_a_quaternion_that_is_no_rotation_is_refused(tmp_path: Path, norm: float) -> None:
    """As trackers write it where they lost the robot; in the second episode here."""
    lost = turning()
    for entry in ("qw", "qx", "qy", "qz"):
        lost[f"q.root.{entry}"] = lost[f"q.root.{entry}"] * np.where(np.arange(20) == 11, norm, 1.0)
    said = rf"episode 1: the quaternion of columns q.root.qw, q.root.qx, q.root.qy, q.root.qz has the norm {norm:.3g} in row 11, .* leave the rows out"
    with pytest.raises(demos.BadDemonstrations, match=said):
        demos.from_columns("Ant-v5", [turning(), lost], tmp_path / "a.npz", dt=0.05)
    assert not (tmp_path / "a.npz").exists()


def test_a_quaternion_that_is_nearly_one_has_its_direction(tmp_path: Path) -> None:
    rounded = {name: 0.9 * of if name.startswith("q.root.q") else of for name, of in turning().items()}
    data = checked(demos.from_columns("Ant-v5", [rounded], tmp_path / "a.npz", dt=0.05), "Ant-v5")
    half = 0.2 * 0.05 * np.arange(20)
    np.testing.assert_allclose(data["qpos"][:, 3:7], np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], 1), rtol=0, atol=1e-12)


def test_how_a_base_is_turned_is_asked_for_where_nothing_observes_it(tmp_path: Path) -> None:
    """There is no 0 among rotations, as there is among places."""
    (tmp_path / "float.xml").write_text(
        '<mujoco><option timestep="0.01"/><worldbody><body name="base"><freejoint name="root"/><geom size=".1" mass="1"/><body name="leg">'
        '<joint name="knee" axis="0 1 0" range="-90 90"/><geom size=".05" mass="1"/></body></body></worldbody>'
        '<actuator><motor joint="knee" ctrlrange="-9 9"/></actuator></mujoco>'
    )
    task = tmp_path / "float.toml"
    task.write_text(
        'name = "float"\n[model]\nmjcf = "float.xml"\n[time]\ndt = 0.02\nsim_dt = 0.01\n[state]\nobservation = ["q.knee", "v.knee"]\ncontrollable = ["knee"]\n'
        '[reward]\na = "1"\n[constraints]\nconsistency = "free"\nposition = {}\n[idm]\nkind = "learned"\n'
    )
    with pytest.raises(demos.BadDemonstrations, match="episode 0: no column 'q.root.qw'; it has q.knee"):
        demos.from_columns(task, [{"q.knee": np.zeros(9)}], tmp_path / "a.npz", dt=0.02)
    turned = {"q.knee": np.zeros(9)} | {f"q.root.{entry}": np.full(9, value) for entry, value in zip(("qw", "qx", "qy", "qz"), (0.6, 0.8, 0, 0))}
    with np.load(demos.from_columns(task, [turned], tmp_path / "a.npz", dt=0.02)) as data:
        assert data["qpos"][4].tolist() == [0, 0, 0, 0.6, 0.8, 0, 0, 0], "a place may be missing"


def test_masked_values_are_no_values(tmp_path: Path) -> None:
    columns = episode()
    part = columns | {"q.leg_joint": np.ma.array(columns["q.leg_joint"], mask=np.isin(np.arange(30), (12, 20)))}
    with pytest.raises(demos.BadDemonstrations, match="episode 0: column 'q.leg_joint' is masked in row 12, so it has no value there; fill it, or give"):
        demos.from_columns("Hopper-v5", [part], tmp_path / "a.npz", dt=0.008)
    whole = {name: np.ma.array(of, mask=np.zeros(30, bool)) for name, of in columns.items()}
    data = checked(demos.from_columns("Hopper-v5", [whole], tmp_path / "a.npz", dt=0.008))
    assert np.array_equal(data["qpos"][:, 4], columns["q.leg_joint"])


@pytest.mark.parametrize("factor", [-1.0, 0.0, 180 / np.pi, 1e-3])
def test_velocities_that_positions_do_not_follow_are_warned_of(tmp_path: Path, factor: float) -> None:
    right = [episode(60), episode(60, 1)]
    wrong = [columns | {"v.leg_joint": factor * columns["v.leg_joint"]} for columns in right]
    with pytest.warns(UserWarning, match=r"episode .: column 'v.leg_joint' is .* where 'q.leg_joint' changes by .* look at sign, unit and dt") as told:
        demos.from_columns("Hopper-v5", wrong, tmp_path / "a.npz", dt=0.008)
    assert sum("changes by" in str(warning.message) for warning in told) == 1
    every = {name: factor * of if name.startswith("v.") else of for name, of in right[1].items()}
    with pytest.warns(UserWarning, match=r"likewise .*v.foot_joint"):
        demos.from_columns("Hopper-v5", [every], tmp_path / "b.npz", dt=0.008)


@pytest.mark.parametrize("task", ["HalfCheetah-v5", "Hopper-v5", "Ant-v5", "Panda-reach", "Walker2d-v5"])
@pytest.mark.parametrize("every", [1, 3])
def test_velocities_of_a_simulation_are_not(tmp_path: Path, task: str, every: int) -> None:
    """Of wild motions too, with impacts, and of rows that are too far apart for them."""
    env, rng = _core.Env(task), np.random.default_rng(3)
    q_names, v_names = demos._entries(env)
    env.reset(3)
    rows = []
    for _ in range(200):
        rows.append([*env.qpos, *env.qvel])
        env.step(rng.uniform(env.action_low, env.action_high))
    columns = dict(zip([*q_names, *v_names], np.array(rows)[::every].T))
    if task == "Panda-reach":
        columns |= {f"goal.{axis}": np.full(len(columns[q_names[0]]), 0.4) for axis in "xyz"}
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*changes by")
        demos.from_columns(task, [columns], tmp_path / "a.npz", dt=env.dt * every)


def test_csv(tmp_path: Path) -> None:
    parts = [episode(), episode(20, 1)]
    table = {name: np.concatenate([p[name] for p in parts]) for name in parts[0]} | {"episode": np.repeat([4, 2], [30, 20])}
    file = tmp_path / "walk.csv"
    np.savetxt(file, np.stack(list(table.values()), 1), delimiter=",", header=",".join(table), comments="", fmt="%.17g")
    data = checked(demos.from_csv("Hopper-v5", file, tmp_path / "a.npz", dt=0.008, actions=("a", "b", "c")))
    assert data["lengths"].tolist() == [29, 19] and np.array_equal(data["qpos"][30:, 3], parts[1]["q.thigh_joint"])
    file.write_text(file.read_text().replace("\n", ",1\n", 2).replace(",1\n", "\n", 1))
    with pytest.raises(demos.BadDemonstrations, match=r"walk.csv"):
        demos.from_csv("Hopper-v5", file, tmp_path / "b.npz", dt=0.008)
    columns = episode()
    columns["q.rooty"][11] = np.nan
    with pytest.raises(demos.BadDemonstrations, match="episode 0: column 'q.rooty' is nan in row 11"):
        demos.from_columns("Hopper-v5", [columns], tmp_path / "b.npz", dt=0.008)
    with pytest.raises(demos.BadDemonstrations, match="actions cannot be interpolated"):
        demos.from_columns("Hopper-v5", [episode()], tmp_path / "b.npz", dt=0.01, actions=("a", "b", "c"))


@pytest.mark.parametrize("name", ["d.csv", "d"])
def test_what_is_written_is_called_what_it_is(tmp_path: Path, name: str) -> None:
    with pytest.raises(demos.BadDemonstrations, match=rf"out is '.*/{name}', and demonstrations are written as NumPy's .npz; give '.*/d.npz'"):
        demos.from_columns("Hopper-v5", [episode()], tmp_path / name, dt=0.008)
    assert not list(tmp_path.iterdir())


def test_motion_clips(tmp_path: Path) -> None:
    columns = episode()
    joints = [name[2:] for name in columns if name.startswith("q.")]
    file = tmp_path / "clip.npz"
    positions = np.stack([columns[f"q.{joint}"] for joint in joints], 1)
    np.savez(file, fps=np.array([125]), joint_pos=positions, joint_names=np.array(joints))
    data = checked(demos.from_motion("Hopper-v5", file, tmp_path / "a.npz"))
    assert np.array_equal(data["qpos"], positions)
    # as HDF5 gives names
    np.savez(file, fps=np.array([125]), joint_pos=positions, joint_names=np.array([joint.encode() for joint in joints]))
    with np.load(demos.from_motion("Hopper-v5", file, tmp_path / "bytes.npz")) as again:
        assert all(np.array_equal(again[name], of) for name, of in data.items())
    demos.from_motion("Hopper-v5", file, tmp_path / "given.npz", joints=[joint.encode() for joint in joints])
    np.savez(file, fps=np.array([125]), joint_pos=positions, joint_names=np.array([b"\xff", *(joint.encode() for joint in joints[1:])]))
    with pytest.raises(demos.BadDemonstrations, match=r"clip.npz': 'joint_names' has b'\\xff', which is no text in UTF-8; give names as text"):
        demos.from_motion("Hopper-v5", file, tmp_path / "b.npz")
    np.savez(file, fps=np.array([125]), joint_vel=positions)
    with pytest.raises(demos.BadDemonstrations, match="clip.npz': no array 'joint_pos'; it has fps, joint_vel"):
        demos.from_motion("Hopper-v5", file, tmp_path / "b.npz")


def test_minari(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A dataset of Gymnasium's Hopper that Minari itself wrote."""
    minari, gymnasium = pytest.importorskip("minari"), pytest.importorskip("gymnasium")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    env, buffers = gymnasium.make("Hopper-v5"), []
    env.action_space.seed(3)
    for k in range(2):
        observations, actions, rewards = [env.reset(seed=k)[0]], [], []
        for _ in range(12):
            actions.append(0.3 * env.action_space.sample())
            observation, reward, *_ = env.step(actions[-1])
            observations.append(observation)
            rewards.append(reward)
        cut = [False] * 11 + [True]
        lists = {"observations": np.array(observations), "actions": np.array(actions), "rewards": rewards, "terminations": [False] * 12, "truncations": cut}
        buffers.append(minari.data_collector.EpisodeBuffer(id=k, **lists))
    dataset = minari.create_dataset_from_buffers("nearl/hopper-v0", buffers, env=env)
    env.close()
    data = checked(demos.from_minari("Hopper-v5", dataset, tmp_path / "a.npz"))
    e = next(iter(dataset.iterate_episodes()))
    n = len(e.actions)
    assert data["lengths"][0] == n and np.allclose(data["observations"][: n + 1], e.observations) and np.array_equal(data["actions"][:n], e.actions)


def test_robomimic(tmp_path: Path) -> None:
    """Its layout: `data/demo_<k>/obs/<key>`, demonstration 10 after 9."""
    h5py = pytest.importorskip("h5py")
    parts = {f"demo_{k}": episode(12, k) for k in (0, 2, 10)}
    joints = [name for name in parts["demo_0"] if name.startswith("q.")]
    with h5py.File(tmp_path / "low_dim.hdf5", "w") as file:
        for name, columns in parts.items():
            group = file.create_group(f"data/{name}")
            group.attrs["num_samples"] = 12
            group["obs/joint_pos"] = np.stack([columns[joint] for joint in joints], 1)
            group["actions"] = np.stack([columns[name] for name in "cab"], 1)
    which = {name: ("joint_pos", k) for k, name in enumerate(joints)}
    data = checked(demos.from_robomimic("Hopper-v5", tmp_path / "low_dim.hdf5", tmp_path / "a.npz", dt=0.008, columns=which))
    assert data["lengths"].tolist() == [11] * 3 and np.array_equal(data["qpos"][24:, 4], parts["demo_10"]["q.leg_joint"])
    with pytest.raises(demos.BadDemonstrations, match=r"episode 0 \(demo_0\): no observation 'arm'"):
        demos.from_robomimic("Hopper-v5", tmp_path / "low_dim.hdf5", tmp_path / "b.npz", dt=0.008, columns={"q.rooty": ("arm", 0)})
    # actions of the demonstration, in the order of the task's actuators: by entries, or by names of columns
    expected = np.concatenate([np.stack([part[name] for name in "abc"], 1)[:-1] for part in parts.values()])
    named = which | {"first": ("actions", 1), "second": ("actions", 2), "third": ("actions", 0)}
    for columns, actions in ((which, [("actions", 1), ("actions", 2), ("actions", 0)]), (named, ["first", "second", "third"])):
        out = demos.from_robomimic("Hopper-v5", tmp_path / "low_dim.hdf5", tmp_path / "c.npz", dt=0.008, columns=columns, actions=actions, overwrite=True)
        assert np.array_equal(checked(out)["actions"], expected)
    with pytest.raises(demos.BadDemonstrations, match=r"no observation 'actions' with entry 3 for 'actions\[2\]'; it has .*actions \(12, 3\)"):
        actions = [("actions", k) for k in (1, 2, 3)]
        demos.from_robomimic("Hopper-v5", tmp_path / "low_dim.hdf5", tmp_path / "d.npz", dt=0.008, columns=which, actions=actions)
    for actions, words in ([["a", 1.5]], r"columns\['actions\[0\]'\] is \['a', 1.5\]; give the"), ("actions", "actions is 'actions'; give one column for each"):
        with pytest.raises(demos.BadDemonstrations, match=words):
            demos.from_robomimic("Hopper-v5", tmp_path / "low_dim.hdf5", tmp_path / "d.npz", dt=0.008, columns=which, actions=actions)


def test_lerobot(tmp_path: Path) -> None:
    """Its layout of version 3: `meta/info.json` and several episodes in one `data/chunk-*/file-*.parquet`."""
    pa, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    parts = [episode(12, k) for k in (0, 1)]
    joints = [name for name in parts[0] if name.startswith("q.")]
    (tmp_path / "meta").mkdir()
    (tmp_path / "data" / "chunk-000").mkdir(parents=True)
    names = [f"{name[2:]}.pos" for name in joints]
    feature = {"dtype": "float32", "shape": [len(names)], "names": names}
    (tmp_path / "meta" / "info.json").write_text(json.dumps({"codebase_version": "v3.0", "fps": 125, "features": {"observation.state": feature}}))
    rows = np.concatenate([np.stack([p[name] for name in joints], 1) for p in parts]).astype(np.float32)
    table = {"observation.state": pa.array(rows.tolist(), pa.list_(pa.float32())), "episode_index": np.repeat([0, 1], 12)}
    parquet.write_table(pa.table(table), tmp_path / "data" / "chunk-000" / "file-000.parquet")
    data = checked(demos.from_lerobot("Hopper-v5", tmp_path, tmp_path / "a.npz"))
    assert data["lengths"].tolist() == [11, 11] and np.allclose(data["qpos"][12:, 5], parts[1]["q.foot_joint"], atol=1e-6)
    with pytest.raises(demos.BadDemonstrations, match=r"no feature 'state'; it has observation.state"):
        demos.from_lerobot("Hopper-v5", tmp_path, tmp_path / "b.npz", key="state")


def lerobot(folder: Path, features: dict[str, tuple[object, np.ndarray]], episodes: np.ndarray) -> Path:
    """A dataset of version 3 of names and rows by feature."""
    pa, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    (folder / "meta").mkdir(parents=True)
    (folder / "data" / "chunk-000").mkdir(parents=True)
    of = {key: {"dtype": "float32", "shape": [rows.shape[1]], "names": names} for key, (names, rows) in features.items()}
    (folder / "meta" / "info.json").write_text(json.dumps({"codebase_version": "v3.0", "fps": 125, "features": of}))
    table = {key: pa.array(rows.astype(np.float32).tolist(), pa.list_(pa.float32())) for key, (_, rows) in features.items()}
    parquet.write_table(pa.table(table | {"episode_index": episodes}), folder / "data" / "chunk-000" / "file-000.parquet")
    return folder


@pytest.mark.parametrize(
    ("times", "words"),
    [
        (0.016 * np.arange(12), "'timestamp' goes on by 0.016 from row to row, and dt is 0.008 s"),
        (0.008 * np.arange(12) + np.where(np.arange(12) > 6, 0.5, 0.0), "'timestamp' goes from 0.04.* in row 6 to 0.55.* in the next, and dt is 0.008 s"),
        (0.008 * np.arange(12), None),
    ],
)
def test_the_timestamps_of_lerobot_are_held_against_its_rate(tmp_path: Path, times: np.ndarray, words: str | None) -> None:
    part = episode(12, 0)
    joints = [name for name in part if name.startswith("q.")]
    rows = np.stack([part[name] for name in joints], 1)
    folder = lerobot(tmp_path / "set", {"observation.state": ([name[2:] for name in joints], rows), "timestamp": (None, times[:, None])}, np.zeros(12, int))
    if words is None:
        assert checked(demos.from_lerobot("Hopper-v5", folder, tmp_path / "a.npz"))["lengths"].tolist() == [11]
        return
    with pytest.raises(demos.BadDemonstrations, match=words):
        demos.from_lerobot("Hopper-v5", folder, tmp_path / "a.npz")


def test_lerobot_has_velocities_and_actions(tmp_path: Path) -> None:
    """Positions, velocities and a gripper in one feature; targets that are called as the positions are in another."""
    parts = [episode(12, k) for k in (0, 1)]
    rows = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    q, v = ([name for name in rows if name.startswith(letter)] for letter in ("q.", "v."))
    names = [f"{name[2:]}.vel" for name in v] + ["gripper.pos"] + [f"{name[2:]}.pos" for name in q]
    states = np.stack([*(rows[name] for name in v), np.zeros(24), *(rows[name] for name in q)], 1)
    acted = np.stack([rows[name] for name in "cab"], 1)
    joints = ["foot_joint.pos", "thigh_joint.pos", "leg_joint.pos"]
    features = {"observation.state": (names, states), "action": ({"motors": joints}, acted)}
    folder = lerobot(tmp_path / "set", features, np.repeat([0, 1], 12))
    with pytest.warns(UserWarning, match="of 'observation.state' gripper.pos is left out"):
        data = checked(demos.from_lerobot("Hopper-v5", folder, tmp_path / "a.npz", actions=[joints[1], joints[2], joints[0]]))
    assert np.array_equal(data["qvel"], np.stack([rows[name] for name in v], 1).astype(np.float32))
    expected = np.concatenate([np.stack([part[name] for name in "abc"], 1)[:-1] for part in parts])
    assert np.array_equal(data["actions"], expected.astype(np.float32))
    with pytest.raises(demos.BadDemonstrations, match="actions has 'knee', which is no entry of 'action'; give a list of foot_joint.pos, thigh_joint.pos"):
        demos.from_lerobot("Hopper-v5", folder, tmp_path / "b.npz", actions=["knee", *joints[:2]])
    features["action"] = (None, acted)
    data = checked(demos.from_lerobot("Hopper-v5", lerobot(tmp_path / "b", features, np.repeat([0, 1], 12)), tmp_path / "c.npz", actions=UNNAMED))
    assert np.array_equal(data["actions"], expected.astype(np.float32))
    del features["action"]
    with pytest.raises(demos.BadDemonstrations, match="no feature 'action' for actions="):
        demos.from_lerobot("Hopper-v5", lerobot(tmp_path / "c", features, np.repeat([0, 1], 12)), tmp_path / "d.npz", actions=UNNAMED)


def lerobot_in_files(folder: Path, lengths: list[int], per_file: int, lists: bool) -> Path:
    """A dataset as LeRobot lays it out, its frames dealt to files of ``per_file`` each; with ``lists`` in meta/episodes where each episode is."""
    pa, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    parts = [episode(n, k) for k, n in enumerate(lengths)]
    joints = [name for name in parts[0] if name.startswith("q.")]
    feature = {"dtype": "float32", "shape": [len(joints)], "names": [f"{name[2:]}.pos" for name in joints]}
    info = {"codebase_version": "v3.0", "fps": 125, "features": {"observation.state": feature}, "total_episodes": len(lengths), "total_frames": sum(lengths),
            "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"}  # fmt: skip
    (folder / "meta" / "episodes").mkdir(parents=True)
    (folder / "data" / "chunk-000").mkdir(parents=True)
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    rows = np.concatenate([np.stack([part[name] for name in joints], 1) for part in parts]).astype(np.float32)
    of, frame = np.repeat(np.arange(len(lengths)), lengths), np.concatenate([np.arange(n) for n in lengths])
    table = pa.table({"observation.state": pa.array(rows.tolist(), pa.list_(pa.float32())), "episode_index": of, "frame_index": frame})
    for k in range(-(-len(of) // per_file)):
        parquet.write_table(table.slice(k * per_file, per_file), folder / "data" / "chunk-000" / f"file-{k:03d}.parquet")
    if lists:
        ends = (np.cumsum(lengths) - 1) // per_file
        of_each = {"episode_index": range(len(lengths)), "length": lengths, "data/chunk_index": [0] * len(lengths), "data/file_index": ends.tolist()}
        parquet.write_table(pa.table({name: list(of) for name, of in of_each.items()}), folder / "meta" / "episodes" / "file-000.parquet")
    return folder


@pytest.mark.parametrize(
    ("per_file", "gone", "lists", "words"),
    [
        (20, 0, False, r"the data has 2 episodes with 24 frames, and meta/info.json says 4 episodes with 44 frames; the first that is missing is episode 0 "
                       r"\('data/chunk-000/file-000.parquet' is not there\)"),
        (20, 1, False, r"episode 3 begins with frame 8 in 'data/chunk-000/file-002.parquet', so .* the data has 3 episodes with 24 frames, .* says 4 e"),
        (20, 2, False, r"the data has 4 episodes with 40 frames, and meta/info.json says 4 episodes with 44 frames; get the dataset again"),
        (20, 2, True, r"episode 3 has 8 frames up to 'data/chunk-000/file-001.parquet', and meta/episodes says 12; .* \('data/chunk-000/file-002.parquet' is"),
        (18, 0, False, r"episode 1 begins with frame 10 in 'data/chunk-000/file-001.parquet', so frames of it are missing; .* 44 frames \(.*file-000.parquet'"),
        (9, 1, True, r"episode 1 goes from frame 0 to frame 10 in 'data/chunk-000/file-002.parquet'.* \('data/chunk-000/file-001.parquet' is not there\); "),
        (4, 3, False, r"episode 1 goes from frame 3 to frame 8 in 'data/chunk-000/file-004.parquet', so .* \('data/chunk-000/file-003.parquet' is not there\)"),
    ],
)  # fmt: skip
def test_lerobot_without_a_file_is_refused(tmp_path: Path, per_file: int, gone: int, lists: bool, words: str) -> None:
    """What its own numbers say must be there: between two episodes, at their end and inside of one."""
    folder = lerobot_in_files(tmp_path / "set", [8, 12, 12, 12], per_file, lists)
    assert checked(demos.from_lerobot("Hopper-v5", folder, tmp_path / "whole.npz"))["lengths"].tolist() == [7, 11, 11, 11]
    (folder / "data" / "chunk-000" / f"file-{gone:03d}.parquet").unlink()
    with pytest.raises(demos.BadDemonstrations, match=f"set': {words}"):
        demos.from_lerobot("Hopper-v5", folder, tmp_path / "a.npz")
    assert not (tmp_path / "a.npz").exists()


def test_lerobot_with_a_file_cut_short_is_refused(tmp_path: Path) -> None:
    folder = lerobot_in_files(tmp_path / "set", [8, 12], 9, True)
    file = folder / "data" / "chunk-000" / "file-001.parquet"
    content = file.read_bytes()
    for bad in (content[:-200], content[:3], b"", content[:4] + bytes(60) + content[64:]):
        file.write_bytes(bad)
        with pytest.raises(demos.BadDemonstrations, match=r"file-001.parquet' cannot be read as parquet \(.+\); it was cut short or damaged: get"):
            demos.from_lerobot("Hopper-v5", folder, tmp_path / "a.npz")
    for rest in (folder / "data").rglob("*.parquet"):
        rest.unlink()
    with pytest.raises(demos.BadDemonstrations, match=r"set': its folder 'data' has no parquet file"):
        demos.from_lerobot("Hopper-v5", folder, tmp_path / "a.npz")


def test_names_for_lerobot_are_spelt_as_its_own(tmp_path: Path) -> None:
    """With names=, bare, with .pos or as columns of the task; what the dataset calls them is of no matter then."""
    part = episode(12, 0)
    q = [name for name in part if name.startswith("q.")]
    rows = np.stack([part[name] for name in q], 1)
    folder = lerobot(tmp_path / "set", {"observation.state": (None, rows)}, np.zeros(12, int))
    for spelt in ("{}", "{}.pos", "q.{}", "{{q.{}}}"):
        names = [spelt.format(name[2:]) for name in q]
        data = checked(demos.from_lerobot("Hopper-v5", folder, tmp_path / "a.npz", names=names, overwrite=True))
        assert np.array_equal(data["qpos"], rows.astype(np.float32)), spelt
    refused = pytest.raises(demos.BadDemonstrations, match="no column 'q.foot_joint'")
    with pytest.warns(UserWarning, match="of 'observation.state' gripper is left out"), refused:
        demos.from_lerobot("Hopper-v5", folder, tmp_path / "b.npz", names=[*(name[2:] for name in q[:-1]), "gripper"])
    for names, words in ((None, r"shape \(12, 6\) and 0 names; give names=, one for each entry: <joint>, <joint>.pos"), ("rootx", "names is 'rootx'; give")):
        with pytest.raises(demos.BadDemonstrations, match=words):
            demos.from_lerobot("Hopper-v5", folder, tmp_path / "b.npz", names=names)


def test_lerobot_as_lerobot_writes_it(tmp_path: Path) -> None:
    """Two episodes that LeRobot itself recorded and closed."""
    datasets = pytest.importorskip("lerobot.datasets.lerobot_dataset", reason="lerobot is not installed (it brings torch)")
    parts = [episode(12, 0), episode(9, 1)]
    joints = [name for name in parts[0] if name.startswith("q.")]
    feature = {"dtype": "float32", "shape": (len(joints),), "names": [f"{name[2:]}.pos" for name in joints]}
    recorded = datasets.LeRobotDataset.create("nearl/hopper", fps=125, features={"observation.state": feature}, root=tmp_path / "set", use_videos=False)
    for columns in parts:
        for row in np.stack([columns[name] for name in joints], 1).astype(np.float32):
            recorded.add_frame({"observation.state": row, "task": "hop"})
        recorded.save_episode()
    recorded.finalize()
    data = checked(demos.from_lerobot("Hopper-v5", tmp_path / "set", tmp_path / "a.npz"))
    assert data["lengths"].tolist() == [11, 8] and float(data["dt"]) == 0.008
    assert np.array_equal(data["qpos"][12:, 5].astype(np.float32), parts[1]["q.foot_joint"].astype(np.float32))


def test_lerobot_with_a_row_of_another_width_is_refused(tmp_path: Path) -> None:
    pa, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    folder = lerobot_in_files(tmp_path / "set", [8, 12], 10, True)
    file = folder / "data" / "chunk-000" / "file-001.parquet"
    table = parquet.read_table(file)
    for entries, shape in (([0.0] * 4, r"\(4,\)"), (None, r"\(\)")):
        rows = table["observation.state"].to_pylist()
        rows[3] = entries
        parquet.write_table(table.set_column(0, "observation.state", pa.array(rows, pa.list_(pa.float32()))), file)
        with pytest.raises(demos.BadDemonstrations, match=rf"file-001.parquet': 'observation.state' has shape {shape} in row 3 \(episode 1\), and \(6,\) in"):
            demos.from_lerobot("Hopper-v5", folder, tmp_path / "a.npz")


def test_an_agent_learns_from_them(tmp_path: Path) -> None:
    file = demos.from_columns("Hopper-v5", [episode(), episode(20, 1)], tmp_path / "a.npz", dt=0.008)
    small = {"train.n_envs": 2, "train.n_steps": 64, "train.ppo.n_epochs": 1, "train.demos.warmup": 128, "train.demos.epochs": 2}
    seen: list[dict[str, float]] = []
    agent = nearl.PID2("Hopper-v5", algo="pid2-il", demos=file, settings=small)
    agent.learn(512, callback=lambda _, metrics: seen.append(metrics))
    assert sum("demos/cloning_mse" in m for m in seen) == 1 and "discriminator/loss" in seen[-1]
    with pytest.raises(ValueError, match="'ppo' takes no demonstrations"):
        nearl.PID2("Hopper-v5", algo="ppo", demos=file)


def test_demonstrations_can_be_looked_at(tmp_path: Path) -> None:
    imageio = pytest.importorskip("imageio.v3")
    pytest.importorskip("imageio_ffmpeg")
    file = demos.from_columns("Hopper-v5", [episode(), episode(20, 1)], tmp_path / "a.npz", dt=0.008)
    film = lambda *more: subprocess.run(  # noqa: E731
        [sys.executable, "-m", "nearl.video", file, tmp_path / "a.mp4", *more], capture_output=True, text=True, env={**os.environ, "MUJOCO_GL": "egl"}
    )
    done = film("--task", "Hopper-v5", "--episodes", "2", "--size", "96", "96")
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip().endswith(": 25 frames"), "every other of 30 and of 20 states"
    assert np.stack(list(imageio.imiter(tmp_path / "a.mp4"))).std() > 5, "not an empty picture"
    for more, words in (((), "say of which task"), (("--task", "Ant-v5"), "the robot of 'Ant-v5' has 15 and 14")):
        failed = film(*more)
        assert failed.returncode == 1 and words in failed.stderr, failed.stderr


def test_a_robot_whose_base_floats_is_drawn_where_it_is() -> None:
    """A URDF says nothing of the floating base: the task does."""
    pytest.importorskip("mujoco")
    from nearl.render import Renderer

    env = _core.Env(str(ROOT / "examples" / "tasks" / "anymal-walk.toml"))
    env.reset(0)
    renderer = Renderer(env, (96, 96))
    stands, lies = env.qpos.copy(), env.qpos.copy()
    lies[2:7] = [0.1, 0.0, 1.0, 0.0, 0.0]  # on its back
    pictures = [renderer.frame(qpos, env.qvel).astype(float) for qpos in (stands, lies)]
    renderer.close()
    assert all(picture.std() > 5 for picture in pictures), "not an empty picture"
    assert np.abs(pictures[0] - pictures[1]).mean() > 2


def test_actions_may_be_none(tmp_path: Path) -> None:
    data = checked(demos.from_columns("Hopper-v5", [episode()], tmp_path / "none.npz", dt=0.008, actions=None))
    assert "actions" not in data


def test_a_column_of_actions_that_is_given_twice_is_named(tmp_path: Path) -> None:
    columns, out = episode() | {"m0": np.zeros(30), "m1": np.zeros(30)}, tmp_path / "a.npz"
    for actions, name in ((["m0"] * 3, "m0"), (["m0", "m1", "m1"], "m1")):
        with pytest.raises(demos.BadDemonstrations, match=rf"actions has '{name}' twice; give one column for each actuator, "):
            demos.from_columns("Hopper-v5", [columns], out, dt=0.008, actions=actions)
    assert not out.exists()


def test_an_entry_of_robomimic_that_is_given_twice_is_named(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    columns, out = episode(), tmp_path / "a.npz"
    with h5py.File(tmp_path / "a.hdf5", "w") as file:
        file["data/demo_0/obs/state"] = np.stack(list(columns.values()), 1)
        file["data/demo_0/actions"] = np.zeros((30, 3))
    of = {name: ("state", k) for k, name in enumerate(columns)}
    with pytest.raises(demos.BadDemonstrations, match=r"actions has \('actions', 0\) twice; give one column for each actuator, "):
        demos.from_robomimic("Hopper-v5", tmp_path / "a.hdf5", out, dt=0.008, columns=of, actions=[("actions", 0), ("actions", 1), ("actions", 0)])
    assert not out.exists()


def test_an_entry_of_lerobot_that_is_given_twice_is_named(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    columns, out = episode(), tmp_path / "a.npz"
    features = {"observation.state": ([*columns], np.stack(list(columns.values()), 1)), "action": (["hip", "knee", "foot"], np.zeros((30, 3)))}
    folder = lerobot(tmp_path / "set", features, np.zeros(30, int))
    with pytest.raises(demos.BadDemonstrations, match=r"actions has 'knee' twice; give one column for each actuator, "):
        demos.from_lerobot("Hopper-v5", folder, out, actions=["hip", "knee", "knee"])
    assert not out.exists()


def test_a_heading_that_is_a_comment_is_named(tmp_path: Path) -> None:
    """As numpy.savetxt writes one, unless it is told otherwise."""
    columns, file = episode(), tmp_path / "walk.csv"
    rows, heading = np.stack(list(columns.values()), 1), ",".join(columns)
    convert = lambda: demos.from_csv("Hopper-v5", file, tmp_path / "a.npz", dt=0.008, overwrite=True)  # noqa: E731
    for above in ("", "walks\n"):
        np.savetxt(file, rows, delimiter=",", header=above + heading)
        with pytest.raises(demos.BadDemonstrations, match=r"walk.csv': its heading begins with '#', '# q.rootx'; save with comments='', or take the sign away"):
            convert()
    np.savetxt(file, rows, delimiter=",", header="a walk, by hand")
    with pytest.raises(demos.BadDemonstrations, match=r"walk.csv': its first line is numbers; begin with a heading"):
        convert()
    np.savetxt(file, rows, delimiter=",", header=heading, comments="")
    assert convert().exists()


@pytest.mark.parametrize("cell", ["1_0.5", "0.02_4", "1_0"])
def test_a_cell_with_an_underscore_is_no_number(tmp_path: Path, cell: str) -> None:
    """Python takes it between digits; it is a slip of the keyboard or no number at all."""
    columns, file = episode(), tmp_path / "walk.csv"
    lines = [[f"{value}" for value in row] for row in np.stack(list(columns.values()), 1)]
    lines[4][1] = cell
    file.write_text("\n".join(map(",".join, [columns, *lines])))
    name = list(columns)[1]
    with pytest.raises(demos.BadDemonstrations, match=rf"walk.csv', line 6: column '{name}' is '{cell}', which is no number; give a number, or leave"):
        demos.from_csv("Hopper-v5", file, tmp_path / "a.npz", dt=0.008)
    assert not (tmp_path / "a.npz").exists()


def test_warnings_point_at_the_line_that_converts(tmp_path: Path) -> None:
    """Of every reader, whatever is warned of: a column that is not used, a joint out of its range, a jump, velocities that positions do not follow."""
    columns = episode() | {"remark": np.zeros(30)}
    columns["q.foot_joint"] = np.where(np.arange(30) < 20, columns["q.foot_joint"], columns["q.foot_joint"] + 1.5)
    columns["v.rootx"] = 40.0 * np.gradient(columns["q.rootx"], 0.008)
    rows = np.stack(list(columns.values()), 1)
    np.savetxt(tmp_path / "a.csv", rows, delimiter=",", header=",".join(columns), comments="")
    joints = [name for name in columns if name.startswith("q.")]
    clip = {"fps": np.array(125), "joint_pos": np.stack([columns[name] for name in joints], 1), "joint_names": np.array([name[2:] for name in joints])}
    np.savez(tmp_path / "a.npz", **clip)
    readers = {
        "columns": lambda: demos.from_columns("Hopper-v5", [columns], tmp_path / "1.npz", dt=0.008),
        "csv": lambda: demos.from_csv("Hopper-v5", tmp_path / "a.csv", tmp_path / "2.npz", dt=0.008),
        "motion": lambda: demos.from_motion("Hopper-v5", tmp_path / "a.npz", tmp_path / "3.npz"),
    }
    for name, read in readers.items():
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            read()
        assert len(said) >= (1 if name == "motion" else 3), [str(w.message) for w in said]
        assert {(w.filename, w.lineno) for w in said} == {(__file__, read.__code__.co_firstlineno)}, name
