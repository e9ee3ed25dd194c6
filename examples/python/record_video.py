"""Gymnasium's own RecordVideo on a NEARL environment, without a screen. Needs `pip install moviepy`."""

import sys

import gymnasium
from gymnasium.wrappers import RecordVideo

import nearl  # noqa: F401  # registers the environments

try:
    import moviepy  # noqa: F401
except ImportError as error:
    raise SystemExit(f"record_video.py needs MoviePy, but {error}: pip install moviepy") from None

folder = sys.argv[1] if len(sys.argv) > 1 else "runs/videos"
env = RecordVideo(gymnasium.make("nearl/Hopper-v5", render_mode="rgb_array"), folder, episode_trigger=lambda episode: episode == 0)
env.reset(seed=0)
over = False
while not over:
    _, _, terminated, truncated, _ = env.step(env.action_space.sample())
    over = terminated or truncated
env.close()
print("wrote", folder)
