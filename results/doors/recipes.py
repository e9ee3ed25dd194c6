"""unitree's own deployment files as recipes: the whole way from a state to the joints' targets, beside NumPy and onnxruntime.

    python results/doors/recipes.py UNITREE_RL_LAB UNITREE_RL_MJLAB >> results/doors/policies.md

Both arguments are checkouts. Random states of the bundled G1 near its pose, 200 policy ticks each, without the guard. Needs onnxruntime and PyYAML.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np
import onnxruntime
import yaml

import nearl

ROOT = Path(__file__).resolve().parents[2]
G1 = ROOT / "examples" / "robots" / "g1" / "g1.urdf"
# Motors in the order of unitree's SDK, which is the robot file's.
MOTORS = nearl.Model.from_urdf(G1).joint_names
TERMS = {
    "base_ang_vel": "base_ang_vel",
    "projected_gravity": "projected_gravity",
    "velocity_commands": "velocity_commands",
    "joint_pos_rel": "joint_pos_rel",
    "joint_vel_rel": "joint_vel_rel",
    "last_action": "last_action",
}


def read(path: Path) -> dict:
    lines = [line for line in path.read_text().splitlines() if "!!python" not in line]
    return yaml.safe_load("\n".join(lines))


def recipe(said: dict, joints: list[str]) -> str:
    """The TOML that `nearl import --recipe` takes."""
    action = said["actions"]["JointPositionAction"]
    terms = []
    for name, term in said["observations"].items():
        extra = ', entries = ["command.x", "command.y", "command.yaw"]' if name == "velocity_commands" else ""
        terms.append(f'{{ term = "{TERMS[name]}", scale = {term["scale"]}, history = {term["history_length"]}{extra} }}')
    return f"""
[time]
dt = {said["step_dt"]}
[model]
free_flyer = true
[command]
interface = "pd"
stiffness = {{ {", ".join(f"{j} = {k}" for j, k in zip(MOTORS, map(float, said["stiffness"]), strict=True))} }}
damping = {{ {", ".join(f"{j} = {d}" for j, d in zip(MOTORS, map(float, said["damping"]), strict=True))} }}
[constraints]
torque = {{ scale = 1.0 }}
[policy]
joints = {joints}
pose = {[float(x) for x in said["default_joint_pos"]]}
action = {{ scale = {[float(x) for x in action["scale"]]}, offset = {[float(x) for x in action["offset"]]} }}
observation = [{", ".join(terms)}]
"""


def check(name: str, folder: Path) -> str:
    said = read(folder / "params" / "deploy.yaml")
    joints = [MOTORS[i] for i in said["joint_ids_map"]]
    path = folder / "exported" / "policy.onnx"
    with tempfile.TemporaryDirectory() as scratch:
        file = Path(scratch) / "recipe.toml"
        file.write_text(recipe(said, joints))
        controller = nearl.import_onnx(path, robot=G1, recipe=file, name=name)
    session = onnxruntime.InferenceSession(path)
    rng, n = np.random.default_rng(1), len(joints)
    order = [MOTORS.index(j) for j in joints]
    scale, offset = (np.array(said["actions"]["JointPositionAction"][k], float) for k in ("scale", "offset"))
    pose, last, seen, worst = np.array(said["default_joint_pos"], float), np.zeros(n), {}, 0.0
    for _ in range(200):
        q, v, command = np.zeros(7 + n), 0.3 * rng.normal(size=6 + n), 0.5 * rng.normal(size=3)
        quaternion = 0.1 * rng.normal(size=4) + [0, 0, 0, 1]
        q[3:7] = quaternion / np.linalg.norm(quaternion)
        q[7:][order] = pose + 0.1 * rng.normal(size=n)
        x, y, z, w = q[3:7]
        now = {
            "base_ang_vel": v[3:6],
            "projected_gravity": -np.array([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]),
            "velocity_commands": command,
            "joint_pos_rel": q[7:][order] - pose,
            "joint_vel_rel": v[6:][order],
            "last_action": last,
        }
        parts = []
        for term, said_of in said["observations"].items():
            values = now[term] * np.array(said_of["scale"])
            history = [*seen.get(term, [values] * said_of["history_length"])[1:], values]
            seen[term] = history
            parts.extend(history)
        last = session.run(None, {"obs": np.concatenate(parts)[None].astype(np.float32)})[0][0].astype(float)
        want = np.zeros(n)
        want[order] = offset + scale * last
        given, _ = controller.update(q, v, np.concatenate([q[7:], v[6:], command]))
        worst = max(worst, float(np.max(np.abs(given - want))))
    return f"| {name} | {len(said['observations'])} | {session.get_inputs()[0].shape[1]} | {worst:.1e} |"


def main(lab: Path, mjlab: Path) -> None:
    velocity = Path("deploy/robots/g1/config/policy/velocity/v0")
    for checkout in (lab, mjlab):
        if not (checkout / velocity).is_dir():
            sys.exit(f"recipes.py: '{checkout}' is no such checkout: it has no folder {velocity}")
    print("\n| deployment | terms | entries | largest difference of a joint's target [rad] |")
    print("|---|---|---|---|")
    print(check("unitree_rl_lab-g1", lab / velocity))
    print(check("unitree_rl_mjlab-g1", mjlab / velocity))


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    main(Path(sys.argv[1]), Path(sys.argv[2]))
