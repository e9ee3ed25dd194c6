"""Metrics for TensorBoard, under SB3's tags.

    nearl tensorboard runs/HalfCheetah-v5/pid2-ib_0      # event files beside metrics.csv; then: tensorboard --logdir runs
    nearl tensorboard --follow runs/HalfCheetah-v5/pid2-ib_0   # while it is trained

    agent.learn(1_000_000, callback=nearl.tensorboard.Writer("runs/mine"))
"""

import argparse
import os
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from nearl.runs import ReadError, read_run

STEPS = "time/total_timesteps"


class Writer:
    """A callback of :meth:`nearl.PID2.learn` that writes one scalar a metric and iteration.

    Args:
        folder: Where the event file goes; several runs in folders side by side are compared by TensorBoard.

    Raises:
        ImportError: tensorboardX is not installed.
    """

    def __init__(self, folder: str | os.PathLike[str]):
        try:
            from tensorboardX import SummaryWriter
        except ImportError as error:
            raise ImportError("writing for TensorBoard needs tensorboardX: pip install 'nearl[tensorboard]'") from error
        self._writer = SummaryWriter(os.fspath(folder))

    def __call__(self, agent: Any, metrics: dict[str, float]) -> None:
        """Writes ``metrics`` at their own number of steps."""
        self.write(metrics)
        self.flush()

    def write(self, metrics: dict[str, float]) -> None:
        """The same without waiting for the disk."""
        for tag, value in metrics.items():
            if tag != STEPS and np.isfinite(value):
                self._writer.add_scalar(tag, value, int(metrics[STEPS]))

    def flush(self) -> None:
        """Puts what was written on the disk."""
        self._writer.flush()

    def close(self) -> None:
        """Ends the file."""
        self._writer.close()

    def __enter__(self) -> "Writer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def convert(run: str | os.PathLike[str], folder: str | os.PathLike[str] | None = None) -> int:
    """Writes a run folder's ``metrics.csv`` as an event file into ``folder`` (the run folder by default), in place of older ones.

    Returns:
        Number of rows.

    Raises:
        ReadError: ``run`` is not a run folder.
    """
    metrics = read_run(Path(run)).metrics
    n = len(metrics[STEPS])
    with Writer(_emptied(run, folder)) as writer:
        for i in range(n):
            writer.write({tag: float(values[i]) for tag, values in metrics.items()})
    return n


def follow(run: str | os.PathLike[str], folder: str | os.PathLike[str] | None = None, every: float = 5.0, seconds: float | None = None) -> int:
    """:func:`convert`, and then each new row of a training that goes on, until its steps are done.

    Args:
        run: Run folder.
        folder: As for :func:`convert`.
        every: Time between two looks [s].
        seconds: How long at most; None until the training is done.

    Returns:
        Number of rows.
    """
    end = None if seconds is None else time.monotonic() + seconds
    n = 0
    with Writer(_emptied(run, folder)) as writer:
        while True:
            is_done = (Path(run) / "checkpoints" / "final.safetensors").is_file()  # before the rows, so that none is missed
            metrics = read_run(Path(run)).metrics
            for i in range(n, len(metrics[STEPS])):
                writer.write({tag: float(values[i]) for tag, values in metrics.items()})
            n = len(metrics[STEPS])
            writer.flush()
            if is_done or (end is not None and time.monotonic() >= end):
                return n
            time.sleep(every)


def _emptied(run: str | os.PathLike[str], folder: str | os.PathLike[str] | None) -> Path:
    """Where the event file goes, without older ones."""
    folder = Path(run if folder is None else folder)
    for old in folder.glob("events.out.tfevents.*"):
        old.unlink()
    return folder


def main(arguments: list[str] | None = None) -> int:
    """0 on success, 1 with one sentence on standard error otherwise."""
    parser = argparse.ArgumentParser(prog="nearl tensorboard", description="Event files from run folders of 'nearl train'.")
    parser.add_argument("runs", metavar="RUN_FOLDER", nargs="+", type=Path)
    parser.add_argument("--follow", action="store_true", help="go on with each new row of one training until it is done")
    given = parser.parse_args(arguments)
    if given.follow and len(given.runs) > 1:
        parser.error("--follow takes one run folder")
    try:
        for run in given.runs:
            print(f"{run}: {follow(run) if given.follow else convert(run)} rows")
    except KeyboardInterrupt:
        return 0
    except (ReadError, ImportError, OSError) as error:
        print(f"nearl tensorboard: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
