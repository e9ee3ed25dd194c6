"""One training on several hosts: ``nearl.PID2(..., ranks=nearl.Ranks())``, started by torchrun, Ray Train or Slurm."""

import os
import re
from collections.abc import MutableMapping
from datetime import timedelta
from typing import Protocol, runtime_checkable


@runtime_checkable
class Gather(Protocol):
    """What a training asks of its ranks. :class:`Ranks` is one by ``torch.distributed``; any other object with these three will do."""

    rank: int
    """This process among the ranks, from 0."""
    size: int
    """Number of ranks."""

    def gather(self, mine: bytes) -> bytes:
        """Hands ``mine`` to all ranks and returns what all handed in, one after the other. All call it equally often, with equal lengths."""


def take_slurm(environment: MutableMapping[str, str]) -> None:
    """Sets what is missing of torch's variables as ``srun`` has them; nothing where a process was not started by it.

    The first task runs on the first host of the step. The port follows from the number of the job (15000 to 24999): two steps of one job
    that train at once need ``MASTER_PORT`` each.
    """
    if not {"SLURM_PROCID", "SLURM_NTASKS"} <= environment.keys():
        return
    environment.setdefault("RANK", environment["SLURM_PROCID"])
    environment.setdefault("WORLD_SIZE", environment["SLURM_NTASKS"])
    hosts = environment.get("SLURM_STEP_NODELIST") or environment.get("SLURM_JOB_NODELIST")
    if hosts:
        environment.setdefault("MASTER_ADDR", first_host(hosts))
    if "SLURM_JOB_ID" in environment:
        environment.setdefault("MASTER_PORT", str(15000 + int(environment["SLURM_JOB_ID"]) % 10000))


def first_host(hosts: str) -> str:
    """The first of Slurm's list of hosts: ``node01`` of ``node[01-03,07],gpu5``."""
    first = re.match(r"(?:[^,\[]|\[[^\]]*\])+", hosts)
    return re.sub(r"\[(\w+)[^\]]*\]", r"\1", first[0]) if first else hosts


class Ranks:
    """The ranks of a training by ``torch.distributed`` with gloo; needs ``torch``.

    A process group that is there already is used (Ray Train makes one). Otherwise it is made from the environment variables ``WORLD_SIZE``,
    ``RANK``, ``MASTER_ADDR`` and ``MASTER_PORT``, which torchrun sets; what is missing of them is taken from Slurm's, which srun sets.

    Args:
        timeout: Seconds after which a rank that says nothing is given up [s].

    Raises:
        ImportError: torch is not installed.
        ValueError: a variable is missing; the message names it.
    """

    def __init__(self, timeout: float = 600.0):
        try:
            import torch
            import torch.distributed as distributed
        except ImportError as error:
            raise ImportError(f"training on several hosts hands bytes round by torch.distributed, but {error}; pip install 'nearl[torch]'") from error
        if not distributed.is_initialized():
            take_slurm(os.environ)
            missing = [name for name in ("WORLD_SIZE", "RANK", "MASTER_ADDR", "MASTER_PORT") if name not in os.environ]
            if missing:
                raise ValueError(f"{' and '.join(missing)} not set; start the ranks with torchrun or srun, or set all four of torch's variables")
            distributed.init_process_group("gloo", timeout=timedelta(seconds=timeout))
        self.rank: int = distributed.get_rank()
        self.size: int = distributed.get_world_size()
        self._torch, self._distributed = torch, distributed
        # A group of its own: one that is there already may be of another backend.
        self._group = distributed.new_group(backend="gloo", timeout=timedelta(seconds=timeout))

    def gather(self, mine: bytes) -> bytes:
        """See :class:`Gather`."""
        torch = self._torch
        all_of_them = torch.empty(self.size * len(mine), dtype=torch.uint8)
        own = torch.frombuffer(bytearray(mine), dtype=torch.uint8)
        self._distributed.all_gather(list(all_of_them.chunk(self.size)), own, group=self._group)
        return all_of_them.numpy().tobytes()
