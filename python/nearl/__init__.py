"""NEARL: a policy proposes a next state, a projector makes it safe, inverse dynamics makes it happen.

    import nearl

    model = nearl.Model.from_urdf("panda.urdf")
    limits = [nearl.PositionLimit(model), nearl.VelocityLimit(model), nearl.AccelerationLimit(model, 10.0)]
    projector = nearl.Projector(model, limits, dt=1e-3)
    target = projector.project(q, v, q_proposal, v_proposal)

With Gymnasium installed, importing this module registers ``nearl/HalfCheetah-v5`` and its like, and ``nearl.make_vec`` makes
vectors of them.
"""

from nearl import limits as _limits
from nearl._core import (
    Controller,
    Ledger,
    Limit,
    Model,
    Policy,
    Projector,
    Target,
    Targets,
    __version__,
    algorithms,
    tasks,
)
from nearl.importers import import_onnx, import_sb3, import_torch
from nearl.limits import *  # noqa: F403
from nearl.link import Link
from nearl.pid2 import PID2
from nearl.plant import Loop, Plant
from nearl.proposer import Proposer, blank
from nearl.ranks import Ranks

__all__ = [
    "Controller",
    "Ledger",
    "Limit",
    "Link",
    "Loop",
    "Model",
    "PID2",
    "Plant",
    "Policy",
    "Projector",
    "Proposer",
    "Ranks",
    "Target",
    "Targets",
    "__version__",
    "algorithms",
    "blank",
    "import_onnx",
    "import_sb3",
    "import_torch",
    "tasks",
]
__all__ += _limits.__all__

try:
    import gymnasium as _gymnasium  # noqa: F401
except ImportError:  # the extra [train] is not installed
    def __getattr__(name: str) -> object:
        if name in ("Env", "Guard", "ProjectedEnv", "VecEnv", "from_gymnasium", "make_vec", "register"):
            raise ImportError(f"nearl.{name} needs Gymnasium: pip install 'nearl[train]'")
        raise AttributeError(f"module 'nearl' has no attribute '{name}'")
else:
    from nearl.env import Env
    from nearl.from_gymnasium import from_gymnasium
    from nearl.guard import Guard
    from nearl.projected import ProjectedEnv
    from nearl.registration import register
    from nearl.vector import VecEnv, make_vec

    __all__ += ["Env", "Guard", "ProjectedEnv", "VecEnv", "from_gymnasium", "make_vec", "register"]
    register()
