"""Blocks that are computed again in the backward pass learn the same and keep less."""

import pytest
import torch
from torch import Tensor

from planners.models.backbones import Backbone, build_backbone, set_recompute
from planners.models.layers import LatentFusion
from planners.models.settings import BackboneSettings, FusionSettings


def learnt(settings: BackboneSettings, recompute: bool, size: int = 64) -> tuple[Backbone, Tensor, int]:
    """The backbone after a backward pass in training, its loss, and the bytes that were kept for that pass."""
    torch.manual_seed(0)
    model = build_backbone(settings)
    model.recompute = recompute
    picture = torch.randint(0, 256, (2, 3, size, size), dtype=torch.uint8)
    kept: dict[int, int] = {}

    def keep(value: Tensor) -> Tensor:
        kept[value.untyped_storage().data_ptr()] = value.untyped_storage().nbytes()
        return value

    with torch.autograd.graph.saved_tensors_hooks(keep, lambda value: value):
        loss = torch.stack([features.square().mean() for features in model.train()(picture)]).sum()
    loss.backward()
    weights = {p.untyped_storage().data_ptr() for p in model.parameters()}
    return model, loss.detach(), sum(n for at, n in kept.items() if at not in weights)


@pytest.mark.parametrize(
    "settings",
    [
        BackboneSettings(name="small"),
        BackboneSettings(name="small", frozen_norm=True),
        pytest.param(BackboneSettings(name="vovnet99", frozen_norm=True), marks=pytest.mark.slow),
    ],
    ids=["small", "frozen", "vovnet99"],
)
def test_loss_gradients_and_running_statistics_are_the_same_and_less_is_kept(settings: BackboneSettings) -> None:
    (model, loss, bytes_kept), (plain, expected, plain_bytes) = learnt(settings, True), learnt(settings, False)
    assert torch.equal(loss, expected)
    for (name, ours), wanted in zip(model.named_parameters(), plain.parameters()):
        assert wanted.grad is not None and ours.grad is not None
        assert torch.equal(ours.grad, wanted.grad), name
    for (name, ours), wanted in zip(model.named_buffers(), plain.buffers()):
        assert torch.equal(ours, wanted), name
    assert bytes_kept < 0.6 * plain_bytes


def test_of_a_fusion_the_backbone_over_the_picture_is_meant() -> None:
    small = BackboneSettings(name="small", widths=(2, 2, 2, 2))
    fusion = LatentFusion(FusionSettings(small, 32, image_tokens=(1, 1), latent_tokens=(1, 1), heads=1))
    for on in (True, False):
        set_recompute(fusion, on)
        assert (fusion.image.recompute, fusion.latent.recompute) == (on, False)
