"""A running loop, or a training, in a browser: the robot, its proposals as a ghost, and what holds each joint back.

    nearl run examples/snapshots/panda-reach.safetensors --plant arm
    nearl view arm                             # then open http://localhost:8080
    nearl view runs/HalfCheetah-v5/pid2-ib_0   # the newest policy of a training, without exploration

What is drawn is what the loop sends in every tick: state, proposal, target, active rows with their multipliers, mode, ledger and times.
The loop does not wait for it, and sends nothing where nobody looks.
"""

from nearl.view.figure import Figure, led, qpos_of
from nearl.view.panel import Panel
from nearl.view.show import Page, view
from nearl.view.sources import Held, Loop, Picture, Robot, ViewError
from nearl.view.training import Training

__all__ = ["Figure", "Held", "Loop", "Page", "Panel", "Picture", "Robot", "Training", "ViewError", "led", "qpos_of", "view"]
