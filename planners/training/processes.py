"""The processes of one training: which of them this is, what they tell each other, and batch normalisation over all.

PyTorch's SyncBatchNorm runs on GPUs alone and is no BatchNorm2d, so that what looks for those (`frozen_norm`) passes it
by. A normalisation here stays what it was, names and weights and all, and sums over the processes in training, on CPUs
as on GPUs.
"""

import gc
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.nn.modules.batchnorm import _BatchNorm


@dataclass(frozen=True)
class RaySettings:
    """The processes that Ray Train starts."""

    processes: int = 2
    gpus: int = 0  # of each
    cpus: int = 1


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

    def anyone(self, flag: bool) -> bool:
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
def joined(device: str, place: torch.device | None = None) -> Iterator[TrainingProcess]:
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


def synchronise(model: nn.Module) -> None:
    """Let every batch normalisation of a model see the parts of a batch that all processes of the group have at once.

    One in evaluation, as with `frozen_norm`, and in a single process computes as ever.
    Raises ValueError where a model has none, or one that is neither BatchNorm1d nor BatchNorm2d.
    """
    found = {name: module for name, module in model.named_modules() if isinstance(module, _BatchNorm)}
    if not found:
        raise ValueError("sync_batch_norm=true, but the planner has no batch normalisation: leave it out")
    for name, module in found.items():
        if type(module) in SYNCED:
            module.__class__ = SYNCED[type(module)]
        elif not isinstance(module, _Synced):
            kind = type(module).__name__
            raise ValueError(f"sync_batch_norm=true: {name} is a {kind}, not one of BatchNorm1d and BatchNorm2d")


class _Synced(_BatchNorm):
    """The forward of both kinds."""

    @torch.compiler.disable  # a compiled graph ends at an exchange between processes
    def forward(self, x: Tensor) -> Tensor:
        """(B, C, ...) normalised over all but C, and over the processes."""
        if not (self.training and dist.is_initialized() and dist.get_world_size() > 1):
            return super().forward(x)
        y, mean, variance = _Normalised.apply(x, self.weight, self.bias, self.eps)
        if self.running_mean is not None and self.running_var is not None and self.num_batches_tracked is not None:
            self.num_batches_tracked.add_(1)
            share = 1.0 / float(self.num_batches_tracked) if self.momentum is None else self.momentum
            self.running_mean.lerp_(mean.to(self.running_mean.dtype), share)
            self.running_var.lerp_(variance.to(self.running_var.dtype), share)
        assert isinstance(y, Tensor)
        return y


class SyncedBatchNorm1d(_Synced, nn.BatchNorm1d):
    """BatchNorm1d over all processes."""


class SyncedBatchNorm2d(_Synced, nn.BatchNorm2d):
    """BatchNorm2d over all processes."""


SYNCED: dict[type[nn.Module], type[_Synced]] = {
    nn.BatchNorm1d: SyncedBatchNorm1d,
    nn.BatchNorm2d: SyncedBatchNorm2d,
}


class _Normalised(torch.autograd.Function):
    """The normalised input, and the mean and unbiased variance (C,) of all processes' inputs; sums in float32 or more.

    Gradients of scale and shift are those of this process's part: the distributed wrapper averages them.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor | None, bias: Tensor | None, eps: float) -> Any:
        axes, shape = [0, *range(2, x.dim())], [1, -1, *[1] * (x.dim() - 2)]
        wide = x.to(torch.promote_types(x.dtype, torch.float32))
        count = wide.new_full((1,), x.numel() / x.shape[1])
        sums = torch.cat([wide.sum(axes), count])
        dist.all_reduce(sums)
        mean, n = sums[:-1] / sums[-1], sums[-1]
        squares = (wide - mean.view(shape)).square().sum(axes)
        dist.all_reduce(squares)
        scale = (squares / n + eps).rsqrt()
        ctx.save_for_backward(x, weight, mean, scale, n)
        ctx.axes, ctx.shape = axes, shape
        y = (wide - mean.view(shape)) * (scale if weight is None else scale * weight).view(shape)
        y = y if bias is None else y + bias.view(shape)
        variance = squares / (n - 1)
        ctx.mark_non_differentiable(mean, variance)
        return y.to(x.dtype), mean, variance

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        x, weight, mean, scale, n = ctx.saved_tensors
        gradient = gradients[0].to(mean.dtype)
        normal = (x.to(mean.dtype) - mean.view(ctx.shape)) * scale.view(ctx.shape)
        of_shift, of_scale = gradient.sum(ctx.axes), (gradient * normal).sum(ctx.axes)
        sums = torch.stack([of_shift, of_scale])
        dist.all_reduce(sums)
        common, along = (sums / n).view(2, *ctx.shape).unbind()
        to_input = (gradient - common - normal * along) * (scale if weight is None else scale * weight).view(ctx.shape)
        affine = (None, None) if weight is None else (of_scale, of_shift)
        return to_input.to(x.dtype), *affine, None
