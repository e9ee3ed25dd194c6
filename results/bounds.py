"""What a joint may accelerate so that it still stops in front of a limit; from the formulas, for programs that check our answers."""

import numpy as np


def upper_acceleration(d, v, speed, most, braking, dt):
    """Largest acceleration towards a limit at distance d after which `braking` still stops before it; one semi-implicit Euler step.

    Arrays of any shapes that broadcast.
    """
    inside = (d - dt * v) / dt**2
    w = v - braking * dt / 2
    b, c = 2 * w * dt + 2 * braking * dt**2, w**2 - 2 * braking * (d - dt * v)
    with np.errstate(invalid="ignore"):
        root = (-b + np.sqrt(b**2 - 4 * dt**2 * c)) / (2 * dt**2)
    stopping = np.where(np.isnan(root), -w / dt, np.fmax(root, -w / dt))
    return np.minimum(np.minimum(most, (speed - v) / dt), np.minimum(inside, stopping))
