"""The promise of the first screen in three numbers, out of what was measured."""

import numpy as np

from nearl.report.flight import percentiles
from nearl.report.read import Log, Run, Summary

Card = tuple[str, str, bool]
Shares = tuple[dict[str, float], str]


def promise(trained: list[Run], programs: list[Summary], flights: list[Log]) -> list[Card]:
    """At most three of: proposals outside, targets outside, reached states outside, time of a tick; ``(number, words, is good)``."""
    shares, of = next((found for found in (_of_evaluations(programs), _of_flights(flights), _of_trainings(trained)) if found[0]), ({}, ""))
    cards = [
        (f"{100 * shares[kind]:.2f} %", words, kind != "raw" and shares[kind] == 0)
        for kind, words in (
            ("raw", f"of raw proposals broke a limit{of}"),
            ("target", "of projected targets did"),
            ("reached", "of the reached states did"),
        )
        if kind in shares
    ]
    times = _times(programs, flights)
    if len(cards) == 3 or times is None:
        return cards
    return [*cards, (f"{times[0]:.0f} µs", f"99 of 100 ticks were computed within, of {times[1]}", True)]


def _of_evaluations(programs: list[Summary]) -> Shares:
    """The first evaluation with the projection on, and words for what it is of."""
    for name, e in (found for p in programs for found in p.evaluations):
        if e["mode"] == "projected" and e.get("ticks"):
            kinds = ("raw", "target", "reached")
            return {kind: e[f"{kind}_violations"] / e["ticks"] for kind in kinds if e.get(f"{kind}_violations") is not None}, f" in {name}"
    return {}, ""


def _of_flights(flights: list[Log]) -> Shares:
    for log in flights:
        acted = log.acted & np.isin(np.char.lower(log.mode), ("active", "degraded"))  # a brake of the loop's own is no proposal of the policy
        if acted.any():
            return {kind: float(np.mean(log.columns[f"{kind}_violations"][acted] > 0)) for kind in ("raw", "target")}, f" in {log.path.name}"
    return {}, ""


def _of_trainings(trained: list[Run]) -> Shares:
    """Means of the last rows of all trainings that project, and words for how many they are."""
    columns = [{kind: run.column(f"constraints/{kind}_violations") for kind in ("raw", "target", "reached")} for run in trained]
    projecting = [found for found in columns if found["raw"] is not None]
    ends = {kind: [c[1][-1] for found in projecting if (c := found[kind]) is not None] for kind in ("raw", "target", "reached")}
    of = f" at the end of {len(projecting)} trainings" if len(projecting) > 1 else " at the end of the training"
    return {kind: float(np.mean(values)) for kind, values in ends.items() if values}, of


def _times(programs: list[Summary], flights: list[Log]) -> tuple[float, str] | None:
    """p99 of the time that a tick took to compute [us], and of how much."""
    for name, loop in (found for p in programs for found in p.loops):
        return loop["compute"]["p99"] * 1e-3, f"the loop of {name}"
    for log in flights:
        return float(percentiles((log.columns["end_ns"] - log.columns["begin_ns"]) * 1e-3)[1]), f"{1e6 * log.dt:.0f} µs in a period"
    return None
