"""Bars and curves of the panel, as HTML and SVG."""

from collections.abc import Sequence
from html import escape

import numpy as np
from numpy.typing import NDArray

from nearl.view.sources import Held

Floats = NDArray[np.float64]
BLUE, RED = "#0072B2", "#b91c1c"


def share(value: float, low: float, high: float) -> float | None:
    """Where ``value`` lies from ``low`` (0) to ``high`` (1), cut there; None without both."""
    if not (np.isfinite(low) and np.isfinite(high) and low < high):
        return None
    return float(np.clip((value - low) / (high - low), 0.0, 1.0))


def arrow(held: Held) -> str:
    """Up for an upper bound, down for a lower one."""
    return "↑" if held.side == "upper" else "↓"


def mark(at: float | None, lit: Sequence[Held], words: str) -> str:
    """A cell with a mark at ``at`` (0 to 1), lit where rows hold the target back, with the largest multiplier; the words alone where there is
    no limit."""
    hardest = max(lit, key=lambda h: h.multiplier, default=None)
    pull = "" if hardest is None else f" <b>{arrow(hardest)}{hardest.multiplier:.2g}</b>"
    title = escape("; ".join(f"{h.name}, {h.kind} {h.side}: multiplier {h.multiplier:.3g}, {h.ticks} ticks" for h in lit))
    if at is None:
        return f'<td title="{title or "no limit"}">{words}{pull}</td>'
    place = f'<i style="left:{100 * at:.1f}%;width:3px;margin-left:-1.5px"></i>'
    return f'<td title="{title}"><div class="bar{" lit" if lit else ""}">{place}</div>{words}{pull}</td>'


def length(part: float, is_lit: bool) -> str:
    """A cell with a bar of that length (0 to 1)."""
    return f'<td><div class="bar{" lit" if is_lit else ""}"><i style="left:0;width:{100 * part:.0f}%"></i></div></td>'


def columns(values: Sequence[float], line: float, most: int) -> str:
    """Columns of room for ``most``, red above the dashed line."""
    top, parts = max([line, *values]), []
    for i, value in enumerate(values):
        height = 36 * value / top
        parts.append(f'<rect x="{2 * i}" y="{38 - height:.1f}" width="1.6" height="{height:.1f}" fill="{RED if value > line else BLUE}"/>')
    y = 38 - 36 * line / top
    dashes = f'<line x1="0" x2="{2 * most}" y1="{y:.1f}" y2="{y:.1f}" stroke="{RED}" stroke-dasharray="4 3"/>'
    return f'<svg viewBox="0 0 {2 * most} 40" preserveAspectRatio="none" style="width:100%;height:40px">{"".join(parts)}{dashes}</svg>'


def curve(steps: Floats, values: Floats, points: int = 200) -> str:
    """Values over steps, so many points of them."""
    keep = np.unique(np.linspace(0, len(steps) - 1, min(points, len(steps))).astype(int))
    x, y = steps[keep], values[keep]
    across = 100 * (x - x[0]) / max(float(x[-1] - x[0]), 1.0)
    up = 38 - 36 * (y - y.min()) / (np.ptp(y) or 1.0)
    places = " ".join(f"{a:.2f},{b:.2f}" for a, b in zip(across, up))
    line = f'<polyline points="{places}" fill="none" stroke="{BLUE}" stroke-width="1.5" vector-effect="non-scaling-stroke"/>'
    return f'<svg viewBox="0 0 100 40" preserveAspectRatio="none" style="width:100%;height:44px">{line}</svg>'
