"""One self-contained HTML page about trainings, evaluations and flights.

    nearl report runs/sweep
    nearl report --run runs/HalfCheetah-v5/pid2-ib_0 --log flight.mcap --out report.html

or ``nearl.report.build(...)``. Figures are inside the file; nothing is fetched from anywhere.
"""

from typing import Any

try:
    from nearl.report.build import build
except ModuleNotFoundError as error:
    if (error.name or "").split(".")[0] != "matplotlib":
        raise

    def build(*_: Any, **__: Any) -> None:  # type: ignore[misc]
        """Says what is missing."""
        raise ImportError("the report needs matplotlib: pip install 'nearl[viz]'")


__all__ = ["build"]
