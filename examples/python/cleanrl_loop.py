"""CleanRL's loop on the native vector, with a learner of thirty lines in NumPy: evolution of a linear policy.

What a trainer meets is Gymnasium's VectorEnv: `reset`, `step`, `final_obs`, an autoreset mode that is stated.
"""

import numpy as np

import nearl

N_ENVS, GENERATIONS, SIGMA = 16, 5, 0.3
envs = nearl.make_vec("Hopper-v5", N_ENVS)
n_obs, n_act = envs.single_observation_space.shape[0], envs.single_action_space.shape[0]
rng, mean = np.random.default_rng(0), np.zeros((n_act, n_obs))

for generation in range(GENERATIONS):
    noise = rng.standard_normal((N_ENVS, n_act, n_obs))
    policies = mean + SIGMA * noise
    obs, _ = envs.reset(seed=generation)
    returns, alive = np.zeros(N_ENVS), np.ones(N_ENVS, bool)
    for _ in range(300):
        actions = np.tanh(np.einsum("eao,eo->ea", policies, obs)).astype(np.float32)
        obs, rewards, terminated, truncated, _ = envs.step(actions)
        returns += rewards * alive
        alive &= ~(terminated | truncated)
        if not alive.any():
            break
    advantage = (returns - returns.mean()) / (returns.std() + 1e-8)
    mean += 0.5 * SIGMA * np.einsum("e,eao->ao", advantage, noise) / N_ENVS
    print(f"generation {generation}: return {returns.mean():.1f}, best {returns.max():.1f}")
