"""A policy that somebody else trained, behind limits: Stable-Baselines3 on Gymnasium's Reacher, exported to ONNX by PyTorch."""

import sys

import gymnasium
import numpy as np

import nearl

FOLDER = "examples/policies"
# What it sees, what its outputs mean, and the limits stand in the recipe.
controller = nearl.import_onnx(f"{FOLDER}/reacher.onnx", robot=f"{FOLDER}/reacher.xml", recipe=f"{FOLDER}/reacher.toml", name="reacher")
controller.save(f"{sys.argv[1] if len(sys.argv) > 1 else 'runs'}/reacher.safetensors")  # for nearl run, nearl plant, nearl doctor
print(f"entries: {', '.join(controller.obs_names)}")

env, fastest, replaced, total = gymnasium.make("Reacher-v5"), 0.0, 0, 0.0
for seed in range(10):
    obs, _ = env.reset(seed=seed)
    controller.reset()
    over = False
    while not over:
        q, v = env.unwrapped.data.qpos, env.unwrapped.data.qvel  # [rad], [rad/s]; of the target [m], [m/s]
        cos_sin, target, away = obs[:4], obs[4:6], obs[8:10]
        control, ledger = controller.update(q, v, np.concatenate([q[:2], v[:2], cos_sin, target, away]))  # of the motors, -1 to 1
        replaced += ledger.moved > 0.0
        obs, reward, terminated, truncated, _ = env.step(control.astype(np.float32))
        over, total = terminated or truncated, total + float(reward)
        fastest = max(fastest, float(np.abs(env.unwrapped.data.qvel[:2]).max()))
print(f"return {total / 10:.2f}, {replaced} actions replaced, fastest joint {fastest:.4f} rad/s, allowed 2")
assert 1.5 < fastest <= 2.0 + 1e-3  # it moves, and its integrator and ours differ in the second order
