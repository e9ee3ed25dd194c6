"""Random arms over the physics steps of a period, pushed onto their limits: python results/steps/steps.py [ARMS].

The arms are those of python/tests/unknown_arms.py. What MuJoCo did is compared with what was promised: speeds and accelerations to 1e-8, positions
to the ends of the ranges at the end of a period. Writes steps.csv; of another number of ARMS than 60 into a folder of that number.
"""

import sys
import tempfile
import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np

import nearl

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parents[1] / "python/tests"))
from unknown_arms import ACCELERATION, SPEED, arm, task, with_drives, with_weak_motors, within_ranges  # noqa: E402

USUAL, TICKS, PUSHED = 60, 600, 25  # arms a setting, ticks of each, ticks of a push


class Setting(NamedTuple):
    """Control period [s], numbers of physics steps one is drawn from, margin [rad]; how fast joints swing under drives of targets [rad/s], motors where it
    is empty; MuJoCo's integrator, whether targets end where the joints do, what drives give of what they need, and the hard jerk [rad/s³]."""

    dt: float
    counts: tuple[int, ...] = (2, 5, 10)
    margin: float = 0.0
    speeds: tuple[float, ...] = ()
    integrator: str = "Euler"
    ends: bool = False
    share: float = 0.0
    jerk: float = np.inf


SETTINGS = [
    Setting(0.002),
    Setting(0.005),
    Setting(0.01),
    Setting(0.02),
    Setting(0.02, margin=0.002),
    Setting(0.04, counts=(10, 20)),
    Setting(0.04, counts=(10, 20), margin=0.01),
    *(
        setting
        for integrator in ("Euler", "implicitfast")
        for setting in (
            Setting(0.005, (1,), speeds=(10.0, 30.0, 80.0), integrator=integrator),
            Setting(0.005, speeds=(10.0, 30.0, 80.0), integrator=integrator),
            Setting(0.01, speeds=(10.0, 30.0, 80.0), integrator=integrator),
            Setting(0.02, speeds=(10.0, 30.0), integrator=integrator),
            Setting(0.02, speeds=(10.0, 30.0, 80.0), integrator=integrator),
            Setting(0.005, (1,), speeds=(30.0, 80.0), integrator=integrator, ends=True),
            Setting(0.005, speeds=(30.0, 80.0), integrator=integrator, ends=True),
            Setting(0.01, speeds=(30.0, 80.0), integrator=integrator, ends=True),
        )
    ),
    *(Setting(dt, speeds=(30.0, 80.0), share=share) for dt in (0.005, 0.01) for share in (1.05, 2.0)),
    *(Setting(dt, jerk=jerk) for dt in (0.002, 0.005, 0.01, 0.02) for jerk in (100.0, 1000.0)),
    *(Setting(dt, speeds=(10.0, 30.0, 80.0), jerk=1000.0) for dt in (0.005, 0.01)),
]


def excess(seed: int, of: Setting) -> tuple[int, np.ndarray]:
    """Steps a period, and the worst of position [rad], speed [rad/s], acceleration [rad/s²] and change of it in a period [rad/s²] beyond their limits."""
    rng = np.random.default_rng(seed)
    steps = int(rng.choice(of.counts))
    text, ranges = arm(rng, of.dt / steps, of.integrator)
    n, command, far = len(ranges), 'interface = "effort"', 300.0
    if of.speeds:
        text, command = with_drives(text, ranges, rng, list(of.speeds))
        far = 3.0
    if of.ends:
        text = within_ranges(text, ranges)
    if of.share:
        text = with_weak_motors(text, ranges, of.share)
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "arm.xml").write_text(text)
        envs = nearl.make_vec(task(Path(folder), n, of.dt, of.dt / steps, of.margin, command, of.jerk), 1, constraints="task", actions="guarded")
    obs, _ = envs.reset(seed=0)
    push, worst, before, last = np.zeros(n), np.zeros(4), obs[0, n:].copy(), np.zeros(n)
    for tick in range(TICKS):
        if tick % PUSHED == 0:
            push = rng.uniform(-far, far, n)
        obs = envs.step(push[None])[0]
        q, v = obs[0, :n].copy(), obs[0, n:].copy()
        beyond = np.maximum(q - ranges[:, 1], ranges[:, 0] - q)
        a = (v - before) / of.dt
        changed = np.abs(a - last).max() - of.jerk * of.dt
        worst = np.maximum(worst, [beyond.max(), np.abs(v).max() - SPEED, np.abs(a).max() - ACCELERATION, changed])
        before, last = v, a
    return steps, worst


def main() -> None:
    """Attacks the arms of every setting, and says how many kept everything."""
    warnings.simplefilter("ignore")
    arms = int(sys.argv[1]) if len(sys.argv) > 1 else USUAL
    place = HERE if arms == USUAL else HERE / str(arms)
    lines = ["dt,steps,margin,drives,integrator,targets_end,share,jerk,seed,position,speed,acceleration,change"]
    for of in SETTINGS:
        runs = [(seed, *excess(seed, of)) for seed in range(arms)]
        fastest = max(of.speeds, default=0)
        setting = f"{of.margin},{fastest:g},{of.integrator},{int(of.ends)},{of.share:g},{of.jerk:g}"
        lines += [f"{of.dt},{steps},{setting},{seed},{w[0]:.3g},{w[1]:.3g},{w[2]:.3g},{w[3]:.3g}" for seed, steps, w in runs]
        kept = sum(w.max() < 1e-8 for _, _, w in runs)
        most = np.max([w for _, _, w in runs], axis=0)
        worst = f"{most[0]:.2g} rad, {most[1]:.2g} rad/s, {most[2]:.2g} rad/s², {most[3]:.2g} rad/s² in a period"
        drives = f"drives up to {fastest:g} rad/s{', targets end with the joints' if of.ends else ''}"
        drives += f", {of.share} of the force they need" if of.share else ""
        drives += f", hard jerk of {of.jerk:g} rad/s³" if np.isfinite(of.jerk) else ""
        counts = ", ".join(map(str, of.counts))
        print(f"{of.dt * 1e3:g} ms, {counts} steps, {of.integrator}, margin {of.margin}, {drives}: {kept} of {arms} kept everything; worst {worst}", flush=True)
    place.mkdir(exist_ok=True)
    (place / "steps.csv").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
