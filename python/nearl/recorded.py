"""What a recording says of a task beside the joints' states: what the robot was asked to do, in which period, and whether its units can be true."""

import os
import re
import sys
import warnings
from collections.abc import Collection, Mapping, Sequence
from difflib import get_close_matches
from numbers import Real

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nearl import _core
from nearl.arguments import task_of

Floats = NDArray[np.float64]
Columns = Mapping[str, ArrayLike]
SAME = 1e-6  # part of a period by which two may differ
_FAST = 10.0  # times its limit at which a joint's speed is one of other units
_SLOW = 1.0  # s between two rows, which only a policy as slow records
_STILL = 0.02  # rad/s or m/s below which a joint stands, for all that a recording tells
_FEW = 5  # rows of motion that say something of a velocity
_OFF = 0.65  # part of the larger by which velocity and difference must differ: a factor of three, or the sign
_FACTOR, _MOST = 1.45, 1.3  # how many times as fast as the other one is in half of the rows, and in three quarters: a factor of 1.5 with room for rounding
_SPAN = 8  # rows over which noise of positions matters less
_BEYOND = 0.1  # part of its range by which a joint is outside of it, where that is told
_DRAWS = 3  # episodes in which a state is looked at, to see what is drawn in each
_LOOKS = 256  # states of an episode that are looked at for it
_JITTER = 0.05  # part of dt by which recorded times may differ from it
_GAP = 0.5  # part of dt by which one step of time may
_UNITS = (1.0, 1e3, 1e6, 1e9)  # of recorded times in a second
_OUT = 3.0  # times the speed of the rows around at which a step is a jump
_NORM = 0.15  # by which the norm of a quaternion may differ from one: Gymnasium's Ant begins with 0.9 to 1.12
_APART, _PART = 0.01, 0.05  # of the task's units, and of the largest value, by which a recorded entry of the observation may differ from the computed one
_OFTEN = 0.1  # part of the rows in which it must, as velocities at an impact do in a few
# Columns that say of which episode a row is, and at which time it was, by their names without case and signs.
_EPISODE = re.compile(r"(episodes?|ep|demo|demonstration|traj|trajectory|rollout|trial)(index|idx|id|number|num|no|nr)?")
_TIME = re.compile(r"(time|timestamps?|stamp|t|elapsed|seconds|secs?)(s|secs?|seconds|ms|us|ns|milliseconds|microseconds|nanoseconds)?")
# Names of commands in an expression: `command.x`, or `{command.left-x}` in braces.
_COMMAND = re.compile(r"\{(command\.[^}]*)\}|(?<![\w.])(command\.[\w.]+)")


class BadDemonstrations(ValueError):
    """A source that does not fit the task: the message names file, column and episode."""


def numbers(values: ArrayLike, what: str, where: str) -> Floats:
    """An array of real numbers."""
    if np.ma.is_masked(values):
        row = np.argwhere(np.ma.getmask(values))[0][0]
        raise BadDemonstrations(
            f"{where}: {what} is masked in row {row}, so it has no value there; fill it, or give the rows before and after as episodes of their own"
        )
    try:
        given = np.asarray(values)
        if not np.iscomplexobj(given):
            return given.astype(float)
    except (TypeError, ValueError):
        raise BadDemonstrations(f"{where}: {what} holds what is no number; give numbers") from None
    raise BadDemonstrations(f"{where}: {what} holds complex numbers; give real ones, as numpy.real of them")


def column(columns: Columns, name: str, n: int, where: str) -> Floats:
    """A column (n) by its name, all of it finite."""
    if name not in columns:
        raise BadDemonstrations(f"{where}: no column '{name}'; it has {', '.join(columns)}")
    values = numbers(columns[name], f"column '{name}'", where)
    if values.shape != (n,):
        raise BadDemonstrations(f"{where}: column '{name}' has shape {values.shape} where the others have {n} rows")
    bad = np.flatnonzero(~np.isfinite(values))
    if len(bad):
        raise BadDemonstrations(f"{where}: column '{name}' is {values[bad[0]]} in row {bad[0]}")
    return values


def controller(env: _core.Env, task: str | os.PathLike[str]) -> _core.Controller:
    """The task's controller around a policy that asks for nothing: it knows the policy period and the limits."""
    n_obs, n_act = len(env.obs_names), len(env.actuator_names)
    idle = [(np.zeros((n_act, n_obs)), np.zeros(n_act), "identity")]
    policy = _core.Policy.from_layers(idle, np.zeros(n_obs), np.ones(n_obs), (-np.inf, np.inf), (-np.inf, np.inf))
    try:
        return policy.in_task(task_of(task))
    except ValueError as error:
        try:  # a [policy] of its own sees something else, which is left out here
            return policy.in_task(task_of(task), ["policy.observation=[]"])
        except ValueError:
            raise error from None


def check_period(dt: float, period: float, source: str) -> None:
    """Refuses a time between two rows that no recording of the task has."""
    for name, value, is_of in (("dt", dt, "the time between two rows"), ("period", period, "the policy period")):
        if not isinstance(value, Real):
            raise BadDemonstrations(f"{source}: {name} is {value!r}; give {is_of} in seconds, a number")
    if not (period > 0 and np.isfinite(period)):
        raise BadDemonstrations(f"{source}: period is {period}; give the policy period in seconds")
    if not (dt > 0 and np.isfinite(dt)):
        raise BadDemonstrations(f"{source}: dt is {dt}; give the time between two rows in seconds")
    if dt >= _SLOW and dt > 10 * period:
        raise BadDemonstrations(
            f"{source}: dt is {dt} s between two rows, and the policy of the task acts every {period} s; dt is in seconds, so for {dt:g} ms give {dt / 1e3:g}"
        )


def is_episode(name: object) -> bool:
    """Whether a column of this name says of which episode a row is, however it is spelt."""
    return _EPISODE.fullmatch(_letters(name)) is not None


def _letters(name: object) -> str:
    return re.sub(r"[^a-z0-9]", "", str(name).lower())


def warn(message: str) -> None:
    """Warns at the line that called this package, however many functions of it there are between."""
    frame, level = sys._getframe(1), 2
    while frame.f_back is not None and str(frame.f_globals.get("__name__")).partition(".")[0] == "nearl":
        frame, level = frame.f_back, level + 1
    warnings.warn(message, stacklevel=level)


def check_others(columns: Columns, used: Collection[str], n: int, dt: float, where: str, told: set[str]) -> None:
    """Holds the columns (n) that are not ``used`` against what else is known: one episode, whose rows are ``dt`` apart. Of the rest it warns, once each."""
    left = []
    for name in columns:
        if name in used:
            continue
        if is_episode(name):
            of = np.asarray(columns[name]).ravel()
            if len(others := np.flatnonzero(of != of[:1])):
                raise BadDemonstrations(
                    f"{where}: its column '{name}' is {of[0]} up to row {others[0] - 1} and {of[others[0]]} after it, so this is more than one episode; give a "
                    f"table for each, in pandas [table for _, table in frame.groupby('{name}')]"
                )
        elif _TIME.fullmatch(_letters(name)):
            _check_times(columns, name, n, dt, where)
        elif str(name) not in told:
            left.append(name)
    if not left:
        return
    told.update(map(str, left))
    free = {name.lower(): name for name in used if name not in columns}
    said = []
    for name in left:
        near = get_close_matches(str(name).lower(), free, 1, 0.8)
        said.append(f"'{name}'" + (f" (is '{free[near[0]]}' meant?)" if near else ""))
    are = ("column", "is") if len(said) == 1 else ("columns", "are")
    none = "it is no position, velocity or observation of the task" if len(said) == 1 else "they are no positions, velocities or observations of the task"
    warn(f"{where}: {are[0]} {', '.join(said)} {are[1]} not used: {none}, and not in actions=")


def _check_times(columns: Columns, name: str, n: int, dt: float, where: str) -> None:
    """Refuses recorded times (n), in s, ms, µs or ns, between which is no ``dt``."""
    times = column(columns, name, n, where)
    steps = np.diff(times)
    usual = float(np.median(steps))
    unit = next((unit for unit in _UNITS if abs(usual - dt * unit) <= _JITTER * dt * unit), None)
    if unit is None:
        raise BadDemonstrations(
            f"{where}: column '{name}' goes on by {usual:g} from row to row, and dt is {dt:g} s; correct dt, or leave the column out if it is no "
            f"time in s, ms, µs or ns"
        )
    if len(off := np.flatnonzero(np.abs(steps - dt * unit) > _GAP * dt * unit)):
        row = int(off[0])
        raise BadDemonstrations(
            f"{where}: column '{name}' goes from {times[row]:.10g} in row {row} to {times[row + 1]:.10g} in the next, and dt is {dt:g} s; if rows are missing "
            f"there or another episode begins, give the rows from there on as an episode of their own (in CSV by a column 'episode'), and leave the column "
            f"out if its times are not to be believed"
        )


def check_turns(names: Sequence[str], qpos: Floats, where: str) -> None:
    """Refuses quaternions among positions (n x nq) that are far from length one, and so no rotations."""
    for k, name in enumerate(names):
        if name.endswith(".qw"):
            norms = np.linalg.norm(qpos[:, k : k + 4], axis=1)
            if len(off := np.flatnonzero(np.abs(norms - 1) > _NORM)):
                raise BadDemonstrations(
                    f"{where}: the quaternion of columns {', '.join(names[k : k + 4])} has the norm {norms[off[0]]:.3g} in row {off[0]}, and that of a "
                    f"rotation is 1 (within {_NORM}); where tracking was lost, leave the rows out and give those before and after as episodes of their own"
                )


def check_units(
    of_task: _core.Controller,
    names: tuple[Sequence[str], Sequence[str]],
    qpos: Floats,
    qvel: Floats,
    rates: Floats,
    dt: float,
    where: str,
    told: set[str],
) -> None:
    """Refuses positions (n x nq) further outside the task's limits than these are apart and than half a turn. Warns of positions outside by a tenth of the
    range, of speeds (n x nv) that are far above theirs, and of single rows between which a joint jumps (``rates``, n - 1 x nv)."""
    limits, dofs = of_task.limits, of_task.row_names
    for k, name in enumerate(names[1]):
        joint = name[2:]
        if joint not in dofs:
            continue
        dof = dofs.index(joint)
        if "q." + joint in names[0]:
            lower, upper = limits["lower_position"][dof], limits["upper_position"][dof]
            positions = qpos[:, names[0].index("q." + joint)]
            outside = np.maximum(lower - positions, positions - upper)
            row = int(np.argmax(outside))
            if outside[row] > max(upper - lower, np.pi):
                raise BadDemonstrations(
                    f"{where}: column 'q.{joint}' is {positions[row]:g} in row {row}, and joint '{joint}' goes from {lower:.3g} to {upper:.3g} rad or m; "
                    f"if these are degrees or millimetres, give numpy.radians of them, or metres"
                )
            if outside[row] > _BEYOND * (upper - lower) and (key := f"range of {joint}") not in told:
                told.add(key)
                _warn_of_range(joint, float(positions[row]), row, (lower, upper), positions, where)
        limit = limits["velocity"][dof]
        if (at := _jump(rates[:, k], limit)) is not None and "q." + joint in names[0]:
            if (key := f"jump of {joint}") not in told:
                told.add(key)
                _warn_of_jump(joint, qpos[:, names[0].index("q." + joint)], *at, dt, limit, where)
            continue
        row = int(np.argmax(np.abs(qvel[:, k])))
        if (speed := abs(qvel[row, k])) > _FAST * limit > 0:
            warn(
                f"{where}: joint '{joint}' moves at {speed:.3g} rad/s or m/s in row {row}, {speed / limit:.0f} times the task's limit of {limit:.3g}; "
                f"look whether its columns are in rad or m, and dt in seconds",
            )


def _warn_of_range(joint: str, value: float, row: int, limits: tuple[float, float], positions: Floats, where: str) -> None:
    lower, upper = limits
    share = np.mean((positions < lower) | (positions > upper))
    warn(
        f"{where}: column 'q.{joint}' is {value:.4g} in row {row}, and the task lets joint '{joint}' be at {lower:.3g} to {upper:.3g} rad or m (its range less "
        f"constraints.position.margin); {100 * share:.3g} % of the rows are outside. Look whether these are degrees, millimetres or shares of an opening (0 to "
        f"1), and whether the column is of another joint or counts from another zero; if it is right, give the joint that room in the robot file or the task",
    )


def _jump(rate: Floats, limit: float) -> tuple[int, bool] | None:
    """The row after which a joint is faster (n - 1) than its limit, and far faster than before and after; and whether it is back one row later."""
    speed = np.abs(rate)
    away_and_back = np.where(rate[1:] * rate[:-1] < 0, np.minimum(speed[1:], speed[:-1]), 0.0)
    for back, steps in ((False, speed), (True, away_and_back)):
        beside = np.pad(speed, 1)
        out = (steps > limit) & (steps > _OUT * np.maximum(beside[: len(steps)], beside[len(beside) - len(steps) :]))
        if limit > 0 and out.any():
            return int(np.argmax(np.where(out, steps, 0.0))), back
    return None


def _warn_of_jump(joint: str, positions: Floats, row: int, back: bool, dt: float, limit: float, where: str) -> None:
    a, b = positions[row : row + 2]
    returns = f" and back to {positions[row + 2]:.4g}" if back else ""
    if abs(abs(b - a) / (2 * np.pi) - 1) < 0.1:
        reason = "take the turn out with numpy.unwrap"
    elif back:
        reason = f"look whether the measurement of row {row + 1} was lost, and put one between those beside in its place"
    else:
        reason = "look whether rows are missing there, or another episode begins (in CSV a column 'episode')"
    warn(
        f"{where}: joint '{joint}' jumps from {a:.4g} in row {row} to {b:.4g} in the next{returns}, {abs(b - a) / dt:.3g} rad/s or m/s with dt = {dt:g} s, "
        f"where the task's limit is {limit:.3g}; {reason}",
    )


def check_velocities(columns: Columns, names: Sequence[str], qvel: Floats, rates: Floats, dt: float, where: str, told: set[str]) -> None:
    """Warns of recorded velocities (n x nv) that positions do not follow: another sign, unit, gear or ``dt``.

    Between two rows the mean of both velocities stands against ``rates`` (n - 1 x nv), what the positions change by. Only rows in which something moves
    steadily count, and half of these must be off, so that an angle that jumps by a turn, an impact or rows that are far apart are no reason. Off is a factor
    of three or the other sign, or a factor of one and a half that is in most of the rows and over longer spans too, as noise makes none. ``told`` are the
    columns that were warned of.
    """
    wrong, factors = [], []
    for k, name in enumerate(names):
        base, _, entry = name.rpartition(".")
        place = f"q{base[1:]}.qw" if entry in ("wx", "wy", "wz") else "q" + name[1:]
        if name in told or name not in columns or place not in columns:
            continue
        if (found := _disagrees(qvel[:, k], rates[:, k])) is not None:
            told.add(name)
            row, factor = found
            given = (qvel[row, k] + qvel[row + 1, k]) / 2
            wrong.append((f"column '{name}' is {given:.3g} around row {row}, where '{place}' changes by {rates[row, k]:.3g} a second", name))
            factors.append(factor)
    if not wrong:
        return
    also = f" (likewise {', '.join(name for _, name in wrong[1:])})" if wrong[1:] else ""
    of_time = None not in factors and len(factors) > 1 and max(factors) < 1.1 * min(factors)  # type: ignore[type-var, operator]
    fits = f" (rows about {dt / float(np.median(factors)):.2g} s apart would fit, and dt is {dt:g} s)" if of_time else ""  # type: ignore[arg-type]
    warn(
        f"{where}: {wrong[0][0]}, and is as far off in half of the rows{also}; look at sign, unit and dt{fits}, or leave velocities out: then they are the "
        "differences of the positions",
    )


def _disagrees(velocity: Floats, rate: Floats) -> tuple[int, float | None] | None:
    """A row in which a velocity (n) is as far from the change of the position (n - 1) as in half of the rows, where that is far, and how many times as fast
    it is, where it is as many times in most of them."""
    mean = (velocity[1:] + velocity[:-1]) / 2
    size = np.maximum(np.abs(mean), np.abs(rate))
    step = np.abs(np.diff(rate))
    jumps = np.maximum(np.append(step, 0.0), np.insert(step, 0, 0.0))
    # Where a velocity is another one in the next row, rows are too far apart to tell.
    steady = (np.abs(np.diff(velocity)) <= 0.5 * np.abs(mean)) & (jumps <= 0.5 * np.abs(rate))
    moves = np.flatnonzero(steady & (size >= max(_STILL, 0.2 * np.percentile(size, 90))))
    if len(moves) < max(_FEW, 0.2 * len(rate)):
        return None
    off = np.abs(mean - rate)[moves] / size[moves]
    row = int(moves[np.argsort(off)[len(off) // 2]])
    factor = _factor(mean[moves], rate[moves])
    span = min(_SPAN, len(rate) // _FEW)
    sums = [np.convolve(of, np.ones(span), "valid") for of in (mean, rate)]
    if np.median(off) > _OFF:
        # A velocity that is another one in each row and comes to nothing is noise around a joint that stands.
        noise = np.median(np.abs(rate[moves])) < _STILL and np.median(np.abs(sums[0])) < 0.65 * span * np.median(np.abs(mean))
        return None if noise else (row, factor)
    if factor is None:
        return None
    far = np.maximum(*np.abs(sums))
    over = _factor(*(of[far >= max(_STILL * span, 0.2 * np.percentile(far, 90))] for of in sums))
    return (row, factor) if over is not None and (over > 1) == (factor > 1) else None


def _factor(given: Floats, found: Floats) -> float | None:
    """How many times as fast ``given`` is as ``found``, neither of them small, where that is far from one in most entries."""
    size = np.maximum(np.abs(given), np.abs(found))
    # in parts of the larger one, so that neither is divided by what may be 0
    lead = np.where(given * found > 0, (np.abs(given) - np.abs(found)) / np.maximum(size, 1e-300), 0.0)
    for sign in (1, -1):
        quarter, half = np.percentile(sign * lead, [25, 50]) if len(lead) else (0.0, 0.0)
        if half > 1 - 1 / _FACTOR and quarter > 1 - 1 / _MOST:
            return float((1 / (1 - half)) ** sign) if half < 1 else None
    return None


class Rows:
    """Which rows of an episode are those of the policy: every so many, or between two of them."""

    def __init__(self, n: int, dt: float, period: float):
        every = round(period / dt)
        self.whole = every >= 1 and abs(period / dt - every) <= SAME * every
        at = np.arange(int((n - 1) * dt / period + SAME) + 1)
        self._times, self._at = np.arange(n) * dt, at * period
        self._newest = at * every if self.whole else np.minimum((self._at / dt + SAME).astype(int), n - 1)

    def states(self, rows: Floats) -> Floats:
        """Of rows (n x any) that change steadily."""
        if self.whole:
            return rows[self._newest]
        return np.stack([np.interp(self._at, self._times, of) for of in rows.T], 1)

    def newest(self, values: Floats) -> Floats:
        """Of a column (n) that holds until the next row."""
        return values[self._newest]


def goal_names(env: _core.Env) -> list[str]:
    """Columns of the entries of the environment's goal, in its order; none where the observation does not tell of all of them."""
    own = [name for name in env.obs_names if name.startswith("goal.")]
    asked = {braced or plain for entry in env.obs_names for braced, plain in _COMMAND.findall(entry)}
    names = own or sorted(asked)  # as the task file's table of commands is kept
    return names if len(names) == len(env.goal) else []


def observations(
    env: _core.Env,
    columns: Mapping[str, Floats],
    rows: Rows,
    state: Mapping[str, Floats],
    qpos: Floats,
    qvel: Floats,
    period: float,
    where: str,
    told: set[str],
) -> Floats:
    """Observations (n x n_obs) of an episode.

    What follows from the state and from what was asked for is the task's own; what was recorded of it should be the same. What does not, as noise, is what
    was recorded.

    Args:
        env: Of the task.
        columns: Observed and asked for, as they were recorded, by name.
        rows: Which rows of them are these n.
        state: Columns (n) of ``qpos`` and ``qvel`` by name.
        qpos: Configurations (n x nq).
        qvel: Velocities (n x nv).
        period: Between two of them [s].
        where: Source and episode, for messages.
        told: Columns that were warned of.
    """
    goals = goal_names(env)
    recorded = {name: rows.newest(of) for name, of in columns.items()}
    given = [(k, recorded[name]) for k, name in enumerate(goals) if name in recorded]

    def look(seed: int, rows: range) -> Floats:
        env.reset(seed)
        return np.stack([_seen(env, qpos[i], qvel[i], i * period, [(k, of[i]) for k, of in given]) for i in rows])

    n = len(qpos)
    seen, some = look(0, range(n)), range(0, n, max(1, n // _LOOKS))
    others = [look(seed, some) for seed in range(1, _DRAWS)]
    lacking, computed = [], {}
    for k, name in enumerate(env.obs_names):
        drawn = any(not np.array_equal(other[:, k], seen[some, k]) for other in others)
        if not drawn and not name.startswith("cfrc."):
            if name in columns and name not in state and name not in goals:
                computed[name] = seen[:, k]
            continue
        if (own := state.get(name, recorded.get(name))) is not None:
            seen[:, k] = own
        elif drawn:
            lacking.append(name)
    if lacking:
        missing = [name for name in goals if name not in recorded]
        raise BadDemonstrations(
            f"{where}: the task also observes {', '.join(lacking)}, which positions and velocities do not say; give the columns "
            f"{', '.join(missing or lacking)} as they were when it was recorded"
            + ("" if missing else ", or convert with a task file without [noise] and [random]")
        )
    _check_observed(columns, rows, computed, where, told)
    return seen


def _check_observed(columns: Mapping[str, Floats], rows: Rows, computed: Mapping[str, Floats], where: str, told: set[str]) -> None:
    """Warns of recorded entries of the observation that are not what the task computes from the same states: those are of other joints, or in other units."""
    wrong = []
    for name, own in computed.items():
        given = rows.states(columns[name][:, None])[:, 0]
        off = np.abs(given - own) > _APART + _PART * max(np.abs(given).max(), np.abs(own).max())
        if name not in told and np.mean(off) >= _OFTEN:
            told.add(name)
            k = int(np.argmax(off))
            row = int(rows.newest(np.arange(len(columns[name]), dtype=float))[k])
            said = f"column '{name}' is {given[k]:.4g} in row {row}, where positions and velocities give {own[k]:.4g} in the task's units (rad, m, s)"
            wrong.append((f"{said}, and {100 * np.mean(off):.3g} % of the rows are as far off", name))
    if wrong:
        also = f" (likewise {', '.join(name for _, name in wrong[1:])})" if wrong[1:] else ""
        warn(
            f"{where}: {wrong[0][0]}{also}; what they give is written. Look whether the joints' columns have the right names and units, and whether the column "
            f"is of this robot's tool; if it alone is wrong, leave it out",
        )


def _seen(env: _core.Env, qpos: Floats, qvel: Floats, time: float, goal: list[tuple[int, float]]) -> Floats:
    """The observation (n_obs) in a state, asked for what was asked for."""
    seen = env.set_state(qpos, qvel, time)
    if not goal:
        return seen
    asked = env.goal
    for k, value in goal:
        asked[k] = value
    env.goal = asked
    return env.observe()
