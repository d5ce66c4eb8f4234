"""Checkpoints: a planner that anyone can load, and the state that its training goes on from.

    <out>/checkpoints/<step>/record.json         the planner, its settings, what it was trained on, how far
                             weights.safetensors
                             arrays.npz          what the planner is built around: vocabulary, anchors
                             training.pt         optimiser and loader; only tensors and plain values are read back

A checkpoint is written beside its place and moved there whole. The record holds the checksums of the others and its
own. No file of it holds code; a planner of a user's own package is imported by the name that the record gives, from
what is installed.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import sys
import zipfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from factory.config.compose import ConfigError
from factory.config.shapes import to_plain
from factory.files import naming_disk_errors
from factory.readers.pickles import load_tensors
from factory.wording import one_line
from planners.models.settings import PlannerChoice
from tasks.caches import json_with_checksum, parse_json_with_checksum
from tasks.world.arrays import FloatArray

if TYPE_CHECKING:
    from torch import Tensor

    from planners.models.planner import Planner

FOLDER = "checkpoints"
RECORD, WEIGHTS, ARRAYS, TRAINING = "record.json", "weights.safetensors", "arrays.npz", "training.pt"
FILES = "files"  # of the record: a checksum of each other file
KEPT = 2  # the newest ones of a training
BEST, ENDED = "best", "ended"  # of the record: the best validation so far, why the training ended before its last step


def save_checkpoint(
    out: Path,
    step: int,
    planner: Planner,
    record: Mapping[str, Any],
    training: Mapping[str, Any],
    keep_every: int = 0,
    best: int | None = None,
) -> Path:
    """Write checkpoint `step` under `out` and remove those that do not stay; returns its folder.

    record: what is to be known of the training, plain values; the planner's name and settings are added. What stays
    beside the newest: those of every so many steps, and that of the step `best`. Raises DiskFull, NotWritable.
    """
    import torch
    from safetensors.torch import save_file

    folder = out / FOLDER / f"{step:08d}"
    unfinished = folder.with_name(f".{folder.name}.{os.getpid()}")
    shutil.rmtree(unfinished, ignore_errors=True)
    who = {"planner": {"name": planner.chosen_as, "settings": settings_record(planner.settings)}, "step": step}
    weights = {k: v.contiguous() for k, v in planner.state_dict().items()}
    with naming_disk_errors(folder, sum(v.nbytes for v in weights.values())):
        unfinished.mkdir(parents=True)
        save_file(weights, unfinished / WEIGHTS)
        np.savez(unfinished / ARRAYS, **planner.arrays)  # type: ignore[arg-type]
        with (unfinished / TRAINING).open("wb") as file:  # by its path PyTorch writes itself, and says not what failed
            torch.save(_interned(training), file)
        files = {FILES: {name: _sha256(unfinished / name) for name in (WEIGHTS, ARRAYS, TRAINING)}}
        (unfinished / RECORD).write_text(json_with_checksum({**who, **record, **files}))
        shutil.rmtree(folder, ignore_errors=True)
        os.replace(unfinished, folder)
    for old in checkpoints(out)[:-KEPT]:
        if int(old.name) != best and not (keep_every and int(old.name) % keep_every == 0):
            shutil.rmtree(old)
    return folder


def _interned(value: Any) -> Any:
    """The same with one string for all equal keys: pickle writes them by identity, which a checkpoint read back has not
    as the one that it was written from, and a training that went on would end with other bytes."""
    if isinstance(value, Mapping):
        return {sys.intern(k) if isinstance(k, str) else k: _interned(of) for k, of in value.items()}
    if type(value) in (list, tuple):
        return type(value)(_interned(of) for of in value)
    return value


def settings_record(settings: Any) -> dict[str, Any]:
    """A planner's settings as a checkpoint keeps them, those that configuration offers."""
    record: dict[str, Any] = json.loads(json.dumps(to_plain(settings)))
    return record


def checkpoints(out: Path) -> list[Path]:
    """The whole checkpoints under a training's folder, oldest first."""
    return sorted(path for path in (out / FOLDER).glob("[0-9]*") if (path / TRAINING).is_file())


def newest_checkpoint(path: Path) -> Path:
    """The checkpoint that `path` is or whose newest it holds, of <training>/best the best. Raises ConfigError where
    there is none."""
    if (path / RECORD).is_file():
        return path
    if path.name == BEST and checkpoints(path.parent):
        return best_checkpoint(path.parent)
    found = checkpoints(path)
    if not found:
        raise ConfigError(f"{path}: no checkpoint here, nor in its folder {FOLDER}: name the folder of a training")
    return found[-1]


def best_checkpoint(out: Path) -> Path:
    """That of a training's best validation. Raises ConfigError where it kept none."""
    best = read_record(out).get(BEST)
    if best is None:
        raise ConfigError(f"{out}: it kept no best checkpoint: train with keep_best=")
    return out / FOLDER / f"{best['step']:08d}"


def is_training(path: Path) -> bool:
    """Whether it can be the folder of a training, or <training>/best."""
    return path.is_dir() or (path.name == BEST and (path.parent / FOLDER).is_dir())


def read_record(path: Path) -> dict[str, Any]:
    """What a checkpoint says of itself. Raises ConfigError."""
    try:
        record = parse_json_with_checksum((newest_checkpoint(path) / RECORD).read_bytes())
        record["planner"]["name"], record["planner"]["settings"], record["step"], record[FILES]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigError(f"{path}: its {RECORD} cannot be read ({error}): restore the checkpoint") from error
    return record


def load_planner(path: str | Path, changed: Mapping[str, Any] | None = None) -> Planner:
    """The trained planner of a checkpoint or a training's newest one, ready to plan.

    changed: settings of planning alone (`Planner.free_settings`) that are to be others than it was trained with.
    Raises ConfigError.
    """
    from planners.models.planner import build_planner, planner_class

    folder = newest_checkpoint(Path(path))
    record = read_record(folder)
    choice = PlannerChoice(**record["planner"])
    bound = sorted(set(changed or {}) - planner_class(choice.name).free_settings)
    if bound:
        free = ", ".join(sorted(planner_class(choice.name).free_settings)) or "none"
        raise ConfigError(f"{folder}: {', '.join(bound)} of {choice.name} cannot change after training; free: {free}")
    choice = replace(choice, settings={**choice.settings, **(changed or {})})
    planner = build_planner(choice, load_arrays(folder))
    load_weights(planner, folder)
    return planner.eval()


def load_arrays(folder: Path) -> dict[str, FloatArray]:
    """What a checkpoint's planner is built around, by name. Raises ConfigError."""
    _refuse_damaged(folder, ARRAYS)
    try:
        with np.load(folder / ARRAYS, allow_pickle=False) as stored:
            return {name: stored[name] for name in stored.files}
    except (OSError, ValueError, zipfile.BadZipFile) as error:
        raise ConfigError(f"{folder / ARRAYS}: {error}: restore the checkpoint") from error


def load_weights(planner: Planner, folder: Path) -> None:
    """Raises ConfigError where the weights are damaged or another model's, naming what differs."""
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    _refuse_damaged(folder, WEIGHTS)
    try:
        stored = load_file(folder / WEIGHTS)
    except (OSError, SafetensorError) as error:
        raise ConfigError(f"{folder / WEIGHTS}: {error}: restore the checkpoint") from error
    put_weights(planner, stored, f"{folder}: not a checkpoint of this {planner.name}")


def put_weights(planner: Planner, stored: Mapping[str, Tensor], refusal: str) -> None:
    """Raises ConfigError that begins with `refusal` where a weight is missing, unknown or of another shape."""
    own = planner.state_dict()
    wrong = [f"{name} is missing" for name in own if name not in stored]
    wrong += [f"{name} is unknown" for name in stored if name not in own]
    wrong += [
        f"{name} is {tuple(stored[name].shape)}, not {tuple(own[name].shape)}"
        for name in own.keys() & stored.keys()
        if stored[name].shape != own[name].shape
    ]
    if wrong:
        more = f" and {len(wrong) - 3} more" if len(wrong) > 3 else ""
        raise ConfigError(f"{refusal}: {'; '.join(wrong[:3])}{more}")
    planner.load_state_dict(stored)


def load_training(folder: Path) -> dict[str, Any]:
    """The state that a training goes on from. Raises ConfigError for a file that is damaged or holds anything else."""
    _refuse_damaged(folder, TRAINING, f"remove {folder} to go on from the one before")
    try:
        state = load_tensors(folder / TRAINING)
    except Exception as error:  # whatever a damaged zip or a refused object raises
        raise ConfigError(
            f"{folder / TRAINING}: {one_line(error)}: remove {folder} to go on from the one before"
        ) from error
    assert isinstance(state, dict)
    return state


def _refuse_damaged(folder: Path, name: str, remedy: str = "restore the checkpoint") -> None:
    """Raises ConfigError where a file is not what the record says."""
    try:
        damaged = _sha256(folder / name) != read_record(folder)[FILES][name]
    except OSError as error:
        raise ConfigError(f"{folder / name}: {error}: {remedy}") from error
    if damaged:
        raise ConfigError(f"{folder / name}: its checksum is another than when it was written: {remedy}")


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def planner_digest(path: str | Path) -> str:
    """16 hex digits of a planner's weights, arrays and settings: what it plans depends on nothing else."""
    folder = newest_checkpoint(Path(path))
    found = hashlib.sha256(json.dumps(read_record(folder)["planner"], sort_keys=True).encode())
    for name in (WEIGHTS, ARRAYS):
        found.update((folder / name).read_bytes())
    return found.hexdigest()[:16]
