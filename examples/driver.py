"""A carriage of 2 kg on a rail, driven by a force: a complete driver. Usage: python driver.py NAME TICKS"""

import sys

import nearl


def main(name: str, ticks: int) -> int:
    dt, q, v, force = 0.001, 0.0, 0.0, 0.0  # the robot
    acted = braked = tick = 0
    farthest = fastest = 0.0
    with nearl.Plant(name, joints=["slide"], observation=["q.slide", "v.slide"], dt=dt, nu=1, watchdog=0.02, lockstep=True) as plant:
        while acted < ticks and braked < 100:
            # 1. measure, 2. ask
            turn, action = plant.exchange([q], [v], [q, v], patience=0.3, time=tick * dt, begins=tick == 0)
            if turn == "brake":  # 3. brake by itself
                force, braked = -2.0 * v / dt, braked + 1
            else:
                force, acted = action[0], acted + (turn == "act")
            v += dt * min(max(force, -40.0), 40.0) / 2.0  # 4. actuate
            q += dt * v
            farthest, fastest = max(farthest, abs(q)), max(fastest, abs(v))
            tick += 1
    print(f"{acted} {braked} {farthest:.6f} {fastest:.6f}")
    return 0 if acted == ticks else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], int(sys.argv[2])))
