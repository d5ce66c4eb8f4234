"""Backbones by the names of their weights, and weights from files."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor, nn

from planners.models.backbones import Backbone, build_backbone, load_pretrained
from planners.models.settings import STRIDES, BackboneSettings

SMALL = BackboneSettings(name="small", widths=(4, 8, 12, 16))


def on_meta(settings: BackboneSettings) -> Backbone:
    with torch.device("meta"):
        return build_backbone(settings)


def parameters(model: nn.Module) -> int:
    return sum(p.numel() for p in model.parameters())


@pytest.mark.parametrize("name", ["resnet34", "vovnet99", "small"])
def test_four_maps_at_their_strides(name: str) -> None:
    model = on_meta(BackboneSettings(name=name))  # type: ignore[arg-type]
    maps = model(torch.zeros(2, 3, 96, 352, dtype=torch.uint8, device="meta"))
    assert [m.shape for m in maps] == [(2, c, 96 // s, 352 // s) for c, s in zip(model.channels, STRIDES)]


@pytest.mark.parametrize("suffix", ["safetensors", "pth"])
@pytest.mark.parametrize("prefix", ["", "img_backbone."])
def test_weights_from_a_file_come_back_without_its_classifier(tmp_path: Path, suffix: str, prefix: str) -> None:
    torch.manual_seed(0)
    source = build_backbone(SMALL)
    named = {prefix + k: v for k, v in source.state_dict().items() if not k.endswith("num_batches_tracked")}
    named[prefix + "fc.weight"] = torch.zeros(1000, 16)
    if prefix:
        named["neck.weight"] = torch.zeros(3)
    path = tmp_path / f"weights.{suffix}"
    if suffix == "safetensors":
        save_file(named, path)
    else:
        torch.save({"state_dict": named, "epoch": 3}, path)
    settings = BackboneSettings(name="small", widths=SMALL.widths, pretrained=str(path))
    model = nn.ModuleDict({"image": build_backbone(settings)})
    record = load_pretrained(model)
    assert list(record) == ["image"] and record["image"].startswith(f"weights.{suffix} ")
    image = torch.randint(0, 256, (2, 3, 32, 32), dtype=torch.uint8)
    for got, expected in zip(model.eval()["image"](image), source.eval()(image)):
        assert torch.equal(got, expected)


def test_pictures_are_normalised_as_imagenet_and_other_inputs_are_left_alone() -> None:
    model = build_backbone(SMALL)
    mean, std = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
    image = torch.randint(0, 256, (2, 3, 4, 4), dtype=torch.uint8)
    expected = ((image.permute(0, 2, 3, 1) / 255 - mean) / std).permute(0, 3, 1, 2)
    torch.testing.assert_close(model.normalised(image), expected, rtol=1e-5, atol=1e-5)
    assert torch.equal(model.normalised(expected), expected)


def test_pixels_may_be_0_to_1() -> None:
    image = torch.randint(0, 256, (2, 3, 4, 4), dtype=torch.uint8)
    model = build_backbone(replace(SMALL, pixels="unit"))
    torch.testing.assert_close(model.normalised(image), image / 255, rtol=1e-6, atol=0.0)


def test_frozen_normalisations_keep_their_statistics_and_learn_their_scale() -> None:
    image = torch.randint(0, 256, (2, 3, 32, 32), dtype=torch.uint8)
    for frozen in (True, False):
        model = build_backbone(BackboneSettings(name="small", frozen_norm=frozen))
        before = model.get_buffer("bn1.running_mean").clone()
        still = model.eval()(image)[-1]
        moved = model.train()(image)[-1]
        moved.sum().backward()
        assert torch.equal(model.get_buffer("bn1.running_mean"), before) == frozen
        assert torch.equal(moved, still) == frozen
        scale = model.get_parameter("bn1.weight")
        assert model.training and scale.grad is not None and bool(scale.grad.any())


def test_named_weights_that_were_not_loaded_are_refused_and_a_checkpoint_counts_as_loading() -> None:
    model = build_backbone(BackboneSettings(name="small", widths=SMALL.widths, pretrained="elsewhere.pth"))
    image = torch.zeros(1, 3, 32, 32, dtype=torch.uint8)
    with pytest.raises(RuntimeError, match=r"elsewhere\.pth.*load_pretrained"):
        model(image)
    outer = nn.ModuleDict({"image": model})
    outer.load_state_dict({f"image.{k}": v for k, v in build_backbone(SMALL).state_dict().items()})
    assert len(outer["image"].eval()(image)) == 4


def test_a_wrong_weights_file_is_refused_by_name(tmp_path: Path) -> None:
    def load(content: dict[str, Tensor]) -> None:
        save_file(content, tmp_path / "w.safetensors")
        path = str(tmp_path / "w.safetensors")
        settings = BackboneSettings(name="small", widths=SMALL.widths, pretrained=path)
        load_pretrained(build_backbone(settings))

    good = dict(build_backbone(SMALL).state_dict())
    with pytest.raises(ValueError, match=r"lacks layer2\.0\.conv1\.weight of small"):
        load({k: v for k, v in good.items() if k != "layer2.0.conv1.weight"})
    with pytest.raises(ValueError, match=r"has layer5\.weight, unknown to small"):
        load({**good, "layer5.weight": torch.zeros(1)})
    with pytest.raises(ValueError, match=r"conv1\.weight \(4, 3, 3, 3\), not \(4, 3, 7, 7\)"):
        load({**good, "conv1.weight": torch.zeros(4, 3, 3, 3)})
    with pytest.raises(ValueError, match=r"holds such weights under \['a\.', 'b\.'\]"):
        load({f"{prefix}.{k}": v.clone() for prefix in "ab" for k, v in good.items()})
    with pytest.raises(ValueError, match="there is no file"):
        load_pretrained(build_backbone(BackboneSettings(name="small", pretrained=str(tmp_path / "absent.pth"))))
    with pytest.raises(ValueError, match="give 4"):
        build_backbone(BackboneSettings(name="small", widths=(8, 16)))


class NoTensor:
    """What no weights file may hold: reading it would have to build it."""


@pytest.mark.parametrize("suffix", [".safetensors", ".pth"])
def test_a_file_that_is_damaged_or_holds_objects_is_refused_by_name(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"weights{suffix}"
    if suffix == ".pth":
        torch.save({"conv1.weight": NoTensor()}, path)
    else:
        path.write_bytes(b"not weights")
    model = build_backbone(BackboneSettings("small", pretrained=str(path)))
    with pytest.raises(ValueError, match=r"weights\..* cannot be read as weights"):
        load_pretrained(model)
