"""A film of a flight log of the walking ANYmal: the states that the plant told, drawn by MuJoCo without a screen.

    MUJOCO_GL=egl .venv/bin/python results/walk/film.py LOG OUT.webp [FROM [SECONDS]]
"""

import json
import os
import sys
from pathlib import Path

os.environ.setdefault("MUJOCO_GL", "egl")

import mujoco
import numpy as np
from mcap.reader import make_reader
from PIL import Image

URDF = Path(__file__).parents[2] / "examples/robots/anymal/anymal.urdf"
FPS, DT, SIZE = 25, 0.005, (400, 260)


def scene() -> mujoco.MjModel:
    """The robot of the file on a floor of squares, its base floating."""
    spec = mujoco.MjSpec.from_file(str(URDF))
    spec.visual.global_.offwidth, spec.visual.global_.offheight = SIZE
    spec.add_texture(
        name="squares",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=[0.93, 0.93, 0.93],
        rgb2=[0.8, 0.83, 0.86],
        width=256,
        height=256,
    )
    floor = spec.add_material(name="squares", texrepeat=[2, 2], texuniform=True)
    floor.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "squares"
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[20, 20, 1], material="squares")
    spec.worldbody.add_light(pos=[0, 0, 5], dir=[0.2, 0.3, -1], type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
    base = spec.worldbody.first_body()
    base.add_freejoint()
    for leg in ("LF", "RF", "LH", "RH"):
        spec.body(f"{leg}_FOOT").add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.03, 0, 0], pos=[0, 0, 0.0225], rgba=[0.1, 0.1, 0.1, 1])
    return spec.compile()


def main(log: str, out: str, start: float = 0.0, seconds: float = 8.0) -> None:
    with open(log, "rb") as stream:
        states = [json.loads(message.data)["state"]["q"] for _, _, message in make_reader(stream).iter_messages(topics=["tick"])]
    with open(log, "rb") as stream:
        joints = next(r.metadata["joints"] for r in make_reader(stream).iter_metadata() if "joints" in r.metadata).split(",")[1:]
    model = scene()
    data = mujoco.MjData(model)
    camera = mujoco.MjvCamera()
    camera.type, camera.distance, camera.azimuth, camera.elevation = mujoco.mjtCamera.mjCAMERA_FREE, 2.6, 130.0, -18.0
    places = [int(model.joint(name).qposadr[0]) for name in joints]
    frames = []
    with mujoco.Renderer(model, SIZE[1], SIZE[0]) as renderer:
        for q in states[round(start / DT) : round((start + seconds) / DT) : round(1 / FPS / DT)]:
            x, y, z, qx, qy, qz, qw = q[:7]
            data.qpos[:7] = [x, y, z, qw, qx, qy, qz]
            data.qpos[places] = q[7:]
            mujoco.mj_forward(model, data)
            camera.lookat[:] = np.array([x, y, 0.4])
            renderer.update_scene(data, camera)
            frames.append(Image.fromarray(renderer.render()))
    frames[0].save(out, save_all=True, append_images=frames[1:], duration=1000 // FPS, loop=0, quality=60, method=4)
    print(f"{len(frames)} frames in {out}")


if __name__ == "__main__":
    if len(sys.argv) not in (3, 4, 5):
        sys.exit(__doc__)
    main(sys.argv[1], sys.argv[2], *map(float, sys.argv[3:]))
