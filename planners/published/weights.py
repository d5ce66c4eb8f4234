"""A public state dict read into a planner's: every number of it is moved, or named as left aside.

A family's file says what goes where, with the methods of `Moves`; `Moves.done` refuses what nobody spoke of.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor

from factory.config.compose import ConfigError
from factory.readers.torch_file import load_tensors

ANCHOR = "_status_encoding.weight"  # in every family's model, at its top


@dataclass
class Moves:
    """Public names still to be told of, and what ours have become so far."""

    public: dict[str, Tensor]
    source: str = "checkpoint"  # for messages
    ours: dict[str, Tensor] = field(default_factory=dict)
    aside: dict[str, Tensor] = field(default_factory=dict)  # what a planner of ours does not have
    came_from: dict[str, tuple[str, ...]] = field(default_factory=dict)  # ours -> public names

    def one(self, name: str, ours: str, turned: Callable[[Tensor], Tensor] = lambda x: x) -> None:
        """One number array. Raises ConfigError where the checkpoint lacks it."""
        self.ours[ours], self.came_from[ours] = turned(self._taken(name)), (name,)

    def all(self, prefix: str, ours: str) -> None:
        """All that begins with a prefix, under the same words behind another. Raises ConfigError where nothing does."""
        for name in self._under(prefix):
            self.one(name, ours + name.removeprefix(prefix))

    def layer(self, name: str, ours: str, turned: Callable[[Tensor], Tensor] = lambda x: x) -> None:
        """Weight and bias of a linear map; `turned` is for the weight."""
        self.one(f"{name}.weight", f"{ours}.weight", turned)
        self.one(f"{name}.bias", f"{ours}.bias")

    def joined(self, names: Sequence[str], ours: str) -> None:
        """Weights and biases of several linear maps as those of one, their outputs one after the other."""
        for kind in ("weight", "bias"):
            parts = tuple(f"{name}.{kind}" for name in names)
            self.ours[f"{ours}.{kind}"] = torch.cat([self._taken(part) for part in parts])
            self.came_from[f"{ours}.{kind}"] = parts

    def attention(self, name: str, ours: str) -> None:
        """torch's MultiheadAttention, whose three maps are one, as planners.models.attention.Attention."""
        for kind in ("weight", "bias"):
            whole = self._taken(f"{name}.in_proj_{kind}")
            for part, values in zip(("query", "key", "value"), whole.chunk(3)):
                self.ours[f"{ours}.{part}.{kind}"] = values.clone()
                self.came_from[f"{ours}.{part}.{kind}"] = (f"{name}.in_proj_{kind}",)
        self.layer(f"{name}.out_proj", f"{ours}.out")

    def decoder(self, name: str, ours: str) -> None:
        """torch's TransformerDecoder as planners.models.attention.Decoder."""
        numbers = sorted({int(key.removeprefix(f"{name}.layers.").split(".")[0]) for key in self._under(name)})
        for number in numbers:
            theirs, here = f"{name}.layers.{number}", f"{ours}.layers.{number}"
            self.attention(f"{theirs}.self_attn", f"{here}.own")
            self.attention(f"{theirs}.multihead_attn", f"{here}.cross")
            for other, own in (("norm1", "own_norm"), ("norm2", "cross_norm"), ("norm3", "feedforward_norm")):
                self.layer(f"{theirs}.{other}", f"{here}.{own}")
            self.layer(f"{theirs}.linear1", f"{here}.feedforward.0")
            self.layer(f"{theirs}.linear2", f"{here}.feedforward.3")

    def leave(self, prefix: str) -> None:
        """All that begins with a prefix is no part of our planner."""
        for name in self._under(prefix):
            self.aside[name] = self._taken(name)

    def kept(self, name: str) -> Tensor:
        """What is not learned and becomes an array that our planner is built around."""
        self.aside[name] = self._taken(name)
        return self.aside[name]

    def done(self) -> None:
        """Raises ConfigError where something was not told of."""
        if self.public:
            raise ConfigError(f"{self.source} holds {_listed(list(self.public))}, of which this planner knows nothing")

    def _taken(self, name: str) -> Tensor:
        if name not in self.public:
            raise ConfigError(f"{self.source} lacks {name}: it is of another planner, or damaged")
        return self.public.pop(name)

    def _under(self, prefix: str) -> list[str]:
        found = [name for name in self.public if name.startswith(prefix)]
        if not found:
            raise ConfigError(f"{self.source} lacks {prefix}...: it is of another planner, or damaged")
        return found


def read_public(path: Path) -> dict[str, Tensor]:
    """The weights of a Lightning checkpoint under the names of the public model, without what wraps it.

    Only tensors and plain values are read back; nothing of the file runs. Raises ConfigError.
    """
    try:
        content = load_tensors(path)
    except OSError as error:
        raise ConfigError(f"{path}: {error}") from error
    except ValueError as error:
        raise ConfigError(str(error)) from error
    return model_weights(content, str(path))


def model_weights(content: object, source: str) -> dict[str, Tensor]:
    """`content` of a Lightning checkpoint, or a bare state dict, as names of the public model. Raises ConfigError."""
    if isinstance(content, Mapping) and isinstance(content.get("state_dict"), Mapping):
        content = content["state_dict"]
    if not isinstance(content, Mapping) or not all(isinstance(value, Tensor) for value in content.values()):
        raise ConfigError(f"{source} holds no state_dict of tensors: give a checkpoint of the public training")
    found = [name.removesuffix(ANCHOR) for name in content if isinstance(name, str) and name.endswith(ANCHOR)]
    if len(found) != 1:
        raise ConfigError(
            f"{source}: {len(found)} of its {len(content)} weights are named ...{ANCHOR}, not one: it is no checkpoint "
            "of the public Latent TransFuser, DiffusionDrive or GTRS-Dense"
        )
    prefix = found[0]
    other = [name for name in content if not name.startswith(prefix)]
    if other:
        raise ConfigError(f"{source} holds {_listed(other)} beside the model {prefix.rstrip('.')}")
    return {name.removeprefix(prefix): value for name, value in content.items()}


def _listed(names: list[str], most: int = 3) -> str:
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")
