"""Draws docs/arm.webp: the same careless proposals followed by two Pandas, one as they are, one through the projector.

    .venv/bin/python docs/animation.py
"""

from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

import nearl
from nearl import _core
from nearl.render import Renderer

ROOT = Path(__file__).resolve().parents[1]
SECONDS, DT, EVERY, SIZE = 6.0, 1e-3, 66, (360, 340)
DARK, RED, GREEN = "#1d2939", "#B42318", "#067647"


def fly(projected: bool, projector: nearl.Projector, rest: np.ndarray) -> tuple[list[np.ndarray], list[int]]:
    """Configurations at each frame, and the limits broken so far. Proposals jump to a new pose every second."""
    rng = np.random.default_rng(3)
    q, v, broken, poses, counts = rest.copy(), np.zeros(7), 0, [], []
    for tick in range(round(SECONDS / DT)):
        if tick % 1000 == 0:
            goal = rest + rng.uniform(-1.6, 1.6, 7)
        v_hat = 12.0 * (goal - q)
        q_hat = q + DT * v_hat
        target = projector.project(q, v, q_proposal=q_hat, v_proposal=v_hat)
        broken += sum((target.target_violations if projected else target.raw_violations).values())
        q, v = (target.q, target.v) if projected else (q_hat, v_hat)
        if tick % EVERY == 0:
            poses.append(q.copy())
            counts.append(broken)
    return poses, counts


def main() -> None:
    """Writes the picture."""
    model = nearl.Model.from_urdf(ROOT / "examples/robots/panda/panda.urdf")
    limits = [nearl.PositionLimit(model, 0.01), nearl.VelocityLimit(model), nearl.AccelerationLimit(model, 10.0), nearl.TorqueLimit(model)]
    projector = nearl.Projector(model, limits, dt=DT, sub_steps=1, braking="stored")
    rest = np.array([0, 0.2, 0, -1.6, 0, 1.8, 0.5])
    renderer = Renderer(_core.Env("Panda-reach"), SIZE)
    font, small = (ImageFont.load_default(size) for size in (20, 15))
    frames = []
    for (q_raw, n_raw), (q, n) in zip(zip(*fly(False, projector, rest)), zip(*fly(True, projector, rest))):
        picture = Image.new("RGB", (2 * SIZE[0], SIZE[1] + 64), "white")
        draw = ImageDraw.Draw(picture)
        for column, (pose, count, words, colour) in enumerate(((q_raw, n_raw, "as proposed", RED), (q, n, "projected", GREEN))):
            frame = renderer.frame(pose, np.zeros(7)).astype(float)
            sky = frame.max(axis=2, keepdims=True) == 0
            picture.paste(Image.fromarray(np.where(sky, 255, np.minimum(255, 1.6 * frame)).astype(np.uint8)), (column * SIZE[0], 0))
            draw.text((column * SIZE[0] + 14, SIZE[1] + 8), words, DARK, small)
            draw.text((column * SIZE[0] + 14, SIZE[1] + 30), f"{count:,} limits broken", colour, font)
        frames.append(picture)
    frames[0].save(ROOT / "docs/arm.webp", save_all=True, append_images=frames[1:], duration=EVERY, loop=0, quality=60, method=4)


if __name__ == "__main__":
    main()
