"""A Franka arm behind its own protocol: franky-sim is the robot, examples/franka its driver. results/doors/franka.py is the whole measurement."""

import importlib.util
from pathlib import Path

import pytest
from conftest import ROOT

pytest.importorskip("franky_sim", reason="franky-sim is not installed; results/doors/franka.py says how")
pytest.importorskip("onnx")


@pytest.fixture(scope="module")
def measurement():
    spec = importlib.util.spec_from_file_location("franka", ROOT / "results/doors/franka.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    if not Path(module.DRIVER).exists():
        pytest.skip("the driver is not built: cargo build --release --locked --manifest-path examples/franka/Cargo.toml")
    return module


def test_a_wild_network_of_torques_leaves_no_limit_of_the_arm(measurement, tmp_path):
    found = measurement.attacked("torques", True, 2000, tmp_path)
    assert found["ticks led"] > 1900 and found["broken limits asked for"] > 1000  # of ticks
    assert found["states outside"] == 0


def test_without_its_loop_the_arm_comes_to_rest_within_its_limits(measurement, tmp_path):
    found = measurement.killed("loop", tmp_path, 1.0)
    assert float(found["fastest joint then [rad/s]"]) > 0.9, "it was moving"
    assert 0 < found["at rest after [ms]"] < 1500
    assert float(found["fastest joint afterwards [rad/s]"]) < 0.1 and found["states outside in the whole run"] == 0


def test_the_simulator_as_it_comes_is_refused_by_version(measurement):
    arm = measurement.Arm(mended=False)
    said = measurement.driver(arm.address, "model", stderr=measurement.subprocess.PIPE).communicate()[1]
    arm.stop()
    assert "2560" in said, "franky-sim 1.0.4 writes its version where the protocol has another field"
