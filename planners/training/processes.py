"""The processes of one training: which of them this is, and what they tell each other."""

import gc
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
import torch.distributed as dist
from torch import Tensor


@dataclass(frozen=True)
class TrainingProcess:
    """One of `size` processes; rank 0 writes."""

    rank: int
    size: int
    device: torch.device

    @property
    def writes(self) -> bool:
        return self.rank == 0

    def mean(self, values: Tensor) -> Tensor:
        """The mean over all processes, in all of them."""
        if self.size == 1:
            return values
        total = values.clone()
        dist.all_reduce(total)
        return total / self.size

    def any_process(self, flag: bool) -> bool:
        """Whether the flag is set in any process."""
        if self.size == 1:
            return flag
        told = torch.tensor([float(flag)], device=self.device)
        dist.all_reduce(told, op=dist.ReduceOp.MAX)
        return bool(told.item() > 0)

    def wait(self) -> None:
        """Until all processes are here."""
        if self.size > 1:
            dist.barrier()


@contextmanager
def join_process_group(device: str, place: torch.device | None = None) -> Iterator[TrainingProcess]:
    """What this process was started as: alone, by torchrun, or in a group that stands already (Ray Train).

    device: auto | cpu | cuda; place: the device itself, where that is known. Raises ValueError for cuda where there is
    none.
    """
    if device == "cuda" and not torch.cuda.is_available():
        raise ValueError(
            "device=cuda, but PyTorch sees no GPU here: leave device=auto, or install a CUDA build of torch"
        )
    if place is None:
        on_gpu = device != "cpu" and torch.cuda.is_available()
        place = torch.device("cuda", int(os.environ.get("LOCAL_RANK", 0))) if on_gpu else torch.device("cpu")
    if place.type == "cuda":
        torch.cuda.set_device(place)
    started = not dist.is_initialized() and int(os.environ.get("WORLD_SIZE", 1)) > 1
    if started:
        dist.init_process_group("nccl" if place.type == "cuda" else "gloo")
    try:
        group = dist.is_initialized()
        yield TrainingProcess(dist.get_rank() if group else 0, dist.get_world_size() if group else 1, place)
        if started:
            dist.barrier()  # a process that leaves first takes the connections of the others down
    finally:
        if started:
            gc.collect()  # a wrapper that is still about would keep the group's threads beyond the interpreter's end
            dist.destroy_process_group()
