"""What a planner is worth in the middle of its training: its plans for held-out samples, beside the log's and scored.

Scores are `planners evaluate`'s of one stage without filter and extended comfort: the plan is driven by the tracker
among the logged traffic, and progress is relative to PDM-Closed (docs/bank.md).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch

from factory.exits import Stopped
from factory.files import DamagedFile
from factory.graph.parallel import WorkerDied
from factory.graph.steps import TaskStopped
from factory.setup.bank import write_clips
from factory.store.location import Location, SceneFiles
from factory.store.samples import Store
from factory.store.schema import UNLISTED
from factory.views.scene_files import prepared_clip
from planners.data.index import Dataset, DataSettings, open_data
from planners.data.loader import Loader
from planners.data.mix import MixSettings
from planners.models.planner import Planner
from tasks.bank import HEAD, SceneBank
from tasks.subscores import OF_ONE_PLAN
from tasks.world.clip import Clip

LARGEST_BATCH = 32
HOW = "a folder that factory.setup.bank.write_bank wrote of its logs, docs/bank.md"
Validation = Callable[[Planner], dict[str, float]]


def make_validation(
    data: DataSettings, planner: Planner, device: torch.device, workers: int, bank: Path | None = None
) -> Validation:
    """A function that plans for all human samples of the tables `data.val`: means over them.

    ade_m, fde_m: mean and final distance from the plans of the log; with a bank (`open_bank`) before them epdms and
    its sub-scores, 0 .. 1, over the samples that it has scenes of. Raises ValueError where the tables are not what the
    planner needs, and as `open_bank`.
    """
    where = {name: getattr(data, name) for name in ("storage_options", "pictures", "pictures_gb")}
    dataset = open_data(DataSettings(real=data.tables("val"), **where))
    size = max(n for n in range(1, LARGEST_BATCH + 1) if len(dataset) % n == 0)  # no sample is left out
    loader = Loader(dataset, planner.needs_to_plan, MixSettings(), size, workers=workers)
    scenes = None if bank is None else open_bank(bank, dataset, workers)
    scored = set() if scenes is None else {*scenes.clip_ids}
    clips = dict(zip(dataset.rows.attempt_id.tolist(), dataset.rows.clip_id.tolist()))

    def measure(trained: Planner) -> dict[str, float]:
        trained.eval()
        torch.manual_seed(0)  # of what a public planner draws as it plans; a step has a seed of its own
        distances, scores = [], []
        with torch.no_grad():
            for batch in loader.epoch(0):
                here = batch.to(device)
                plans = trained.plan(here).float()
                labels = here.plan_2hz if plans.shape[1] == here.plan_2hz.shape[1] else here.plan_10hz
                distances.append((plans[..., :2] - labels[..., :2]).norm(dim=-1).cpu())
                if scenes is not None:
                    known = {i: clips[name] for i, name in enumerate(batch.attempt_ids) if clips[name] in scored}
                    found = scenes.score([*known.values()], plans[[*known]].unsqueeze(1).cpu().numpy())
                    scores.append(np.concatenate([found.score[..., None], found.subscores], axis=-1)[:, 0])
        off = torch.cat(distances)
        means = [] if scenes is None else np.concatenate(scores).mean(axis=0).tolist()
        names = () if scenes is None else ("epdms", *OF_ONE_PLAN)
        return {**dict(zip(names, means)), "ade_m": float(off.mean()), "fde_m": float(off[:, -1].mean())}

    return measure


@dataclass(frozen=True)
class _KeptClip:
    """Where a run kept a clip."""

    table: str
    clip_id: str
    settings_hash: str


def open_bank(folder: Path, dataset: Dataset, workers: int = 1) -> SceneBank:
    """The bank in a folder; where it lacks clips of the samples it is written first, of what the runs of their tables
    kept, by so many processes. An interrupted one goes on.

    Raises FileNotFoundError where a run kept no scene of a sample, DamagedFile where a damaged one, Damaged for a bank
    of other clips, ValueError where none of the samples can be scored, Stopped where it is interrupted.
    """
    rows = dataset.rows
    hashes = (str(revision).partition(" ")[0] for revision in rows.revision)
    columns = zip(rows.file.tolist(), rows.clip_id.tolist(), hashes, strict=True)
    places = {clip_id: _KeptClip(dataset.files[file].table, clip_id, made_by) for file, clip_id, made_by in columns}
    found = SceneBank(folder) if any(folder.glob(HEAD)) else None
    if found is None or places.keys() - {*found.clip_ids, *found.left_out}:
        tables = {file.table for file in dataset.files}
        stores = {table: Store(Location.parse(table, dataset.settings.storage_options)) for table in tables}
        try:
            write_clips(folder, partial(_read_kept, stores), places, workers=workers)
        except TaskStopped as error:
            raise Stopped("interrupted; what is written of the bank is kept, and the same command goes on") from error
        except WorkerDied as error:
            raise Stopped(str(error)) from error
        found = SceneBank(folder)
    if without := sorted(places.keys() - {*found.clip_ids}):
        said = f"{len(without)} of {len(places)} samples of data.val have no score, such as {without[0]}"
        said += f" ({found.left_out[without[0]]})"
        if len(without) == len(places):
            raise ValueError(f"{said}: name other tables")
        print(f"note: {said}")
    return found


def _read_kept(stores: Mapping[str, Store], kept: _KeptClip) -> Clip:
    """A sample's clip as its run kept it: among a benchmark's scenes, else prepared for attempts."""
    store, clip_id = stores[kept.table], kept.clip_id
    made = {run["settings_hash"]: run["prepare_digest"] for run in store.runs()}
    try:
        if clip_id in SceneFiles(store.location.child("scenes")).clip_ids():
            return SceneFiles(store.location.child("scenes")).load(clip_id).clip
        for digest in dict.fromkeys((made.get(kept.settings_hash, UNLISTED), UNLISTED)):
            if (clip := prepared_clip(store, clip_id, digest)) is not None:
                return clip
    except ValueError as error:  # a damaged one; to the bank a ValueError is of a clip that cannot be scored
        raise DamagedFile(f"{error}; or remove it and give bank=<{HOW}>") from error
    raise FileNotFoundError(
        f"{kept.table}: its run keeps no scene of clip {clip_id}, and data.val is to be scored: give bank=<{HOW}>"
    )
