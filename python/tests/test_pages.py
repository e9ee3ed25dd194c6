"""What the pages show and no command of theirs runs: every block of TOML is built into the task that it is a part of, every block of C
compiles against the header."""

import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import JOINT, ROOT, link
from test_readme import PAGES

import nearl
from nearl import _core
from nearl.pid2 import _toml
from nearl.runs import tomllib

Build = Callable[..., None]  # (folder, blocks)
EXAMPLES = ROOT / "examples"
TASKS = EXAMPLES / "tasks"


def blocks(language: str) -> dict[str, list[str]]:
    """Those of every page that has some."""
    found = {page.stem: re.findall(rf"```{language}\n(.*?)```", page.read_text(), re.DOTALL) for page in PAGES}
    return {page: of for page, of in found.items() if of}


def merged(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    """Section by section, key by key."""
    both = below | above
    return both | {key: below[key] | above[key] for key in below.keys() & above.keys() if isinstance(above[key], dict)}


def task(folder: Path, base: Path, *given: str) -> str:
    """`base` with the keys of the blocks in the place of its own."""
    sections: dict[str, Any] = {}
    for text in (base.read_text(), *given):
        sections = merged(sections, tomllib.loads(text))
    if sections.get("model", {}).get("urdf", "").endswith("anymal.urdf"):
        sections["model"]["urdf"] = str(EXAMPLES / "robots" / "anymal" / "anymal.urdf")
    file = folder / base.name
    file.write_text("".join(f"{key} = {_toml(value)}\n" for key, value in sections.items()))
    return str(file)


def trains(base: str) -> Build:
    """Environment, networks and controllers of the whole task."""

    def build(folder: Path, *given: str) -> None:
        nearl.PID2(task(folder, TASKS / base, *given), algo="ppo", settings={"train.n_envs": 2, "train.n_steps": 32, "train.ppo.batch_size": 32}).learn(64)

    return build


def limits(folder: Path, block: str) -> None:
    """Those of a Panda, with the line `[constraints]` or without."""
    block = block if block.startswith("[") else f"[constraints]\n{block}"
    nearl.blank(task(folder, TASKS / "Panda-reach.toml", block), folder / "panda.safetensors")
    nearl.Controller.load(folder / "panda.safetensors")


def guarded_file(folder: Path, block: str) -> None:
    """Those of a recipe."""
    policies = EXAMPLES / "policies"
    nearl.import_onnx(policies / "reacher.onnx", policies / "reacher.xml", task(folder, policies / "reacher.toml", block))


def recipe(folder: Path, block: str) -> None:
    """For a leg on a base that floats, and a network of the sizes that the recipe says."""
    parts = ['<robot name="leg">', link("base", 0.4, 6.0)]
    parent = "base"
    for joint in ("FL_hip_joint", "FL_thigh_joint", "FL_calf_joint"):
        shape = {"x": 0.2, "y": 0, "axis": "0 1 0", "low": -3.0, "high": 3.0, "speed": 20.0, "effort": 30.0, "damping": 0.1}
        parts += [JOINT.format(name=joint, parent=parent, child=f"of_{joint}", **shape), link(f"of_{joint}", 0.2, 1.0)]
        parent = f"of_{joint}"
    (folder / "leg.urdf").write_text("\n".join([*parts, "</robot>"]))
    (folder / "recipe.toml").write_text(block)
    n_in, n_out = 3 + 3 + 3 + 3 + 3 * 5 + 3, 3
    layers = [(np.zeros((n_out, n_in)), np.zeros(n_out), "identity")]
    policy = _core.Policy.from_layers(layers, np.zeros(n_in), np.ones(n_in), (-10.0, 10.0), (-100.0, 100.0))
    controller = policy.controller(folder / "leg.urdf", folder / "recipe.toml")
    assert (controller.dt, controller.policy_every) == (0.004, 5)


# What the blocks of a page are a part of, in the page's order. Those of OWN_ROBOT are one file, which test_readme.py trains.
PARTS: dict[str, list[Build]] = {
    "GUARD": [guarded_file],
    "LIMITS": [limits, *[trains("HalfCheetah-v5.toml")] * 3],
    "OWN_LIMIT": [limits],
    "POLICIES": [recipe],
    "TASKS": [trains("anymal-walk.toml")] * 2,
}
# A block of these goes with those before it.
TOGETHER = {"TASKS"}
TOML = blocks("toml")
SHOWN = [
    pytest.param(build, TOML[page][: i if page in TOGETHER else 0], block, id=f"{page}: {block.splitlines()[0][:40]}")
    for page in PARTS
    for i, (build, block) in enumerate(zip(PARTS[page], TOML.get(page, [])))
]


def test_every_block_of_toml_has_its_place() -> None:
    assert {page: len(of) for page, of in TOML.items() if page != "OWN_ROBOT"} == {page: len(of) for page, of in PARTS.items()}


@pytest.mark.parametrize(("build", "before", "block"), SHOWN)
def test_toml(build: Build, before: list[str], block: str, tmp_path: Path) -> None:
    build(tmp_path, *before, block)


@pytest.mark.parametrize(("build", "before", "block"), SHOWN)
def test_toml_with_a_key_that_is_none_is_refused(build: Build, before: list[str], block: str, tmp_path: Path) -> None:
    last = re.findall(r"^\w+(?= = )", block, re.MULTILINE)[-1]
    with pytest.raises(ValueError, match="unheard_of"):
        build(tmp_path, *before, re.sub(rf"^{last}(?= = )", "unheard_of", block, flags=re.MULTILINE))


def compiled(compiler: str, body: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """The lines of a driver in a function, with what a driver has beside them."""
    program = f"""#include <nearl.h>
extern void read_sensors(double *q, double *v);
extern void my_brake(const double *q, const double *v, double *torque);
extern void write_motors(const double *torque);
extern void sleep_until_next_period(void);
void drive(nearl_robot robot, nearl_state state, double *q, double *v, double *torque);
void drive(nearl_robot robot, nearl_state state, double *q, double *v, double *torque) {{
    char error[256];
    {body}
}}
"""
    file = folder / ("page.c" if compiler == "cc" else "page.cpp")
    file.write_text(program)
    command = [compiler, "-Wall", "-Wextra", "-Werror", "-fsyntax-only", "-I", ROOT / "runtime" / "c" / "include", file]
    return subprocess.run(command, capture_output=True, text=True)


@pytest.mark.parametrize("compiler", ["cc", "c++"])
@pytest.mark.parametrize("block", [block for of in blocks("c").values() for block in of])
def test_c(compiler: str, block: str, tmp_path: Path) -> None:
    assert shutil.which(compiler), f"{compiler} is needed to build NEARL"
    run = compiled(compiler, block, tmp_path)
    assert run.returncode == 0, run.stderr
    for name in set(re.findall(r"\bnearl_plant_\w+|\bNEARL_[A-Z]+", block)):
        assert compiled(compiler, block.replace(name, f"{name}_x"), tmp_path).returncode != 0, f"{name} may be anything"


def test_there_is_c_to_compile() -> None:
    assert "CONNECT" in blocks("c")


def test_pictures_of_the_pages_are_small_and_the_first_one_moves() -> None:
    pictures = {page.parent / name for page in PAGES for name in re.findall(r"!\[[^]]*\]\(([^)]+)\)", page.read_text())}
    assert len(pictures) > 3 and all(picture.stat().st_size < 2_000_000 for picture in pictures), pictures
    first = re.search(r"!\[[^]]*\]\(([^)]+)\)", (ROOT / "README.md").read_text())
    assert first and (ROOT / first[1]).read_bytes().count(b"ANMF") > 20, "frames of a WebP"
