"""Prints what Pinocchio's own parser makes of every URDF below a folder: joints, limits, and dynamics at three random states, one JSON line each.

    python results/robots/reference.py FOLDER > REFERENCES      # run.sh does both
"""

import json
import pathlib
import sys

import numpy as np
import pinocchio as pin

STATES = 3


def robot(path: pathlib.Path) -> dict:
    try:
        model = pin.buildModelFromUrdf(str(path))
        floating = model.nv == 0  # a body that flies: without a floating base nothing of it moves
        if floating:
            model = pin.buildModelFromUrdf(str(path), pin.JointModelFreeFlyer())
    except Exception as error:  # whatever it throws is its answer
        return {"refused": str(error).splitlines()[0].replace(str(path), path.name)}
    data, rng, states = model.createData(), np.random.default_rng(5), []
    for _ in range(STATES):
        q = pin.integrate(model, pin.neutral(model), rng.uniform(-1, 1, model.nv))
        v = rng.normal(size=model.nv)
        mass = pin.crba(model, data, q)
        mass = np.triu(mass) + np.triu(mass, 1).T
        states.append({"q": q.tolist(), "v": v.tolist(), "mass": mass.ravel().tolist(),
                       "nle": pin.nonLinearEffects(model, data, q, v).tolist()})
    limits = {}
    for name, joint in zip(list(model.names)[1:], list(model.joints)[1:]):
        if joint.nq == joint.nv == 1:
            q, v = joint.idx_q, joint.idx_v
            of = (model.lowerPositionLimit[q], model.upperPositionLimit[q], model.upperVelocityLimit[v], model.upperEffortLimit[v])
            limits[name] = [q, v, *map(float, of)]
    return {"floating": floating, "limits": limits, "joints": list(model.names)[1:], "nq": model.nq, "nv": model.nv, "states": states}


if len(sys.argv) != 2:
    sys.exit(__doc__)
root = pathlib.Path(sys.argv[1])
for path in sorted(root.rglob("*.urdf")):
    print(json.dumps({"file": str(path.relative_to(root)), **robot(path)}))
