"""Stable-Baselines3's PPO on the native vector: an adapter of forty lines, faster than `make_vec_env` with single environments.
Needs `pip install stable-baselines3==2.9.2`."""

import sys

import numpy as np

import nearl

try:
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env.base_vec_env import VecEnv, VecEnvObs, VecEnvStepReturn
except ImportError as error:
    raise SystemExit(f"sb3_vec_env.py needs Stable-Baselines3, but {error}: pip install stable-baselines3==2.9.2") from None


class NearlVecEnv(VecEnv):
    """`nearl.make_vec` as SB3 wants it: same-step autoreset, one info a environment."""

    def __init__(self, task: str, n_envs: int, **arguments: object):
        self.envs = nearl.make_vec(task, n_envs, autoreset_mode="SameStep", **arguments)
        super().__init__(n_envs, self.envs.single_observation_space, self.envs.single_action_space)

    def reset(self) -> VecEnvObs:
        return self.envs.reset(seed=self._seeds[0])[0]

    def step_async(self, actions: np.ndarray) -> None:
        self.actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        obs, rewards, terminated, truncated, info = self.envs.step(self.actions)
        infos: list[dict] = [{"TimeLimit.truncated": bool(t and not d)} for t, d in zip(truncated, terminated)]
        for i in np.flatnonzero(terminated | truncated):
            infos[i]["terminal_observation"] = info["final_obs"][i]
        return obs, rewards, terminated | truncated, infos

    def close(self) -> None: ...

    def get_attr(self, name: str, indices: object = None) -> list:
        return [getattr(self.envs, name, None)] * self.num_envs

    def set_attr(self, name: str, value: object, indices: object = None) -> None:
        setattr(self.envs, name, value)

    def env_method(self, name: str, *arguments: object, indices: object = None, **named: object) -> list:
        return [getattr(self.envs, name)(*arguments, **named)]

    def env_is_wrapped(self, wrapper: type, indices: object = None) -> list[bool]:
        return [False] * self.num_envs


if __name__ == "__main__":
    steps = int(sys.argv[1]) if len(sys.argv) > 1 else 100_000
    model = PPO("MlpPolicy", NearlVecEnv("HalfCheetah-v5", 8), n_steps=256, seed=0, device="cpu")
    model.learn(steps)
    print(f"learned from {model.num_timesteps} steps")
