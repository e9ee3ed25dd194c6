"""An example whose package is missing says how to get it, in one sentence."""

import re
import subprocess
import sys

import pytest
from conftest import ROOT

# Arguments with which each needs a package that does not come with NEARL, and that package's module.
NEEDED = {
    "python/sb3_vec_env.py": ([], "stable_baselines3"),
    "python/sb3_guarded.py": (["sac", "arm", "100"], "stable_baselines3"),
    "python/wandb_callback.py": ([], "wandb"),
    "python/flight_log.py": ([], "mcap"),
    "python/record_video.py": ([], "moviepy"),
    "ros2/bridge.py": (["arm", "policy.safetensors"], "rclpy"),
    "lerobot/guarded_robot.py": ([], "lerobot"),
    "ray_rollouts.py": (["policy.safetensors", "--out", "a.npz"], "ray"),
    "ray_sweep.py": (["--tasks", "Hopper-v5", "--out", "runs"], "ray"),
    "ray_train.py": (["Hopper-v5", "--out", "run"], "ray"),
}


@pytest.mark.parametrize("example", NEEDED)
def test_an_example_whose_package_is_missing_names_it(example: str) -> None:
    arguments, module = NEEDED[example]
    file = ROOT / "examples" / example
    program = f"import runpy, sys; sys.modules[{module!r}] = None; sys.argv[1:] = {arguments!r}; runpy.run_path({str(file)!r}, run_name='__main__')"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 1 and done.stderr.count("\n") == 1, done.stderr
    assert re.match(rf"{file.name} needs .*: pip install \S", done.stderr), done.stderr


def test_every_package_that_an_example_needs_is_asked_for() -> None:
    """What an example imports beside NEARL, what comes with it and Gymnasium."""
    known = sys.stdlib_module_names | {"nearl", "numpy", "gymnasium"}
    for file in sorted((ROOT / "examples").rglob("*.py")):
        found = set(re.findall(r"^(?:import|from) (\w+)", file.read_text(), re.MULTILINE))
        assert found <= known, f"{file.name} ends in a traceback without {', '.join(found - known)}"
