"""Random arms over several physics steps a period, pushed onto their limits: python results/steps/steps.py [ARMS].

The arms are those of python/tests/test_guard_steps.py. What MuJoCo did is compared with what was promised: speeds and accelerations to 1e-8, positions
to the ends of the ranges at the end of a period. Writes steps.csv.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

import nearl

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parents[1] / "python/tests"))
from test_guard_steps import ACCELERATION, SPEED, arm, task, with_drives  # noqa: E402

TICKS, PUSHED = 600, 25
# Control period [s], numbers of physics steps one is drawn from, margin [rad], and how fast joints swing under drives of targets
# [rad/s]; motors where it is empty.
SETTINGS = [
    (0.002, (2, 5, 10), 0.0, []),
    (0.005, (2, 5, 10), 0.0, []),
    (0.01, (2, 5, 10), 0.0, []),
    (0.02, (2, 5, 10), 0.0, []),
    (0.02, (2, 5, 10), 0.002, []),
    (0.04, (10, 20), 0.0, []),
    (0.04, (10, 20), 0.01, []),
    (0.005, (2, 5, 10), 0.0, [10.0, 30.0, 80.0]),
    (0.01, (2, 5, 10), 0.0, [10.0, 30.0, 80.0]),
    (0.02, (2, 5, 10), 0.0, [10.0, 30.0]),
    (0.02, (2, 5, 10), 0.0, [10.0, 30.0, 80.0]),
]


def excess(seed: int, dt: float, counts: tuple[int, ...], margin: float, speeds: list[float]) -> tuple[int, np.ndarray]:
    """Steps a period, and the worst of position [rad], speed [rad/s] and acceleration [rad/s²] beyond their limits."""
    rng = np.random.default_rng(seed)
    steps = int(rng.choice(counts))
    text, ranges = arm(rng, dt / steps, "Euler")
    n, command, far = len(ranges), 'interface = "effort"', 300.0
    if speeds:
        text, command = with_drives(text, ranges, rng, speeds)
        far = 3.0
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "arm.xml").write_text(text)
        envs = nearl.make_vec(task(Path(folder), n, dt, dt / steps, margin, command), 1, constraints="task", actions="guarded")
    obs, _ = envs.reset(seed=0)
    push, worst, before = np.zeros(n), np.zeros(3), obs[0, n:].copy()
    for tick in range(TICKS):
        if tick % PUSHED == 0:
            push = rng.uniform(-far, far, n)
        obs = envs.step(push[None])[0]
        q, v = obs[0, :n].copy(), obs[0, n:].copy()
        beyond = np.maximum(q - ranges[:, 1], ranges[:, 0] - q)
        worst = np.maximum(worst, [beyond.max(), np.abs(v).max() - SPEED, np.abs(v - before).max() / dt - ACCELERATION])
        before = v
    return steps, worst


def main() -> None:
    """Attacks the arms of every setting, and says how many kept everything."""
    arms = int(sys.argv[1]) if len(sys.argv) > 1 else 60
    lines = ["dt,steps,margin,drives,seed,position,speed,acceleration"]
    for dt, counts, margin, speeds in SETTINGS:
        runs = [(seed, *excess(seed, dt, counts, margin, speeds)) for seed in range(arms)]
        lines += [f"{dt},{steps},{margin},{max(speeds, default=0):g},{seed},{w[0]:.3g},{w[1]:.3g},{w[2]:.3g}" for seed, steps, w in runs]
        kept = sum(w.max() < 1e-8 for _, _, w in runs)
        most = np.max([w for _, _, w in runs], axis=0)
        worst = f"{most[0]:.2g} rad, {most[1]:.2g} rad/s, {most[2]:.2g} rad/s²"
        drives = f"drives up to {max(speeds, default=0):g} rad/s"
        print(f"{dt * 1e3:g} ms, margin {margin}, {drives}: {kept} of {arms} kept everything; worst {worst}")
    (HERE / "steps.csv").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
