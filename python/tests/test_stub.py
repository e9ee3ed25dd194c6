"""The stub names exactly what the extension has, with the same parameters."""

import ast
import importlib.resources
import inspect

from nearl import _core


def stub() -> dict[str, ast.stmt]:
    tree = ast.parse(importlib.resources.files("nearl").joinpath("_core.pyi").read_text())
    return {node.name: node for node in tree.body if isinstance(node, ast.ClassDef | ast.FunctionDef)}


def members(node: ast.ClassDef, of: dict[str, ast.stmt]) -> dict[str, ast.FunctionDef]:
    found = {}
    for base in node.bases:
        if isinstance(base, ast.Name) and base.id in of:
            found |= members(of[base.id], of)
    return found | {f.name: f for f in node.body if isinstance(f, ast.FunctionDef)}


def parameters(f: ast.FunctionDef) -> list[str]:
    return [a.arg for a in [*f.args.args, *f.args.kwonlyargs] if a.arg not in ("self", "cls")]


def test_the_stub_and_the_module_agree() -> None:
    written = stub()
    public = {name for name in dir(_core) if not name.startswith("_")}
    assert public == {name for name in written if name != "ActiveRow" and not name.startswith("_")}
    for name in sorted(public):
        thing, node = getattr(_core, name), written[name]
        if not inspect.isclass(thing):
            assert list(inspect.signature(thing).parameters) == parameters(node)
            continue
        bases = [base for base in thing.__mro__ if base.__module__ == thing.__module__]
        theirs = {m for base in bases for m in vars(base) if not m.startswith("_")}
        ours = members(node, written)
        if name == "Target":  # hands on the fields of its ledger
            theirs |= {m for m in vars(_core.Ledger) if not m.startswith("_")}
        assert theirs == {m for m in ours if not m.startswith("_")}, name
        for member in theirs & vars(thing).keys():
            value = vars(thing)[member]
            value = getattr(value, "__func__", value)
            if callable(value):
                given = [p for p in inspect.signature(value).parameters if p != "self"]
                assert given == parameters(ours[member]), f"{name}.{member}"


def test_everything_public_is_documented() -> None:
    for name in dir(_core):
        thing = getattr(_core, name)
        if not name.startswith("_"):
            assert thing.__doc__, name
            if inspect.isclass(thing):
                bare = [m for m, v in vars(thing).items() if not m.startswith("_") and not v.__doc__]
                assert not bare, f"{name}: {bare}"
