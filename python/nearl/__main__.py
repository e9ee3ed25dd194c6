"""The ``nearl`` command: the program that comes inside this package, in place of the Python that started it."""

import os
import sys
from pathlib import Path

PROGRAM = Path(__file__).parent / "bin" / "nearl"


def main() -> None:
    """Becomes the program, with the arguments of this command line; ``nearl demo`` draws its report with this very Python.

    ``nearl view`` is Python: it shows a running loop or a training in a browser.
    """
    if sys.argv[1:2] == ["view"]:
        from nearl.view.__main__ import main as view

        sys.exit(view(sys.argv[2:]))
    if not PROGRAM.is_file():
        sys.exit(f"nearl: '{PROGRAM}' is missing; install a wheel ('make wheel' builds one), not the source folder")
    os.environ.setdefault("NEARL_PYTHON", sys.executable)
    os.execv(PROGRAM, ["nearl", *sys.argv[1:]])


if __name__ == "__main__":
    main()
