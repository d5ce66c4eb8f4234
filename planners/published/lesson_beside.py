"""The public code's half of a training beside ours; it runs in the public code's own Python.

    main([<checkout>, <lesson.npz>, <out.npz>])

The checkout's agent, with the weights of planners.published.formula, is trained by its own Lightning module, optimiser
and schedule, in Lightning's Trainer, on the batches of planners.published.lesson. Nothing is switched off but dropout.
"""

from __future__ import annotations

import json
import os
import tempfile
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.overrides import TorchFunctionMode

from planners.published.beside import (
    built,
    features,
    filled,
    gradients,
    model_of,
    origin,
    targets,
    tokens,
    without_dropout,
)
from planners.published.formula import first_weight


def main(argv: list[str]) -> None:
    """See the module."""
    import pytorch_lightning as pl

    code, lesson, out = argv
    with np.load(lesson, allow_pickle=False) as stored:
        given = {name: stored[name] for name in stored.files}
    told = json.loads(str(given.pop("told")))
    width, height = told["picture"]
    with tempfile.TemporaryDirectory() as folder:
        os.environ.setdefault("NAVSIM_DEVKIT_ROOT", code)
        agent = built(told["case"], given, Path(folder), width, height, told["rate"])
    filled(model_of(agent), given, first_weight)
    without_dropout(agent)
    watch = watched(pl.Callback)(given["seeds"])
    trainer = pl.Trainer(
        max_steps=len(given["order"]),
        accelerator="cpu",
        devices=1,
        precision="64-true" if told["double"] else "32-true",
        callbacks=[watch],
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
    )
    module = lightning_module(told["case"])(agent=agent)
    lessons = LessonBatches(given, told["case"], told["epoch_steps"], trainer)
    with Doubled() if told["double"] else nullcontext():
        trainer.fit(module, torch.utils.data.DataLoader(lessons, batch_size=None))
    told.update(
        names={name: list(value.shape) for name, value in model_of(agent).state_dict().items()},
        code=origin(code),
        versions={"torch": torch.__version__, "lightning": pl.__version__, "numpy": np.__version__},
        matrices=watch.matrices,
        optimiser=watch.optimiser,
    )
    losses, rates = np.array(watch.losses), np.array(watch.rates)
    np.savez_compressed(out, told=np.array(json.dumps(told)), losses=losses, rates=rates, gradients=watch.gradients)


def lightning_module(case: str) -> Any:
    """The class that the public training script of a family wraps its agent in."""
    if case == "ltf":
        from navsim.planning.training.agent_lightning_module_transfuser import AgentLightningModule
    elif case == "diffusiondrive":
        from navsim.planning.training.agent_lightning_module_diffusiondrive import AgentLightningModule
    else:
        from navsim.planning.training.agent_lightning_module import AgentLightningModule
    return AgentLightningModule


class LessonBatches(torch.utils.data.Dataset):  # type: ignore[misc,unused-ignore]
    """An epoch's batches as the public data sets collate them: features, targets, tokens."""

    def __init__(self, given: dict[str, Any], case: str, epoch_steps: int, trainer: Any) -> None:
        self.given, self.case, self.epoch_steps, self.trainer = given, case, epoch_steps, trainer

    def __len__(self) -> int:
        return self.epoch_steps

    def __getitem__(self, index: int) -> Any:
        rows = self.given["order"][self.trainer.current_epoch * self.epoch_steps + index]
        names = tokens(self.given)
        return features(self.given, self.case, rows), targets(self.given, rows), [names[row] for row in rows]


def watched(callback: Any) -> Any:
    """A Lightning callback (of the base class given) that seeds every step, and keeps what is compared."""

    class Seeing(callback):  # type: ignore[misc,unused-ignore]
        def __init__(self, seeds: Any) -> None:
            self.seeds = seeds
            self.losses: list[float] = []
            self.rates: list[list[float]] = []

        def on_train_batch_start(self, trainer: Any, module: Any, batch: Any, index: int) -> None:
            torch.manual_seed(int(self.seeds[trainer.global_step]))

        def on_after_backward(self, trainer: Any, module: Any) -> None:
            if trainer.global_step == 0:
                self.matrices, self.gradients = gradients(model_of(module.agent))

        def on_before_optimizer_step(self, trainer: Any, module: Any, optimiser: Any) -> None:
            if trainer.global_step == 0:
                self.optimiser = told_of(optimiser)
            self.rates.append([group["lr"] for group in optimiser.param_groups])

        def on_train_batch_end(self, trainer: Any, module: Any, outputs: Any, batch: Any, index: int) -> None:
            self.losses.append(float(outputs["loss"]))

    return Seeing


def told_of(optimiser: torch.optim.Optimizer) -> dict[str, Any]:
    """What an optimiser does beside its rate, and to how many numbers that have a gradient."""
    numbers: dict[str, int] = {}
    for group in optimiser.param_groups:
        does = {key: group[key] for key in ("eps", "amsgrad")}
        does.update(betas=list(group["betas"]), weight_decay=float(group["weight_decay"]))
        with_gradient = sum(parameter.numel() for parameter in group["params"] if parameter.grad is not None)
        words = ", ".join(f"{key} {does[key]}" for key in sorted(does))
        numbers[words] = numbers.get(words, 0) + with_gradient
    return {"kind": type(optimiser).__name__, **{words: count for words, count in numbers.items() if count}}


class Doubled(TorchFunctionMode):
    """Inside, what would become float32 becomes float64, so that rounding tells nothing."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return args[0].double() if func is torch.Tensor.float else func(*args, **(kwargs or {}))
