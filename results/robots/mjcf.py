"""Reads the MJCF files of a folder with our reader and with MuJoCo and compares the equations of motion: writes mjcf/runs.jsonl and mjcf/table.md here.

    .venv/bin/python results/robots/mjcf.py FOLDER      # mjcf.sh does it with the packages
"""

import json
import pathlib
import sys

import mujoco
import numpy as np

import nearl

HERE = pathlib.Path(__file__).parent / "mjcf"


def compare(root: pathlib.Path, path: pathlib.Path) -> dict | None:
    """A line of the table; none where MuJoCo itself compiles no robot of the file."""
    try:
        simulated = mujoco.MjModel.from_xml_path(str(path))
    except ValueError:
        return None
    if simulated.nv == 0:
        return None
    row = {"file": str(path.relative_to(root)), "nv": simulated.nv, "motors": simulated.nu}
    try:
        model = nearl.Model.from_mjcf(path)
    except (ValueError, OSError) as error:
        return {**row, "ours": str(error).replace(str(root), "")}
    if (model.nq, model.nv) != (simulated.nq, simulated.nv):
        return {**row, "ours": "another number of joints"}
    data, mass, worst = mujoco.MjData(simulated), np.zeros((simulated.nv, simulated.nv)), 0.0
    rng = np.random.default_rng(0)
    for _ in range(3):
        data.qpos[:] = simulated.qpos0
        mujoco.mj_integratePos(simulated, data.qpos, 0.5 * rng.normal(size=simulated.nv), 1.0)
        data.qvel[:] = rng.normal(size=simulated.nv)
        mujoco.mj_forward(simulated, data)
        mujoco.mj_fullM(simulated, data, mass)
        qacc = 5.0 * rng.normal(size=simulated.nv)
        theirs = mass @ qacc + data.qfrc_bias
        q = model.q_from_mujoco(data.qpos)
        v = model.v_from_mujoco(q, data.qvel)
        ours = model.tau_to_mujoco(q, model.rnea(q, v, model.a_from_mujoco(q, v, qacc)))
        worst = max(worst, float(np.abs(ours - theirs).max() / max(1e-3, np.abs(theirs).max())))
    return {**row, "ours": "loads", "off": worst, "notes": model.notes}


def table(rows: list[dict]) -> str:
    loads = [row for row in rows if row["ours"] == "loads"]
    lines = [
        f"{len(rows)} MJCF files with joints that MuJoCo {mujoco.__version__} compiles: {len(loads)} load. The forces for a motion (`rnea`), at three random",
        f"states, differ by {max(row['off'] for row in loads):.1e} of the largest entry at most.",
        "",
        "| file | dofs | motors | forces | notes |",
        "|---|---|---|---|---|",
    ]
    for row in rows:
        result = f"{row['off']:.0e}" if row["ours"] == "loads" else row["ours"]
        lines.append(f"| {row['file']} | {row['nv']} | {row['motors'] or ''} | {result} | {len(row.get('notes', [])) or ''} |")
    return "\n".join(lines) + "\n"


if len(sys.argv) != 2:
    sys.exit(__doc__)
root = pathlib.Path(sys.argv[1]).resolve()
rows = [row for path in sorted(root.rglob("*.xml")) if (row := compare(root, path))]
HERE.mkdir(exist_ok=True)
(HERE / "runs.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
(HERE / "table.md").write_text(table(rows))
print("\n".join(table(rows).splitlines()[:2]))
