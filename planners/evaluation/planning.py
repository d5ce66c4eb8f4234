"""The plans of a benchmark's frames, by planners with either face (planners/evaluation/planner_names.py).

A planner is shown everything of a sample up to now and nothing that only comes later (`as_shown`). Several planners
plan from one reading of the samples: what is decoded for one serves all that need the same.
"""

import json
import os
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from factory.config.compose import ConfigError
from factory.graph.progress import RateBar
from factory.store.reader import Sample
from factory.store.schema import LABEL_COLUMNS, NOW_INDEX, SCHEMA
from planners.data.batch import Batch, BevLayout, ImageLayout, Needs
from planners.data.bev import bev_raster
from planners.data.decode import BatchBuffer, StoredRows
from planners.data.images import stitch_sample
from planners.data.index import BEV_COLUMNS
from planners.evaluation.benchmark_folder import BenchmarkFolder
from planners.evaluation.frames import LOGGED_KINDS, FrameKey
from planners.evaluation.planner_names import EvaluatedPlanner, needs_of
from planners.evaluation.scoring import Plans
from tasks.trajectories import at_ten_hz
from tasks.world.arrays import Array, Bytes

SCORES = ("stage1_", "stage2_", "off_log_", *LABEL_COLUMNS)
LATER_NAN = ("agent_boxes", "agent_velocities", "agent_center_z")
LATER_ZERO = ("agent_valid", "light_states")
EGO_COLUMNS = ("attempt_id", "expert", "command", "ego_status", "ego_history_2hz")


def without_future(sample: Mapping[str, Any]) -> Sample:
    """A copy of a sample, or of some of its columns, without what comes after now.

    label_*, proposal_10hz                      zeros (the drive that followed)
    stage1_*, stage2_*, label_subscores, off_log_*, ...    None (scores)
    agent_boxes, agent_velocities, ...          NaN, and agent_valid False, after now
    light_states                                0, unknown, after now
    parent_states                               the logged state at T+H is NaN in frames at or before T
    """
    shown: Sample = {name: value for name, value in sample.items() if not name.startswith(SCORES)}
    for name in ("label_10hz", "label_2hz", "proposal_10hz"):
        if shown.get(name) is not None:
            shown[name] = np.zeros_like(shown[name])
    for names, unknown in ((LATER_NAN, np.nan), (LATER_ZERO, 0)):
        for name in shown.keys() & set(names):
            shown[name] = np.array(sample[name])
            if len(shown[name]):
                shown[name][:, NOW_INDEX + 1 :] = unknown
    if "parent_states" in shown and sample["expert"] in LOGGED_KINDS:
        shown["parent_states"] = np.array(sample["parent_states"])
        shown["parent_states"][1] = np.nan
    return shown


def columns_to_read(needs: Needs | None) -> list[str]:
    """The columns that have to be read of a sample for a batch with these needs; None: all that may be shown."""
    if needs is None:
        return [name for name in SCHEMA.names if not name.startswith(SCORES)]
    bev = BEV_COLUMNS if needs.bev is not None else ()
    route = () if needs.command == "navsim" or "route_centerline" in bev else ("route_centerline",)
    return [*EGO_COLUMNS, *bev, *route, *(("cameras", "images") if needs.image is not None else ())]


class _StoredSample(StoredRows):
    """A sample as the loader's rows are read; zeros for the plans, which are not shown."""

    def __init__(self, sample: Mapping[str, Any]) -> None:
        self._sample = sample

    def value(self, column: str, row: int) -> Any:
        return 0.0 if column.startswith("label_") else self._sample[column]

    def values(self, columns: Sequence[str], row: int) -> Any:
        return self._sample

    def raster(self, row: int, layout: BevLayout) -> Bytes:
        return bev_raster(self._sample, layout)

    def picture(self, row: int, layout: ImageLayout, out: Bytes, keep: bool = False) -> None:
        out[:] = stitch_sample(self._sample, layout)


def batch_samples(samples: Sequence[Mapping[str, Any]], needs: Needs) -> Batch:
    """The batch that a planner plans for. Raises ValueError, naming the sample, where it lacks what `needs` asks."""
    buffer = BatchBuffer(len(samples), replace(needs, labels=None), 0)
    for i, sample in enumerate(samples):
        try:
            buffer.fill(i, _StoredSample(sample), 0)
        except ValueError as error:
            raise ValueError(f"sample {sample['attempt_id']}: {error}") from error
    simulated = np.array([sample["expert"] not in LOGGED_KINDS for sample in samples])
    return buffer.batch([str(sample["attempt_id"]) for sample in samples], simulated, np.zeros_like(simulated))


Samples = Sequence[Mapping[str, Any]]

PLANS = "plans.npz"  # kept, so that scoring may begin again without planning


def plan_samples(made: Any, samples: Samples, device: str = "cpu") -> Array:
    """(B, 40, 3) plans of one planner. Raises ValueError, naming the sample, for what is no plan."""
    return _answers(made, _shown_to(needs_of(made), samples, device), samples)


def all_plans(
    benchmark: BenchmarkFolder,
    keys: Sequence[FrameKey],
    who: Sequence[tuple[EvaluatedPlanner, Path, Mapping[str, Any]]],
    batch_size: int,
    at_once: int,
    device: str,
) -> dict[str, Plans]:
    """The plans of every planner, by label; read from its folder where they are there.

    who: each with its folder and what identifies its plans there; at_once: planners in memory at a time. Plans are
    stored as soon as those planners are through. Raises ConfigError naming planner and sample for what is no plan.
    """
    plans: dict[str, Plans] = {}
    waiting = []
    for one, folder, identity in who:
        stored = read_plans(folder, identity)
        if stored is not None:
            plans[one.label] = stored
        elif one.submitted is not None:
            plans[one.label] = one.plans_of(benchmark.tokens, keys)
        else:
            waiting.append((one, folder, identity))
    for first in range(0, len(waiting), at_once):
        group = waiting[first : first + at_once]
        found = _planned(benchmark, keys, [one for one, _, _ in group], batch_size, device)
        for one, folder, identity in group:
            write_plans(folder, identity, found[one.label])
        plans.update(found)
    return plans


def _planned(
    benchmark: BenchmarkFolder, keys: Sequence[FrameKey], who: Sequence[EvaluatedPlanner], batch_size: int, device: str
) -> dict[str, dict[FrameKey, Array]]:
    made = {one.label: _loaded(one, device) for one in who}
    needs = {label: needs_of(planner) for label, planner in made.items()}
    kinds = list(dict.fromkeys(needs.values()))
    columns = dict.fromkeys(name for kind in kinds for name in columns_to_read(kind))
    wanted = set(keys)
    frames = (frame for frame in benchmark.stream(list(columns)) if frame[0] in wanted)
    plans: dict[str, dict[FrameKey, Array]] = {label: {} for label in made}
    name = who[0].label if len(who) == 1 else f"{len(who)} planners"
    done = 0
    with RateBar(f"{name}: frames planned", len(keys)) as progress:
        while part := list(islice(frames, batch_size)):
            samples = [sample for _, sample in part]
            for kind in kinds:
                shown = _shown_to(kind, samples, device)
                for label in (label for label in made if needs[label] == kind):
                    try:
                        answers = _answers(made[label], shown, samples)
                    except ValueError as error:
                        raise ConfigError(f"planner {label}: {error}") from error
                    plans[label].update(zip((key for key, _ in part), answers))
            done += len(part)
            progress.show(done)
    return plans


def _loaded(one: EvaluatedPlanner, device: str) -> Any:
    from torch import nn

    made = one.made()
    return made.to(device) if isinstance(made, nn.Module) else made


def _shown_to(needs: Needs | None, samples: Samples, device: str) -> Batch | Samples:
    shown = [without_future(sample) for sample in samples]
    return shown if needs is None else batch_samples(shown, needs).to(device)


def _answers(made: Any, shown: Batch | Samples, samples: Samples) -> Array:
    if isinstance(shown, Batch):
        plans = list(plan_batch(made, shown))
    else:
        plans = [np.asarray(made.plan(sample), dtype=np.float64) for sample in shown]
    for sample, plan in zip(samples, plans):
        check_plan(plan, f"sample {sample['attempt_id']}")
    return np.concatenate([at_ten_hz(plan[None]) for plan in plans])


def check_plan(plan: Array, name: str) -> None:
    """Raises ValueError, naming whose it is, for what is no plan."""
    if plan.shape not in ((8, 3), (40, 3)) or not np.isfinite(plan).all():
        raise ValueError(f"{name}: a plan must be (8 or 40, 3) finite numbers, got {plan.shape}")


def plan_batch(made: Any, batch: Batch) -> Array:
    """What a planner answers to a batch, (B, 8 or 40, 3). Raises ValueError for anything else."""
    import torch

    with torch.inference_mode():
        plans = made.plan(batch)
    array = plans.detach().double().cpu().numpy() if isinstance(plans, torch.Tensor) else np.asarray(plans, np.float64)
    if array.ndim != 3 or len(array) != len(batch):
        raise ValueError(f"plan() of a batch of {len(batch)} returned {array.shape}, not ({len(batch)}, 8 or 40, 3)")
    return array


def write_plans(folder: Path, identity: Mapping[str, Any], plans: Mapping[FrameKey, Array]) -> None:
    """`plans.npz`: who planned (JSON), frame by frame which, and poses (F, 40, 3) in the ego frame."""
    unfinished = folder / f".{os.getpid()}.{PLANS}"
    np.savez_compressed(
        unfinished,
        identity=np.array(json.dumps(identity, sort_keys=True)),
        clip_id=np.array([key.clip_id for key in plans]),
        kind=np.array([key.kind for key in plans]),
        candidate_index=np.array([key.candidate_index for key in plans]),
        poses=np.stack(list(plans.values())),
    )
    os.replace(unfinished, folder / PLANS)


def read_plans(folder: Path, identity: Mapping[str, Any] | None = None) -> dict[FrameKey, Array] | None:
    """The stored plans; None where there are none, or they are another's than `identity`, or damaged."""
    try:
        with np.load(folder / PLANS, allow_pickle=False) as stored:
            if identity is not None and json.loads(str(stored["identity"])) != dict(identity):
                return None
            keys = zip(stored["clip_id"].tolist(), stored["kind"].tolist(), stored["candidate_index"].tolist())
            return dict(zip((FrameKey(*key) for key in keys), stored["poses"]))
    except (FileNotFoundError, zipfile.BadZipFile, KeyError, ValueError):
        return None
