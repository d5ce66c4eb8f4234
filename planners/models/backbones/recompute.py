"""Blocks whose activations are not kept for the backward pass but computed again in it."""

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext

from torch import Tensor, nn
from torch.nn.modules.batchnorm import _BatchNorm
from torch.utils.checkpoint import checkpoint


def recomputed(block: nn.Module, features: Tensor) -> Tensor:
    """block(features), with its gradients and running statistics; of memory, what its input takes."""

    def contexts() -> tuple[AbstractContextManager[None], AbstractContextManager[None]]:
        return nullcontext(), _statistics_kept(block)

    result: Tensor = checkpoint(block, features, use_reentrant=False, context_fn=contexts)
    return result


@contextmanager
def _statistics_kept(block: nn.Module) -> Iterator[None]:
    """Inside, normalisations count what they see in copies of their statistics: the first pass has counted it."""
    counting = [m for m in block.modules() if isinstance(m, _BatchNorm) and m.training]
    counted = [(module, name, value) for module in counting for name, value in module.named_buffers(recurse=False)]
    for module, name, value in counted:
        setattr(module, name, value.clone())
    try:
        yield
    finally:
        for module, name, value in counted:
            setattr(module, name, value)
