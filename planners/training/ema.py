"""The exponential moving average of a planner's weights: what is validated and saved where `training.ema` is set."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor

from planners.models.planner import Planner

RAW = "weights"  # in a checkpoint's training state: those that go on, where the averaged ones are the planner's


class Averaged:
    """After each step n = 1, 2, ... a = d a + (1 - d) w, d = min(decay, (1 + n) / (10 + n)).

    It begins with the weights of the start; the bound on d, TensorFlow's (ExponentialMovingAverage, num_updates), lets
    it forget them in short trainings too. Running statistics are averaged as weights are, counts are the newest.
    """

    def __init__(self, planner: Planner, decay: float, values: Mapping[str, Tensor] | None = None) -> None:
        """values: of a training that goes on; None: the planner's as they are."""
        self._planner, self._decay = planner, decay
        self._values = {name: value.detach().clone() for name, value in (values or planner.state_dict()).items()}

    def update(self, steps: int) -> None:
        """Take in the planner's weights after so many steps."""
        share = 1.0 - min(self._decay, (1 + steps) / (10 + steps))
        for name, value in self._planner.state_dict().items():
            if value.is_floating_point():
                self._values[name].lerp_(value, share)
            else:
                self._values[name].copy_(value)

    @contextmanager
    def in_planner(self) -> Iterator[dict[str, Any]]:
        """Inside, the planner has the averaged weights; gives the raw ones under RAW, which it has again behind."""
        with torch.no_grad():
            raw = {name: value.detach().clone() for name, value in self._planner.state_dict().items()}
            self._planner.load_state_dict(self._values)
            try:
                yield {RAW: raw}
            finally:
                self._planner.load_state_dict(raw)
