"""``nearl report``."""

import argparse
import sys
import warnings
from pathlib import Path
from typing import Any

from nearl.report import build
from nearl.report.read import ReadError


def main(arguments: list[str] | None = None) -> int:
    """Writes the report; 0 on success, 1 with one sentence on standard error otherwise."""
    parser = argparse.ArgumentParser(prog="nearl report", description="One HTML page about runs and flights.")
    several: dict[str, Any] = {"action": "extend", "nargs": "+", "type": Path, "default": []}
    parser.add_argument("sweeps", metavar="DIR", nargs="*", type=Path, help="folders of many runs, as 'nearl sweep' makes them: one figure, also as a PNG")
    parser.add_argument("--run", metavar="RUN_FOLDER", help="run folders of 'nearl train'; seeds of one task and algorithm share a curve", **several)
    parser.add_argument("--log", metavar="FILE.mcap", help="flight logs of 'nearl run --log'", **several)
    parser.add_argument("--eval", metavar="FILE.json", help="output of 'nearl eval --json'", **several)
    parser.add_argument("--summary", metavar="FILE.json", help="output of 'nearl run --json', or summary.json of 'nearl demo'", **several)
    parser.add_argument("--demos", metavar="FILE.npz", help="demonstrations; those of a --run are shown anyway", **several)
    parser.add_argument("--task", help="name or file of the task whose robot the demonstrations are of, for pictures")
    parser.add_argument("--title", default="NEARL report", help="of the page")
    parser.add_argument("--out", type=Path, default=Path("report.html"), metavar="FILE.html", help="to write (default report.html)")
    given = parser.parse_args(arguments)
    try:
        with warnings.catch_warnings():
            warnings.showwarning = lambda message, *_, **__: print(f"nearl report: {message}", file=sys.stderr)
            build(given.out, runs=given.run, logs=given.log, evals=given.eval, summaries=given.summary, sweeps=given.sweeps, demos=given.demos,
                  task=given.task, title=given.title)  # fmt: skip
    except (ReadError, OSError, ImportError) as error:
        print(f"nearl report: {sentence(error, given.out)}", file=sys.stderr)
        return 1
    print(given.out)
    return 0


def sentence(error: Exception, out: Path) -> str:
    """What went wrong while a report into ``out`` was made."""
    if not isinstance(error, OSError) or error.filename is None:
        return str(error)
    path = Path(error.filename)
    if path in (out, out.with_suffix(".png"), *out.parents):
        return f"cannot write '{path}': {error.strerror}; give another place with --out"
    return f"cannot read '{path}': {error.strerror}"


if __name__ == "__main__":
    sys.exit(main())
