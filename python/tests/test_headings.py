"""Columns of a recording by their names: which are taken, how they are spelt, what contradicts another one, and files that are there already."""

import warnings
from pathlib import Path

import numpy as np
import pytest

from nearl import _core, demos

TASK = "Hopper-v5"
DT = 0.008
JOINTS = [f"q.{joint}" for joint in _core.Env(TASK).joint_names]


def moving(n: int = 40, phase: float = 0.0) -> dict[str, np.ndarray]:
    """Positions by column, slow in comparison with every limit."""
    t = np.arange(n) * DT
    return {name: 0.2 * np.sin(2 * t + k + phase) for k, name in enumerate(JOINTS)}


def csv(file: Path, table: dict[str, np.ndarray]) -> Path:
    np.savetxt(file, np.stack(list(table.values()), 1), delimiter=",", header=",".join(table), comments="", fmt="%.17g")
    return file


def two(name: str, values: tuple[float, float] = (0, 1)) -> dict[str, np.ndarray]:
    """Two episodes, 40 rows and 25, below each other."""
    parts = [moving(), moving(25, 1.5)]
    return {name: np.repeat(values, [40, 25])} | {joint: np.concatenate([part[joint] for part in parts]) for joint in JOINTS}


@pytest.mark.parametrize("name", ["episode", "Episode", "EPISODE", "episode_index", "episode id", "Episode-Nr", "demo", "traj_id", "ep"])
def test_the_column_of_episodes_is_found_however_it_is_spelt(tmp_path: Path, name: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        out = demos.from_csv(TASK, csv(tmp_path / "a.csv", two(name)), tmp_path / "a.npz", dt=DT)
    with np.load(out) as data:
        assert data["lengths"].tolist() == [39, 24]
        parts = [np.stack(list(part.values()), 1) for part in (moving(), moving(25, 1.5))]
        np.testing.assert_allclose(data["qvel"], np.concatenate([np.gradient(part, DT, axis=0) for part in parts]), rtol=0, atol=1e-11)


def test_a_column_of_episodes_that_is_not_there_or_not_the_only_one_is_named(tmp_path: Path) -> None:
    file = csv(tmp_path / "a.csv", two("part"))
    with pytest.raises(demos.BadDemonstrations, match=r"a.csv': no column 'trial'; it has part, q.rootx"):
        demos.from_csv(TASK, file, tmp_path / "a.npz", dt=DT, episode="trial")
    with np.load(demos.from_csv(TASK, file, tmp_path / "a.npz", dt=DT, episode="part")) as data:
        assert data["lengths"].tolist() == [39, 24]
    file = csv(tmp_path / "b.csv", two("demo") | {"Episode": np.zeros(65)})
    with pytest.raises(demos.BadDemonstrations, match=r"b.csv': columns demo, Episode may all say .*; give episode="):
        demos.from_csv(TASK, file, tmp_path / "b.npz", dt=DT)


def test_several_episodes_in_one_table_are_refused(tmp_path: Path) -> None:
    with pytest.raises(demos.BadDemonstrations, match=r"episode 0: its column 'episode_index' is 3 up to row 39 and 4 after it.*groupby\('episode_index'\)"):
        demos.from_columns(TASK, [two("episode_index", (3, 4))], tmp_path / "a.npz", dt=DT)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        demos.from_columns(TASK, [moving() | {"episode_index": np.full(40, 3)}], tmp_path / "a.npz", dt=DT)


@pytest.mark.parametrize(("name", "unit"), [("time", 1.0), ("Timestamp", 1.0), ("time [ms]", 1e3), ("t_us", 1e6), ("timestamp", 1e9)])
def test_times_are_held_against_dt(tmp_path: Path, name: str, unit: float) -> None:
    t = 7.0 + DT * np.arange(40) + 1e-3 * np.sin(np.arange(40.0))  # a clock that is not quite even
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        demos.from_csv(TASK, csv(tmp_path / "a.csv", {name: unit * t} | moving()), tmp_path / "a.npz", dt=DT)
    gap, back = t.copy(), t.copy()
    gap[12:] += DT
    back[12:] -= t[11]
    for times in (gap, back):
        with pytest.raises(demos.BadDemonstrations, match=r"column '.*' goes from .* in row 11 to .* in the next, and dt is 0.008 s; if rows are missing"):
            demos.from_columns(TASK, [moving() | {name: unit * times}], tmp_path / "b.npz", dt=DT)
    for factor in (0.5, 1.25, 0.0):
        with pytest.raises(demos.BadDemonstrations, match=rf"column '.*' goes on by .* from row to row, and dt is {factor * DT or 3.0:g} s; correct dt"):
            demos.from_columns(TASK, [moving() | {name: unit * (t if factor else 0 * t)}], tmp_path / "b.npz", dt=factor * DT or 3.0, period=3.0)
    assert not (tmp_path / "b.npz").exists()


def test_columns_that_are_not_used_are_told_with_the_name_that_was_meant(tmp_path: Path) -> None:
    wrong = moving() | {"v.foot_jiont": np.full(40, 9.0), "camera": np.zeros(40)}
    for read in (
        lambda: demos.from_columns(TASK, [wrong, wrong], tmp_path / "a.npz", dt=DT),
        lambda: demos.from_csv(TASK, csv(tmp_path / "a.csv", wrong), tmp_path / "b.npz", dt=DT),
    ):
        with pytest.warns(UserWarning, match=r"columns 'v.foot_jiont' \(is 'v.foot_joint' meant\?\), 'camera' are not used") as told:
            read()
        assert sum("not used" in str(one.message) for one in told) == 1
    with pytest.warns(UserWarning, match=r"column 'V.Leg_Joint' \(is 'v.leg_joint' meant\?\) is not used"):
        demos.from_columns(TASK, [moving() | {"V.Leg_Joint": np.zeros(40)}], tmp_path / "c.npz", dt=DT)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        acted = moving() | dict.fromkeys("abc", np.zeros(40))
        demos.from_columns(TASK, [acted], tmp_path / "d.npz", dt=DT, actions=("a", "b", "c"))


def test_a_jump_between_two_rows_is_told_with_row_and_joint(tmp_path: Path) -> None:
    """Of two episodes that are joined, and of an angle that turns over; a joint that stays faster than its limit (10 rad/s) is the expert's own."""
    slow = 0.2 * np.arange(40) * DT
    for start, jump, words in ((-0.5, 0.4, "look whether rows are missing"), (2.9, -2 * np.pi, "numpy.unwrap")):
        columns = moving() | {"q.leg_joint": start + slow + jump * (np.arange(40) >= 20)}
        with pytest.warns(UserWarning, match=rf"joint 'leg_joint' jumps from .* in row 19 to .* in the next, .* the task's limit is 10; .*{words}") as told:
            demos.from_columns(TASK, [columns, columns], tmp_path / "a.npz", dt=DT, overwrite=True)
        assert sum("'leg_joint' jumps" in str(one.message) for one in told) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        demos.from_columns(TASK, [moving() | {"q.leg_joint": 12.0 * np.abs(np.arange(40) - 20) * DT - 2.4}], tmp_path / "b.npz", dt=DT)


def test_headings_of_ones_own_have_a_table(tmp_path: Path) -> None:
    own = {f"Position of {name[2:]}": of for name, of in moving().items()}
    which = {name: f"Position of {name[2:]}" for name in JOINTS}
    file = csv(tmp_path / "a.csv", own | {"v.foot_joint": np.gradient(moving()["q.foot_joint"], DT)})
    with np.load(demos.from_csv(TASK, file, tmp_path / "a.npz", dt=DT, columns=which)) as data:
        np.testing.assert_allclose(data["qpos"], np.stack(list(moving().values()), 1), atol=1e-15)
    for columns, said in (
        (which | {"q.rooty": "Angle"}, "columns\\['q.rooty'\\] is 'Angle', and its heading has no such column; it has Position of rootx"),
        (which | {"v.foot_joint": "Position of rootx"}, "column 'v.foot_joint' is there twice"),
        (list(which), "columns is \\['q.rootx', .*; give the heading's name of each column"),
    ):
        with pytest.raises(demos.BadDemonstrations, match=f"a.csv': {said}"):
            demos.from_csv(TASK, file, tmp_path / "b.npz", dt=DT, columns=columns)
    for read in (demos.from_csv, demos.from_minari, demos.from_robomimic, demos.from_lerobot, demos.from_motion):
        with pytest.raises(TypeError, match=rf"{read.__name__}\(\) got an unexpected keyword argument 'colums'"):
            read(TASK, file, tmp_path / "b.npz", colums=which)


def test_a_file_that_is_no_dataset_of_lerobot_is_told_what_one_is(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    (tmp_path / "one.parquet").write_bytes(b"PAR1")
    for given in (tmp_path / "one.parquet", tmp_path):
        with pytest.raises(demos.BadDemonstrations, match=r"no LeRobot dataset, which is a folder with meta/info.json .* pandas.read_parquet"):
            demos.from_lerobot(TASK, given, tmp_path / "a.npz")
    with pytest.raises(FileNotFoundError, match="nowhere"):
        demos.from_lerobot(TASK, tmp_path / "nowhere", tmp_path / "a.npz")


def test_parquet_in_the_place_of_csv_is_named(tmp_path: Path) -> None:
    (tmp_path / "one.parquet").write_bytes(b"PAR1\x15\x00\xe0\xff")
    with pytest.raises(demos.BadDemonstrations, match="one.parquet' is a parquet file, no CSV; give nearl.demos.from_columns what pandas.read_parquet"):
        demos.from_csv(TASK, tmp_path / "one.parquet", tmp_path / "a.npz", dt=DT)


def test_a_file_that_is_there_is_not_written_over_unless_asked(tmp_path: Path) -> None:
    out, clip = tmp_path / "a.npz", tmp_path / "clip.npz"
    np.savez(clip, fps=125, joint_pos=np.stack(list(moving().values()), 1), joint_names=[name[2:] for name in JOINTS])
    reads = [
        lambda **more: demos.from_columns(TASK, [moving()], out, dt=DT, **more),
        lambda **more: demos.from_csv(TASK, csv(tmp_path / "a.csv", moving()), out, dt=DT, **more),
        lambda **more: demos.from_motion(TASK, clip, out, **more),
    ]
    for read in reads:
        out.write_text("mine")
        with pytest.raises(FileExistsError, match=r"a.npz' is there already; give another file, remove it, or give overwrite=True"):
            read()
        assert out.read_text() == "mine"
        assert np.load(read(overwrite=True))["lengths"].tolist() == [39]
