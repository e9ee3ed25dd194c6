"""The newest picture as HTML: mode, latency, a bar for each limit of a joint and for each row, and what the projector said."""

from collections import deque
from collections.abc import Sequence
from html import escape

import numpy as np
from numpy.typing import NDArray

from nearl.view.marks import arrow, columns, curve, length, mark, share
from nearl.view.sources import Held, Picture, Robot

Floats = NDArray[np.float64]
MODES = {"active": "#15803d", "training": "#15803d", "degraded": "#b45309", "braking": "#b45309", "fault": "#b91c1c"}
# Which bar of its joint a row of a single joint lights, by kind.
BARS = {"position": 0, "viability": 0, "locked": 0, "velocity": 1, "velocity_profile": 1, "acceleration": 2, "jerk": 2}
# Rows of one motor each, named after its joint, light the bar of its force.
OF_MOTORS = ("torque", "torque rate", "torque speed")
HEADS = ("position", "speed", "acceleration", "force")
SHOWN_ROWS = 16
STYLE = """<style>
.nearl{font:12px/1.3 system-ui,sans-serif;padding:6px 10px}
.nearl table{border-collapse:collapse;width:100%;table-layout:fixed}
.nearl td,.nearl th{padding:1px 3px;text-align:left;font-weight:400;overflow:hidden;text-overflow:ellipsis;white-space:nowrap}
.nearl th{opacity:.65}
.nearl h4{margin:10px 0 2px;font-size:12px}
.nearl .bar{position:relative;height:10px;background:#98a2b340;border:1px solid #98a2b3;border-radius:2px;overflow:hidden}
.nearl .bar i{position:absolute;top:0;bottom:0;background:#667085}
.nearl .lit{background:#ffb000;border-color:#b45309}
.nearl .told td:first-child{width:34%}
.nearl .joints{font-size:11px}
.nearl .joints th:first-child{width:22%}
.nearl .rows td:nth-child(2){width:34%}
.nearl .rows td:nth-child(3){width:20%}
.nearl .lit i{background:#7c2d12}
</style>"""


class Panel:
    """Remembers what a picture alone does not say: the latencies of the last seconds and the largest multiplier.

    Args:
        robot: Its joints, rows and limits.
        pictures: How many of them the chart of latencies shows.
    """

    def __init__(self, robot: Robot, pictures: int = 120):
        self._robot, self._pictures = robot, pictures
        self._motors = {f"{joint} {kind}": (i, HEADS.index("force")) for i, joint in enumerate(robot.joints) for kind in OF_MOTORS}
        self._latencies: deque[float] = deque(maxlen=pictures)
        self._largest = 0.0

    def html(self, picture: Picture, curves: dict[str, tuple[Floats, Floats]]) -> str:
        """Everything as HTML; ``curves`` are steps and values by name."""
        self._largest = max([self._largest, *(h.multiplier for h in picture.held)])
        parts = [self._head(picture), self._latency(picture), self._joints(picture), self._rows(picture.held), self._ledger(picture)]
        for name, (steps, values) in curves.items():
            parts.append(f"<h4>{escape(name)}: {values[-1]:.4g} at {int(steps[-1]):,} steps</h4>{curve(steps, values)}")
        return f'{STYLE}<div class="nearl">{"".join(parts)}</div>'

    def _head(self, p: Picture) -> str:
        why = "" if p.reason in (None, "none") else f" ({escape(str(p.reason))})"
        mode = f'<b style="color:{MODES.get(p.mode, "#667085")}">{escape(p.mode.upper())}</b>{why}'
        lost = f"; {p.lost:,} ticks were not read by this view" if p.lost else ""
        outside = f"ticks so far that broke a limit: {p.raw_total:,} by proposals, {p.broken_total:,} by targets{lost}"
        return f"{mode} tick {p.tick:,}, policy {p.version}, episode {p.episode}<br>{outside}"

    def _latency(self, p: Picture) -> str:
        if p.latency is None or p.overruns is None or not len(p.latency):
            return ""
        self._latencies.append(float(p.latency.max()))
        median, most, deadline = (1e6 * x for x in (np.median(p.latency), p.latency.max(), p.period))
        words = f"median {median:,.0f} µs, largest {most:,.0f} µs, deadline {deadline:,.0f} µs; red is above it<br>"
        words += f"ticks so far for which the loop itself took longer: {p.overruns:,}"
        return f"<h4>From a tick's due time to its action</h4>{words}{columns(self._latencies, p.period, self._pictures)}"

    def _joints(self, p: Picture) -> str:
        limits, shift, lines = self._robot.limits, len(p.q) - len(p.v), []
        reached = np.full(len(p.v), np.nan) if p.target is None else (p.target[1] - p.v) / p.period
        force = np.full(len(p.v), np.nan) if p.force is None else p.force
        shown = [k for k in range(len(HEADS)) if k < 2 or np.isfinite(limits[("acceleration", "effort")[k - 2]]).any()]
        for i, name in enumerate(self._robot.joints):
            speed, bound, effort = (limits[what][i] for what in ("velocity", "acceleration", "effort"))
            places = [
                (p.q[i + shift], limits["lower_position"][i], limits["upper_position"][i]),
                (p.v[i], -speed, speed),
                (reached[i], -bound, bound),
                (force[i], -effort, effort),
            ]
            cells = []
            for k in shown:
                lit = [h for h in p.held if self._bar(h) == (i, k)]
                value = places[k][0]
                cells.append(mark(share(*places[k]) if np.isfinite(value) else None, lit, f"{value:.{2 - k // 2}f}" if np.isfinite(value) else ""))
            lines.append(f'<tr><td title="{escape(name)}">{escape(name)}</td>{"".join(cells)}</tr>')
        head = "".join(f"<th>{HEADS[k]}</th>" for k in shown)
        words = "Joints within their limits; a lit bar holds the target back, by its multiplier"
        return f"<h4>{words}</h4><table class=joints><tr><th></th>{head}</tr>{''.join(lines)}</table>"

    def _bar(self, held: Held) -> tuple[int, int | None]:
        """Joint and bar that a row lights."""
        if held.row < len(self._robot.joints):
            return held.row, BARS.get(held.kind)
        return self._motors.get(held.name, (-1, None))

    def _rows(self, held: Sequence[Held]) -> str:
        first, names = len(self._robot.joints), self._robot.rows
        active = {h.row: h for h in sorted(held, key=lambda h: h.multiplier) if h.row >= first}
        order = list(range(first, len(names)))
        if len(order) > SHOWN_ROWS:
            order.sort(key=lambda row: row not in active)
        lines = []
        for row in order[:SHOWN_ROWS]:
            h = active.get(row)
            words = "" if h is None else f"{arrow(h)} <b>{h.multiplier:.2g}</b>"
            part = 0.0 if h is None or self._largest == 0.0 else h.multiplier / self._largest
            lines.append(f'<tr><td title="{escape(names[row])}">{escape(names[row])}</td>{length(part, h is not None)}<td>{words}</td></tr>')
        hidden = order[SHOWN_ROWS:]
        more = f"and {len(hidden)} rows more, {sum(row in active for row in hidden)} of them active" if hidden else ""
        words = "Rows over several joints; the bar is the multiplier as a share of the largest so far"
        return f"<h4>{words}</h4><table class=rows>{''.join(lines)}</table>{more}" if lines else ""

    def _ledger(self, p: Picture) -> str:
        if p.ledger is None:
            return "<h4>Ledger</h4>nothing was projected in this tick"
        told = p.ledger
        lines = {
            "status": escape(str(told["status"])),
            "answered by": f"{escape(str(told['rung']))}, {told['iterations']} iterations",
            "active rows": told["active"],
            "moved by": f"{told['moved']:.3g}",
            "slack": f"{told['slack']:.3g}",
            "residual": f"{told['residual']:.1e}",
            "projection took": f"{told['duration_ns'] / 1e3:.1f} µs",
            f"broken in {p.ticks:,} ticks": f"{p.raw:,} by proposals, {p.broken:,} by targets",
        }
        return "<h4>Ledger of the newest tick</h4><table class=told>" + "".join(f"<tr><td>{k}</td><td>{v}</td></tr>" for k, v in lines.items()) + "</table>"
