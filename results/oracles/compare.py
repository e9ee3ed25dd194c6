"""Independent optima of the problems that `oracle_problems` wrote, and how far our answers are from them.

Boxes from the formulas, mass matrices, forces and Jacobians from the Python package of Pinocchio, optima from quadprog and proxsuite
(rows) or ECOS (cones). Nothing of NEARL is imported.

    .oracles/bin/python results/oracles/compare.py PROBLEMS.jsonl > results/oracles/table.md
"""

import json
import sys
from pathlib import Path

import ecos
import numpy as np
import pinocchio as pin
import proxsuite
import quadprog
from scipy import sparse

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from bounds import upper_acceleration  # noqa: E402

ROBOTS = Path(__file__).resolve().parents[2] / "examples" / "robots"


class Robot:
    """A robot with the limits of a head line."""

    def __init__(self, head: dict):
        self.head, c = head, head["constraints"]
        self.model = pin.buildModelFromUrdf(str(ROBOTS / head["robot"] / f"{head['robot']}.urdf"))
        self.data, self.dt, self.n = self.model.createData(), head["dt"], self.model.nv
        assert list(self.model.names)[1:] == head["joints"]
        self.low, self.high = self.model.lowerPositionLimit, self.model.upperPositionLimit
        scale, own = c["velocity"].get("scale"), c["velocity"].get("limit")
        self.speed = np.full(self.n, float(own)) if own else scale * self.model.upperVelocityLimit
        self.most = np.full(self.n, float(c["acceleration"]["limit"]))
        braking = np.full(self.n, float(c["acceleration"]["braking"]))
        room = (self.high - self.low) / (self.dt**2 * (1 + 0.125))
        self.braking = np.min([braking, self.most, self.speed / self.dt, room], axis=0)
        self.effort = c["torque"]["scale"] * self.model.upperEffortLimit
        self.worth = (2 * (self.most * self.dt) ** 2).max()

    def box(self, q, v):
        up = upper_acceleration(self.high - q, v, self.speed, self.most, self.braking, self.dt)
        down = upper_acceleration(q - self.low, -v, self.speed, self.most, self.braking, self.dt)
        return -self.dt * down, self.dt * up

    def torque_rows(self, q, v):
        mass = pin.crba(self.model, self.data, q)
        mass = np.triu(mass) + np.triu(mass, 1).T
        nle = pin.nonLinearEffects(self.model, self.data, q, v)
        g = mass / self.dt / self.effort[:, None]
        return mass, np.vstack([g, -g]), np.concatenate([1 - nle / self.effort, 1 + nle / self.effort])

    def user_rows(self, v):
        """Equal rows (A, b), hard rows (G, h), soft rows (coefficients, lower, upper, linear, quadratic); shares of their sizes."""
        a, b, g, h, soft = [], [], [], [], []
        for row in self.head["constraints"].get("rows", []):
            terms = np.zeros(self.n)
            for name, coefficient in row["terms"].items():
                terms[self.head["joints"].index(name[2:])] = coefficient
            now = terms @ v
            bounds = [abs(row[k]) for k in ("lower", "upper", "equals") if row.get(k) is not None]
            size = max(bounds) or np.abs(terms).max()
            if row.get("soft"):
                s = row["soft"]
                soft.append((terms / size, (row["lower"] - now) / size, (row["upper"] - now) / size, s["linear"], s["quadratic"]))
            elif row.get("equals") is not None:
                a.append(terms / size)
                b.append((row["equals"] - now) / size)
            else:
                g.append(terms / size)
                h.append((row["upper"] - now) / size)
        return np.reshape(a, (-1, self.n)), np.array(b), np.reshape(g, (-1, self.n)), np.array(h), soft

    def cones(self, q, v, mass):
        """(C, c, radius): |C y + c| <= radius."""
        c, out = self.head["constraints"], []
        for speed in c.get("frame_speed", []):
            frame = self.model.getFrameId(speed["frame"])
            jacobian = pin.computeFrameJacobian(self.model, self.data, q, frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)[:3]
            out.append((jacobian / speed["limit"], jacobian @ v / speed["limit"], 1.0))
        if c.get("energy"):
            root, radius = np.linalg.cholesky(mass).T, np.sqrt(2 * c["energy"]["limit"])
            out.append((root / radius, root @ v / radius, 1.0))
        return out


def rows_problem(robot, q, v, goal):
    """H, c, G, h, A, b over (z, s) with y = sigma z and a slack s for each soft row, in units of the largest velocity change."""
    sigma, n = robot.most * robot.dt, robot.n
    lower, upper = robot.box(q, v)
    _, torque, torque_h = robot.torque_rows(q, v)
    a, b, user, user_h, soft = robot.user_rows(v)
    m = len(soft)
    hessian = np.diag(np.concatenate([2 * sigma**2, [robot.worth * s[4] for s in soft]])) / robot.worth
    c = np.concatenate([-2 * sigma * goal, [robot.worth * s[3] for s in soft]]) / robot.worth
    wide = lambda g: np.hstack([np.reshape(g, (-1, n)) * sigma, np.zeros((len(g), m))])  # noqa: E731
    g = [np.hstack([np.eye(n), np.zeros((n, m))]), -np.hstack([np.eye(n), np.zeros((n, m))]), wide(torque), wide(user)]
    h = [upper / sigma, -lower / sigma, torque_h, user_h]
    for k, (row, low, high, _, _) in enumerate(soft):
        for sign, bound in ((1, high), (-1, -low)):
            g.append(np.concatenate([sign * row * sigma, [-float(j == k) for j in range(m)]])[None])
            h.append([bound])
    g.append(np.hstack([np.zeros((m, n)), -np.eye(m)]))
    h.append(np.zeros(m))
    return sigma, hessian, c, np.vstack(g), np.concatenate(h), wide(a), b


def by_quadprog(problem):
    sigma, hessian, c, g, h, a, b = problem
    x = quadprog.solve_qp(hessian, -c, np.vstack([a, -g]).T, np.concatenate([b, -h]), len(b))[0]
    return sigma * x[: len(sigma)]


def by_proxsuite(problem):
    sigma, hessian, c, g, h, a, b = problem
    result = proxsuite.proxqp.dense.solve(hessian, c, a, b, g, np.full(len(h), -1e20), h, eps_abs=1e-12, eps_rel=0.0, max_iter=100_000)
    if result.info.status != proxsuite.proxqp.QPSolverOutput.PROXQP_SOLVED:
        return None
    return sigma * result.x[: len(sigma)]


def by_ecos(robot, q, v, goal):
    """min t s.t. |y - goal| <= t, box, torque rows and cones, over (t, z) with y = goal + scale z."""
    lower, upper = robot.box(q, v)
    mass, torque, torque_h = robot.torque_rows(q, v)
    n, scale = robot.n, robot.most.max() * robot.dt
    linear = np.vstack([np.eye(n), -np.eye(n), torque])
    h = np.concatenate([upper, -lower, torque_h]) - linear @ goal
    size = np.abs(linear).max(axis=1) * scale
    blocks, rights, dims = [np.hstack([np.zeros((len(h), 1)), linear * scale / size[:, None]])], [h / size], []
    blocks.append(-np.eye(n + 1))
    rights.append(np.zeros(n + 1))
    dims.append(n + 1)
    for matrix, constant, radius in robot.cones(q, v, mass):
        blocks.append(np.vstack([np.zeros(n + 1), np.hstack([np.zeros((len(matrix), 1)), -matrix * scale])]))
        rights.append(np.concatenate([[radius], matrix @ goal + constant]))
        dims.append(len(matrix) + 1)
    objective = np.concatenate([[1.0], np.zeros(n)])
    result = ecos.solve(objective, sparse.csc_matrix(np.vstack(blocks)), np.concatenate(rights), {"l": len(h), "q": dims},
                        verbose=False, abstol=1e-13, reltol=1e-13, feastol=1e-12, max_iters=200)  # fmt: skip
    return goal + scale * result["x"][1:] if result["info"]["exitFlag"] in (0, 10) else None


def polished(robot, q, v, goal, y):
    """Newton's method on the optimality conditions from ECOS' answer on: quadprog with the cones linearised, and their curvature."""
    lower, upper = robot.box(q, v)
    mass, torque, torque_h = robot.torque_rows(q, v)
    n, cones, sigma = robot.n, robot.cones(q, v, mass), robot.most * robot.dt
    nu = np.zeros(len(cones))
    for _ in range(30):
        hessian, slopes, rooms = 2 * np.eye(n), [], []
        for k, (matrix, constant, radius) in enumerate(cones):
            point = matrix @ y + constant
            norm = np.linalg.norm(point)
            slopes.append(matrix.T @ point / norm)
            rooms.append(radius - norm)
            hessian += nu[k] * (matrix.T @ matrix - np.outer(slopes[k], slopes[k])) / norm
        g = np.vstack([np.eye(n), -np.eye(n), torque, *slopes]) * sigma
        h = np.concatenate([upper - y, y - lower, torque_h - torque @ y, rooms])
        scaled = hessian * np.outer(sigma, sigma) / robot.worth
        step, _, _, _, multipliers, _ = quadprog.solve_qp(scaled, -2 * sigma * (y - goal) / robot.worth, -g.T, -h)
        y, nu = y + sigma * step, multipliers[len(h) - len(cones) :] * robot.worth
        if np.linalg.norm(sigma * step) < 1e-14:
            break
    return y


def compare(path):
    results, robot, here = [], None, None
    for text in Path(path).open():
        line = json.loads(text)
        if "robot" in line:
            robot, here = Robot(line), {"quadprog": [], "proxsuite": [], "ECOS": [], "ECOS, polished": [], "gave up": 0, "kinds": {}, "rungs": {}}
            results.append((line["robot"], line["kind"], here))
            continue
        q, v, q_hat, v_hat, answer = (np.array(line[k]) for k in ("q", "v", "q_hat", "v_hat", "answer"))
        goal = ((q_hat - q - robot.dt * v) / robot.dt + v_hat - v) / 2
        if robot.head["kind"] == "rows":
            problem = rows_problem(robot, q, v, goal)
            optima = {"quadprog": by_quadprog(problem), "proxsuite": by_proxsuite(problem)}
        else:
            start = by_ecos(robot, q, v, goal)
            optima = {"ECOS": start, "ECOS, polished": None if start is None else polished(robot, q, v, goal, start)}
        for name, y in optima.items():
            if y is None:
                here["gave up"] += 1
            else:
                here[name].append(np.linalg.norm(answer - v - y))
        for kind in set(line["active"]):
            here["kinds"][kind] = here["kinds"].get(kind, 0) + 1
        here["rungs"][line["rung"]] = here["rungs"].get(line["rung"], 0) + 1
    return results


def main() -> None:
    print("| robot | problems | solved by | solver | problems | furthest [rad/s] | median [rad/s] | limits active in |")
    print("|---|---|---|---|---|---|---|---|")
    for robot, kind, here in compare(sys.argv[1]):
        kinds = ", ".join(f"{k} {n}" for k, n in sorted(here["kinds"].items()))
        rungs = ", ".join(f"{k} {n}" for k, n in sorted(here["rungs"].items()))
        for solver in ("quadprog", "proxsuite", "ECOS", "ECOS, polished"):
            d = here[solver]
            if d:
                print(f"| {robot} | {kind} | {rungs} | {solver} | {len(d)} | {max(d):.1e} | {np.median(d):.1e} | {kinds} |")
        if here["gave up"]:
            print(f"| {robot} | {kind} | | gave up | {here['gave up']} | | | |")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main()
