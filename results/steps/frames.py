"""Limits of points and of the whole arm over several physics steps of a period: python results/steps/frames.py [ARMS].

The arms are those of steps.py, the physics step is 2 ms. What MuJoCo did at the end of each period is compared with the limit. Writes frames.csv.
"""

import sys
import tempfile
import warnings
from pathlib import Path

import mujoco
import numpy as np

import nearl

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parents[1] / "python/tests"))
from test_guard_steps import arm, task  # noqa: E402

STEP, TICKS, PUSHED = 0.002, 600, 25
SPEED, ENERGY, PLANE = 0.5, 3.0, -0.1

LIMITS = {
    "frame_speed": f'frame_speed = [{{ frame = "TIP", limit = {SPEED} }}]',
    "energy": f"energy = {{ limit = {ENERGY} }}",
    "frame": f'frame = [{{ frame = "TIP", half_space = {{ normal = [0, 0, -1], through = [0, 0, {PLANE}] }}, braking = 5.0 }}]',
}


class Watched:
    """The arm in MuJoCo, at the states that the environment came to."""

    def __init__(self, text: str, n: int) -> None:
        self.model = mujoco.MjModel.from_xml_string(text)
        self.data, self.tip, self.n = mujoco.MjData(self.model), self.model.body(f"b{n - 1}").id, n

    def excess(self, kind: str, obs: np.ndarray) -> float:
        """Of speed and energy as a share of the limit, of the plane in m."""
        self.data.qpos[:], self.data.qvel[:] = obs[: self.n], obs[self.n :]
        mujoco.mj_forward(self.model, self.data)
        if kind == "frame":
            return PLANE - self.data.xpos[self.tip][2]
        if kind == "energy":
            mass = np.zeros((self.n, self.n))
            mujoco.mj_fullM(self.model, self.data, mass)
            return 0.5 * self.data.qvel @ mass @ self.data.qvel / ENERGY - 1.0
        turn, jacobian = np.zeros((3, self.n)), np.zeros((3, self.n))
        mujoco.mj_jacBody(self.model, self.data, jacobian, turn, self.tip)
        return float(np.linalg.norm(jacobian @ self.data.qvel)) / SPEED - 1.0


def attack(seed: int, kind: str, steps: int) -> tuple[float, float]:
    """The worst excess, and the share of ticks within 5 % of the limit (5 mm of the plane)."""
    rng = np.random.default_rng(seed)
    text, ranges = arm(rng, STEP, "Euler")
    n = len(ranges)
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "arm.xml").write_text(text)
        file = task(Path(folder), n, steps * STEP, STEP)
        file.write_text(file.read_text() + LIMITS[kind].replace("TIP", f"b{n - 1}") + "\n")
        envs = nearl.make_vec(file, 1, constraints="task", actions="guarded")
    watched, obs = Watched(text, n), envs.reset(seed=0)[0]
    push, worst, near = np.zeros(n), -np.inf, 0
    close = -0.005 if kind == "frame" else -0.05
    for tick in range(TICKS):
        if tick % PUSHED == 0:
            push = rng.uniform(-300.0, 300.0, n)
        obs = envs.step(push[None])[0]
        excess = watched.excess(kind, obs[0])
        worst, near = max(worst, excess), near + (excess > close)
    return worst, near / TICKS


def main() -> None:
    """Attacks the arms with each limit, and says what the worst of them did."""
    warnings.simplefilter("ignore")
    arms = int(sys.argv[1]) if len(sys.argv) > 1 else 40
    lines = ["limit,steps,seed,excess,near"]
    for kind in LIMITS:
        for steps in (1, 2, 5, 10):
            runs = [(seed, *attack(seed, kind, steps)) for seed in range(arms)]
            lines += [f"{kind},{steps},{seed},{worst:.3g},{near:.2f}" for seed, worst, near in runs]
            worst = np.array([run[1] for run in runs])
            unit = "m" if kind == "frame" else "of the limit"
            print(
                f"{kind}, {steps} steps: worst {worst.max():.2g} {unit}, {np.sum(worst > 1e-6)} of {arms} beyond it by more than 1e-6; "
                f"near it in {np.mean([run[2] for run in runs]):.0%} of the ticks",
                flush=True,
            )
    (HERE / "frames.csv").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
