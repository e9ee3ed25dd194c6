"""The report from a synthetic run: what must be in it, and what is said where something is missing."""

import io
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import synthetic
from conftest import ROOT
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

import nearl
from nearl import curves, report
from nearl.report import flight, rows
from nearl.report.__main__ import main
from nearl.report.read import ReadError, read_log, read_run

NEARL = ROOT / "target" / "release" / "nearl"


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[Path]]:
    root = tmp_path_factory.mktemp("inputs")
    runs = [synthetic.run_folder(root, "HalfCheetah-v5", algo, seed, top) for algo, top in (("pid2-ib", 4000), ("ppo", 3000)) for seed in range(3)]
    return {
        "runs": runs,
        "logs": [synthetic.flight_log(root / "panda.mcap")],
        "evals": [synthetic.evaluations(root / "eval.json")],
        "summaries": [synthetic.summary(root / "summary.json")],
    }


def text_of(page: Path) -> str:
    return re.sub(r"<[^>]+>", " ", re.sub(r"<style>.*?</style>", "", page.read_text(), flags=re.S))


def test_everything_is_in_one_file(inputs, tmp_path) -> None:
    page = report.build(tmp_path / "report.html", **inputs)
    html, words = page.read_text(), text_of(page)
    assert not re.search(r"(src|href)=\"(?!data:)", html), "nothing is fetched"
    assert "<script" not in html and "url(" not in html
    assert html.count("data:image/png") == 8
    for part in (
        "HalfCheetah-v5, pid2-ib",
        "21.00 %",
        "4116.7",
        "95 % bootstrap",
        "threshold",
        "Rows that hold the target back",
        "later than the control period",
        "Which stage of the projector answered",
        "Always zero: slack",
        "overruns",
        "9.1",
        "320.0",
        "velocity 0.012",
        "8,123",
        "swapped in",
        "refused",
    ):
        assert part in words or part in html, part


def test_what_was_not_measured_has_no_section(inputs, tmp_path) -> None:
    def sections(**given) -> list[str]:
        return re.findall("<h2>(.*?)</h2>", report.build(tmp_path / "r.html", **given).read_text())

    assert sections(runs=inputs["runs"][3:4]) == ["Results", "Learning"], "plain PPO projects nothing and learns no inverse model"
    assert sections(logs=inputs["logs"]) == ["Results", "Flight panda.mcap"]


def test_the_first_screen_is_the_promise_in_three_numbers(inputs, tmp_path) -> None:
    page = report.build(tmp_path / "r.html", **inputs).read_text()
    first = page[: page.index("<h2>")]
    shown = re.findall(r"<strong[^>]*>(.*?)</strong>", first)
    told = json.loads(inputs["evals"][0].read_text())
    (e,) = [e for e in (told if isinstance(told, list) else told["evaluations"]) if e["mode"] == "projected"][:1]
    share = {kind: f"{100 * e[f'{kind}_violations'] / e['ticks']:.2f} %" for kind in ("raw", "target", "reached")}
    assert shown == [share["raw"], share["target"], share["reached"]] and first.count("data:image/png") == 1
    assert "of raw proposals broke a limit in eval" in first, "named by its file"


def test_a_flight_counts_broken_targets_as_the_run_does(tmp_path) -> None:
    """The policy's ticks that began within the limits; one that began outside can only come nearer, and a brake of the loop's own is no proposal."""
    whole = synthetic.flight_log(tmp_path / "whole.mcap", 200, {"dt": "0.001"})
    changed = tmp_path / "changed.mcap"
    with open(whole, "rb") as source, open(changed, "wb") as file:
        reader, writer = make_reader(source), Writer(file)
        writer.start()
        for record in reader.iter_metadata():
            writer.add_metadata(record.name, record.metadata)
        channel = writer.register_channel("tick", "json", writer.register_schema("nearl.Tick", "jsonschema", b"{}"))
        for _, _, message in reader.iter_messages(topics=["tick"]):
            tick = json.loads(message.data)
            n = tick["tick"]
            tick["ledger"] |= {"outside": int(n <= 105), "target_violations": int(n > 5 and n <= 115), "raw_violations": int(n > 100)}
            tick["mode"] = "hold" if n <= 5 else "braking" if n > 155 else "active"
            writer.add_message(channel, message.log_time, json.dumps(tick).encode(), message.publish_time, n)
        writer.finish()
    page = report.build(tmp_path / "r.html", logs=[changed]).read_text()
    assert re.findall(r"<strong[^>]*>(.*?)</strong>", page)[:2] == [f"{100 * 55 / 150:.2f} %", f"{100 * 10 / 150:.2f} %"]


@pytest.mark.parametrize("dt, ticks", [(1e-3, 600), (8e-3, 250), (0.05, 60)])
def test_the_picture_of_a_flight_is_short_enough_to_read(dt: float, ticks: int, tmp_path) -> None:
    """Two seconds, where these are neither too few ticks nor too many."""
    log = read_log(synthetic.flight_log(tmp_path / "long.mcap", 1000, {"dt": str(dt)}))
    window = flight._window(log)
    assert log.dt == dt and window.stop - window.start == ticks


def test_settings_of_a_loop_are_a_table_and_no_raw_json(tmp_path) -> None:
    log = synthetic.flight_log(tmp_path / "long.mcap", 300, {"dt": "0.001", "settings": json.dumps({"key": "x" * 900})})
    page = report.build(tmp_path / "r.html", logs=[log]).read_text()
    assert "<details>" in page and "Metadata:" not in page and "x" * 301 not in page


def test_a_flight_says_what_the_joints_are_commanded(tmp_path) -> None:
    commands = {"shoulder": "effort [N m or N]", "elbow": "effort [N m or N]", "wrist": "pd target [rad or m], stiffness 50 N m/rad or N/m"}
    log = synthetic.flight_log(tmp_path / "commands.mcap", 300, {"dt": "0.001", "commands": json.dumps(commands)})
    words = text_of(report.build(tmp_path / "r.html", logs=[log]))
    assert "Commanded: shoulder, elbow: effort [N m or N]. wrist: pd target [rad or m], stiffness 50 N m/rad or N/m." in words


def test_the_command(inputs, tmp_path) -> None:
    out = tmp_path / "report.html"
    command = [sys.executable, "-m", "nearl.report", "--out", str(out)]
    assert subprocess.run([*command, "--run", *map(str, inputs["runs"][:2])], check=True, capture_output=True, text=True).stdout.strip() == str(out)
    failed = subprocess.run([*command, "--run", str(tmp_path)], capture_output=True, text=True)
    assert failed.returncode == 1 and failed.stderr.startswith("nearl report: ") and "no metrics.csv" in failed.stderr
    assert failed.stderr.count("\n") == 1


def test_without_matplotlib_it_says_what_to_install(tmp_path) -> None:
    program = "import sys; sys.modules['matplotlib'] = None; from nearl.report.__main__ import main; sys.exit(main(['--run', 'none']))"
    done = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 1 and done.stderr == "nearl report: the report needs matplotlib: pip install 'nearl[viz]'\n", done.stderr


@pytest.mark.parametrize("content", [b"", b"not mcap", b"\x89MCAP0\r\n"])
def test_a_broken_log_is_refused_in_a_sentence(tmp_path, content) -> None:
    path = tmp_path / "broken.mcap"
    path.write_bytes(content)
    with pytest.raises(ReadError, match=r"broken\.mcap.*(cannot|can) be read|holds no ticks"):
        read_log(path)


@pytest.fixture(scope="module", params=["lz4", "zstd"])
def chunks(request, tmp_path_factory) -> tuple[Path, list[dict], list[int]]:
    """A log of many small chunks as a loop writes it, its ticks, and at which byte the data of each chunk ends."""
    folder = tmp_path_factory.mktemp("chunks")
    whole = synthetic.flight_log(folder / "long.mcap", 200, {"dt": "0.001"})
    path, ticks = folder / "small.mcap", []
    with open(whole, "rb") as source, open(path, "wb") as file:
        reader, writer = make_reader(source), Writer(file, chunk_size=20_000, compression=CompressionType[request.param.upper()])
        writer.start()
        for record in reader.iter_metadata():
            writer.add_metadata(record.name, record.metadata)
        channel = writer.register_channel("tick", "json", writer.register_schema("nearl.Tick", "jsonschema", b"{}"))
        for _, _, message in reader.iter_messages(topics=["tick"]):
            ticks.append(json.loads(message.data))
            writer.add_message(channel, message.log_time, message.data, message.publish_time, ticks[-1]["tick"])
        writer.finish()
    with open(path, "rb") as file:
        ends = [c.chunk_start_offset + c.chunk_length for c in make_reader(file).get_summary().chunk_indexes]
    assert len(ends) > 4
    return path, ticks, ends


def test_a_log_of_a_loop_that_was_killed_is_read_to_its_end(chunks, tmp_path) -> None:
    """In the middle of a chunk, and with a last chunk whose length was not written yet, as our runtime leaves it."""
    path, ticks, ends = chunks
    content = path.read_bytes()
    seen = []
    for k, rest in ((2, content[ends[2] : ends[2] + 90]), (3, b"\x06" + b"\xff" * 8 + content[ends[3] : ends[3] + 500])):
        file = tmp_path / "killed.mcap"
        file.write_bytes(content[: ends[k]] + rest)
        with pytest.warns(UserWarning, match=r"killed.mcap' is without its end, and \d+ ticks of it are reported: the loop was killed"):
            log = read_log(file)
        n = len(log)
        seen.append(n)
        assert log.without_end and log.metadata["dt"] == "0.001"
        assert np.array_equal(log.q, [tick["state"]["q"] for tick in ticks[:n]]) and log.columns["tick"].tolist() == [tick["tick"] for tick in ticks[:n]]
    assert 0 < seen[0] < seen[1] < len(ticks)
    done = subprocess.run([sys.executable, "-m", "nearl.report", "--log", str(file), "--out", str(tmp_path / "r.html")], capture_output=True, text=True)
    assert done.returncode == 0 and done.stderr.count("\n") == 1 and done.stderr.startswith(f"nearl report: '{file}' is without its end"), done.stderr
    page = text_of(tmp_path / "r.html")
    assert f"killed.mcap: {n} ticks of 1 ms, without its end." in page and "The end of this log is missing: the loop was killed" in page
    assert not read_log(path).without_end and "without its end" not in text_of(report.build(tmp_path / "r.html", logs=[path]))


@pytest.mark.parametrize("end", ["cut", "added to"])
def test_a_log_that_is_cut_or_added_to_at_its_very_end_says_so(chunks, tmp_path, end) -> None:
    """All ticks are there, so that nothing else shows it; docs/FLIGHT_LOG.md promises a warning."""
    path, ticks, _ = chunks
    log, file = path.read_bytes(), tmp_path / "end.mcap"
    for content in {"cut": (log[:-3], log[:-8] + b"\x89MCAP1\r\n", log[:-100]), "added to": (log + b"junk", log + b"\n", log + log)}[end]:
        file.write_bytes(content)
        with pytest.warns(UserWarning, match=f"end.mcap' is {end} at its end, behind its {len(ticks)} ticks: "):
            found = read_log(file)
        assert found.off_end == end and not found.without_end and len(found) == len(ticks)
    done = subprocess.run([sys.executable, "-m", "nearl.report", "--log", str(file), "--out", str(tmp_path / "r.html")], capture_output=True, text=True)
    assert done.returncode == 0 and done.stderr.count("\n") == 1, done.stderr
    assert done.stderr.startswith(f"nearl report: '{file}' is {end} at its end, behind its {len(ticks)} ticks: "), done.stderr
    page = text_of(tmp_path / "r.html")
    assert f"end.mcap: {len(ticks)} ticks of 1 ms, {end} at its end." in page and f"The end of this log, behind its ticks, is {end}: " in page


def test_numbers_that_nobody_can_draw_are_left_out_and_counted(tmp_path) -> None:
    """Too large for matplotlib, or for any float; all others are drawn, and the shares are those of the whole log."""
    whole = synthetic.flight_log(tmp_path / "whole.mcap", 300, {"dt": "0.001"}, rows=True)
    changed, planted = tmp_path / "changed.mcap", 0
    with open(whole, "rb") as source, open(changed, "wb") as file:
        reader, writer = make_reader(source), Writer(file)
        writer.start()
        for record in reader.iter_metadata():
            writer.add_metadata(record.name, record.metadata)
        channel = writer.register_channel("tick", "json", writer.register_schema("nearl.Tick", "jsonschema", b"{}"))
        for n, (_, _, message) in enumerate(reader.iter_messages(topics=["tick"])):
            tick = json.loads(message.data)
            if n == 100:
                tick["target_q"][0], tick["target_v"][6], tick["end_ns"], tick["ledger"]["moved"] = 1e308, -1e308, 1e308, 1e308
                tick["state"]["q"][2], tick["proposal_q"][1], tick["due_ns"], tick["ledger"]["rung"] = 1e300, -(10**400), 10**30, 1e15
                tick["ledger"]["active_rows"] = [{"row": 0, "kind": "velocity", "side": "upper", "multiplier": 1e308}]
                planted += 9
            if n > 200:
                tick["state"]["v"] = [1e308] * 7
                planted += 7
            writer.add_message(channel, message.log_time, json.dumps(tick).encode(), message.publish_time, n)
        writer.finish()
    done = subprocess.run([sys.executable, "-m", "nearl.report", "--log", str(changed), "--out", str(tmp_path / "r.html")], capture_output=True, text=True)
    said = f"has {planted} numbers beyond 1e+20, which are left out of pictures and tables; `nearl verify` tells in which tick"
    assert done.returncode == 0 and done.stderr == f"nearl report: '{changed}' {said}\n", done.stderr
    page, all_of_it = (tmp_path / "r.html").read_text(), report.build(tmp_path / "w.html", logs=[whole]).read_text()
    assert f"This log {said}." in text_of(tmp_path / "r.html") and page.count("data:image/png") == all_of_it.count("data:image/png") == 5
    numbers = [re.findall(r"<strong[^>]*>(.*?)</strong>", of)[:2] for of in (page, all_of_it)]
    assert numbers[0] == numbers[1]
    with pytest.warns(UserWarning, match="beyond"):
        log = read_log(changed)
    kept, own = read_log(whole), [i for i in range(201) if i != 100]
    assert np.array_equal(log.target_q[own], kept.target_q[own], equal_nan=True) and np.array_equal(log.v[:201], kept.v[:201])
    assert np.array_equal(np.flatnonzero(np.isnan(log.target_q[100])), [0]) and np.isnan(log.v[201:]).all()
    assert np.allclose(log.time, kept.time), "a time that is left out lies between those beside it"


def test_a_log_with_a_flipped_bit_is_refused_in_a_sentence(chunks, tmp_path) -> None:
    path, _, ends = chunks
    for place in (ends[0] - 40, ends[1] - 200, ends[2] - 1000):
        content = bytearray(path.read_bytes())
        content[place] ^= 0x40
        file = tmp_path / "flipped.mcap"
        file.write_bytes(content)
        done = subprocess.run([sys.executable, "-m", "nearl.report", "--log", str(file), "--out", str(tmp_path / "r.html")], capture_output=True, text=True)
        assert done.returncode == 1 and not (tmp_path / "r.html").exists()
        begin = f"nearl report: '{file}' is a flight log that is damaged ("
        end = "; neither a report nor `nearl verify` can tell what of it holds; give another copy of it\n"
        assert done.stderr.startswith(begin) and done.stderr.endswith(end) and done.stderr.count("\n") == 1, done.stderr
        verified = subprocess.run([NEARL, "verify", file], capture_output=True, text=True)
        assert verified.returncode == 2 and "cannot be verified" in verified.stderr, "as the sentence says"


@pytest.mark.parametrize(
    ("tick", "metadata", "why"),
    [
        ("{}", {}, "tick 1 of its 1 has no number, mode, state or ledger"),
        ("[1]", {}, "has no attribute"),
        ('{"tick": 1, "mode": "act", "state": {"q": [NaN]}, "ledger": {}}', {}, "a number that is NaN"),
        ('{"tick": 1, "mode": "act", "state": {}, "ledger": {}, "due_ns": "x"}', {}, "could not convert string to float"),
        ('{"tick": 1, "mode": "act", "state": {}, "ledger": {}}', {"dt": "0"}, "a control period of 0 s"),
        ('{"tick": 1, "mode": "act", "state": {}, "ledger": {}}', {"rows": "hello"}, "Expecting value"),
    ],
)
def test_a_log_that_no_loop_wrote_is_refused_in_a_sentence(tmp_path, tick, metadata, why) -> None:
    file = tmp_path / "edited.mcap"
    with file.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        writer.add_metadata("nearl", metadata)
        writer.add_message(writer.register_channel("tick", "json", writer.register_schema("nearl.Tick", "jsonschema", b"{}")), 1, tick.encode(), 1)
        writer.finish()
    with pytest.raises(ReadError, match="is a flight log that is damaged") as error:
        read_log(file)
    assert why in str(error.value)


def test_what_is_no_regular_file_is_refused_at_once(tmp_path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "endless").symlink_to("/dev/zero")
    (tmp_path / "folder").mkdir()
    whats = {"pipe": "is not a regular file", "endless": "is not a regular file", "folder": "is a folder, not a regular file", "gone": "does not exist"}
    given = [(option, name) for option in ("--log", "--eval", "--summary", "--demos") for name in whats]
    program = f"from nearl.report.__main__ import main; print([main([option, name]) for option, name in {given}])"
    done = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.stdout == f"{[1] * len(given)}\n" and not (tmp_path / "report.html").exists(), done.stderr
    for line, (_, name) in zip(done.stderr.splitlines(), given, strict=True):
        assert line.startswith(f"nearl report: '{name}' {whats[name]}; give "), line


def test_a_place_that_cannot_be_written_is_named(inputs, tmp_path, capsys) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "folder").mkdir()
    whats = {"file/page.html": ("file", "File exists"), "folder": ("folder", "Is a directory")}
    for out, (named, why) in whats.items():
        assert main(["--eval", str(inputs["evals"][0]), "--out", str(tmp_path / out)]) == 1
        assert capsys.readouterr().err == f"nearl report: cannot write '{tmp_path / named}': {why}; give another place with --out\n"


def test_the_pull_from_states_is_the_sum_of_the_multipliers(tmp_path) -> None:
    """Without torque rows active, what is worked out from the states is what the ledger says, row by row."""
    path = synthetic.flight_log(tmp_path / "rows.mcap", 2000, {"joints": "a b c d e f g", "dt": "0.001"}, rows=True)
    log = read_log(path)
    recorded = rows.active_rows(log)
    log.active = []
    derived = rows.active_rows(log)
    assert any("position" in n or "viability" in n for n in recorded.names) and all(n[0] in "abcdefg" for n in recorded.names)
    total = np.zeros((7, len(log)))
    for name, values in zip(recorded.names, recorded.multiplier, strict=True):
        if "torque" not in name:
            total["abcdefg".index(name[0])] += np.where(np.isfinite(values), values, 0.0) * (1 if "↑" in name else -1)
    pull = np.zeros((7, len(log)))
    for name, values in zip(derived.names, derived.multiplier, strict=True):
        pull["abcdefg".index(name[0])] += np.where(np.isfinite(values), values, 0.0) * (1 if "↑" in name else -1)
    torque = np.arange(len(log)) < 5  # no target yet
    for name, values in zip(recorded.names, recorded.multiplier, strict=True):
        torque |= np.isfinite(values) & ("torque" in name)
    assert (~torque).sum() > 1000
    np.testing.assert_allclose(pull[:, ~torque], total[:, ~torque], atol=1e-6)


def test_a_row_cut_short_is_left_out(inputs) -> None:
    run = read_run(inputs["runs"][0])
    assert run.algo == "pid2-ib" and run.seed == 0 and len(run.metrics["time/fps"]) == 244
    assert len(run.column("rollout/ep_rew_mean")[0]) == 242


def test_interquartile_mean_by_hand() -> None:
    assert curves.interquartile_mean([1.0, 2.0, 3.0, 100.0]) == 2.5
    assert curves.interquartile_mean([5.0]) == 5.0 and curves.interquartile_mean([1.0, 2.0]) == 1.5
    # Three values: a quarter of 3 is 0.75, so the outer two count by a quarter each: (0.25 + 2 + 0.25 * 9) / 1.5.
    assert curves.interquartile_mean([9.0, 1.0, 2.0]) == pytest.approx((0.25 * 1 + 2 + 0.25 * 9) / 1.5)
    assert np.array_equal(curves.interquartile_mean([[0, 1], [2, 3]], axis=1), [0.5, 2.5])


def test_the_band_covers_the_truth_about_as_often_as_it_says() -> None:
    rng = np.random.default_rng(0)
    covered = 0
    for i in range(200):
        low, high = curves.bootstrap_band(rng.normal(3.0, 1.0, size=20), resamples=400, seed=i)
        covered += low <= 3.0 <= high
    assert 172 <= covered <= 198  # 95 % of 200 is 190; a percentile bootstrap of 20 values covers a little less


def test_curves_meet_where_all_seeds_have_values() -> None:
    band = curves.over_seeds([([0, 10, 20], [0, 10, 20]), ([5, 30], [7, 32]), ([0, 20], [np.nan, 1])][:2], points=4)
    assert np.array_equal(band.steps, [5, 10, 15, 20]) and np.allclose(band.centre, band.steps + 1)
    with pytest.raises(ValueError, match="no steps in common"):
        curves.over_seeds([([0, 1], [0, 0]), ([5, 6], [0, 0])])
    assert np.array_equal(curves.smooth([1, 2, 3, 4], 2), [1, 1.5, 2.5, 3.5])


def demonstrations(path: Path) -> Path:
    """Three episodes of a hopper that bends its knee."""
    env = nearl._core.Env("Hopper-v5")
    rng, rows = np.random.default_rng(0), []
    lengths = [40, 60, 50]
    for length in lengths:
        for step in range(length + 1):
            qpos = np.array([0.1 * step, 1.25 - 0.002 * step, 0, -0.01 * step, -0.02 * step, 0]) + 1e-3 * rng.normal(size=6)
            rows.append((env.set_state(qpos, np.zeros(6)), qpos, np.zeros(6)))
    obs, qpos, qvel = (np.array(part) for part in zip(*rows, strict=True))
    np.savez(path, observations=obs, qpos=qpos, qvel=qvel, lengths=lengths, dt=0.008, names=env.obs_names)
    return path


def test_demonstrations_can_be_looked_at(tmp_path) -> None:
    file = demonstrations(tmp_path / "hops.npz")
    page = report.build(tmp_path / "r.html", demos=[file]).read_text()
    assert re.findall("<h2>(.*?)</h2>", page) == ["Demonstrations"] and page.count("data:image/png") == 1
    assert [x in page for x in ("<td>3</td>", "<td>40 .. 60</td>", "<td>8</td>", "<td>1.2</td>", "<td>no</td>")] == [True] * 5
    # of a run that learned from them, with pictures of the robot, once however many runs read the file
    for seed in range(2):
        run = synthetic.run_folder(tmp_path, "Hopper-v5", "soil", seed, 900)
        (run / "task.toml").write_text((ROOT / "examples/tasks/Hopper-v5.toml").read_text() + f'\n[train.demos]\nfile = "{file}"\n')
    runs = [tmp_path / "Hopper-v5" / f"soil_{seed}" for seed in range(2)]
    shown = report.build(tmp_path / "r.html", runs=runs).read_text()
    assert shown.count("The first episode of hops.npz at 0.00, 0.06, 0.13, 0.19, 0.26, 0.32 s.") == 2, "as text and caption"
    assert shown.count('class="photo"') == 1
    with pytest.raises(ReadError, match=r"of another robot than 'HalfCheetah-v5'"):
        report.build(tmp_path / "r.html", demos=[file], task="HalfCheetah-v5")
    np.savez(tmp_path / "half.npz", qpos=np.zeros((3, 6)))
    with pytest.raises(ReadError, match=r"half\.npz' has no array 'observations'"):
        report.build(tmp_path / "r.html", demos=[tmp_path / "half.npz"])
    (tmp_path / "no.npz").write_bytes(b"no archive")
    with pytest.raises(ReadError, match=r"no\.npz' are no demonstrations that can be read"):
        report.build(tmp_path / "r.html", demos=[tmp_path / "no.npz"])


def test_a_sweep_and_a_training_begin_with_three_numbers_and_a_picture(inputs, tmp_path) -> None:
    runs = inputs["runs"][:3]
    ends = [[read_run(r).column(f"constraints/{kind}_violations")[1][-1] for r in runs] for kind in ("raw", "target", "reached")]
    wanted = [f"{100 * np.mean(end):.2f} %" for end in ends]
    for given in ({"runs": runs}, {"sweeps": [runs[0].parent]}):
        page = report.build(tmp_path / "r.html", **given).read_text()
        assert re.findall(r"<strong[^>]*>(.*?)</strong>", page) == wanted and "at the end of 3 trainings" in page
        table = page.index("<table>")
        assert page.index('class="drawn"') < table, "a picture comes before the tables"


def test_the_table_ends_where_the_curve_ends(inputs, tmp_path) -> None:
    run = inputs["runs"][0]
    page = report.build(tmp_path / "r.html", runs=[run]).read_text()
    assert f"<td>{read_run(run).column('rollout/ep_rew_mean')[1][-1]:.1f}</td>" in page


def test_rows_of_a_flight_have_the_names_of_its_snapshot(tmp_path) -> None:
    names = [f"joint {i}" for i in range(7)] + [f"motor {i}" for i in range(7)]
    given = {"joints": "a b c d e f g", "dt": "0.001", "rows": json.dumps(names)}
    log = read_log(synthetic.flight_log(tmp_path / "named.mcap", 300, given))
    row = {"kind": "torque", "side": "upper", "multiplier": 0.5}
    log.active = [[{**row, "row": 9}, {**row, "row": 1, "kind": "velocity"}] if tick == 40 else [] for tick in range(len(log))]
    found = rows.active_rows(log)
    assert found.names == ["joint 1 velocity ↑", "motor 2 torque ↑"] and np.isfinite(found.multiplier).sum(axis=1).tolist() == [1, 1]


def test_nothing_runs_over_the_edge_at_1200_pixels_and_no_page_on_a_phone(inputs, tmp_path) -> None:
    """In Chromium, light and dark: no element is wider than the page, and the figures turn dark with it."""
    sync_api = pytest.importorskip("playwright.sync_api")
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        pytest.skip("no Chromium here: apt-get install chromium")
    pages = [report.build(tmp_path / "all.html", **inputs), report.build(tmp_path / "sweep.html", sweeps=[inputs["runs"][0].parent])]
    wider = """[...document.querySelectorAll('body *')].filter(e => e.getBoundingClientRect().right > innerWidth + 1
        || (e.scrollWidth > e.clientWidth + 1 && getComputedStyle(e).display != 'inline')).map(e => e.tagName + ' ' + e.textContent.slice(0, 60))"""
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        for scheme, is_dark in (("light", False), ("dark", True)):
            tab = browser.new_page(viewport={"width": 1200, "height": 900}, color_scheme=scheme)
            for page in pages:
                tab.goto(page.as_uri())
                assert tab.evaluate(wider) == []
                for place in ("h1", "figure.drawn"):
                    shot = tab.locator(place).first.screenshot()
                    assert (np.median(plt_gray(shot)) < 0.4) == is_dark, (page.name, scheme, place)
        phone = browser.new_page(viewport={"width": 390, "height": 844})
        for page in pages:
            phone.goto(page.as_uri())
            assert phone.evaluate("document.documentElement.scrollWidth - innerWidth") <= 0, page.name
            assert phone.locator(".wide").first.evaluate("e => e.scrollWidth > e.clientWidth"), "a wide table is moved sideways in its own frame"
        browser.close()


def plt_gray(png: bytes) -> np.ndarray:
    import matplotlib.image

    return matplotlib.image.imread(io.BytesIO(png))[..., :3].mean(axis=2)
