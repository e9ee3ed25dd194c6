"""Limits of points and of the whole arm over several physics steps of a period: python results/steps/frames.py [ARMS].

The arms and the attack are those of python/tests/test_frame_steps.py, the physics step is 2 ms. What MuJoCo did at the end of each period is
compared with the limit. Writes frames.csv; of another number of ARMS than 40 into a folder of that number.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parents[1] / "python/tests"))
from test_frame_steps import LIMITS, attack  # noqa: E402

USUAL = 40  # arms a setting
# A limit, and how fast joints swing under drives of targets [rad/s]; motors where it is empty.
SETTINGS = [*((kind, ()) for kind in LIMITS), ("frame_speed", (30.0,)), ("frame_speed", (80.0,))]


def main() -> None:
    """Attacks the arms with each limit, and says what the worst of them did."""
    arms = int(sys.argv[1]) if len(sys.argv) > 1 else USUAL
    place = HERE if arms == USUAL else HERE / str(arms)
    lines = ["limit,drives,steps,seed,excess,near"]
    for kind, speeds in SETTINGS:
        drives = "-".join(f"{speed:g}" for speed in speeds)
        for steps in (1, 2, 5, 10):
            with tempfile.TemporaryDirectory() as folder:
                runs = [(seed, *attack(Path(folder), seed, kind, steps, speeds)) for seed in range(arms)]
            lines += [f"{kind},{drives},{steps},{seed},{worst:.3g},{near:.2f}" for seed, worst, near in runs]
            worst = np.array([run[1] for run in runs])
            unit = {"frame": "m", "equals": "rad", "rows": "rad"}.get(kind, "of the limit")
            under = f", drives of {drives} rad/s" if speeds else ""
            print(
                f"{kind}{under}, {steps} steps: worst {worst.max():.2g} {unit}, {np.sum(worst > 1e-6)} of {arms} beyond it by more than 1e-6; "
                f"near it in {np.mean([run[2] for run in runs]):.0%} of the ticks",
                flush=True,
            )
    place.mkdir(exist_ok=True)
    (place / "frames.csv").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
