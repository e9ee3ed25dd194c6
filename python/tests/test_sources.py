"""Files of others that are not what they were given as: each mistake is refused in a sentence with the file and the place in it."""

import gzip
import io
import json
import os
import zipfile
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from nearl import _core, demos, sources

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


def odd_files(folder: Path, end: str) -> list[tuple[Path, str]]:
    """What is no regular file or one too large, with what is said of it."""
    pipe, large, link, inner = folder / f"pipe.{end}", folder / f"large.{end}", folder / f"link.{end}", folder / f"folder.{end}"
    os.mkfifo(pipe)
    link.symlink_to("/dev/zero")
    inner.mkdir()
    with large.open("wb") as file:
        file.truncate(sources.LARGEST + 1)  # of which the system keeps nothing
    odd = [(of, "' is not a regular file; give ") for of in (pipe, link, Path("/dev/zero"))]
    return [*odd, (inner, "' is a folder, not a regular file; give "), (large, "' has 4294967297 bytes, more than the limit of 4294967296; split it, and")]


def test_what_is_no_regular_file_or_too_large_is_not_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A device had filled the memory, and a pipe been waited for."""
    out = tmp_path / "out.npz"
    readers = {"csv": lambda file: demos.from_csv(TASK, file, out, dt=0.008), "npz": lambda file: demos.from_motion(TASK, file, out)}
    for end, read in readers.items():
        for file, said in odd_files(tmp_path, end):
            with pytest.raises(demos.BadDemonstrations, match=f"'{file}{said}"):
                read(file)
    data = tmp_path / "hopper" / "x-v0" / "data"
    data.mkdir(parents=True)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    monkeypatch.setitem(__import__("sys").modules, "minari", SimpleNamespace(load_dataset=lambda _: pytest.fail("it is opened")))
    (data / "0").mkdir()  # as its Arrow has an episode
    for odd, said in odd_files(tmp_path, "hdf5"):
        if odd.is_dir():
            continue
        (data / "main_data.hdf5").symlink_to(odd)
        more = "what `minari download hopper/x-v0` writes" if "give" in said else ""
        with pytest.raises(demos.BadDemonstrations, match=f"'{data / 'main_data.hdf5'}{said}{more}"):
            demos.from_minari(TASK, "hopper/x-v0", out)
        (data / "main_data.hdf5").unlink()
    assert not out.exists()


def test_arrays_that_say_more_than_they_hold_are_refused(tmp_path: Path) -> None:
    """As a forged head of an array does, which had ended in NumPy's MemoryError."""
    file, good = tmp_path / "clip.npz", {"fps": np.array(125), "joint_pos": np.zeros((9, 6)), "joint_names": np.array([name[2:] for name in JOINTS])}

    def entry(array: np.ndarray, shape: tuple[int, ...]) -> bytes:
        head = io.BytesIO()
        np.lib.format.write_array_header_1_0(head, {"descr": array.dtype.str, "fortran_order": False, "shape": shape})
        return head.getvalue() + array.tobytes()

    def write(content: bytes) -> None:
        with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, array in good.items():
                archive.writestr(f"{name}.npy", content if name == "joint_pos" else entry(array, array.shape))

    read = lambda: demos.from_motion(TASK, file, tmp_path / "out.npz")  # noqa: E731
    write(entry(good["joint_pos"], (9, 6)))
    assert read().exists()
    for content in (
        *(entry(good["joint_pos"], shape) for shape in ((99999999999999, 2), (2**62, 2**62), (10, 6), (-1, 6))),
        entry(good["joint_pos"], (9, 6)).replace(b"'shape'", b"'shap('"),
        entry(good["joint_pos"], (9, 6))[:9],
    ):
        write(content)
        with pytest.raises(demos.BadDemonstrations, match=r"clip.npz': array 'joint_pos' cannot be read \(.+\); write numbers or text, no objects"):
            read()
    for content in (b"", b"text"):
        write(content)
        with pytest.raises(demos.BadDemonstrations, match=r"clip.npz': 'joint_pos' is no array of NumPy; write it with numpy.savez"):
            read()
    write(entry(good["joint_pos"], (9, 6)))
    whole = file.read_bytes()
    for content, said in ((b"MZ" + whole, "cannot be read as .npz|is no .npz file"), (whole[:60] + b"\xff" * 200 + whole[260:], "cannot be read")):
        file.write_bytes(content)
        with pytest.raises(demos.BadDemonstrations, match=f"clip.npz.*({said}).*; write"):
            read()


def test_rows_that_do_not_fit_into_memory_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise MemoryError

    monkeypatch.setattr(sources, "_take", full)
    with pytest.raises(demos.BadDemonstrations, match=r"walk.csv', line 2: its numbers do not fit into memory; split it, and convert each part"):
        converted(tmp_path, f"{HEADING}\n{line(0, 0)}\n{line(0, 1)}\n")


def test_arrays_that_unpack_to_too_much_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    joints, file = [name[2:] for name in JOINTS], tmp_path / "clip.npz"
    np.savez_compressed(file, fps=125, joint_pos=np.zeros((20000, 6)), joint_names=np.array(joints), other=np.zeros(99))
    monkeypatch.setattr(sources, "LARGEST", 900_000)
    with pytest.raises(demos.BadDemonstrations, match=r"clip.npz': fps, joint_pos, joint_names have 960\d\d\d bytes, more than the limit of 900000; split it"):
        demos.from_motion(TASK, file, tmp_path / "out.npz")


def test_robomimic_files_hold_all_of_their_data(tmp_path: Path) -> None:
    """A link to another file had been followed, and a shape of any size believed."""
    h5py = pytest.importorskip("h5py")
    file, columns = tmp_path / "low_dim.hdf5", {name: ("q", k) for k, name in enumerate(JOINTS)}
    read = lambda: demos.from_robomimic(TASK, file, tmp_path / "out.npz", dt=0.008, columns=columns)  # noqa: E731
    for odd, said in odd_files(tmp_path, "hdf5"):
        with pytest.raises(demos.BadDemonstrations, match=f"'{odd}{said}"):
            demos.from_robomimic(TASK, odd, tmp_path / "out.npz", dt=0.008, columns=columns)
    outside = h5py.ExternalLink(tmp_path / "pipe.hdf5", "/q")
    layout = h5py.VirtualLayout((9, 6), "f8")
    layout[:] = h5py.VirtualSource(tmp_path / "pipe.hdf5", "q", (9, 6))
    for name, part, said in (
        ("data", outside, "low_dim.hdf5': 'data' is a link, which is not followed; give a file that holds all of its data itself"),
        ("data/demo_0", outside, "low_dim.hdf5': 'demo_0' is a link"),
        ("data/demo_0/obs", outside, r"episode 0 \(demo_0\): 'obs' is a link"),
        ("data/demo_0/obs/q", outside, r"episode 0 \(demo_0\): 'q' is a link"),
        ("data/demo_0/obs/q", h5py.SoftLink("/other/q"), r"episode 0 \(demo_0\): 'q' is a link"),
        ("data/demo_0/obs", np.zeros(3), r"episode 0 \(demo_0\): '/data/demo_0/obs' is no group"),
        ("data/demo_0", np.zeros(3), r"episode 0 \(demo_0\): '/data/demo_0' is no group"),
    ):
        with h5py.File(file, "w") as data:
            data[name] = part
        with pytest.raises(demos.BadDemonstrations, match=said):
            read()
    for make, said in (
        (lambda at: at.create_dataset("q", (9, 6), "f8", external=[(str(tmp_path / "pipe.hdf5"), 0, 432)]), "'q' is in another file, which"),
        (lambda at: at.create_virtual_dataset("q", layout), "'q' is in another file, which is not followed"),
        (lambda at: at.create_dataset("q", (10**14, 6), "f8", chunks=(64, 6)), r"'q' has shape \(1\d+, 6\), 8\d+ bytes a column, more than the limit"),
    ):
        with h5py.File(file, "w") as data:
            make(data.create_group("data/demo_0/obs"))
        with pytest.raises(demos.BadDemonstrations, match=rf"episode 0 \(demo_0\): {said}"):
            read()
    with h5py.File(file, "w") as data:
        rows = data.create_dataset("data/demo_0/obs/q", data=np.random.default_rng(0).normal(size=(9, 6)), chunks=(9, 6), compression="gzip")
        chunk = rows.id.get_chunk_info(0)
    content = bytearray(file.read_bytes())
    content[chunk.byte_offset : chunk.byte_offset + chunk.size] = b"\xff" * chunk.size
    file.write_bytes(content)
    with pytest.raises(demos.BadDemonstrations, match=r"episode 0 \(demo_0\): 'q' cannot be read \(.+\); it was cut short or damaged: get the file again"):
        read()


def test_lerobot_opens_regular_files_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pa, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    meta, data = tmp_path / "meta" / "info.json", tmp_path / "data" / "chunk-000" / "file-000.parquet"
    meta.parent.mkdir()
    data.parent.mkdir(parents=True)
    good = json.dumps({"fps": 125, "features": {"observation.state": {"names": [name[2:] for name in JOINTS]}}})
    read = lambda: demos.from_lerobot(TASK, tmp_path, tmp_path / "out.npz")  # noqa: E731
    meta.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(demos.BadDemonstrations, match="info.json' describes no LeRobot dataset"):
        read()
    meta.unlink()
    (tmp_path / "odd").mkdir()
    for odd, said in odd_files(tmp_path / "odd", "parquet"):
        meta.write_text(good)
        data.symlink_to(odd)
        with pytest.raises(demos.BadDemonstrations, match=f"'{data}{said}"):
            read()
        data.unlink()
        meta.unlink()
        meta.symlink_to(odd)
        with pytest.raises(demos.BadDemonstrations, match="is no LeRobot dataset, which is a folder" if "bytes" not in said else f"'{meta}{said}"):
            read()
        meta.unlink()
    meta.write_text(good)
    parquet.write_table(pa.table({"observation.state": [[0.0] * len(JOINTS)] * 20000, "episode_index": [0] * 20000}), data)
    assert read().exists()
    monkeypatch.setattr(sources, "LARGEST", 900_000)
    with pytest.raises(demos.BadDemonstrations, match=r"file-000.parquet' unpacks to \d+ bytes, more than the limit of 900000; split it, and convert each"):
        demos.from_lerobot(TASK, tmp_path, tmp_path / "more.npz")
