"""Image backbones by name, with weights from a file of the user's.

Nothing is downloaded. A planner is built without weights; `load_pretrained` reads the files its settings name when a
training begins, so that a checkpoint is opened where those files are not.
"""

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from safetensors.torch import load_file
from torch import Tensor, nn

from factory.readers.torch_file import load_tensors
from factory.wording import one_line
from planners.models.backbones.base import STRIDES, Backbone, BackboneSettings
from planners.models.backbones.resnet import ResNet
from planners.models.backbones.vovnet import VoVNet99

CLASSIFIERS = ("fc.", "classifier.", "head.")  # of the published networks; not part of a backbone


def build_backbone(settings: BackboneSettings, in_channels: int = 3) -> Backbone:
    """The network with random weights; in_channels other than 3 for residual networks over something not a picture.

    Raises ValueError for settings that make no network.
    """
    if settings.name == "resnet34":
        return ResNet(settings, (64, 128, 256, 512), (3, 4, 6, 3), True, in_channels)
    if settings.name == "small":
        if len(settings.widths) != len(STRIDES):
            raise ValueError(f"backbone.widths are {settings.widths}: give {len(STRIDES)}, one for each stride")
        return ResNet(settings, settings.widths, (1, 1, 1, 1), False, in_channels)
    if in_channels != 3:
        raise ValueError("vovnet99 takes pictures of 3 channels only: use resnet34 or small")
    return VoVNet99(settings)


def set_recompute(model: nn.Module, on: bool) -> None:
    """Whether the backbones of a model that are over pictures keep no activations for the backward pass."""
    for module in model.modules():
        if isinstance(module, Backbone) and module.over_pictures:
            module.recompute = on


def load_pretrained(model: nn.Module) -> dict[str, str]:
    """Loads what every backbone of a model names, and says what that was: module -> "none", or file and sha256.

    Raises ValueError naming what a file lacks or has too much.
    """
    record = {}
    for name, module in model.named_modules():
        if isinstance(module, Backbone):
            path = module.settings.pretrained
            if path is not None:
                _load(module, Path(path), module.settings.prefix)
            record[name or "backbone"] = "none" if path is None else f"{Path(path).name} {_digest(Path(path))}"
    return record


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _load(backbone: Backbone, path: Path, prefix: str) -> None:
    weights = _read(path)
    own = backbone.state_dict()
    named = {key.removeprefix(prefix): value for key, value in weights.items() if key.startswith(prefix)}
    named = {key: value for key, value in named.items() if key in own or not key.startswith(CLASSIFIERS)}
    counters = {key for key in own if key.endswith("num_batches_tracked")}  # older files lack them, nothing reads them
    missing = sorted(set(own) - set(named) - counters)
    if missing:
        hint = _prefix_hint(set(own) - counters, weights)
        raise ValueError(f"{path} lacks {_listed(missing)} of {backbone.settings.name}{hint}")
    extra = sorted(set(named) - set(own))
    if extra:
        raise ValueError(f"{path} has {_listed(extra)}, unknown to {backbone.settings.name}: wrong network or prefix")
    wrong = [f"{k} {tuple(named[k].shape)}, not {tuple(own[k].shape)}" for k in named if named[k].shape != own[k].shape]
    if wrong:
        raise ValueError(f"{path} has other shapes than {backbone.settings.name}: {_listed(wrong)}")
    backbone.load_state_dict(named, strict=False)


def _read(path: Path) -> Mapping[str, Tensor]:
    if not path.is_file():
        raise ValueError(f"backbone.pretrained: there is no file {path}")
    try:
        content: Any = load_file(path) if path.suffix == ".safetensors" else load_tensors(path)
    except Exception as error:  # whatever a damaged file, or an object that is no tensor, raises
        raise ValueError(f"backbone.pretrained: {path} cannot be read as weights: {one_line(error)}") from error
    for wrapper in ("state_dict", "model"):  # as trainers wrap their checkpoints
        if isinstance(content, Mapping) and isinstance(content.get(wrapper), Mapping):
            content = content[wrapper]
    if not isinstance(content, Mapping):
        raise ValueError(f"backbone.pretrained: {path} holds a {type(content).__name__}, not named tensors")
    return {key: value for key, value in content.items() if isinstance(value, Tensor)}


def _prefix_hint(keys: set[str], weights: Mapping[str, Tensor]) -> str:
    probe = max(keys, key=len)
    candidates = [name.removesuffix(probe) for name in weights if name.endswith("." + probe)]
    complete = [prefix for prefix in candidates if all(prefix + key in weights for key in keys)]
    return f": it has them elsewhere, set backbone.prefix to one of {complete}" if complete else ""


def _listed(names: list[str], most: int = 5) -> str:
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")
