"""How pip builds the package from sources: a source distribution, a clone, or a repository's address. Needs Rust and a C++ compiler.

The extension is maturin's matter; the ``nearl`` program beside it is built here. MuJoCo and Pinocchio come with the build requirements, or
from ``.venv`` in a checkout that ``make setup`` has seen.
"""

import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

import maturin

prepare_metadata_for_build_wheel = maturin.prepare_metadata_for_build_wheel

ROOT = Path(__file__).resolve().parents[1]
TARGET = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target"))
PROGRAM = ROOT / "python" / "nearl" / "bin" / "nearl"
MUJOCO = "libmujoco.so.3.17.0"
# Installed, the program finds the libraries beside the package, as the extension does.
RPATH = "$ORIGIN/../../cmeel.prefix/lib:$ORIGIN/../../mujoco"
# What a source distribution holds of the checkout: every crate of the workspace, so that Cargo.lock is true of it, and what they include.
PACKED = ["Cargo.toml", "Cargo.lock", "LICENSE", "pyproject.toml", "constraints", "examples", "fuzz", "python", "runtime", "tests", "trainer"]


def build_wheel(wheel_directory: str, config_settings: dict | None = None, metadata_directory: str | None = None) -> str:
    """The wheel, with the program inside."""
    find_libraries()
    put_program()
    return maturin.build_wheel(wheel_directory, config_settings, metadata_directory)


def build_sdist(sdist_directory: str, config_settings: dict | None = None) -> str:
    """The committed files that a build needs, below ``nearl-VERSION/``, with ``PKG-INFO``."""
    with tempfile.TemporaryDirectory() as folder:
        metadata = Path(folder, prepare_metadata_for_build_wheel(folder), "METADATA").read_bytes()
    version = next(line.split()[1] for line in metadata.decode().splitlines() if line.startswith("Version:"))
    listed = subprocess.run(["git", "ls-files", "-z", *PACKED], cwd=ROOT, check=True, stdout=subprocess.PIPE, text=True).stdout
    with tarfile.open(Path(sdist_directory, f"nearl-{version}.tar.gz"), "w:gz", format=tarfile.PAX_FORMAT) as archive:
        for name in sorted(filter(None, listed.split("\0"))):
            archive.add(ROOT / name, f"nearl-{version}/{name}")
        with tempfile.NamedTemporaryFile() as file:
            file.write(metadata)
            file.flush()
            archive.add(file.name, f"nearl-{version}/PKG-INFO")
    return f"nearl-{version}.tar.gz"


def find_libraries() -> None:
    """Tells the build scripts where MuJoCo and Pinocchio are, unless somebody has."""
    if (ROOT / ".venv" / "mujoco-link" / "libmujoco.so").exists():
        return  # .cargo/config.toml says it
    for folder in map(Path, sys.path):
        if (folder / "cmeel.prefix").is_dir() and (folder / "mujoco" / MUJOCO).is_file():
            break
    else:
        sys.exit("neither 'make setup' was run here, nor are mujoco 3.17.0 and libpinocchio 4.1.0 installed: build without --no-build-isolation")
    link = TARGET / "mujoco-link"
    link.mkdir(parents=True, exist_ok=True)
    for name in ("libmujoco.so", MUJOCO):
        (link / name).unlink(missing_ok=True)
        (link / name).symlink_to(folder / "mujoco" / MUJOCO)
    os.environ.setdefault("NEARL_SITE_PACKAGES", str(folder))
    os.environ.setdefault("MUJOCO_DYNAMIC_LINK_DIR", str(link))


def put_program() -> None:
    """Builds all programs, as ``make build`` does, so that the extension finds the same crates compiled; puts ``nearl`` into the package."""
    if shutil.which("cargo") is None:
        sys.exit("nearl is built with Rust 1.95 or later, and 'cargo' was not found: install Rust, or install a wheel, which needs none")
    subprocess.run(["cargo", "build", "--release", "--locked", "--bins"], cwd=ROOT, check=True)
    PROGRAM.parent.mkdir(exist_ok=True)
    shutil.copyfile(TARGET / "release" / "nearl", PROGRAM)
    PROGRAM.chmod(0o755)
    subprocess.run(["strip", PROGRAM], check=True)
    subprocess.run(["patchelf", "--set-rpath", RPATH, PROGRAM], check=True)
