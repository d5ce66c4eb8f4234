"""What a training begins with, by the rules of the drawings."""

import torch
from torch import nn

from planners.models.layers import Decoder, LatentFusion, Layer, initialise_as_public
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


def test_layers_of_a_decoder_begin_as_clones() -> None:
    model = parts()
    initialise_as_public(model)
    first, *others = (layer.state_dict() for layer in model.decoder.layers)
    for other in others:
        assert all(torch.equal(value, other[name]) for name, value in first.items())
