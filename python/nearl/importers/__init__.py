"""Policies made elsewhere, as controllers of this package.

    controller = nearl.import_onnx("policy.onnx", robot="go1.xml", recipe="go1.toml")
    controller.save("go1.safetensors")                 # for nearl run, nearl doctor, nearl plant

    model = stable_baselines3.PPO("MlpPolicy", "nearl/HalfCheetah-v5").learn(1_000_000)
    controller = nearl.import_sb3(model, task="HalfCheetah-v5")

Live objects are read, never files of theirs: the library that wrote a file loads it, and its weights come over as arrays.
"""

from nearl.importers.onnx import import_onnx
from nearl.importers.sb3 import import_sb3
from nearl.importers.torch import import_torch

__all__ = ["import_onnx", "import_sb3", "import_torch"]
