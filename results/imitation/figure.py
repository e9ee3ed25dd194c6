"""The data, table and figure of runs with evaluations on the way: `curves.csv`, `table.md`, `figure.png`.

    .venv/bin/python results/imitation/figure.py RUNS FOLDER --experts EXPERTS [--variants]

RUNS has `<task>/<algo>_<seed>`, or with --variants `<variant>/<task>/<algo>_<seed>`. Returns are without noise and from ordinary resets. Seeds that
RUNS does not have stay what they are in the data of FOLDER. The table there has one mean of two columns over all seeds: where RUNS has some of these seeds
and not all, nothing can be told apart, and what RUNS has goes to RUNS, by itself.
"""

import argparse
import csv
import json
import sys
from collections import defaultdict
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import numpy as np
from matplotlib import pyplot as plt

from nearl.curves import bootstrap_band, interquartile_mean

RETURN, R2, UPDATED = "eval/ep_rew_mean", "idm/r2_before", "idm/updated"


def read(runs: Path, variants: bool) -> dict[tuple[str, str], dict[int, dict[str, np.ndarray]]]:
    """Columns of each finished run, by task and name, then by seed."""
    found: dict = defaultdict(dict)
    for file in sorted(runs.glob(f"{'*/' if variants else ''}*/*_*/metrics.csv")):
        if not (file.parent / "checkpoints" / "final.safetensors").is_file():
            continue
        name, seed = file.parent.name.rsplit("_", 1)
        if variants:
            name = file.parents[2].name
        with open(file) as text:
            rows = list(csv.DictReader(text))
        number = lambda cell: float(cell) if cell else np.nan  # noqa: E731
        columns = {k: np.array([number(row[k]) for row in rows]) for k in ("time/total_timesteps", RETURN, R2, UPDATED)}
        found[file.parents[1].name, name][int(seed)] = columns
    return found


def curve(columns: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Steps and returns where there was an evaluation."""
    there = np.isfinite(columns[RETURN])
    return columns["time/total_timesteps"][there], columns[RETURN][there]


def mean(columns: list[np.ndarray]) -> float:
    """Over everything that was measured; NaN where nothing was."""
    values = np.concatenate(columns)
    values = values[np.isfinite(values)]
    return float(values.mean()) if len(values) else float("nan")


def kept(folder: Path, found: set[tuple[str, str, str]]) -> tuple[list[dict], dict[tuple[str, str], list[str]]]:
    """Rows of the curves that are there already, of other tasks, names and seeds than `found`, and the cells of the table by task and name."""
    if not (folder / "curves.csv").is_file():
        return [], {}
    with open(folder / "curves.csv", newline="") as text:
        rows = [row for row in csv.DictReader(text) if (row["task"], row["name"], row["seed"]) not in found]
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in (folder / "table.md").read_text().splitlines()[2:]]
    return rows, {(cells[0], cells[1]): cells[2:] for cells in lines}


def together(new: list[float], n_kept: int, cells: list[str], place: int) -> float:
    """Mean of a column over the seeds that were measured now and those that were before, of which the table has the mean; all have equally many rows."""
    before = float(cells[place] or "nan") if n_kept else 0.0
    return (sum(new) + n_kept * before) / (len(new) + n_kept)


def divided(rows: list[dict], table: dict[tuple[str, str], list[str]], found: dict) -> str:
    """Of which task and name some of the seeds in the table would stay and others not; empty where there is none."""
    for task, name in found:
        stay = len({row["seed"] for row in rows if (row["task"], row["name"]) == (task, name)})
        if stay and int(table[task, name][0]) != stay:
            return f"{task}, {name}: {stay} of {table[task, name][0]} seeds"
    return ""


def panels(rows: list[dict], variants: bool) -> dict[str, dict]:
    """Curves of each panel, by its title, then by name and seed: a panel for each task, of variants one for the inverse models and one for the parts."""
    found: dict = defaultdict(lambda: defaultdict(lambda: defaultdict(list)))
    for row in rows:
        prior = row["name"].startswith(("right", "full", "missing"))
        titles = {row["task"]}
        if variants:
            titles = {f"{row['task']}: {what}" for what, is_there in (("inverse model", prior), ("parts", not prior or row["name"] == "right_0.5")) if is_there}
        for title in titles:
            found[title][row["name"]][row["seed"]].append((int(row["steps"]), float(row["return"])))
    return found


def draw(rows: list[dict], expert: dict[str, float], file: Path, variants: bool) -> None:
    """Interquartile means over the seeds and their bands."""
    found = panels(rows, variants)
    across = min(len(found), 2)
    figure, axes = plt.subplots(-(-len(found) // across), across, figsize=(5.2 * across, 3.8 * -(-len(found) // across)), squeeze=False)
    for axis, (title, names) in zip(axes.flat, sorted(found.items())):
        for name, seeds in sorted(names.items()):
            n = min(len(points) for points in seeds.values())
            steps = [x for x, _ in next(iter(seeds.values()))[:n]]
            values = np.array([[y for _, y in points[:n]] for points in seeds.values()])
            (line,) = axis.plot(steps, interquartile_mean(values), label=f"{name} ({len(values)})")
            if len(values) > 1:
                axis.fill_between(steps, *bootstrap_band(values), color=line.get_color(), alpha=0.15, lw=0)
        axis.axhline(expert[title.split(":")[0]], color="black", lw=0.8, ls="--", label="expert")
        axis.set(title=title, xlabel="steps", ylabel="return without noise")
        axis.legend(fontsize=7)
    for axis in axes.flat[len(found) :]:
        axis.set_visible(False)
    figure.tight_layout()
    figure.savefig(file, dpi=100)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("runs", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--experts", type=Path, required=True)
    parser.add_argument("--variants", action="store_true")
    args = parser.parse_args()
    found = read(args.runs, args.variants)
    for (task, name), seeds in found.items():
        for seed in [seed for seed, columns in seeds.items() if not len(curve(columns)[0])]:
            print(f"{task}, {name}, seed {seed}: no evaluation, left out", file=sys.stderr)
            del seeds[seed]
    found = {key: seeds for key, seeds in found.items() if seeds}
    if not found:
        sys.exit(f"no finished run in {args.runs} has an evaluation, the first of which is after train.eval_every steps: give more steps")
    expert = {file.stem: float(np.mean(json.loads(file.read_text())["returns"])) for file in args.experts.glob("*.json")}
    rows, table = kept(args.folder, {(task, name, str(seed)) for (task, name), seeds in found.items() for seed in seeds})
    if of := divided(rows, table, found):
        print(f"{args.folder} has one mean over all seeds, and of these would stay {of}: what was measured now goes to {args.runs}", file=sys.stderr)
        args.folder, rows, table = args.runs, [], {}
    args.folder.mkdir(parents=True, exist_ok=True)
    lines = []
    for (task, name), seeds in found.items():
        for seed, (xs, ys) in ((seed, curve(columns)) for seed, columns in seeds.items()):
            rows += [{"task": task, "name": name, "seed": seed, "steps": int(x), "return": f"{y:.5g}"} for x, y in zip(xs, ys)]
    for task, name in sorted({(row["task"], row["name"]) for row in rows}):
        by_seed: dict = defaultdict(list)
        for row in rows:
            if (row["task"], row["name"]) == (task, name):
                by_seed[row["seed"]].append(float(row["return"]))
        n = min(len(returns) for returns in by_seed.values())
        values = np.stack([returns[:n] for returns in by_seed.values()])
        new = list(found.get((task, name), {}).values())
        n_kept, cells = len(values) - len(new), table.get((task, name), [])
        r2, updated = (together([mean([columns[k]]) for columns in new], n_kept, cells, place) for k, place in ((R2, 5), (UPDATED, 6)))
        centre = interquartile_mean(values)
        speed, half, end = interquartile_mean(values.mean(axis=1)), centre[(n - 1) // 2], centre[-1]
        share = end / expert[task]
        model = " | ".join("" if np.isnan(value) else f"{value:.2f}" for value in (r2, updated))
        lines.append(f"| {task} | {name} | {len(values)} | {speed:.0f} | {half:.0f} | {end:.0f} | {share:.2f} | {model} |")
    draw(rows, expert, args.folder / "figure.png", args.variants)
    with open(args.folder / "curves.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(sorted(rows, key=lambda row: (row["task"], row["name"], int(row["seed"]), int(row["steps"]))))
    head = "| task | | seeds | mean over the run | at its half | at its end | share of the expert | R² of the inverse model | it learned by itself |"
    (args.folder / "table.md").write_text("\n".join([head, "|---|---|---|---|---|---|---|---|---|", *sorted(lines)]) + "\n")


if __name__ == "__main__":
    main()
