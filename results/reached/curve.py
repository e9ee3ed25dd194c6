"""What limits on speed cost a gait that was learned without them: return behind the guard, by how tight they are.

    python results/reached/curve.py TASK SNAPSHOT... > results/reached/curve.csv

A joint's limit is a share of the fastest it goes in five episodes of the policy alone (of its 999th thousandth, so that no single blow decides). With the
share the columns say: the ticks in which the guard put another action in the policy's place, and after which the robot was outside; the median and the
lowest return of five episodes, and what the median is of that without a guard. `stops` are the joints' ranges alone.
"""

import pathlib
import sys

import gymnasium
import numpy as np

import nearl

SHARES = (1.5, 1.2, 1.0, 0.9, 0.8, 0.7, 0.6, 0.5)
EPISODES = 5


def play(env: gymnasium.Env, controller: nearl.Controller, episodes: int) -> tuple[list[float], list[dict], np.ndarray]:
    """Returns, each step's info and the joints' velocities (ticks x nv)."""
    returns, infos, speeds = [], [], []
    for seed in range(200, 200 + episodes):
        obs, over, total = env.reset(seed=seed)[0], False, 0.0
        controller.reset()
        while not over:
            obs, reward, terminated, truncated, info = env.step(np.clip(np.asarray(controller.act(obs), np.float32), -1, 1))
            speeds.append(env.unwrapped.data.qvel.copy())
            infos.append(info)
            total, over = total + float(reward), terminated or truncated
        returns.append(total)
    return returns, infos, np.array(speeds)


def main(task: str, *snapshots: str) -> None:
    print("task,policy,limits,ticks,replaced,outside,median_return,lowest,of_unguarded", flush=True)
    for path in snapshots:
        controller = nearl.Controller.load(path)
        returns, _, speeds = play(gymnasium.make(task), controller, EPISODES)
        alone, name = np.median(returns), pathlib.Path(path).parts[-3]
        model = gymnasium.make(task).unwrapped.model
        joints = {model.joint(i).name: int(model.jnt_dofadr[i]) for i in range(model.njnt) if model.jnt_limited[i]}
        fastest = {joint: float(np.quantile(np.abs(speeds[:, dof]), 0.999)) for joint, dof in joints.items()}
        print(f"{task},{name},none,{len(speeds)},0,0,{alone:.1f},{min(returns):.1f},1.000", flush=True)
        kinds = {"stops": {"position": {}}}
        kinds |= {f"{share}": {"velocity": {"limit": {joint: share * speed for joint, speed in fastest.items()}}} for share in SHARES}
        for kind, limits in kinds.items():
            returns, infos, _ = play(nearl.Guard(gymnasium.make(task), limits), controller, EPISODES)
            verdicts = [info["guard"] for info in infos]
            row = [len(verdicts), verdicts.count("replaced"), verdicts.count("outside")]
            print(f"{task},{name},{kind},{','.join(map(str, row))},{np.median(returns):.1f},{min(returns):.1f},{np.median(returns) / alone:.3f}", flush=True)


if __name__ == "__main__":
    if len(sys.argv) < 3:
        sys.exit(__doc__)
    main(*sys.argv[1:])
