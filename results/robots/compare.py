"""Reads the same files with our reader and compares: writes runs.jsonl and table.md beside this script.

    .venv/bin/python results/robots/compare.py FOLDER REFERENCES      # REFERENCES is what reference.py printed of FOLDER; run.sh does both
"""

import json
import pathlib
import sys

import numpy as np

import nearl

HERE = pathlib.Path(__file__).parent


def off(ours: np.ndarray, theirs: np.ndarray) -> float:
    return float(np.abs(ours - theirs).max() / max(1e-3, np.abs(theirs).max()))


def compare(path: pathlib.Path, theirs: dict) -> dict:
    row = {"file": theirs["file"], "theirs": theirs.get("refused", "loads")}
    try:
        model = nearl.Model.from_urdf(path, free_flyer=theirs.get("floating", False))
    except (ValueError, OSError) as error:
        return {**row, "ours": str(error).replace(str(path), path.name)}
    row |= {"ours": "loads", "nv": model.nv, "floating": theirs.get("floating", False), "notes": model.notes}
    if "refused" in theirs:
        return row
    if model.joint_names != theirs["joints"] or (model.nq, model.nv) != (theirs["nq"], theirs["nv"]):
        return {**row, "different": "joints"}
    def limits(q: int, v: int) -> list[float]:
        return [model.lower_position_limit[q], model.upper_position_limit[q], model.velocity_limit[v], model.effort_limit[v]]

    unlike = [name for name, (q, v, *limit) in theirs["limits"].items() if limits(q, v) != limit]
    row |= {"limits": len(theirs["limits"]), "unlike": unlike}
    worst = {"mass": 0.0, "nle": 0.0}
    for state in theirs["states"]:
        mass = np.array(state["mass"]).reshape(model.nv, model.nv)
        worst["mass"] = max(worst["mass"], off(model.mass_matrix(state["q"]), mass))
        worst["nle"] = max(worst["nle"], off(model.nle(state["q"], state["v"]), np.array(state["nle"])))
    return row | worst


def reasons(row: dict) -> list[str]:
    """Why a file is refused, one by one, in the program's own words."""
    name = pathlib.Path(row["file"]).name
    return row["ours"].removeprefix(f"{name} holds impossible numbers: ").removesuffix("; correct them in the file").split("; ")


def table(rows: list[dict]) -> str:
    loads = [r for r in rows if r["ours"] == "loads"]
    compared = [r for r in loads if "mass" in r]
    worst = max(max(r["mass"], r["nle"]) for r in compared)
    lines = [
        f"{len(rows)} URDFs of example-robot-data 6.0.0: {len(loads)} load, {len(compared)} of them are compared with Pinocchio 4.1.0's own",
        f"parser (mass matrix, non-linear effects at three random states): the largest difference is {worst:.1e} of the largest entry.",
        f"Limits of position, speed and effort are compared for {sum(r['limits'] for r in compared)} joints; {sum(len(r['unlike']) for r in compared)} differ.",
        "", "Refused:", "", "| file | why |", "|---|---|",
    ]
    lines += [f"| {r['file']} | {why} |" for r in rows if r["ours"] != "loads" for why in reasons(r)]
    lines += ["", "Loaded:", "", "| file | dofs | mass matrix | nle | limits that differ | notes |", "|---|---|---|---|---|---|"]
    for r in loads:
        numbers = [f"{r[k]:.0e}" if k in r else (r.get("different") or "refused by Pinocchio") for k in ("mass", "nle")]
        dofs = f"{r['nv']}{' (floating base)' if r['floating'] else ''}"
        counts = [len(r.get(k, [])) or "" for k in ("unlike", "notes")]
        lines.append(f"| {r['file']} | {dofs} | {numbers[0]} | {numbers[1]} | {counts[0]} | {counts[1]} |")
    return "\n".join(lines) + "\n"


if len(sys.argv) != 3:
    sys.exit(__doc__)
root, references = pathlib.Path(sys.argv[1]), pathlib.Path(sys.argv[2]).read_text().splitlines()
rows = [compare(root / theirs["file"], theirs) for theirs in map(json.loads, references)]
(HERE / "runs.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
(HERE / "table.md").write_text(table(rows))
print((HERE / "table.md").read_text())
