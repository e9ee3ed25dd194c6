"""The tables of the comparison from its runs."""

import json
from collections.abc import Callable
from pathlib import Path
from statistics import median


def table(runs: Path, sizes: Path) -> str:
    lines = [json.loads(x) for x in runs.read_text().splitlines()]
    out = []
    for limits in dict.fromkeys(x["limits"] for x in lines):
        out += speeds(limits, [x for x in lines if x["limits"] == limits])
    return "\n".join(out + by_size([json.loads(x) for x in sizes.read_text().splitlines()])) + "\n"


def speeds(limits: str, lines: list[dict]) -> list[str]:
    active = f"; torque rows active in {lines[0]['torque_active']:.0%}" if lines[0]["torque_active"] else ""
    out = [
        f"**{limits[0].upper()}{limits[1:]}**{active}", "",
        "| | problems a round | answers/s | slower than ours | with gradient/s | slower than ours "
        "| furthest from the optimum [rad/s] | median | off by more than 1e-6 | gave up | gradient: furthest | median | off by more than 1e-3 |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]  # fmt: skip
    alone: dict[str, float] = {}
    for name in dict.fromkeys(x["side"] for x in lines):
        mine = [x for x in lines if x["side"] == name]
        forward = median(x["problems"] / x["forward_s"] for x in mine)
        both = median(x["problems"] / (x["forward_s"] + x["backward_s"]) for x in mine)
        alone = alone or {"forward": forward, "both": both}
        x = mine[0]
        out.append(
            f"| {name} | {x['problems']} | {forward:.0f} | {alone['forward'] / forward:.1f} x | {both:.0f} | {alone['both'] / both:.1f} x "
            f"| {x['furthest']:.0e} | {x['median']:.0e} | {x['above_1e-6']:.1%} | {x['none'] / x['compared']:.2%} "
            f"| {x['vjp_furthest']:.0e} | {x['vjp_median']:.0e} | {x['vjp_above_1e-3']:.1%} |"
        )
    return [*out, ""]


def by_size(lines: list[dict]) -> list[str]:
    about = "by the size of proposals (box and torque rows)"
    furthest = sized(f"Furthest from the optimum [rad/s], {about}", lines, lambda x: f"{x['furthest']:.0e}")
    return [*furthest, "", *sized(f"Share off by more than 1e-6, {about}", lines, lambda x: f"{x['above_1e-6']:.0%}")]


def sized(title: str, lines: list[dict], cell: Callable[[dict], str]) -> list[str]:
    """A column for each size; a side that raised has no answers there."""
    sizes = sorted({x["size"] for x in lines})
    out = [f"**{title}**", "", "| | " + " | ".join(f"{10**s} sigma" for s in sizes) + " |", "|---|" + "---|" * len(sizes)]
    for name in dict.fromkeys(x["side"] for x in lines):
        mine = {x["size"]: x for x in lines if x["side"] == name}
        out.append(f"| {name} | " + " | ".join("no answers" if "raised" in mine[s] else cell(mine[s]) for s in sizes) + " |")
    return out
