"""The ``nearl`` command: the program that comes inside this package, in place of the Python that started it."""

import os
import sys
from pathlib import Path

PROGRAM = Path(__file__).parent / "bin" / "nearl"


def main() -> None:
    """Becomes the program, with the arguments of this command line; what of it is Python, such as ``nearl view``, is this very Python's."""
    if not PROGRAM.is_file():
        sys.exit(f"nearl: '{PROGRAM}' is missing; install a wheel ('make wheel' builds one), not the source folder")
    os.environ.setdefault("NEARL_PYTHON", sys.executable)
    os.execv(PROGRAM, ["nearl", *sys.argv[1:]])


if __name__ == "__main__":
    main()
