"""The command ``nearl view``."""

import argparse
import sys

from nearl.view import ViewError, view


def main(arguments: list[str] | None = None) -> int:
    """0 on success, 1 with one sentence on standard error otherwise."""
    parser = argparse.ArgumentParser(prog="nearl view", description="A running loop, or a training, in a browser.")
    parser.add_argument("name", metavar="NAME", help="as in `nearl run --plant NAME`, or the run folder of a training")
    parser.add_argument("--task", help="task name or file whose robot is drawn; by default the one that the loop names")
    parser.add_argument("--port", type=int, default=8080, help="of the page on 127.0.0.1 (default 8080)")
    parser.add_argument("--seconds", type=float, help="how long; by default until the loop is gone")
    given = parser.parse_args(arguments)
    try:
        view(given.name, given.task, given.port, given.seconds)
    except (ViewError, OSError, RuntimeError, ValueError) as error:
        print(f"nearl view: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        pass
    return 0


if __name__ == "__main__":
    sys.exit(main())
