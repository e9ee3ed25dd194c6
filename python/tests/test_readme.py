"""Every command and every example of README.md runs. `make` itself is what runs the tests, so its lines are not repeated."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text()
NEARL = ROOT / "target/release/nearl"


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)


@pytest.mark.parametrize("block", blocks("sh"), ids=lambda b: b.strip().splitlines()[0][:60])
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


def test_every_command_line_is_covered():
    """Indented lines are for `make`, whose targets exist."""
    targets = set(re.findall(r"^    make (\w+)", README, re.MULTILINE))
    makefile = (ROOT / "Makefile").read_text()
    assert targets and all(re.search(rf"^{t}:", makefile, re.MULTILINE) for t in targets)
