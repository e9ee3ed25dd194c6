"""Every command and every example of README.md and of the pages in docs/ runs. `make` itself is what runs the tests, so its lines are
not repeated."""

import csv
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text()
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
NEARL = ROOT / "target/release/nearl"


def blocks(language):
    found = [(page.stem, block) for page in PAGES for block in re.findall(rf"```{language}\n(.*?)```", page.read_text(), re.DOTALL)]
    return [pytest.param(block, id=f"{page}: {block.strip().splitlines()[0][:60]}") for page, block in found]


@pytest.mark.parametrize("block", blocks("sh"))
def test_commands(block, tmp_path):
    if not NEARL.exists():
        pytest.fail(f"{NEARL} was not built: run 'make build'")
    # what the commands write goes into a folder of the test
    block = re.sub(r"\b(runs|demo)/", f"{tmp_path}/", block)
    run = subprocess.run(["bash", "-euo", "pipefail", "-c", block], cwd=ROOT, capture_output=True, text=True, timeout=600)
    assert run.returncode == 0, f"{block}\n{run.stdout[-2000:]}\n{run.stderr[-2000:]}"


@pytest.mark.parametrize("block", blocks("python"))
def test_examples(block, tmp_path):
    block = re.sub(r"\b(runs|demo)/", f"{tmp_path}/", block)
    run = subprocess.run([sys.executable, "-c", block], cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert run.returncode == 0, run.stderr


def test_a_robot_of_ones_own(tmp_path):
    """docs/OWN_ROBOT.md from the page alone: its blocks are one task file, its commands run in order, with fewer steps."""
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    page = (ROOT / "docs/OWN_ROBOT.md").read_text()
    there = {"cwd": tmp_path, "env": os.environ | {"PATH": f"{NEARL.parent}:{os.environ['PATH']}"}}
    for toml, commands in re.findall(r"```toml\n(.*?)```|((?:^    (?:cp|nearl|wait)\b[^\n]*\n)+)", page, re.DOTALL | re.MULTILINE):
        with open(tmp_path / "arm.toml", "a") as task:
            task.write(toml)
        script = re.sub(r"--steps \w+", "--steps 8k", commands)
        run = subprocess.run(["bash", "-euo", "pipefail", "-c", script], capture_output=True, text=True, timeout=600, **there)
        assert run.returncode == 0, f"{script}\n{run.stdout[-2000:]}\n{run.stderr[-2000:]}"
    rows = {}
    for name in ("arm", "random"):
        with open(tmp_path / "runs" / name / "metrics.csv") as file:
            rows[name] = list(csv.DictReader(file))
    returns = [float(row["rollout/ep_rew_mean"]) for row in rows["arm"]]
    assert returns[-1] > returns[0] + 0.5, returns
    assert all(float(row["random/mass"]) > 0 for row in rows["random"]) and "random/mass" not in rows["arm"][0]
    assert json.loads(run.stdout)[0]["lengths"] == [100, 100] and (tmp_path / "arm.mcap").stat().st_size > 10_000


def test_every_command_line_is_covered():
    """Indented lines are for `make`, whose targets exist."""
    targets = set(re.findall(r"^    make (\w+)", README, re.MULTILINE))
    makefile = (ROOT / "Makefile").read_text()
    assert targets and all(re.search(rf"^{t}:", makefile, re.MULTILINE) for t in targets)


NOTEBOOKS = sorted((ROOT / "examples" / "notebooks").glob("*.ipynb"))


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks(notebook, tmp_path):
    """Their cells in order in one process, from the folder of the notebook; no output is kept in the file."""
    cells = [cell for cell in json.loads(notebook.read_text())["cells"] if cell["cell_type"] == "code"]
    assert len(cells) > 3 and all(cell["outputs"] == [] and cell["execution_count"] is None for cell in cells)
    program = tmp_path / "notebook.py"
    program.write_text("import matplotlib\nmatplotlib.use('Agg')\n" + "\n".join("".join(cell["source"]) for cell in cells))
    run = subprocess.run([sys.executable, program], cwd=notebook.parent, capture_output=True, text=True, timeout=300)
    assert run.returncode == 0, run.stderr


EXAMPLES = sorted((ROOT / "examples" / "python").glob("*.py"))


NEEDED = {"sb3_vec_env": "stable_baselines3", "wandb_callback": "wandb"}
# What each prints where it does what it says.
SAID = {
    "project_state": "clamped", "wrap_env": "0 targets", "train": "the pole stood for", "imitate": "the pole stood for 500 periods of 500",
    "wrong_prior": "0.1 kg, not told, margin 0.05 rad/s: of 4000 ticks 0 targets and 0 reached", "own_limit": "= 1.0000 rad, allowed 1",
    "import_policy": "allowed 2", "control_loop": "torque of joint 2", "server_client": "1000 steps", "flight_log": "bit for bit the same",
}  # fmt: skip


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_python_examples(example, tmp_path):
    assert len(example.read_text().splitlines()) < 60
    folder = str(tmp_path)
    arguments = {
        "record_video": [folder], "sb3_vec_env": ["4096"], "wandb_callback": [folder], "imitate": [folder], "import_policy": [folder],
        "flight_log": [f"{folder}/arm.mcap"],
    }.get(example.stem, [])  # fmt: skip
    needed = NEEDED.get(example.stem)
    if needed is not None:
        pytest.importorskip(needed, reason=f"{example.name} needs {needed}: pip install {needed}")
    run = subprocess.run([sys.executable, example, *arguments], cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert run.returncode == 0 and run.stdout, run.stderr
    assert SAID.get(example.stem, "") in run.stdout, run.stdout
    if example.stem == "record_video":
        assert [file.suffix for file in tmp_path.iterdir()].count(".mp4") == 1


def test_the_same_ten_examples_are_there_in_both_languages():
    """By name, in the index, and run by the tests of both."""
    index = (ROOT / "examples" / "README.md").read_text()
    rust_tests = (ROOT / "tests" / "tests" / "programs" / "examples.rs").read_text()
    assert len(SAID) == 10
    for name in SAID:
        assert f"(python/{name}.py)" in index and f"{name}.rs)" in index, name
        assert (ROOT / "examples" / "python" / f"{name}.py").is_file() and (ROOT / "examples" / "rust" / f"{name}.rs").is_file(), name
        assert f'run("{name}"' in rust_tests, name


@pytest.mark.parametrize("block", blocks("rust"))
def test_rust_of_a_page_is_of_a_program_that_the_tests_run(block):
    """README's is the control loop with the robot's own calls."""
    programs = [*(ROOT / "examples" / "rust").glob("*.rs"), *(ROOT / "runtime").rglob("examples/*.rs")]
    assert "robot.measure" in block or any(block in program.read_text() for program in programs)
