"""Whoever reads `help(nearl...)` is told the shape of every array, and the unit of every count and quantity."""

import ast
import importlib.util
import inspect
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from conftest import ROOT

import nearl
from nearl import _core

# (nq), (n x nv), (3), (rows x nv), (n_envs, n_obs), (n,): words and numbers.
SHAPE = re.compile(r"\(\s*[\w+ ]+(?:\s*[x,]\s*[\w+ ]*)*\)")
ARRAYS = {"ArrayLike", "_Floats", "Floats", "NDArray", "Array"}


def is_array(annotation: ast.expr | None) -> bool:
    """Functions that are handed over take arrays themselves; what these are stands where the functions are told of."""
    if annotation is None or "Callable" in ast.unparse(annotation):
        return False
    return any(isinstance(node, ast.Name) and node.id in ARRAYS for node in ast.walk(annotation))


def functions(tree: ast.Module) -> Iterator[tuple[str, ast.FunctionDef]]:
    """Public functions and methods by their name with a dot."""
    for node in tree.body:
        if isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
            yield node.name, node
        if isinstance(node, ast.ClassDef):
            yield from ((f"{node.name}.{f.name}", f) for f in node.body if isinstance(f, ast.FunctionDef) and (f.name[0] != "_" or f.name == "__new__"))


def is_public(name: str, module: str) -> bool:
    """Whether `nearl` has this very thing of a module; another may have a name of its own alike."""
    return getattr(getattr(nearl, name, None), "__module__", "").removeprefix("nearl.") == module.replace("/", ".")


def public() -> dict[str, tuple[ast.FunctionDef, str]]:
    """Every public callable of the package with an array in its annotations, and what is written about it."""
    found = {}
    package = Path(nearl.__file__).parent
    for file in (package / "_core.pyi", *sorted(package.rglob("*.py"))):
        module = str(file.relative_to(package).with_suffix(""))
        owner = _core if file.suffix == ".pyi" else None
        tree = ast.parse(file.read_text())
        classes = {node.name: ast.get_docstring(node) or "" for node in tree.body if isinstance(node, ast.ClassDef)}
        for label, node in functions(tree):
            head, _, member = label.partition(".")
            if owner is None and module not in ("jax", "torch") and not is_public(head, module):
                continue
            arguments = [*node.args.args, *node.args.kwonlyargs]
            if not any(is_array(a.annotation) for a in arguments) and not is_array(node.returns):
                continue
            if owner is None:
                text = (ast.get_docstring(node) or "") + classes.get(head, "")
            else:
                thing = getattr(owner, head if head != "_Report" else "Target", None)
                value = getattr(thing, member, None) if member and member != "__new__" else thing
                text = (inspect.getdoc(value) or "") + (inspect.getdoc(thing) or "" if member == "__new__" else "")
            found[f"{module}: {label}"] = (node, text)
    return found


PUBLIC = public()


def test_there_is_something_to_look_at() -> None:
    assert len(PUBLIC) > 60
    assert {"Projector", "Controller", "Model"} <= {label.split(": ")[1].split(".")[0] for label in PUBLIC}


@pytest.mark.parametrize("label", PUBLIC)
def test_arrays_have_their_shapes(label: str) -> None:
    _, text = PUBLIC[label]
    assert SHAPE.search(text), f"{label} takes or returns an array and says no shape:\n{text}"


@pytest.mark.parametrize("thing", [nearl.Projector.project, nearl.Projector.project_batch, nearl.Controller.update, nearl.Model.rnea, nearl.Model.aba])
def test_states_have_units(thing: object) -> None:
    text = inspect.getdoc(thing) or ""
    assert re.search(r"\[[^\]]*rad", text) or re.search(r"\brad\b", text), text


def test_nearest_says_its_metric_and_planes_say_their_side() -> None:
    assert "((q' - q_proposal) / (kappa dt))²" in (nearl.Projector.__doc__ or ""), nearl.Projector.__doc__
    assert "normal . (p - through) <= 0" in (nearl.FrameLimit.__doc__ or ""), nearl.FrameLimit.__doc__
    assert "`half_space` is what lies at `z <= 0`" in (nearl.CollisionLimit.__doc__ or ""), nearl.CollisionLimit.__doc__


def test_counts_say_what_they_count() -> None:
    for thing in (nearl.ProjectedEnv, nearl.make_vec, nearl.VecEnv):
        text = inspect.getdoc(thing) or ""
        assert "max_episode_steps" not in text or "period" in text.split("max_episode_steps", 1)[1][:120], text
    assert "environment steps" in (nearl.PID2.learn.__doc__ or "")
    assert "max_episode_steps: Control periods" in (inspect.getdoc(nearl.VecEnv) or "")


def test_every_task_says_what_it_needs() -> None:
    """`nearl tasks`: sizes as the environment has them, the inverse model, and whether there is a cost."""
    program = ROOT / "target" / "release" / "nearl"
    if not program.exists():
        pytest.fail(f"{program} was not built: run 'make build'")
    told = subprocess.run([program, "tasks"], capture_output=True, text=True, check=True).stdout
    for name, about in nearl.tasks():
        env, lines = _core.Env(name), re.search(rf"^{name} +(.*\n +.*)$", told, re.MULTILINE)
        assert lines and about in lines[1], name
        for fact in (f"{len(env.obs_names)} observations", f"{len(env.actuator_names)} actions", f"{env.max_episode_steps} control periods", "inverse model: "):
            assert fact in lines[1], (name, lines[1])
        assert lines[1].endswith(", a cost") == env.has_cost, (name, lines[1])


def test_the_reference_says_of_a_member_what_its_own_docstring_says(tmp_path: Path) -> None:
    """Not what Python says of what it is wrapped in."""
    found = importlib.util.spec_from_file_location("build", ROOT / "docs" / "build.py")
    build = importlib.util.module_from_spec(found)
    found.loader.exec_module(build)
    build.reference(tmp_path / "PYTHON.md")
    text = (tmp_path / "PYTHON.md").read_text()
    for wrapper in (staticmethod, classmethod, property):
        assert inspect.getdoc(wrapper).splitlines()[0] not in text
    for load in (nearl.Controller.load, nearl.PID2.load, nearl.Model.from_urdf):
        assert inspect.getdoc(load) in text
