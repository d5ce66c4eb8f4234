"""The training loop: batches in, checkpoints and a loss curve out, the same after any number of interruptions.

Everything random in a step comes from a seed made of (run seed, step, rank), so that nothing but weights, optimiser and
the loader's position needs to be kept.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from itertools import chain, count, islice
from pathlib import Path
from threading import Event
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor
from torch.nn.parallel import DistributedDataParallel

from factory.exits import Stopped, calling_on_stop_signal
from factory.graph.progress import RateBar
from planners.data.batch import Batch
from planners.data.loader import Loader
from planners.models.planner import Planner
from planners.training.callbacks import BestSoFar, Callback, Curves
from planners.training.checkpoint import BEST, ENDED, load_training, load_weights, save_checkpoint
from planners.training.optim import TrainingSettings, build_optimiser, learning_rate, set_rate
from planners.training.processes import TrainingProcess

STATE_VERSION = 1
Precision = Literal["fp32", "bf16", "fp16"]  # fp16: gradients of a scaled loss, steps that overflow are left out
AUTOCAST = {"bf16": torch.bfloat16, "fp16": torch.float16}
SCALER = "scaler"  # in a checkpoint's training state: the scale of the loss and the steps since it changed
CALLBACKS, BEST_SO_FAR = "callbacks", "best so far"  # in it: what they keep, by name, and the trainer's own among them
SCALING = ("loss_scale", "skipped")  # columns of an fp16 training's losses: the scale it had, 1 for a step left out


@dataclass(frozen=True)
class StepSettings:
    """How a training runs, beside what it computes."""

    seed: int
    steps: int  # in all
    accumulate: int = 1  # parts that a batch is computed in, one after the other
    precision: Precision = "fp32"
    log_every: int = 20  # steps between looks at the losses, which cost a wait for the device
    checkpoint_every: int = 1000
    validate_every: int = 0  # 0: only after the last step
    keep_every: int = 0  # checkpoints of every so many steps stay beside the newest; 0: none
    keep_best: str | None = None  # so does that of the best validation by this measure
    patience: int | None = None  # validations without a better one after which the training ends


def total_steps(batches: Loader, training: TrainingSettings, steps: int | None) -> int:
    """Optimiser steps of a training: as many as asked for, else those of its epochs."""
    return steps if steps is not None else sum(batches.n_batches(epoch) for epoch in range(training.epochs))


def fit(
    planner: Planner,
    batches: Loader,
    training: TrainingSettings,
    loop: StepSettings,
    process: TrainingProcess,
    out: Path,
    record: Mapping[str, Any],
    resume_from: Path | None = None,
    validate: Callable[[Planner], dict[str, float]] | None = None,
    callbacks: Mapping[str, Callback] = {},
) -> None:
    """Train `planner` in place, from a checkpoint where one is given, to the last step or until a callback ends it.

    Writes `losses.csv` (every step), `validation.csv`, TensorBoard events and checkpoints under `out`. validate: called
    in the first process alone. Raises Stopped after SIGINT or SIGTERM, with a checkpoint written; FloatingPointError,
    with the step, where the loss is NaN or infinite.
    """
    planner.to(process.device)
    optimiser = build_optimiser(training, planner)
    scaler = torch.amp.GradScaler(process.device.type, enabled=loop.precision == "fp16")
    best = BestSoFar(loop.keep_best, loop.patience)
    kept = {**callbacks, BEST_SO_FAR: best}
    first = 0 if resume_from is None else _resume(resume_from, planner, optimiser, scaler, batches, kept)
    told: list[Callback] = [*kept.values(), *([Curves(out, first)] if process.writes else [])]
    model = _wrapped(planner, process)
    epoch_steps = batches.n_batches(0)
    unlogged: list[Tensor] = []
    names: list[str] = []

    def save(step: int, measured: Mapping[str, float], why: str | None) -> None:
        """why: the training ends here."""
        if process.writes:
            state = {
                "version": STATE_VERSION,
                "step": step,
                "optimiser": optimiser.state_dict(),
                "loader": batches.state(),
                CALLBACKS: {name: one.state() for name, one in kept.items()},
                **({SCALER: scaler.state_dict()} if scaler.is_enabled() else {}),
            }
            of_it = {"validation": dict(measured), BEST: best.state(), ENDED: why}
            stays = best.step if loop.keep_best is not None else None
            of_it = {key: value for key, value in of_it.items() if value and (key != BEST or stays is not None)}
            save_checkpoint(out, step, planner, {**record, **of_it}, state, loop.keep_every, stays)
        process.wait()

    def log(step: int) -> float:
        """Losses of the steps since the last look, the mean over all processes; returns the newest."""
        values = process.mean(torch.stack(unlogged)).tolist()
        done = range(step - len(values), step)
        unlogged.clear()
        for at, row in zip(done, values):
            terms = dict(zip(names, row))
            if not np.isfinite(row).all():
                parts = ", ".join(f"{name} {value:g}" for name, value in terms.items())
                other = ", or precision=bf16 or fp32" if scaler.is_enabled() else ""
                raise FloatingPointError(
                    f"the loss of step {at} is not finite ({parts}): try a smaller learning_rate{other}"
                )
            rate = learning_rate(training, at, loop.steps, epoch_steps)
            scaling = dict(zip(SCALING, row[len(names) :]))
            for one in told if process.writes else ():
                one.on_losses(at, {"total": sum(terms.values()), **terms, "learning_rate": rate, **scaling})
        return float(sum(values[-1][: len(names)]))

    def check(step: int) -> tuple[dict[str, float], str | None]:
        """What the planner is worth, and why the training is to end."""
        if validate is None or not process.writes:
            return {}, None
        measured = validate(planner)
        whys = [one.on_validation_end(step, planner, measured) for one in told]
        so_far = "the best so far" if best.step == step else str(best)
        found = ", ".join(f"{name} {value:.4f}" for name, value in measured.items())
        print(f"validation after step {step}: {found}; {so_far}", flush=True)
        return measured, _first_of(whys)

    asked, stopping, ending = Event(), False, False
    why: str | None = None
    with calling_on_stop_signal(asked.set), RateBar("steps", loop.steps, first, quiet=not process.writes) as counter:
        step, shown = first, "-"  # until the losses are looked at
        epochs = (batches.epoch(epoch) for epoch in count(int(batches.state()["epoch"])))  # from its position on
        for batch in islice(chain.from_iterable(epochs), loop.steps - first):
            torch.manual_seed(step_seed(loop.seed, step, process.rank))
            rate = learning_rate(training, step, loop.steps, epoch_steps)
            terms, scaling = _step(model, optimiser, scaler, batch, rate, training.gradient_clip, loop, process)
            names = names or list(terms)
            unlogged.append(torch.stack([*terms.values(), *scaling]))
            step += 1
            why = _first_of([why, *(one.on_step_end(step, planner, terms) for one in told)])
            looks = step % loop.log_every == 0 or step == loop.steps
            if process.size == 1 or looks:  # several processes must agree, and ask each other rarely
                stopping, ending = process.any_process(asked.is_set()), process.any_process(why is not None)
            measured: dict[str, float] = {}
            saves = stopping or _is_multiple(step, loop.checkpoint_every) or _is_multiple(step, loop.keep_every)
            validates = _is_multiple(step, loop.validate_every) or step == loop.steps or ending
            if looks or saves or validates:  # a checkpoint whose losses are not written would leave a gap after a kill
                shown = f"{log(step):.4f}"
            if validates:
                measured, found_why = check(step)
                why = why or found_why
                ending = process.any_process(why is not None)
                is_best = loop.keep_best is not None and best.step == step
                saves = process.any_process(saves or is_best or ending or step == loop.steps)
            counter.show(step, f"loss {shown}")
            if saves:
                save(step, measured, (why or "as another process asked") if ending and step < loop.steps else None)
            if stopping or ending:
                break
    for one in told:
        one.on_end()
    if stopping and not ending and step < loop.steps:
        raise Stopped(f"stopped after step {step} of {loop.steps}; the same command goes on")


def _first_of(whys: Sequence[str | None]) -> str | None:
    return next((why for why in whys if why is not None), None)


def _step(
    model: torch.nn.Module,
    optimiser: torch.optim.Optimizer,
    scaler: torch.amp.GradScaler,
    batch: Batch,
    rate: float,
    clip: float | None,
    loop: StepSettings,
    process: TrainingProcess,
) -> tuple[dict[str, Tensor], list[Tensor]]:
    """One optimiser step; the terms of the loss, detached, and SCALING where there is some, without a wait for it."""
    model.train()
    set_rate(optimiser, rate)
    optimiser.zero_grad(set_to_none=True)
    sums: dict[str, Tensor] = {}
    for i, part in enumerate(batch.parts(loop.accumulate)):
        last = i == loop.accumulate - 1
        waits: AbstractContextManager[Any] = (
            model.no_sync() if isinstance(model, DistributedDataParallel) and not last else nullcontext()
        )
        with waits:
            with torch.autocast(process.device.type, AUTOCAST.get(loop.precision), enabled=loop.precision != "fp32"):
                terms = {name: term.float() / loop.accumulate for name, term in model(part.to(process.device)).items()}
            scaler.scale(torch.stack(list(terms.values())).sum()).backward()
        sums = {name: sums.get(name, torch.zeros(())).to(term.device) + term.detach() for name, term in terms.items()}
    if clip is not None:
        scaler.unscale_(optimiser)  # nothing without a scale, as are the next two
        torch.nn.utils.clip_grad_norm_(model.parameters(), clip)
    one = torch.ones((), device=process.device)
    before = scaler.scale(one)
    scaler.step(optimiser)
    scaler.update()
    return sums, [before, (scaler.scale(one) < before).float()] if scaler.is_enabled() else []


def _is_multiple(step: int, every: int) -> bool:
    return every > 0 and step % every == 0


def _resume(
    folder: Path,
    planner: Planner,
    optimiser: torch.optim.Optimizer,
    scaler: torch.amp.GradScaler,
    batches: Loader,
    callbacks: Mapping[str, Callback],
) -> int:
    """The steps that are done."""
    state = load_training(folder)
    if state.get("version") != STATE_VERSION:
        raise ValueError(f"{folder}: training state {state.get('version')}, this version goes on from {STATE_VERSION}")
    if (SCALER in state) != scaler.is_enabled():
        raise ValueError(f"{folder}: trained {'in' if SCALER in state else 'not in'} fp16: go on in the same precision")
    load_weights(planner, folder)
    optimiser.load_state_dict(state["optimiser"])
    scaler.load_state_dict(state.get(SCALER, {}))
    batches.resume(state["loader"])
    for name in callbacks.keys() & state.get(CALLBACKS, {}).keys():
        callbacks[name].resume(state[CALLBACKS][name])
    return int(state["step"])


class _WithSpare(torch.nn.Module):
    """A planner beside a parameter that nothing uses: without one every rank warns that all are used."""

    def __init__(self, planner: Planner, device: torch.device) -> None:
        super().__init__()
        self.planner, self.spare = planner, torch.nn.Parameter(torch.zeros(1, device=device))

    def forward(self, batch: Any) -> Any:
        return self.planner(batch)


def _wrapped(planner: Planner, process: TrainingProcess) -> torch.nn.Module:
    if process.size == 1:
        return planner
    return DistributedDataParallel(
        _WithSpare(planner, process.device),
        device_ids=[process.device] if process.device.type == "cuda" else None,
        # Else gradients are dealt to buckets anew after the first step, and a sum over three or more processes, whose
        # order depends on its place in a bucket, is another after a restart.
        find_unused_parameters=True,
    )


def step_seed(seed: int, step: int, rank: int) -> int:
    """Of all that is random in a step; never from what happened before it."""
    return int(np.random.SeedSequence([seed, step, rank]).generate_state(1, np.uint64)[0] >> 1)
