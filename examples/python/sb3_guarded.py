"""Stable-Baselines3 behind the limits: SAC or PPO, on the arm through proposals and on HalfCheetah through the guard.

    pip install stable-baselines3==2.9.2
    python examples/python/sb3_guarded.py sac arm 20000

Prints the return of three episodes and the control ticks that ended outside a limit, 0 on the arm. Without arguments, random actions alone.
"""

import sys

import gymnasium

import nearl

LIMITS = {"position": {}, "velocity": {"limit": 25.0}}


def make(robot: str) -> gymnasium.Env:
    """An environment whose actions are in [-1, 1] and never break a limit of the arm; of the cheetah, hardly ever."""
    if robot == "arm":
        return gymnasium.make("nearl/Panda-reach", constraints="task", actions="change")
    return nearl.Guard(gymnasium.make("HalfCheetah-v5"), LIMITS)


def outside(info: dict) -> int:
    """Ticks of a step that ended outside."""
    return int(info["target_violations"]) if "target_violations" in info else int(info["guard"] == "outside")


def run(env: gymnasium.Env, act, episodes: int) -> tuple[float, int]:
    """Mean return and ticks outside of some episodes under ``act(obs)``."""
    total, broken = 0.0, 0
    for episode in range(episodes):
        obs, over = env.reset(seed=episode)[0], False
        while not over:
            obs, reward, terminated, truncated, info = env.step(act(obs))
            total, broken, over = total + float(reward), broken + outside(info), terminated or truncated
    return total / episodes, broken


def main(algorithm: str = "random", robot: str = "arm", steps: str = "0") -> None:
    if algorithm != "random":
        try:
            import stable_baselines3
        except ImportError as error:
            raise SystemExit(f"sb3_guarded.py needs Stable-Baselines3, but {error}: pip install stable-baselines3==2.9.2") from None
    env = make(robot)
    mean, broken = run(env, lambda obs: env.action_space.sample(), 3)
    print(f"random actions on {robot}: return {mean:.1f}, {broken} ticks outside the limits")
    if algorithm == "random":
        return
    learner = {"sac": stable_baselines3.SAC, "ppo": stable_baselines3.PPO}[algorithm]
    model = learner("MlpPolicy", env, seed=0, device="cpu").learn(int(steps))
    mean, broken = run(env, lambda obs: model.predict(obs, deterministic=True)[0], 3)
    print(f"{algorithm} on {robot} after {steps} steps: return {mean:.1f}, {broken} ticks outside the limits")


if __name__ == "__main__":
    main(*sys.argv[1:])
