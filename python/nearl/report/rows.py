"""Which rows of the projection were active in a flight, and how hard they were leaned on."""

from typing import NamedTuple

import numpy as np

from nearl.report.read import Floats, Log

# Pulls below this are rounding of the numbers in the log [rad/s].
ROUNDING = 1e-7
# Ticks in which what is worked out must agree with the ledger's count.
AGREEMENT = 0.98


class Rows(NamedTuple):
    """Rows that were ever active: names, and the multiplier of each over ticks (n_rows x n), NaN where not active."""

    names: list[str]
    multiplier: Floats
    meaning: str


def active_rows(log: Log) -> Rows | None:
    """The rows the ledger names; where a log only counts them, what they add up to on each joint.

    None where the log counts active rows but neither names them nor lets them be worked out.
    """
    return _recorded(log) if any(log.active) else _from_states(log)


def _recorded(log: Log) -> Rows:
    names = log.names(log.target_v.shape[1])
    table: dict[tuple[int, str, str], Floats] = {}
    for tick, rows in enumerate(log.active):
        for row in rows:
            key = (int(row["row"]), str(row["kind"]), str(row["side"]))
            table.setdefault(key, np.full(len(log), np.nan))[tick] = row["multiplier"]
    keys = sorted(table)
    of = dict(enumerate(log.row_names() or names))
    label = [f"{of.get(row, f'row {row}')} {kind} {_arrow(side)}" for row, kind, side in keys]
    return Rows(label, np.array([table[k] for k in keys]).reshape(len(keys), len(log)), "multiplier")


def _from_states(log: Log) -> Rows | None:
    """At the optimum the multipliers balance the pull towards the proposal; with unit weights and one physics step a tick

    ``mu + G' lambda = (q_hat - q') / T + (v_hat - v')``,

    exactly zero for a joint that nothing holds back.
    """
    names = log.names(log.target_v.shape[1])
    q_hat, v_hat = tick_proposals(log)
    pull, shift = v_hat - log.target_v, log.target_q.shape[1] - log.target_v.shape[1]
    dq = q_hat - log.target_q
    if shift == 0:
        pull = pull + dq / log.dt
    elif pull.shape[1] > 6:  # a free base has one configuration entry more; it is never projected
        pull[:, 6:] += dq[:, 6 + shift :] / log.dt
    held = np.abs(np.nan_to_num(pull)) > ROUNDING
    counted = np.nan_to_num(log.columns["active"]) > 0
    if np.mean(held.any(axis=1) == counted) < AGREEMENT:
        return None
    found, values = [], []
    for i, name in enumerate(names):
        for side, sign in (("upper", 1.0), ("lower", -1.0)):
            row = np.where(held[:, i] & (sign * pull[:, i] > 0), sign * pull[:, i], np.nan)
            if np.isfinite(row).any():
                found.append(f"{name} {_arrow(side)}")
                values.append(row)
    return Rows(found, np.array(values).reshape(len(found), len(log)), "multipliers on the joint, summed [rad/s]")


def _arrow(side: str) -> str:
    return "↑" if side == "upper" else "↓"


def tick_proposals(log: Log) -> tuple[Floats, Floats]:
    """What was projected in each tick: a point of the cubic from the state at the policy's tick to its proposal, as in
    ``Controller``. The log holds the proposal for the end of the policy's period of k ticks."""
    q_hat, v_hat = log.proposal_q, log.proposal_v
    if q_hat.shape[1] != v_hat.shape[1] or len(log) < 2:
        return q_hat, v_hat
    # The half of the state that is not proposed is logged as measured, so it changes in every tick.
    changes = [(np.nan_to_num(x[1:]) != np.nan_to_num(x[:-1])).any(axis=1) for x in (q_hat, v_hat)]
    changed = min(changes, key=np.sum)
    starts = np.concatenate([[0], np.flatnonzero(changed) + 1])
    k = int(np.bincount(np.diff(starts)).argmax()) if len(starts) > 2 else 1
    if k == 1:
        return q_hat, v_hat
    start = np.repeat(starts, np.diff([*starts, len(log)]))
    s = (np.minimum(np.arange(len(log)) - start + 1, k) / k)[:, None]
    period = k * log.dt
    q0, v0, q1, v1 = log.q[start], log.v[start], q_hat[start], v_hat[start]
    acted = np.isfinite(np.hstack([q_hat, v_hat, log.q, log.v])).all(axis=1)
    if np.array_equal(q_hat[acted], log.q[acted]):  # velocities alone are proposed
        q1 = q0 + period * (v0 + v1) / 2
    elif np.array_equal(v_hat[acted], log.v[acted]):  # positions alone
        v1 = 2 * (q1 - q0) / period - v0
    d, a, b = q1 - q0, period * v0, period * v1
    c3, c2 = a + b - 2 * d, 3 * d - 2 * a - b
    return q0 + s * (a + s * (c2 + s * c3)), (a + s * (2 * c2 + 3 * s * c3)) / period
