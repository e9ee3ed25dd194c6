"""One self-contained HTML page about trainings, evaluations and flights.

    python -m nearl.report runs/sweep
    python -m nearl.report --run runs/HalfCheetah-v5/pid2-ib_0 --log flight.mcap --out report.html

or ``nearl.report.build(...)``. Figures are inside the file; nothing is fetched from anywhere.
"""

from nearl.report.build import build

__all__ = ["build"]
