"""Margins adapted online until as many ticks end outside as were asked for, with a learned inverse model: what such a margin has to act on.

    python results/reached/dial.py SNAPSHOT [TICKS [NAME]] > results/reached/dial.csv

NAME is what the column `policy` has, `first` unless given. SNAPSHOT is a deterministic policy with a learned inverse model on HalfCheetah-v5. It is read from
the file and computed here in NumPy: policy, the limits of `consistency = "free"` (each entry of the proposal clamped, without the braking box), inverse
model. Every row, a side of the position or of the velocity of a joint, has a margin of its own, which after each tick becomes

    m <- m + eta (outside - wanted),      eta = GAIN s / (1 + n / SETTLES)^DECAY,      0 <= m <= MOST s

with `outside` 1 where the reached state is beyond the limit of the row, `s` the width of its limits and `n` the ticks so far: adaptive conformal inference
(Gibbs and Candes 2021) with a step that decays (Angelopoulos, Barber and Bates 2024). `wanted` is the share of the row: what was asked for, divided among the
rows by how often each was outside, and scaled by an integral of the error of the whole, as several rows may be outside in one tick.

A margin of a velocity is kept by the target. A margin of a position is kept in one of three ways:

- `position`: the target keeps it.
- `position and velocity`: so does the velocity that leads there at constant acceleration.
- `motor`: where the row is near (the proposal is within a tenth of the range of the limit, or a period at the present velocity leads beyond it) the motor of
  the joint pushes towards the limit by no more than the share `1 - 2 m / (MOST s)` of its range, which is away from it where that is negative.

What is counted comes after the margins had half of the ticks to settle. The floor is what the best of 400 sampled actions leaves outside.
"""

import json
import pathlib
import struct
import sys

import gymnasium
import mujoco
import numpy as np

GAIN, SETTLES, DECAY, MOST, NEAR = 0.02, 2000.0, 0.6, 0.48, 0.1
WAYS = ("position", "position and velocity", "motor")
SAMPLES, EVERY = 400, 40
CLIP = 10.0


class Snapshot:
    """Networks and limits of a deterministic policy with a learned inverse model, whose state is its observation."""

    def __init__(self, path: str) -> None:
        """Reads a safetensors file."""
        data = pathlib.Path(path).read_bytes()
        (length,) = struct.unpack("<Q", data[:8])
        header = json.loads(data[8 : 8 + length])
        self.manifest = json.loads(header.pop("__metadata__")["nearl"].split("\n", 1)[1])
        body = data[8 + length :]
        kinds = {"F32": np.float32, "F64": np.float64}
        self.tensors = {name: np.frombuffer(body[slice(*t["data_offsets"])], kinds[t["dtype"]]).reshape(t["shape"]) for name, t in header.items()}
        state = self.manifest["task"]["state"]
        self.names, joints = state["observation"], state["controllable"]
        self.joints = [(self.names.index(f"q.{j}"), self.names.index(f"v.{j}")) for j in joints]
        self.seen = [k for k, name in enumerate(self.names) if name.split(".", 1)[1] in joints]

    def net(self, name: str, x: np.ndarray) -> np.ndarray:
        """A network with tanh between its layers, and what passes it by where there is such a part."""
        count = sum(key.startswith(f"{name}.") and key.endswith(".weight") and key.split(".")[1].isdigit() for key in self.tensors)
        out = x
        for k in range(count):
            out = self.tensors[f"{name}.{k}.weight"] @ out + self.tensors[f"{name}.{k}.bias"]
            out = np.tanh(out) if k < count - 1 else out
        skip = self.tensors.get(f"{name}.skip")
        return out if skip is None else out + skip @ x

    def see(self, obs: np.ndarray) -> np.ndarray:
        """The networks' input."""
        return np.clip((obs - self.tensors["normaliser.mean"]) / self.tensors["normaliser.std"], -CLIP, CLIP)

    def propose(self, x: np.ndarray, obs: np.ndarray) -> np.ndarray:
        """The state that the policy wants next."""
        return obs + self.tensors["normaliser.scale"] * self.net("policy", x)

    def invert(self, x: np.ndarray, obs: np.ndarray, target: np.ndarray) -> np.ndarray:
        """The action that is to lead there."""
        change = np.clip((target - obs) / self.tensors["normaliser.scale"], -CLIP, CLIP)
        return np.clip(self.net("idm", np.concatenate([x[self.seen], change[self.seen]])), -1.0, 1.0)


class Dial:
    """A margin for each row."""

    def __init__(self, asked: float | None, widths: np.ndarray) -> None:
        """`asked` for as a share of the ticks; none is no margin. `widths` of the limits of each row."""
        self.asked, self.widths = asked, widths
        self.margins = np.zeros_like(widths)
        self.often, self.scale, self.n = np.full(len(widths), 1.0 / len(widths)), 1.0, 0

    def learn(self, outside: np.ndarray) -> None:
        """Takes in which rows a tick ended outside of."""
        if self.asked is None:
            return
        self.n += 1
        step = (1.0 + self.n / SETTLES) ** -DECAY
        self.often += 0.002 * (outside - self.often)
        self.scale *= np.exp(0.01 * step * (self.asked - float(outside.any())) / self.asked)
        wanted = np.clip(self.scale, 0.2, 5.0) * self.asked * self.often / max(self.often.sum(), 1e-9)
        self.margins = np.clip(self.margins + GAIN * step * self.widths * (outside - wanted), 0.0, MOST * self.widths)


def avoidable(env: gymnasium.Env, other: mujoco.MjData, action: np.ndarray, excess, rng: np.random.Generator) -> bool:
    """Whether one of the sampled actions (near the chosen one, anywhere, at the corners) ends inside."""
    base = env.unwrapped
    kind = mujoco.mjtState.mjSTATE_INTEGRATION
    start = np.empty(mujoco.mj_stateSize(base.model, kind))
    mujoco.mj_getState(base.model, base.data, start, kind)
    for k in range(SAMPLES):
        draw = rng.uniform(-1.0, 1.0, len(action))
        tries = (np.clip(action + draw**3, -1, 1), draw, np.clip(action + 0.3 * rng.normal(size=len(action)), -1, 1), np.sign(draw))
        mujoco.mj_setState(base.model, other, start, kind)
        other.ctrl[:] = tries[k % 4]
        mujoco.mj_step(base.model, other, base.frame_skip)
        if not excess(other.qpos, other.qvel).any():
            return True
    return False


def fly(snapshot: Snapshot, asked: float | None, ticks: int, way: str) -> dict:
    """Whole episodes, at least `ticks` ticks; shares of the second half."""
    task = snapshot.manifest["task"]
    env = gymnasium.make(task["name"])
    dt = float(task["time"]["dt"])
    base, rng = env.unwrapped, np.random.default_rng(0)
    other = mujoco.MjData(base.model)
    offset = len(base.data.qpos) + len(base.data.qvel) - len(snapshot.names)
    at = [(iq + offset, iv - len(base.data.qpos) + offset) for iq, iv in snapshot.joints]
    ids = [int(np.flatnonzero(base.model.jnt_qposadr == iq)[0]) for iq, _ in at]
    low, high = base.model.jnt_range[ids].T
    most = np.full(len(ids), float(task["constraints"]["velocity"]["limit"]))
    q_at, v_at = np.array([a for a, _ in at]), np.array([b for _, b in at])

    def excess(qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        q, v = qpos[q_at], qvel[v_at]
        return np.concatenate([q < low, q > high, v < -most, v > most]).astype(float)

    dial = Dial(asked, np.concatenate([high - low, high - low, 2 * most, 2 * most]))
    iq, iv = np.array(snapshot.joints).T
    n = len(ids)
    assert (base.model.actuator_gear[:, 0] > 0.0).all(), "a motor that is turned round pushes the other way"
    rows, counted, out_any, lost, asked_of, returns, settled = np.zeros(4 * n), 0, 0, 0, 0, [], []
    done = 0
    while done < ticks:
        obs, over, total = env.reset(seed=100 + len(returns))[0], False, 0.0
        while not over:
            x = snapshot.see(obs)
            proposal = snapshot.propose(x, obs)
            m_low, m_high, m_slow, m_fast = dial.margins.reshape(4, n)
            lower, upper = (low, high) if way == "motor" else (low + m_low, high - m_high)
            slowest, fastest = -most + m_slow, most - m_fast
            target = proposal.copy()
            target[iq] = np.clip(proposal[iq], lower, upper)
            if way == "position and velocity":  # v' = 2 (q' - q) / T - v at the ends of q'
                slowest, fastest = (np.clip(2.0 * (end - obs[iq]) / dt - obs[iv], slowest, fastest) for end in (lower, upper))
            target[iv] = np.clip(proposal[iv], slowest, fastest)
            action = snapshot.invert(x, obs, target)
            if way == "motor":
                near, ahead = NEAR * (high - low), obs[iq] + dt * obs[iv]
                below, above = (proposal[iq] <= low + near) | (ahead <= low), (proposal[iq] >= high - near) | (ahead >= high)
                share_low, share_high = m_low / (MOST * (high - low)), m_high / (MOST * (high - low))
                action = np.where(below, np.maximum(action, 2.0 * share_low - 1.0), action)
                action = np.where(above, np.minimum(action, 1.0 - 2.0 * share_high), action)
            look = asked is None and done % EVERY == 0
            if look:
                can = avoidable(env, other, action, excess, rng)
            obs, reward, terminated, truncated, _ = env.step(action.astype(np.float32))
            outside = excess(base.data.qpos, base.data.qvel)
            dial.learn(outside)
            total, over, done = total + float(reward), terminated or truncated, done + 1
            if look:
                asked_of, lost = asked_of + 1, lost + int(bool(outside.any()) and not can)
            if done > ticks // 2:
                counted, out_any, rows = counted + 1, out_any + int(outside.any()), rows + outside
        returns.append(total)
        if done > ticks // 2:
            settled.append(total)
    sides = ("below", "above", "slower", "faster")
    names = [f"{name} {side}" for side in sides for name in task["state"]["controllable"]]
    worst = sorted(range(4 * n), key=lambda r: -rows[r])[:3]
    # A margin at its end does what it can; what is outside of such a row yet, no margin of this kind keeps.
    full = [names[r] for r in range(4 * n) if dial.margins[r] >= 0.99 * MOST * dial.widths[r]]
    return {
        "margins of positions": way if asked is not None else "none",
        "asked": "" if asked is None else asked,
        "ticks": counted,
        "outside": round(out_any / counted, 4),
        "floor": round(lost / asked_of, 4) if asked_of else "",
        "return": round(float(np.mean(settled)), 1),
        "worst rows": "; ".join(f"{names[r]} {rows[r] / counted:.4f}" for r in worst),
        "unattainable": "; ".join(full),
    }


if __name__ == "__main__":
    if len(sys.argv) not in (2, 3, 4):
        sys.exit(__doc__)
    ticks = int(sys.argv[2]) if len(sys.argv) > 2 else 20000
    name = sys.argv[3] if len(sys.argv) > 3 else "first"
    print("policy,margins of positions,asked,ticks,outside,floor,return,worst rows,unattainable")
    for way, share in [(WAYS[0], None), *((way, share) for way in WAYS for share in (0.1, 0.05, 0.01))]:
        print(",".join(str(value) for value in (name, *fly(Snapshot(sys.argv[1]), share, ticks, way).values())), flush=True)
