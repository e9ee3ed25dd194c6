"""Train PID²-IB on a task of one's own, with a callback, and use the policy."""

import gymnasium
import numpy as np

import nearl


def progress(agent: nearl.PID2, metrics: dict[str, float]) -> bool:
    """Called after each update; False would end the training."""
    print(f"{agent.num_timesteps:6d} steps, return {metrics.get('rollout/ep_rew_mean', np.nan):.1f}")
    return True


task = "examples/tasks/cart-pole.toml"
agent = nearl.PID2(task, algo="pid2-ib", seed=0, settings={"train.n_steps": 512}).learn(16_384, callback=progress)

env = gymnasium.make(nearl.register(task)[0])
obs, _ = env.reset(seed=0)
over, steps, state = False, 0, None
while not over:
    action, state = agent.predict(obs, state)
    obs, _, terminated, truncated, _ = env.step(action.astype(np.float32))
    over, steps = terminated or truncated, steps + 1
print(f"the pole stood for {steps} periods")
