"""`python -m planners train`: samples in, a planner out.

    python -m planners train planner=ltf data.real=[runs/town] data.sim=[runs/town] out=runs/ltf
    python -m planners train planner=gtrs_dense planner.settings.vocabulary=<K x 40 x 3>.npy mix.sim_ratio=0.5 ...
    python -m planners train planner=ltf init_from=runs/ltf ...  trains a planner further, on other data
    torchrun --nproc-per-node 8 -m planners train ...          on the GPUs of a node
    python -m planners train executor=ray ray.processes=8 ray.gpus=1 ...    on a Ray cluster
    python -m planners train ... --cfg                          the settings, resolved

The same command on the same `out` goes on where it stopped, to the identical curve; with `resume=further` also to more
steps or on another number of processes. Exit codes: 0 complete, 2 bad settings or data, 4 interrupted and resumable.
"""

from __future__ import annotations

import dataclasses
import json
import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from factory.config.arguments import command
from factory.config.compose import ConfigError, build, compose, fill
from factory.config.shapes import GIVE, deep_merge, to_plain
from factory.graph.own_process import run_command_in_own_process
from planners.data.index import Dataset, DataSettings, open_data
from planners.data.loader import Loader
from planners.data.mix import MixSettings, batches_in
from planners.models.settings import GtrsDenseSettings, PlannerChoice, settings_class, settings_of
from planners.training.checkpoint import (
    BEST,
    ENDED,
    best_checkpoint,
    checkpoints,
    load_arrays,
    load_weights,
    newest_checkpoint,
    planner_digest,
    read_record,
    settings_record,
)
from planners.training.optim import TrainingSettings

if TYPE_CHECKING:  # PyTorch is imported once the settings and the samples are found to fit
    from planners.models.planner import Planner
    from planners.training.callbacks import Callback
    from planners.training.processes import TrainingProcess

FURTHER = frozenset({"steps", "processes", "accumulate"})  # what may be another with resume=further
Every = int | str  # steps, or epochs as 2ep or 0.5ep


def in_steps(every: Every, epoch_steps: int) -> int:
    """An interval in steps, of epochs that have so many. Raises ValueError for other text."""
    if isinstance(every, int):
        return every
    epochs = float(every.removesuffix("ep")) if every.endswith("ep") else math.nan
    if not 0.0 < epochs < math.inf:
        raise ValueError(f"{every}: not epochs, such as 2ep")
    return max(1, round(epochs * epoch_steps))


@dataclass(frozen=True)
class PlannerEntry(PlannerChoice):
    """What conf/planner/*.yaml holds."""

    training: TrainingSettings | None = None


@dataclass(frozen=True)
class RaySettings:
    """The processes that Ray Train starts."""

    processes: int = 2
    gpus: int = 0  # of each
    cpus: int = 1


@dataclass(frozen=True)
class TrainConfig:
    """Everything on the command line."""

    planner: PlannerEntry
    out: str  # the same command on the same folder resumes
    mix: MixSettings = field(default_factory=MixSettings)
    data: DataSettings = field(default_factory=DataSettings)
    steps: int | None = None  # optimiser steps in all; null: planner.training.epochs
    seed: int = 0  # of the weights at the start, the order and everything random in a step
    init_from: str | None = None  # folder of a training of the same planner, or a checkpoint: whose weights go on
    resume: Literal["identical", "further"] = "identical"  # further: other steps, processes, accumulate
    executor: Literal["process", "ray"] = "process"  # process: alone, or as torchrun starts it; ray: Ray Train
    device: Literal["auto", "cpu", "cuda"] = "auto"
    precision: Literal["auto", "fp32", "bf16", "fp16"] = "auto"  # auto: bf16 on a GPU, fp32 elsewhere
    accumulate: int = 1  # parts that a batch is computed in
    recompute: bool = False  # backbones over pictures keep no activations: less memory, a forward pass more
    workers: int = 2  # threads that decode; processes that write a bank first
    log_every: int = 20  # steps
    checkpoint_every: Every = 1000  # steps, or epochs as 2ep or 0.5ep
    validate_every: Every = 0  # the same; 0: after the last step
    keep_every: Every = 0  # the same: checkpoints of their multiples stay; 0: only the newest two
    keep_best: Literal["epdms", "ade_m", "fde_m"] | None = None  # the checkpoint that is best by it on data.val stays
    patience: int | None = None  # validations without a better one by keep_best after which the training ends
    bank: str | None = None  # folder of scenes that score plans, made there; null: <out>/bank of keep_best=epdms
    callbacks: dict[str, dict[str, Any]] = field(default_factory=dict)  # planners.training.callbacks.Callback by name
    ray: RaySettings = field(default_factory=RaySettings)

    def __post_init__(self) -> None:
        for name in ("accumulate", "workers", "log_every", "patience"):
            if getattr(self, name) is not None and getattr(self, name) < 1:
                raise ValueError(f"{name}={getattr(self, name)}: must be at least 1")
        for name, least in (("checkpoint_every", 1), ("validate_every", 0), ("keep_every", 0)):
            try:
                fits = in_steps(getattr(self, name), 1) >= least
            except ValueError:
                fits = False
            if not fits:
                raise ValueError(f"{name}={getattr(self, name)}: must be steps, at least {least}, or epochs as 2ep")
        if self.keep_best is not None and not (self.data.val and self.validate_every):
            raise ValueError(
                f"keep_best={self.keep_best}: name data.val, and validate_every, to have some to choose from"
            )
        if self.patience is not None and self.keep_best is None:
            raise ValueError(f"patience={self.patience}: name keep_best, by which it is seen whether it gets better")
        if self.bank is not None and not self.data.val:
            raise ValueError(f"bank={self.bank}: name data.val, whose plans are scored on its scenes")
        if self.steps is not None and self.steps < 1:
            raise ValueError(f"steps={self.steps}: must be at least 1, or null for planner.training.epochs")

    @property
    def bank_folder(self) -> Path | None:
        """Of the scenes; None: plans are not scored."""
        if self.bank is None and self.keep_best != "epdms":
            return None
        return Path(self.out, "bank") if self.bank is None else Path(self.bank)

    @property
    def training(self) -> TrainingSettings:
        """Raises ConfigError for a planner that does not learn."""
        if self.planner.training is None:
            raise ConfigError(f"planner={self.planner.name} has nothing to learn: evaluate it, there is no training")
        return self.planner.training


@command("train", TrainConfig)
def main(argv: Sequence[str]) -> int | None:
    """The command."""
    config = _config_of(argv)
    if config.executor == "ray":
        return run_command_in_own_process(_main_on_ray, tuple(argv))
    config.training  # noqa: B018 - raises ConfigError for a planner that does not learn
    dataset, settings = open_data(config.data, mix=config.mix), settings_of(config.planner)
    if isinstance(settings, GtrsDenseSettings) and config.init_from is None:  # before PyTorch takes its seconds
        try:
            settings.check_labels(dataset.label_vocabulary)
        except ValueError as error:
            raise ConfigError(f"planner {config.planner.name}: {error}") from error
    from planners.training.processes import join_process_group

    with join_process_group(config.device) as process:
        train(config, process, dataset)
    return None


def _config_of(argv: Sequence[str]) -> TrainConfig:
    return fill(TrainConfig, compose("train", argv, TrainConfig, _with_planner_settings, _shapes_of), "train")


def _main_on_ray(argv: Sequence[str]) -> int:
    def does(words: Sequence[str]) -> None:
        from planners.training.on_ray import train_on_ray

        config = _config_of(words)
        train_on_ray(partial(train, config), config.out, **dataclasses.asdict(config.ray))

    return dataclasses.replace(main, does=does)(argv)


def _with_planner_settings(values: dict[str, Any]) -> dict[str, Any]:
    """Composed settings with the defaults of the planner's own. Raises ConfigError."""
    entry = values["planner"]
    if entry["name"] == GIVE:
        return values
    own = settings_of(PlannerChoice(entry["name"], entry.get("settings", {})))
    return deep_merge(values, {"planner": {"settings": to_plain(own)}})


def _shapes_of(values: Mapping[str, Any]) -> Mapping[str, type[Any]]:
    name = values["planner"]["name"]
    return {} if name == GIVE else {"planner.settings": settings_class(name)}


def train(config: TrainConfig, process: TrainingProcess, dataset: Dataset | None = None) -> None:
    """The part of one process; dataset: the samples of `config.data`, None: opened here.

    Raises ConfigError or ValueError for what does not fit, Stopped when interrupted.
    """
    out = Path(config.out).absolute()
    import cv2
    import torch

    from planners.models.backbones import set_recompute
    from planners.training.fit import StepSettings, fit, total_steps

    callbacks = _callbacks(config)
    cv2.setNumThreads(1)  # pictures are decoded side by side already
    settings = settings_of(config.planner)
    dataset = open_data(config.data, mix=config.mix) if dataset is None else dataset
    asked = config.training.batch_size
    if rest := asked % (process.size * config.accumulate):
        raise ConfigError(
            f"planner.training.batch_size={asked} does not divide into {process.size} processes times "
            f"accumulate={config.accumulate} parts: {asked - rest + process.size * config.accumulate} does"
        )
    config = _with_fitting_batch(config, dataset, process)
    training = config.training
    torch.manual_seed(config.seed)
    planner = _planner(config, settings, dataset)
    set_recompute(planner, config.recompute)
    loader = Loader(
        dataset,
        planner.needs,
        config.mix,
        training.batch_size,
        process.rank,
        process.size,
        config.seed,
        config.workers,
        pinned=process.device.type == "cuda",
    )
    steps = total_steps(loader, training, config.steps)
    identity = _identity(config, dataset, steps, process)
    resume_from = _checkpoint_to_resume(out, config, identity)
    before = {} if resume_from is None else read_record(resume_from)
    is_over = ENDED in before and config.resume == "identical"
    check = None
    if config.data.val and process.writes and not is_over:
        from planners.training.validation import make_validation

        check = make_validation(config.data, planner, process.device, config.workers, config.bank_folder)
    backbones = _load_first_weights(planner, config) if resume_from is None else before["backbones"]
    record = {
        "trained": identity,
        **_earlier_settings(before, identity),
        "samples": {"real": int((~dataset.rows.simulated).sum()), "simulated": int(dataset.rows.simulated.sum())},
        "backbones": backbones,
        "parameters": sum(parameter.numel() for parameter in planner.parameters()),
    }
    if process.writes:
        if training.batch_size != asked:
            why = f"a batch of {asked} takes more samples than there are"
            print(f"note: planner.training.batch_size={asked} -> {training.batch_size}: {why}")
        print(_plan_text(config, record, loader, resume_from), flush=True)
    precision = config.precision
    if precision == "auto":
        precision = "bf16" if process.device.type == "cuda" else "fp32"
    epoch_steps = loader.n_batches(0)
    loop = StepSettings(
        seed=config.seed,
        steps=steps,
        accumulate=config.accumulate,
        precision=precision,
        log_every=config.log_every,
        checkpoint_every=in_steps(config.checkpoint_every, epoch_steps),
        validate_every=in_steps(config.validate_every, epoch_steps),
        keep_every=in_steps(config.keep_every, epoch_steps),
        keep_best=config.keep_best,
        patience=config.patience,
    )
    process.wait()  # nobody looks for checkpoints any more
    if not is_over:
        fit(planner, loader, training, loop, process, out, record, resume_from, check, callbacks)
    if process.writes:
        if ENDED in (last := read_record(out)):
            print(f"ended after step {last['step']} of {steps}: {last[ENDED]}")
        print(f"trained: {newest_checkpoint(out)}")
        if config.keep_best is not None:
            print(f"best {config.keep_best}: {best_checkpoint(out)}")
        best = "" if config.keep_best is None else f"/{BEST}"
        print(_next_text(config.out, best, planner.needs_to_plan.image is not None))


def _callbacks(config: TrainConfig) -> dict[str, Callback]:
    """Those that the settings name. Raises ConfigError."""
    from planners.training.callbacks import Callback

    made = {name: build(spec, f"callbacks.{name}") for name, spec in config.callbacks.items()}
    for name, one in made.items():
        if not isinstance(one, Callback):
            raise ConfigError(f"callbacks.{name}: {type(one).__name__} is no planners.training.callbacks.Callback")
    return made


def _next_text(out: str, best: str, looks: bool) -> str:
    """The commands that say what a trained planner is worth, to be pasted into a shell. looks: whether at pictures."""
    who = shlex.quote(f"planner={out}{best}")
    blind = "" if looks else " 'clips.settings.cameras=[]' clips.settings.lidar_beams=0"
    drive = f"drive {who} clips.n_clips=6{blind} films=6 {shlex.quote(f'out={out}/drives')}"
    score = f"evaluate benchmark=runs/hard {who}"
    return f"watch it drive: python -m planners {drive}\nscore it: python -m planners {score}"


def _with_fitting_batch(config: TrainConfig, dataset: Dataset, process: TrainingProcess) -> TrainConfig:
    """With a batch that the samples suffice for; a training that goes on keeps its own. Raises ConfigError."""
    asked, parts = config.training.batch_size, process.size * config.accumulate
    n_first = len(dataset) if config.mix.ratio is None else int((~dataset.rows.simulated).sum())
    sizes = range(asked, 0, -parts)  # in equal parts; 0 where a pass over the samples has no batch
    size = next((size for size in sizes if batches_in(n_first, size, config.mix.ratio)), 0)
    out = Path(config.out).absolute()
    if size != asked and checkpoints(out):
        size = int(read_record(out)["trained"]["planner.training"]["batch_size"])
    if not size or size % parts:
        raise ConfigError(
            f"a batch of {size or f'up to {len(dataset)}'} samples does not divide into {process.size} processes times "
            f"accumulate={config.accumulate} parts: lower accumulate, or take fewer processes"
        )
    return replace(config, planner=replace(config.planner, training=replace(config.training, batch_size=size)))


def _planner(config: TrainConfig, settings: Any, dataset: Dataset) -> Planner:
    """The planner, built around what the samples give it; trained further, around what it was trained with."""
    from planners.models.planner import build_planner, planner_class

    if config.init_from is not None:
        before = read_record(Path(config.init_from))["planner"]
        if before == {"name": config.planner.name, "settings": settings_record(settings)}:
            return build_planner(config.planner, load_arrays(newest_checkpoint(Path(config.init_from))))
    try:
        arrays = planner_class(config.planner.name).fixed_arrays(settings, dataset.training_data())
    except (ValueError, OSError) as error:
        raise ConfigError(f"planner {config.planner.name}: {error}") from error
    return build_planner(config.planner, arrays)


def _load_first_weights(planner: Planner, config: TrainConfig) -> dict[str, str]:
    """Fills in the weights that a training begins with; backbone -> where its weights are from."""
    from planners.models.backbones import load_pretrained

    if config.init_from is None:
        return load_pretrained(planner)
    folder = newest_checkpoint(Path(config.init_from))
    load_weights(planner, folder)
    backbones: dict[str, str] = read_record(folder)["backbones"]
    return backbones


def _identity(config: TrainConfig, dataset: Dataset, steps: int, process: TrainingProcess) -> dict[str, Any]:
    """All that the loss curve depends on beside the planner; a folder is gone on with only where it is the same."""
    values = {
        "planner.training": dataclasses.asdict(config.training),
        "mix": dataclasses.asdict(config.mix),
        "samples": dataset.digest,
        "steps": steps,
        "seed": config.seed,
        "init_from": None if config.init_from is None else planner_digest(config.init_from),
        "precision": config.precision,
        "accumulate": config.accumulate,
        "processes": process.size,
    }
    same: dict[str, Any] = json.loads(json.dumps(values))  # as a checkpoint gives it back
    return same


def _checkpoint_to_resume(out: Path, config: TrainConfig, identity: Mapping[str, Any]) -> Path | None:
    """The checkpoint to go on from; None where there is none. Raises ConfigError where it is of another training."""
    if not checkpoints(out):
        return None
    record = read_record(out)
    now = {
        **identity,
        "planner.name": config.planner.name,
        "planner.settings": settings_record(settings_of(config.planner)),
    }
    who = record["planner"]
    then = {**record["trained"], "planner.name": who["name"], "planner.settings": who["settings"]}
    differs = {key: f"{key} {then.get(key)} -> {value}" for key, value in now.items() if then.get(key) != value}
    allowed = FURTHER if config.resume == "further" else frozenset()
    if differs.keys() - allowed:
        further = ", or resume=further" if differs.keys() <= FURTHER else ""
        raise ConfigError(
            f"out={config.out} holds a training with other settings: {'; '.join(differs.values())}: choose another "
            f"out, or give the settings it began with{further}"
        )
    if record["step"] > identity["steps"]:
        raise ConfigError(f"out={config.out} has done {record['step']} steps: ask for as many in all, or more")
    return newest_checkpoint(out)


def _earlier_settings(before: Mapping[str, Any], identity: Mapping[str, Any]) -> dict[str, Any]:
    """For the record: up to which step a training that goes on further was computed with other settings."""
    earlier = list(before.get("earlier", []))
    then = before["trained"] if before else identity
    changed = {key: then[key] for key in sorted(FURTHER) if then[key] != identity[key]}
    if changed:
        earlier.append({"until_step": before["step"], **changed})
    return {"earlier": earlier} if earlier else {}


def _plan_text(config: TrainConfig, record: Mapping[str, Any], loader: Loader, resume_from: Path | None) -> str:
    begins = f"goes on from {resume_from}" if resume_from is not None else "begins"
    first = config.init_from
    begun = [] if first is None else [f"weights to begin with: {newest_checkpoint(Path(first))}"]
    weights = ", ".join(f"{name}: {source}" for name, source in record["backbones"].items()) or "there are none"
    return "\n".join(
        [
            f"{config.planner.name}: {record['parameters']:,} parameters; pretrained backbones: {weights}",
            *begun,
            loader.text(),
            f"{record['trained']['steps']} steps; {begins}; out: {config.out}",
        ]
    )
