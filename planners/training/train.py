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
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from factory.config.arguments import command
from factory.config.compose import ConfigError, compose, fill
from factory.config.shapes import GIVE, deep_merge, to_plain
from factory.graph.own_process import run_command_in_own_process
from planners.data.index import Dataset, DataSettings, open_data
from planners.data.loader import Loader
from planners.data.mix import MixSettings, batches_in
from planners.models.settings import GtrsDenseSettings, PlannerChoice, settings_class, settings_of
from planners.training.checkpoint import (
    Keep,
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
    from planners.training.processes import TrainingProcess

LARGEST_BATCH = 32
FURTHER = frozenset({"steps", "processes", "accumulate"})  # what may be another with resume=further


def make_validation(
    data: DataSettings, planner: Planner, process: TrainingProcess, workers: int
) -> Callable[[Planner], dict[str, float]]:
    """A function that plans for all human samples of the tables `data.val`: ade_m and fde_m, mean and final distance.

    Raises ValueError where the tables are not what the planner needs.
    """
    import torch

    where = {name: getattr(data, name) for name in ("storage_options", "pictures", "pictures_gb")}
    dataset = open_data(DataSettings(real=data.tables("val"), **where))
    needs = replace(planner.needs, labels=None)
    size = max(n for n in range(1, LARGEST_BATCH + 1) if len(dataset) % n == 0)  # no sample is left out
    loader = Loader(dataset, needs, MixSettings(), size, workers=workers)

    def measure(trained: Planner) -> dict[str, float]:
        trained.eval()
        distances = []
        with torch.no_grad():
            for batch in loader.epoch(0):
                here = batch.to(process.device)
                plans = trained.plan(here)
                labels = here.plan_2hz if plans.shape[1] == here.plan_2hz.shape[1] else here.plan_10hz
                distances.append((plans[..., :2].float() - labels[..., :2]).norm(dim=-1).cpu())
        off = torch.cat(distances)
        return {"ade_m": float(off.mean()), "fde_m": float(off[:, -1].mean())}

    return measure


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
    workers: int = 2  # threads that decode
    log_every: int = 20  # steps
    checkpoint_every: int = 1000  # steps
    validate_every: int = 0  # steps; 0: after the last one
    keep_every: int = 0  # steps: checkpoints of their multiples stay; 0: only the newest two
    keep_best: Literal["ade_m", "fde_m"] | None = None  # the checkpoint with the least of it on data.val stays as well
    ray: RaySettings = field(default_factory=RaySettings)

    def __post_init__(self) -> None:
        for name in ("accumulate", "workers", "log_every", "checkpoint_every"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}={getattr(self, name)}: must be at least 1")
        if self.keep_every < 0:
            raise ValueError(f"keep_every={self.keep_every}: must be at least 1, or 0 for none")
        if self.keep_best is not None and not (self.data.val and self.validate_every):
            raise ValueError(
                f"keep_best={self.keep_best}: name data.val, and validate_every, to have some to choose from"
            )
        if self.steps is not None and self.steps < 1:
            raise ValueError(f"steps={self.steps}: must be at least 1, or null for planner.training.epochs")

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
    check = make_validation(config.data, planner, process, config.workers) if config.data.val else None
    identity = _identity(config, dataset, steps, process)
    resume_from = _checkpoint_to_resume(out, config, identity)
    before = {} if resume_from is None else read_record(resume_from)
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
    loop = StepSettings(
        seed=config.seed,
        steps=steps,
        accumulate=config.accumulate,
        precision=precision,
        log_every=config.log_every,
        checkpoint_every=config.checkpoint_every,
        validate_every=config.validate_every,
        keep=Keep(config.keep_every, config.keep_best),
    )
    process.wait()  # nobody looks for checkpoints any more
    fit(planner, loader, training, loop, process, out, record, resume_from, check)
    if process.writes:
        print(f"trained: {newest_checkpoint(out)}")
        if config.keep_best is not None:
            print(f"least {config.keep_best}: {best_checkpoint(out, config.keep_best)}")
        print(_next_text(config.out, planner.needs_to_plan.image is not None))


def _next_text(out: str, looks: bool) -> str:
    """The commands that say what a trained planner is worth, to be pasted into a shell. looks: whether at pictures."""
    blind = "" if looks else " 'clips.settings.cameras=[]' clips.settings.lidar_beams=0"
    drive = f"drive {shlex.quote(f'planner={out}')} clips.n_clips=6{blind} films=6 {shlex.quote(f'out={out}/drives')}"
    score = f"evaluate benchmark=runs/hard {shlex.quote(f'planner={out}')}"
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
