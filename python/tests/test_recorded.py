"""What a recording says beside the joints' states: what was asked for, the policy's period, its units. Against MuJoCo and the recording itself."""

import os
import subprocess
import warnings
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import ROOT

from nearl import _core, demos

mujoco = pytest.importorskip("mujoco")
NEARL = ROOT / "target" / "release" / "nearl"

ROBOT = """<mujoco><option timestep="0.005"/><worldbody>
  <body name="upper"><joint name="shoulder" axis="0 0 1" range="-170 170" limited="true"/><geom type="capsule" fromto="0 0 0 .4 0 0" size=".03" mass="1"/>
  <body name="lower" pos=".4 0 0"><joint name="elbow" axis="0 0 1" range="-150 150" limited="true"/>
  <geom type="capsule" fromto="0 0 0 .3 0 0" size=".03" mass="1"/><body name="tip" pos=".3 0 0"/></body></body></worldbody>
  <actuator><motor joint="shoulder" ctrlrange="-9 9"/><motor joint="elbow" ctrlrange="-9 9"/></actuator></mujoco>"""
# The names of the commands are in another order than the alphabet's, and in another than the observation's.
TASK = """name = "arm"
[model]
mjcf = "arm.xml"
[time]
dt = 0.01
sim_dt = 0.005
policy_every = 2
[state]
controllable = ["shoulder", "elbow"]
observation = ["q.shoulder", "q.elbow", "v.shoulder", "v.elbow", "{commands}"]
propose = ["q.shoulder", "q.elbow", "v.shoulder", "v.elbow"]
[commands]
y = "0.3 * uniform"
x = "0.4 + 0.1 * uniform"
[reward]
near = "-(command.x - x.tip)^2 - (command.y - y.tip)^2"
[constraints]
position = {{}}
velocity = {{ limit = 3.0 }}
acceleration = {{ limit = 50.0 }}
[idm]
kind = "pinocchio"
"""
COMMANDS = ["command.y - y.tip", "command.x - x.tip", "command.x"]


def arm(folder: Path, commands: list[str], more: str = "") -> Path:
    (folder / "arm.xml").write_text(ROBOT)
    (folder / "arm.toml").write_text(TASK.format(commands='", "'.join(commands)) + more)
    return folder / "arm.toml"


def recording(n: int = 60, dt: float = 0.02) -> dict[str, np.ndarray]:
    """Both joints swing; what is asked for changes in the middle."""
    t = np.arange(n) * dt
    asked = {"command.x": np.where(t < t[n // 2], 0.45, 0.35), "command.y": np.where(t < t[n // 2], -0.1, 0.25)}
    return {"q.shoulder": 0.5 * np.sin(t), "q.elbow": 0.3 * np.cos(2 * t)} | asked


def tips(file: Path, qpos: np.ndarray) -> np.ndarray:
    model = mujoco.MjModel.from_xml_path(str(file))
    data, places = mujoco.MjData(model), []
    for q in qpos:
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        places.append(data.body("tip").xpos[:2].copy())
    return np.array(places)


def test_what_was_asked_for_is_as_recorded(tmp_path: Path) -> None:
    """Behind an expression too: MuJoCo says where the tip is, and what is left over is the recording's."""
    one, other = recording(), recording(40)
    other["command.x"] = other["command.x"] + 0.01
    with np.load(demos.from_columns(arm(tmp_path, COMMANDS), [one, other], tmp_path / "a.npz", dt=0.02)) as file:
        data = dict(file)
    x, y = (np.concatenate([part[f"command.{k}"] for part in (one, other)]) for k in "xy")
    tip = tips(tmp_path / "arm.xml", data["qpos"])
    np.testing.assert_allclose(data["observations"][:, 4:], np.stack([y - tip[:, 1], x - tip[:, 0], x], 1), atol=1e-12)


def test_goals_of_the_bundled_arm_are_columns_too(tmp_path: Path) -> None:
    t = np.arange(30) * 0.02
    columns = {f"q.panda_joint{k + 1}": q + 0.1 * np.sin(t) for k, q in enumerate((0, 0, 0, -1.5, 0, 1.5, 0))}
    goal = {f"goal.{axis}": np.full(30, value) for axis, value in zip("xyz", (0.4, -0.1, 0.5))}
    with np.load(demos.from_columns("Panda-reach", [columns | goal], tmp_path / "a.npz", dt=0.02)) as file:
        data = dict(file)
    assert float(data["dt"]) == 0.02 and (data["observations"][:, 14:17] == (0.4, -0.1, 0.5)).all()
    # the hand is where the goal is without the error, whatever the goal is
    hands = data["observations"][:, 14:17] - data["observations"][:, 17:]
    env = _core.Env("Panda-reach")
    env.reset(9)
    for q, v, hand in zip(data["qpos"], data["qvel"], hands):
        obs = env.set_state(q, v)
        np.testing.assert_allclose(obs[14:17] - obs[17:], hand, atol=1e-12)
    with pytest.raises(demos.BadDemonstrations, match=r"episode 0: .*observes goal.x, .*give the columns goal.x, goal.y, goal.z"):
        demos.from_columns("Panda-reach", [columns], tmp_path / "b.npz", dt=0.02)


def test_a_recording_that_does_not_say_what_was_asked_for_is_refused(tmp_path: Path) -> None:
    task, columns = arm(tmp_path, COMMANDS), recording()
    with pytest.raises(demos.BadDemonstrations, match=r"episode 0: the task also observes command.y - y.tip, which .* give the columns command.y as"):
        demos.from_columns(task, [{name: of for name, of in columns.items() if name != "command.y"}], tmp_path / "a.npz", dt=0.02)
    assert not (tmp_path / "a.npz").exists()


def test_noise_is_what_was_measured(tmp_path: Path) -> None:
    """A simulator's own draw in its place would be nobody's measurement."""
    task, columns = arm(tmp_path, ["command.x"], '[noise]\nq = "0.1 * normal"\n'), recording()
    with np.load(demos.from_columns(task, [columns], tmp_path / "a.npz", dt=0.02)) as data:
        assert np.array_equal(data["observations"][:, :2], data["qpos"]) and np.array_equal(data["observations"][:, 4], columns["command.x"])
    task = arm(tmp_path, COMMANDS, '[noise]\nq = "0.1 * normal"\n')
    with pytest.raises(demos.BadDemonstrations, match="give the columns command.y - y.tip, command.x - x.tip .* without .noise."):
        demos.from_columns(task, [columns], tmp_path / "b.npz", dt=0.02)
    own = {"command.y - y.tip": np.linspace(0, 1, 60), "command.x - x.tip": np.linspace(1, 2, 60)}
    with np.load(demos.from_columns(task, [columns | own], tmp_path / "b.npz", dt=0.02)) as data:
        assert np.array_equal(data["observations"][:, 4:6], np.stack(list(own.values()), 1))


def test_contact_forces_are_those_that_were_recorded(tmp_path: Path) -> None:
    """They follow from the step before, which no state tells."""
    env, t = _core.Env("Ant-v5"), np.arange(5) * 0.05
    columns = {f"q.{joint}": (0.0 if joint.startswith("hip") else 0.9) + 0.01 * t for joint in env.joint_names[1:]}
    columns |= {f"q.root.{entry}": np.full(5, value) for entry, value in zip(("x", "y", "z", "qw", "qx", "qy", "qz"), (0, 0, 0.75, 1, 0, 0, 0))}
    force = next(name for name in env.obs_names if name.startswith("cfrc."))
    with np.load(demos.from_columns("Ant-v5", [columns | {force: t + 3}], tmp_path / "a.npz", dt=0.05)) as data:
        assert np.array_equal(data["observations"][:, env.obs_names.index(force)], t + 3)


def test_rows_that_make_no_transition_are_counted(tmp_path: Path) -> None:
    for n, dt, words in ((0, 0.02, "0 rows make no"), (1, 0.02, "1 rows make no"), (9, 0.002, "9 rows 0.002 s apart make no transition of .* 0.02 s")):
        with pytest.raises(demos.BadDemonstrations, match=words):
            demos.from_columns(arm(tmp_path, ["command.x"]), [{name: of[:n] for name, of in recording(9, 0.002).items()}], tmp_path / "a.npz", dt=dt)


def test_the_period_is_the_policys(tmp_path: Path) -> None:
    """Of rows that are finer every so many are taken as they are, and the trainer takes the file."""
    task = tmp_path / "still.toml"
    text = arm(tmp_path, []).read_text().replace(', ""', "").split("[commands]")
    task.write_text(text[0] + '[reward]\nnear = "-x.tip"\n' + text[1].split('y.tip)^2"\n')[1])
    columns = recording(90, 0.005)
    columns["v.shoulder"] = np.arange(90) / 90
    for dt, rows in ((0.02, slice(None)), (0.005, slice(None, None, 4))):
        file = demos.from_columns(task, [columns], tmp_path / "a.npz", dt=dt, overwrite=True)
        with np.load(file) as data:
            assert float(data["dt"]) == 0.02
            assert np.array_equal(data["qpos"][:, 1], columns["q.elbow"][rows]) and np.array_equal(data["qvel"][:, 0], columns["v.shoulder"][rows])
        told = subprocess.run([NEARL, "demos", "check", file, "--task", task], capture_output=True, text=True, env={**os.environ})
        assert told.returncode == 0, told.stderr
    with pytest.raises(demos.BadDemonstrations, match=r"0.01 s apart and the policy period of the task is 0.02 s"):
        demos.from_columns(task, [columns], tmp_path / "b.npz", dt=0.01, actions=("q.shoulder", "q.elbow"))


def test_what_was_asked_for_is_not_interpolated(tmp_path: Path) -> None:
    with np.load(demos.from_columns(arm(tmp_path, ["command.x"]), [recording(60, 0.03)], tmp_path / "a.npz", dt=0.03)) as data:
        x = data["observations"][:, 4]
    assert set(x) == {0.45, 0.35}
    assert x.argmin() * 0.02 == pytest.approx(30 * 0.03)


def test_other_units_are_named(tmp_path: Path) -> None:
    task, columns = arm(tmp_path, ["command.x"]), recording()
    degrees = {name: np.degrees(of) if name.startswith("q.") else of for name, of in columns.items()}
    with pytest.raises(demos.BadDemonstrations, match=r"episode 0: column 'q.shoulder' is 26.488 in row 59, and .* from -2.97 to 2.97 .*numpy.radians"):
        demos.from_columns(task, [degrees], tmp_path / "a.npz", dt=0.02)
    with pytest.raises(demos.BadDemonstrations, match=r"dt is 20 s .* acts every 0.02 s; dt is in seconds, so for 20 ms give 0.02"):
        demos.from_columns(task, [columns], tmp_path / "a.npz", dt=20)
    fast = columns | {"q.elbow": columns["q.elbow"] + 0.4 * (np.arange(60) % 2)}
    with pytest.warns(UserWarning, match=r"joint 'elbow' moves at .* 3; look whether its columns are in rad"):
        demos.from_columns(task, [fast], tmp_path / "a.npz", dt=0.01)


@pytest.mark.parametrize("factor", [0.4, 1 / 1.5, 1.5, 2.5])
def test_another_rate_is_told_by_the_velocities(tmp_path: Path, factor: float) -> None:
    """Rows of another distance than dt make all recorded velocities as many times as fast as the differences are."""
    rng, t = np.random.default_rng(4), np.arange(80) * 0.02
    columns = recording(80) | {"v.shoulder": 0.5 * np.cos(t), "v.elbow": -0.6 * np.sin(2 * t)}  # derivatives by hand
    noisy = {name: of + 1e-4 * rng.normal(size=80) if name.startswith("q.") else of for name, of in columns.items()}
    for part in (columns, noisy):
        words = rf"'v.shoulder' is .* 'q.shoulder' changes by .*\(likewise v.elbow\); .*rows about 0.02 s apart would fit, and dt is {0.02 * factor:g} s"
        with pytest.warns(UserWarning, match=words):
            demos.from_columns(arm(tmp_path, ["command.x"]), [part], tmp_path / "a.npz", dt=0.02 * factor, overwrite=True)
    gear = columns | {"v.elbow": factor * columns["v.elbow"]}
    with pytest.warns(UserWarning, match=r"'v.elbow' is .*, and is as far off in half of the rows; look at sign, unit and dt, or leave"):
        demos.from_columns(arm(tmp_path, ["command.x"]), [gear], tmp_path / "a.npz", dt=0.02, overwrite=True)


def test_right_velocities_with_noise_and_joints_that_stand_are_not_accused(tmp_path: Path) -> None:
    """Nor does numpy complain of a division, where a joint stands to the last bit."""
    rng, task = np.random.default_rng(5), arm(tmp_path, ["command.x"])
    for k in range(60):
        n, dt = int(rng.choice([6, 20, 60, 200])), float(rng.choice([0.005, 0.02, 0.05]))
        t, a, f = np.arange(n) * dt, rng.uniform(0.1, 0.6), rng.uniform(0.5, 6.0)
        q, v = rng.choice([0.0, 1e-4, 2e-3]), rng.choice([0.0, 0.01, 0.1])
        columns = recording(n, dt) | {"q.shoulder": a * np.sin(f * t) + q * rng.normal(size=n), "v.shoulder": a * f * np.cos(f * t) + v * rng.normal(size=n)}
        columns |= {"q.elbow": np.full(n, 0.3), "v.elbow": (k % 3) * 0.1 * rng.normal(size=n)}
        del columns["command.y"]
        with warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)
            warnings.filterwarnings("error", message=".*changes by")
            demos.from_columns(task, [columns], tmp_path / "a.npz", dt=dt, overwrite=True, period=dt)


def test_positions_outside_of_the_range_are_told_by_joint(tmp_path: Path) -> None:
    """From a tenth of the range on, once for each joint, with the value that is furthest out; MuJoCo says what the range is."""
    task = arm(tmp_path, ["command.x"])
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "arm.xml"))
    lower, upper = model.joint("elbow").range
    columns = {name: of for name, of in recording().items() if name != "command.y"}
    for share in (0.09, 0.11):
        q = np.linspace(0.0, upper + share * (upper - lower), 60)
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            demos.from_columns(task, [columns | {"q.elbow": q}] * 2, tmp_path / "a.npz", dt=0.02, overwrite=True)
        words = [str(warning.message) for warning in told]
        if share < 0.1:
            assert words == []
            continue
        assert len(words) == 1, words
        outside = 100 * np.mean(q > upper)
        assert f"episode 0: column 'q.elbow' is {q[-1]:.4g} in row 59, and the task lets joint 'elbow' be at {lower:.3g} to {upper:.3g} rad or m" in words[0]
        assert f"{outside:.3g} % of the rows are outside. Look whether these are degrees" in words[0]
    far = columns | {"q.elbow": np.linspace(0.0, upper + 1.01 * (upper - lower), 60)}
    with pytest.raises(demos.BadDemonstrations, match="numpy.radians"):
        demos.from_columns(task, [far], tmp_path / "a.npz", dt=0.02, overwrite=True)


def still(folder: Path, observation: str) -> Path:
    """The arm without commands."""
    text = arm(folder, []).read_text()
    head, rest = text.split("[commands]")
    first = head.split("observation =")[0]
    tail = head.split("\npropose")[1]
    task = f'{first}observation = [{observation}]\npropose{tail}[reward]\nnear = "-x.tip"\n[constraints]{rest.split("[constraints]")[1]}'
    (folder / "still.toml").write_text(task)
    return folder / "still.toml"


def swing(n: int = 60) -> dict[str, np.ndarray]:
    """Both joints and the tip of links of 0.4 and 0.3 m, whose place is plane trigonometry."""
    t = np.arange(n) * 0.02
    shoulder, elbow = 0.5 * np.sin(t), 0.9 + 0.3 * np.cos(2 * t)
    tip = {"x.tip": 0.4 * np.cos(shoulder) + 0.3 * np.cos(shoulder + elbow), "y.tip": 0.4 * np.sin(shoulder) + 0.3 * np.sin(shoulder + elbow)}
    return {"q.shoulder": shoulder, "q.elbow": elbow, "v.shoulder": 0.5 * np.cos(t), "v.elbow": -0.6 * np.sin(2 * t)} | tip


def words_of(task: Path, columns: dict[str, np.ndarray], dt: float = 0.02) -> list[str]:
    """What two episodes of these columns are warned of."""
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        demos.from_columns(task, [columns, columns], task.parent / "a.npz", dt=dt, overwrite=True)
    return [str(warning.message) for warning in told]


OBSERVED = '"q.shoulder", "q.elbow", "v.shoulder", "v.elbow", "x.tip", "y.tip"'


def test_what_was_recorded_of_the_tool_is_held_against_the_joints(tmp_path: Path) -> None:
    task, columns = still(tmp_path, OBSERVED), swing()
    assert words_of(task, columns) == []
    assert words_of(task, columns, 0.013) and all("x.tip" not in words for words in words_of(task, columns, 0.013)), "rows that are interpolated are the same"
    impact = columns | {"x.tip": columns["x.tip"] + np.where(np.arange(60) < 5, 0.2, 0.0)}
    assert words_of(task, impact) == [], "a twelfth of the rows"
    (millimetres,) = words_of(task, columns | {"x.tip": 1e3 * columns["x.tip"]})
    x = 0.4 + 0.3 * np.cos(1.2)
    assert f"episode 0: column 'x.tip' is {1e3 * x:.4g} in row 0, where positions and velocities give {x:.4g} in the task's units (rad, m, s)" in millimetres
    assert "100 % of the rows are as far off; what they give is written. Look whether the joints' columns have the right names and units" in millimetres
    (swapped,) = words_of(task, columns | {"q.shoulder": columns["q.elbow"], "q.elbow": columns["q.shoulder"],
                                           "v.shoulder": columns["v.elbow"], "v.elbow": columns["v.shoulder"]})  # fmt: skip
    assert "column 'x.tip' is" in swapped and "(likewise y.tip)" in swapped


def test_the_order_that_minari_does_not_name_is_held_against_the_tool(tmp_path: Path) -> None:
    task, columns = still(tmp_path, OBSERVED), swing()
    data = lambda *names: SimpleNamespace(  # noqa: E731
        iterate_episodes=lambda: [SimpleNamespace(observations=np.stack([columns[name] for name in names], 1), actions=np.zeros((59, 2)))]
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with np.load(demos.from_minari(task, data(*_core.Env(str(task)).obs_names), tmp_path / "a.npz", dt=0.02)) as made:
            assert np.array_equal(made["qpos"][:, 1], columns["q.elbow"])
    with pytest.warns(UserWarning, match=r"episode 0: column 'x.tip' is .*, where positions and velocities give .* \(likewise y.tip\)"):
        demos.from_minari(task, data("q.elbow", "q.shoulder", "v.elbow", "v.shoulder", "x.tip", "y.tip"), tmp_path / "b.npz", dt=0.02)


@pytest.mark.parametrize("row", [1, 30, 58])
@pytest.mark.parametrize("velocities", [True, False])
def test_a_measurement_that_is_lost_for_one_row_is_told(tmp_path: Path, row: int, velocities: bool) -> None:
    task = still(tmp_path, '"q.shoulder", "q.elbow", "v.shoulder", "v.elbow"')
    columns = {name: of for name, of in swing().items() if name.startswith("q." if not velocities else ("q.", "v."))}
    assert words_of(task, columns) == []
    elbow = columns["q.elbow"]
    (words,) = words_of(task, columns | {"q.elbow": np.where(np.arange(60) == row, 0.0, elbow)})
    jump = f"joint 'elbow' jumps from {elbow[row - 1]:.4g} in row {row - 1} to 0 in the next and back to {elbow[row + 1]:.4g}"
    assert f"episode 0: {jump}, {elbow[row - 1] / 0.02:.3g} rad/s or m/s with dt = 0.02 s, where the task's limit is 3; look whether" in words
    assert f"the measurement of row {row} was lost, and put one between those beside in its place" in words


def test_arrays_are_written_row_by_row(tmp_path: Path) -> None:
    """The trainer reads no other order, whatever the order was in memory."""
    columns = {name: np.asfortranarray(np.stack([of, of], 1))[:, 0].astype(np.float32) for name, of in recording().items()}
    with np.load(demos.from_columns(arm(tmp_path, ["command.x"]), [columns, columns], tmp_path / "a.npz", dt=0.02)) as data:
        for name in ("observations", "qpos", "qvel"):
            assert data[name].flags.c_contiguous and data[name].dtype == np.float64
