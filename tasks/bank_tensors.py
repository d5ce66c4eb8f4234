"""The bank for PyTorch, which is the caller's own: tensors in, tensors out (docs/bank.md)."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

from tasks.bank import BankScores, Reference, SceneBank, Traffic
from tasks.subscores import OF_ONE_PLAN

if TYPE_CHECKING:
    from torch import Tensor


class TensorScores(NamedTuple):
    """Scores of P plans on each of B scenes, of the plans' dtype and on their device, without a gradient."""

    subscores: "Tensor"  # (B, P, 8) in the order of tasks.subscores.OF_ONE_PLAN
    score: "Tensor"  # (B, P)


def score_tensors(
    bank: SceneBank,
    clip_ids: Sequence[str],
    plans: "Tensor",
    *,
    reference: Reference = "pdm_closed",
    traffic: Traffic = "replay",
    threads: int | None = None,
) -> TensorScores:
    """`SceneBank.score` of a tensor (B, P, 40 or 8, 3) of any kind of float; raises as it does.

    On the CPU a tensor of float32 or float64 is read where it lies, and the scores are written where the result's lie.
    From another device the plans are fetched once and the scores sent once; half floats are scored as float32.
    """
    import torch

    near = plans.detach().cpu()
    near = near if near.dtype == torch.float64 else near.float()
    subscores, score = near.new_empty((*near.shape[:2], len(OF_ONE_PLAN))), near.new_empty(near.shape[:2])
    out = BankScores(subscores.numpy(), score.numpy())
    bank.score(clip_ids, near.numpy(), reference=reference, traffic=traffic, threads=threads, out=out)
    return TensorScores(subscores.to(plans), score.to(plans))
