"""Colours and sizes of all figures; a figure as text inside HTML."""

import base64
import html
import io
from collections.abc import Sequence

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

# Okabe and Ito's palette: told apart by colour-blind readers and on paper.
PROPOSED, PROJECTED, REACHED = "#D55E00", "#0072B2", "#1a1a1a"
CURVES = ["#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000"]
MUTED, GRID, DEADLINE = "#667085", "#e4e7ec", "#B42318"

plt.rcParams.update(
    {
        "font.family": "DejaVu Sans",
        "font.size": 9.5,
        "axes.titlesize": 10.5,
        "axes.titleweight": "bold",
        "axes.titlelocation": "left",
        "axes.labelcolor": "#344054",
        "axes.edgecolor": "#98a2b3",
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.grid": True,
        "axes.axisbelow": True,
        "grid.color": GRID,
        "grid.linewidth": 0.8,
        "xtick.color": "#475467",
        "ytick.color": "#475467",
        "legend.frameon": False,
        "legend.fontsize": 9,
        "lines.linewidth": 1.6,
        "figure.constrained_layout.use": True,
        "svg.fonttype": "none",
    }
)


def steps_axis(axes: Axes) -> None:
    """Environment steps along x, as 250k or 1.5M."""

    def words(x: float, _: float) -> str:
        for size, unit in ((1e6, "M"), (1e3, "k")):
            if abs(x) >= size:
                return f"{x / size:g}{unit}"
        return f"{x:g}"

    axes.xaxis.set_major_formatter(words)
    axes.set_xlabel("environment steps")
    axes.margins(x=0)


def image(figure: Figure, caption: str) -> str:
    """An HTML figure with the picture inside, which turns dark with the page; closes ``figure``."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=170, facecolor="white")
    width = round(figure.get_size_inches()[0] * 96)
    plt.close(figure)
    return _html(buffer, width, caption, "drawn")


def strip(frames: Sequence[NDArray[np.uint8]], caption: str, gap: int = 8) -> str:
    """Pictures (height x width x 3) of one size side by side as an HTML figure, whose colours stay as they are."""
    clear = np.zeros((*frames[0].shape[:1], gap, 4), np.uint8)
    opaque = [np.dstack([frame, np.full(frame.shape[:2], 255, np.uint8)]) for frame in frames]
    row = np.hstack([part for frame in opaque for part in (frame, clear)][:-1])
    buffer = io.BytesIO()
    plt.imsave(buffer, row, format="png")
    return _html(buffer, row.shape[1], caption, "photo")


def _html(buffer: io.BytesIO, width: int, caption: str, kind: str) -> str:
    data, caption = base64.b64encode(buffer.getvalue()).decode(), html.escape(caption)
    picture = f'<img width="{width}" alt="{caption}" src="data:image/png;base64,{data}">'
    return f'<figure class="{kind}">{picture}<figcaption>{caption}</figcaption></figure>'
