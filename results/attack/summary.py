"""The worst of each kind in z1.md and ur10.md, as summary.md: python results/attack/summary.py [FOLDER], results/attack unless given."""

import sys
from pathlib import Path

HERE = Path(__file__).parent


def rows(file: Path) -> list[list[str]]:
    """The cells of a table's lines, without its head."""
    lines = [line for line in file.read_text().splitlines() if line.startswith("| ")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[1:]]


def share(cells: list[list[str]], column: int) -> str:
    """The mean of a column in percent."""
    return f"{sum(float(c[column].split()[0]) for c in cells) / len(cells):.1f} %"


def main(folder: Path) -> None:
    """Writes summary.md."""
    out = ["| limits | robot | ticks | over | worst excess | slowed | braked |", "|---|---|---|---|---|---|---|"]
    total = over = 0
    for robot in ("z1", "ur10"):
        of: dict[str, list[list[str]]] = {}
        for cells in rows(folder / f"{robot}.md"):
            of.setdefault(cells[0], []).append(cells)
        for kind, cells in of.items():
            ticks, beyond = sum(int(c[3]) for c in cells), sum(int(c[4]) for c in cells)
            worst = max(float(c[5]) for c in cells)
            total, over = total + ticks, over + beyond
            kind = kind.replace("+", ", ")
            out.append(f"| {kind} | {robot} | {ticks} | {beyond} | {worst:.1e} | {share(cells, 6)} | {share(cells, 7)} |")
    (folder / "summary.md").write_text("\n".join(out) + f"\n\n{total} ticks, {over} over.\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else HERE)
