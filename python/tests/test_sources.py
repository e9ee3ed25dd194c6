"""Files of others that are not what they were given as: each mistake is refused in a sentence with the file and the place in it."""

import gzip
import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from nearl import _core, demos

TASK = "Hopper-v5"
JOINTS = [f"q.{joint}" for joint in _core.Env(TASK).joint_names]
HEADING = ",".join(["episode", *JOINTS])


def line(episode: int, k: int) -> str:
    return ",".join([str(episode), *(f"{0.01 * np.sin(0.1 * k + j):.6f}" for j in range(len(JOINTS)))])


def converted(folder: Path, text: str | bytes) -> np.ndarray:
    """Lengths of the episodes of a CSV file."""
    (folder / "walk.csv").write_bytes(text if isinstance(text, bytes) else text.encode())
    with np.load(demos.from_csv(TASK, folder / "walk.csv", folder / "out.npz", dt=0.008)) as data:
        return data["lengths"]


def test_a_heading_may_be_quoted_and_lines_be_commented(tmp_path: Path) -> None:
    quoted = ", ".join(f'"{name}"' for name in HEADING.split(","))
    rows = [line(0, k) for k in range(5)] + ["", "# the second one"] + [line(1, k) for k in range(4)]
    assert converted(tmp_path, "\ufeff" + "\r\n".join(["# made by hand, twice", quoted, *rows, ""])).tolist() == [4, 3]


def test_truth_values_in_csv_are_ones_and_zeros(tmp_path: Path) -> None:
    """As pandas writes them: one column that no task has, and one of episodes."""
    rows = [line(0, k)[1:] for k in range(6)]
    text = "\n".join([HEADING + ",terminated", *(f"{k > 3}{row},{k == 5}" for k, row in enumerate(rows))])
    with pytest.warns(UserWarning, match="column 'terminated' is not used"):
        assert converted(tmp_path, text).tolist() == [3, 1]
    with np.load(tmp_path / "out.npz") as data:
        assert data["qpos"][:, 0].tolist() == [float(row.split(",")[1]) for row in rows]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("\n".join([HEADING + ",q.rootx", line(0, 0) + ",0"]), "walk.csv': column 'q.rootx' is there twice"),
        ("\n".join([HEADING, line(0, 0), line(0, 1) + ",1"]), r"walk.csv', line 3: 8 cells below a heading of 7 columns; give"),
        ("\n".join([HEADING, line(0, 0), "0,x" + line(0, 1)[1:]]).replace(line(0, 1)[1:], ",0,0,0,0,0"), "line 3: column 'q.rootx' is 'x', which is no number"),
        ("\n".join([HEADING, "0,,0,0,0,0,0"]), "line 2: column 'q.rootx' is empty; give a number"),
        (HEADING + "\n", "walk.csv': a heading and no row below it"),
        ("", "walk.csv': its first line is empty; begin with a heading"),
        ("\n".join(line(0, k) for k in range(4)), "walk.csv': its first line is numbers; begin with a heading"),
        ("\n".join([HEADING, line(0, 0)]).replace(",", ";"), "walk.csv': its columns are separated by semicolons; write commas"),
        ("\n".join([HEADING, line(0, 0)]).replace(",", "\t"), "walk.csv': its columns are separated by tabs; write commas"),
        ("\n".join([HEADING, line(0, 0)]).encode("utf-16"), "walk.csv' is text in UTF-16; save it as UTF-8"),
        (gzip.compress(HEADING.encode(), mtime=0), "walk.csv' is compressed with gzip; unpack it first"),
        (b"PK\x03\x04\xe0", "walk.csv' is a zip or .npz file, no CSV"),
        (f"{HEADING}\n{line(0, 0)}\n".encode() + b"\xe0\xff\n", "walk.csv' is no text in UTF-8"),
        ("\n".join([HEADING, *(line(e, k) for e, k in [(0, 0), (0, 1), (1, 0), (1, 1), (0, 9), (0, 10)])]),
         "walk.csv': episode 0 goes on in row 4 after rows of episode 1; put the rows of each episode together"),
    ],
)  # fmt: skip
def test_csv_files_are_refused_by_line_and_column(tmp_path: Path, text: str | bytes, said: str) -> None:
    with pytest.raises(demos.BadDemonstrations, match=said):
        converted(tmp_path, text)
    assert not (tmp_path / "out.npz").exists()


def test_what_is_no_table_of_columns_is_named(tmp_path: Path) -> None:
    columns = {name: 0.01 * np.arange(9) for name in JOINTS}
    out = tmp_path / "out.npz"
    for episodes, said in (
        (np.zeros((2, 9, 5)), "episode 0: it is of ndarray; give a table of columns by name"),
        (None, "episodes is None; give a list of tables"),
        ([{**columns, "q.rooty": np.zeros(9, complex)}], "episode 0: column 'q.rooty' holds complex numbers; give real ones"),
        ([{**columns, "q.rooty": ["a"] * 9}], "episode 0: column 'q.rooty' holds what is no number"),
        ([{**columns, "q.rootx": 1.0}], r"episode 0: column 'q.rootx' has shape \(\)"),
    ):
        with pytest.raises(demos.BadDemonstrations, match=said):
            demos.from_columns(TASK, episodes, out, dt=0.008)
    for actions in (["q.rootx", "q.rooty"], "q.rootx"):
        with pytest.raises(demos.BadDemonstrations, match=r"actions is .*q.rootx.*; give one column for each actuator, "):
            demos.from_columns(TASK, [columns], out, dt=0.008, actions=actions)
    for wrong, said in (({"dt": "0.02"}, "dt is '0.02'; give the time between two rows in seconds"), ({"dt": 0.008, "period": "1"}, "period is '1'; give the")):
        with pytest.raises(demos.BadDemonstrations, match=said):
            demos.from_columns(TASK, [columns], out, **wrong)
    assert not out.exists()


def test_motion_clips_are_refused_by_array(tmp_path: Path) -> None:
    joints, file = [name[2:] for name in JOINTS], tmp_path / "clip.npz"
    good = {"fps": 125, "joint_pos": np.zeros((9, 6)), "joint_names": np.array(joints)}
    for wrong, said in (
        ({"fps": 0}, "fps is 0; give the frames a second"),
        ({"fps": np.array([])}, "fps is .*; give the frames a second"),
        ({"joint_pos": np.zeros(9)}, r"'joint_pos' has shape \(9,\); give one row a frame, \(n, 6\)"),
        ({"joint_pos": np.full((9, 6), "a")}, "array 'joint_pos' holds what is no number"),
        ({"joint_names": np.array([*joints[:5], joints[0]])}, "column 'q.rootx' is there twice"),
        ({"joint_names": np.array(joints, object)}, "array 'joint_names' cannot be read .* write numbers or text"),
        ({"body_pos_w": np.zeros((9, 3)), "body_quat_w": np.zeros((9, 1, 4))}, r"'body_pos_w' has shape \(9, 3\) .*; give \(9, bodies, 3\)"),
    ):
        np.savez(file, **(good | wrong))
        with pytest.raises(demos.BadDemonstrations, match=f"clip.npz': {said}"):
            demos.from_motion(TASK, file, tmp_path / "out.npz")
    for content in (b"", b"fps,joint_pos\n1,2\n"):
        file.write_bytes(content)
        with pytest.raises(demos.BadDemonstrations, match=r"clip.npz' is no .npz file, or was cut short"):
            demos.from_motion(TASK, file, tmp_path / "out.npz")
    with pytest.raises(FileNotFoundError, match=r"cannot read '.*none.npz': No such file or directory; correct the path"):
        demos.from_motion(TASK, tmp_path / "none.npz", tmp_path / "out.npz")
    with pytest.raises(FileNotFoundError, match=r"cannot read '.*none.csv': No such file or directory; correct the path"):
        demos.from_csv(TASK, tmp_path / "none.csv", tmp_path / "out.npz", dt=0.05)


def test_robomimic_files_are_refused_by_group_and_entry(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    file, good = tmp_path / "low_dim.hdf5", {name: ("q", k) for k, name in enumerate(JOINTS)}
    read = lambda columns=good: demos.from_robomimic(TASK, file, tmp_path / "out.npz", dt=0.008, columns=columns)  # noqa: E731
    file.write_text("junk")
    with pytest.raises(demos.BadDemonstrations, match=r"low_dim.hdf5' cannot be read as HDF5 .*; give the file that robomimic wrote"):
        read()
    for group, said in (("x", "no group 'data', .*; it has x"), ("data/first/obs", "'data/first' has not the name of a demonstration")):
        with h5py.File(file, "w") as data:
            data.create_group(group)
        with pytest.raises(demos.BadDemonstrations, match=f"low_dim.hdf5': {said}"):
            read()
    with h5py.File(file, "w") as data:
        data["data/demo_0/obs/q"] = np.zeros((9, 6))
        data["data/demo_0/obs/flat"] = np.zeros(9)
    assert read().exists()
    for wrong in ("s", ("q", -1), ("q", "0"), (0, "q"), ("q",)):
        with pytest.raises(demos.BadDemonstrations, match=r"columns\['q.rooty'\] is .*; give the observation's key and the entry from 0"):
            read({**good, "q.rooty": wrong})
    for wrong in (("q", 6), ("flat", 0), ("p", 0)):
        with pytest.raises(demos.BadDemonstrations, match=rf"episode 0 \(demo_0\): no observation '{wrong[0]}' with entry {wrong[1]} .*q \(9, 6\)"):
            read({**good, "q.rooty": wrong})


def test_minari_datasets_are_found_by_name_or_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    env = _core.Env(TASK)
    observed = np.zeros((9, len(env.obs_names)))
    data = lambda observations, actions: SimpleNamespace(iterate_episodes=lambda: [SimpleNamespace(observations=observations, actions=actions)])  # noqa: E731
    loaded: list[str] = []

    def load(name: str) -> SimpleNamespace:
        loaded.append(name)
        if "/" not in name:
            raise FileNotFoundError(name)
        return data(observed, np.zeros((8, 3)))

    monkeypatch.setitem(__import__("sys").modules, "minari", SimpleNamespace(load_dataset=load))
    read = lambda dataset, **more: demos.from_minari(TASK, dataset, tmp_path / "out.npz", overwrite=True, **more)  # noqa: E731
    with np.load(read("mujoco/hopper-v0")) as made:
        assert made["lengths"].tolist() == [8] and loaded == ["mujoco/hopper-v0"]
    for dataset, said in (
        ("hopper", "Minari dataset 'hopper' is not on this machine; get it with `minari download hopper`"),
        (3, "Minari dataset: 3 is none; give its name, or what minari.load_dataset returns"),
        (data({"a": 1, "b": 2}, []), "episode 0: its observations are tables of a, b; give"),
        (data(observed, np.zeros((8, 4))), r"episode 0: actions of shape \(8, 4\) where the task's are \(8, 3\)"),
    ):
        with pytest.raises(demos.BadDemonstrations, match=said):
            read(dataset)
    with np.load(read(data(observed, np.zeros((8, 4))), actions=())) as made:
        assert "actions" not in made.files
    monkeypatch.setitem(__import__("sys").modules, "minari", None)
    with pytest.raises(ImportError, match=r"needs minari: pip install 'nearl\[minari\]'"):
        read("mujoco/hopper-v0")


def test_a_description_that_is_none_is_named(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    (tmp_path / "meta").mkdir()
    for text, said in (
        ("no json", "describes no LeRobot dataset"),
        (json.dumps({"fps": 5}), "describes no .*'features'"),
        ('{"features": {}, "fps": 0}', ": fps is 0"),
    ):
        (tmp_path / "meta" / "info.json").write_text(text)
        with pytest.raises(demos.BadDemonstrations, match=f"info.json'.*{said}"):
            demos.from_lerobot(TASK, tmp_path, tmp_path / "out.npz")
