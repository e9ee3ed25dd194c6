"""A run folder and a flight log as the programs write them, for the report's test."""

import json
from pathlib import Path

import numpy as np
from conftest import ROBOTS
from mcap.writer import Writer

import nearl

RUNGS = ["closed form", "active set", "clarabel", "brake", "relaxed", "stored brake"]
COLUMNS = [
    "time/total_timesteps", "time/seconds", "time/fps", "rollout/ep_rew_mean", "rollout/ep_len_mean",
    "constraints/raw_violations", "constraints/target_violations", "constraints/reached_violations", "constraints/moved",
    "idm/threshold", "idm/mse_before", "idm/mse_after",
]  # fmt: skip


def run_folder(root: Path, task: str, algo: str, seed: int, top: float) -> Path:
    rng = np.random.default_rng(hash((algo, seed)) % 2**32)
    path = root / task / f"{algo}_{seed}"
    path.mkdir(parents=True)
    (path / "task.toml").write_text(f'name = "{task}"\n')
    (path / "env.json").write_text(json.dumps({"algo": algo, "seed": seed}))
    lines = [",".join(COLUMNS)]
    for i in range(1, 245):
        steps = 4096 * i
        x = steps / 1e6
        reward = top * (1 - np.exp(-3 * x)) * (1 + 0.06 * rng.normal()) + 90 * seed * x - 150 * np.exp(-9 * x)
        raw, reached = 0.6 * np.exp(-3 * x) + 0.1 + 0.02 * rng.random(), 0.05 * np.exp(-2 * x) + 0.004 * rng.random()
        before = 0.5 * np.exp(-5 * x) + 0.02 * (1 + rng.random())
        row = [steps, steps / 28e3, 28e3, reward, 1000, raw, 0, reached, raw, 0.04, before, before * 0.8]
        if algo == "ppo":
            row[5:] = [float("nan")] * len(row[5:])
        if i < 3:
            row[3] = float("nan")  # no episode has finished yet
        lines.append(",".join("" if np.isnan(v) else f"{v}" for v in row))
    (path / "metrics.csv").write_text("\n".join(lines) + "\n4096,")  # a row cut short, as after kill -9
    return path


def flight_log(path: Path, ticks: int = 3000, metadata: dict[str, str] | None = None, rows: bool = False) -> Path:
    """A Panda chasing wild set points through our projector, on paper: the reached state is the target."""
    model = nearl.Model.from_urdf(ROBOTS / "panda" / "panda.urdf")
    limits = [nearl.PositionLimit(model, 0.01), nearl.VelocityLimit(model, scale=0.9), nearl.AccelerationLimit(model, 10.0), nearl.TorqueLimit(model, 0.95)]
    dt, rng = 1e-3, np.random.default_rng(0)
    projector = nearl.Projector(model, limits, dt=dt)
    low, high = model.lower_position_limit, model.upper_position_limit
    q, v, goal = (low + high) / 2, np.zeros(7), (low + high) / 2
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        writer.add_metadata("nearl", {"rungs": ",".join(RUNGS)} | (metadata or {}))
        schema = writer.register_schema("nearl.Tick", "jsonschema", b"{}")
        channel = writer.register_channel("tick", "json", schema)
        for tick in range(1, ticks + 1):
            if tick % 1000 == 1:
                goal = np.where(rng.random(7) < 0.5, low - 0.3, high + 0.3)
            v_hat = 6.0 * (goal - q) + 0.05 * rng.normal(size=7)
            v_hat = v + np.clip(v_hat - v, -0.5, 0.5) * (1 + np.sin(tick / 90))
            q_hat = q + dt * v_hat
            target = projector.project(q, v, q_hat, v_hat)
            due = 10**9 + tick * 10**6
            begin = due + int(rng.gamma(3.0, 4000.0))
            end = begin + int(6000 + rng.gamma(2.0, 2000.0)) + (300_000 if tick % 997 == 0 else 0)
            tick_json = {
                "tick": tick, "due_ns": due, "begin_ns": begin, "end_ns": end, "mode": "Active" if tick > 5 else "Hold", "reason": "None",
                "policy_version": 3, "fresh": True, "swapped": False,
                "state": {"seq": tick, "episode": 0, "reward": 0.0, "q": q.tolist(), "v": v.tolist()},
                "proposal_q": q_hat.tolist(), "proposal_v": v_hat.tolist(), "target_q": target.q.tolist(), "target_v": target.v.tolist(),
                "action": [0.0] * 7,
                "ledger": {"status": 1, "rung": RUNGS.index(target.rung), "active": len(target.active), "iterations": target.iterations,
                           "raw_violations": sum(target.raw_violations.values()), "target_violations": sum(target.target_violations.values()),
                           "moved": target.moved, "slack": target.slack, "residual": target.residual, "duration_ns": target.duration_ns},
                "overruns": 0, "stale": 0, "lost_states": 0,
            }  # fmt: skip
            if rows:
                tick_json["ledger"]["active_rows"] = target.active
            if tick <= 5:
                tick_json |= {"proposal_q": [], "proposal_v": [], "target_q": [], "target_v": [], "action": []}
            writer.add_message(channel, end, json.dumps(tick_json).encode(), begin, tick)
            q, v = q + dt * target.v, target.v
        writer.finish()
    return path


def evaluations(path: Path) -> Path:
    modes = [("projected", 4100.0, 0.21, 0.0, 0.01), ("raw", 3900.0, 0.27, 0.27, 0.2)]
    found = [
        {"mode": m, "returns": [r, r + 80, r - 30], "lengths": [1000] * 3, "ticks": 3000, "raw_violations": int(3000 * a), "target_violations": int(3000 * b),
         "reached_violations": int(3000 * c), "residual": 0.1}
        for m, r, a, b, c in modes
    ]  # fmt: skip
    path.write_text(json.dumps(found))
    return path


def summary(path: Path) -> Path:
    times = {"count": 30000, "p50": 9_100, "p99": 14_000, "p999": 31_000, "max": 320_000}
    loop = {"robot": "panda", "ticks": 30000, "seconds": 30.0, "dt": 1e-3, "wake": times, "compute": times,
            "counters": {"overruns": 1, "raw_violations": 8123, "target_violations": 0}}  # fmt: skip
    loop["plant"] = {"late": 2, "violations": {"position": 0, "velocity": 3}, "worst": {"position": 0.0, "velocity": 0.012}}
    receipts = [{"version": 4, "accepted": True, "text": "in use"}, {"version": 5, "accepted": False, "text": "snapshot digest mismatch"}]
    path.write_text(json.dumps([{"run": loop}, {"task": "HalfCheetah-v5", "run": loop, "swap": receipts}]))
    return path
