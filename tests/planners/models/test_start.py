"""What a training begins with, by the rules of the drawings."""

import math

import pytest
import torch
from torch import Tensor, nn

from planners.models.layers import Attention, Decoder, LatentFusion, Layer, initialise_as_public
from planners.models.settings import BackboneSettings, FusionSettings


class Parts(nn.Module):
    """One of everything that is drawn anew."""

    def __init__(self) -> None:
        super().__init__()
        small = BackboneSettings(name="small", widths=(64, 64, 64, 64))
        self.fusion = LatentFusion(FusionSettings(small, 32, image_tokens=(1, 1), latent_tokens=(1, 1)))
        self.decoder = Decoder(64, 4, 64, layers=3)
        self.among = Layer(64, 4, 64, crosses=False, bias=False)


def parts() -> Parts:
    torch.manual_seed(0)
    return Parts()


def spread(weight: Tensor) -> float:
    return float(weight.detach().std())


def test_blocks_begin_as_their_shortcuts_and_exchanges_small() -> None:
    model = parts()
    initialise_as_public(model)
    for name, value in model.fusion.named_parameters():
        if name.endswith("bn2.weight"):
            assert not value.any(), name
        if name.startswith("exchanges.") and value.dim() == 2:
            assert spread(value) == pytest.approx(0.02, rel=0.05), name
        if name.startswith("exchanges.") and name.endswith("bias"):
            assert not value.any(), name


def test_attention_begins_as_torch_s_own() -> None:
    torch.manual_seed(0)
    torch_s, ours = nn.MultiheadAttention(256, 4), Attention(256, 4)
    initialise_as_public(ours)
    whole = torch_s.in_proj_weight.detach()
    for projection in (ours.query, ours.key, ours.value):
        assert float(projection.weight.detach().abs().max()) == pytest.approx(float(whole.abs().max()), rel=1e-3)
        assert spread(projection.weight) == pytest.approx(spread(whole), rel=0.02)
        assert not projection.bias.any()
    assert spread(ours.out.weight) == pytest.approx(spread(torch_s.out_proj.weight), rel=0.02)
    assert not ours.out.bias.any()


def test_attention_without_biases_begins_as_plain_linear_maps() -> None:
    model = parts()
    initialise_as_public(model)
    for projection in (model.among.own.query, model.among.own.key, model.among.own.value):
        assert float(projection.weight.detach().abs().max()) == pytest.approx(1.0 / math.sqrt(64), rel=0.01)


def test_layers_of_a_decoder_begin_as_clones() -> None:
    model = parts()
    initialise_as_public(model)
    first, *others = (layer.state_dict() for layer in model.decoder.layers)
    for other in others:
        assert all(torch.equal(value, other[name]) for name, value in first.items())
