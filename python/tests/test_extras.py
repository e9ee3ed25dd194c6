"""What the package imports comes with it or with an extra, and whoever lacks it is told which one."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import ROOT

from nearl.runs import tomllib

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS = PROJECT["optional-dependencies"]
# Modules of a distribution, where they are called otherwise.
MODULES = {"imageio-ffmpeg": "imageio_ffmpeg", "stable-baselines3": "stable_baselines3", "tensorboardX": "tensorboardX"}
# Brought for the sake of the user's own program, whose objects are handed over.
HANDED_OVER = {"stable_baselines3"}
# What an extra is for, tried without its libraries.
TRIED = {
    "train": "import nearl; nearl.make_vec",
    "viz": "import nearl.report; nearl.report.build()",
    "view": "import nearl.view; nearl.view.view('nobody')",
    "video": "import nearl.video; nearl.video.check()",
    "tensorboard": "import nearl.tensorboard; nearl.tensorboard.Writer('events')",
    "torch": "import nearl.torch",
    "jax": "import nearl.jax",
    "demos": "import nearl.demos; nearl.demos.from_robomimic('Hopper-v5', 'a.hdf5', 'a.npz', dt=0.1, columns={})",
    "minari": "import nearl.demos; nearl.demos.from_minari('Hopper-v5', 'mujoco/hopper/expert-v0', 'a.npz')",
}


def module(requirement: str) -> str:
    name = re.match(r"[\w.-]+", requirement)[0]
    return MODULES.get(name, name)


def imported() -> set[str]:
    """Modules of others that some file of the package imports."""
    found = set()
    for file in (ROOT / "python" / "nearl").rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Import):
                found |= {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.level == 0:
                found.add(node.module.split(".")[0])
    return found - sys.stdlib_module_names - {"nearl", "tomllib"}


def without(modules: set[str], program: str) -> subprocess.CompletedProcess[str]:
    """Runs a program in which these modules are not to be found."""
    hidden = f"""
import sys
class Hidden:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {sorted(modules)!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Hidden())
"""
    return subprocess.run([sys.executable, "-c", hidden + program], capture_output=True, text=True, timeout=120)


def test_what_is_imported_is_a_dependency_or_in_an_extra() -> None:
    core = {module(need) for need in PROJECT["dependencies"]}
    extra = {module(need) for needs in EXTRAS.values() for need in needs}
    # trimesh comes with viser, whose interface takes its meshes, and so does websockets, which is its server.
    assert imported() - core - extra == {"trimesh", "websockets"}
    assert extra - imported() == HANDED_OVER


@pytest.mark.parametrize("extra", TRIED)
def test_whoever_lacks_an_extra_is_told_its_name(extra: str) -> None:
    told = without({module(need) for need in EXTRAS[extra]}, TRIED[extra])
    assert told.returncode != 0 and f"pip install 'nearl[{extra}]'" in told.stderr.splitlines()[-1], told.stderr


@pytest.mark.parametrize("hidden, program", [("pyarrow", "nearl.demos.from_lerobot('Hopper-v5', '.', 'a.npz')"), ("h5py", TRIED["demos"])])
def test_either_library_of_the_extra_demos_is_named(hidden: str, program: str) -> None:
    told = without({hidden}, f"import nearl.demos; {program}").stderr.splitlines()[-1]
    assert hidden in told and "nearl[demos]" in told


def test_the_package_alone_needs_none_of_them() -> None:
    told = without({module(need) for needs in EXTRAS.values() for need in needs}, "import nearl; print(nearl.tasks()[0][0])")
    assert told.returncode == 0 and told.stdout.strip(), told.stderr


def test_every_message_names_an_extra_that_there_is() -> None:
    sources = [file.read_text() for file in (ROOT / "python" / "nearl").rglob("*.py")]
    assert {name for source in sources for name in re.findall(r"pip install 'nearl\[(\w+)\]'", source)} == TRIED.keys()


@pytest.mark.parametrize("page", ["docs/START.md", "python/README.md"])
def test_the_pages_name_every_extra(page: str) -> None:
    text = Path(ROOT / page).read_text()
    assert [extra for extra in EXTRAS if f"`{extra}`" not in text] == []
