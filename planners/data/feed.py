"""What there is to learn from, checked before the first batch: `open_data`, and what a planner's needs make of it.

What is wrong with the data is said by table, sample and setting, before anything is decoded.
"""

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from factory.store.parquet_file import naming
from factory.store.reader import TIME_TOLERANCE_S, group_rows
from factory.store.schema import LABEL_COLUMNS
from planners.data.batch import ImageLayout, Needs
from planners.data.files import group_bytes, leaves, read_all
from planners.data.images import chosen_cameras
from planners.data.index import OPEN_FILES, Dataset, DataSettings, open_dataset
from planners.data.mix import MixSettings, Samples, check_sides, sample_weights
from tasks.world.arrays import Array, Ints

PLAN_COLUMNS = ("command", "ego_status", "ego_history_2hz", "label_2hz", "label_10hz")
IMAGE_COLUMNS = ("images.camera", "images.time_s", "images.jpeg")
AGENT_COLUMNS = ("agent_kinds", "agent_boxes", "agent_valid")
BEV_COLUMNS = (
    *AGENT_COLUMNS,
    "lane_polygons",
    "lane_centerlines",
    "drivable_rings",
    "crossing_rings",
    "route_centerline",
)


@dataclass(frozen=True, eq=False)
class Feed:
    """What is read of the samples for one planner."""

    dataset: Dataset
    needs: Needs
    columns: tuple[str, ...]
    cameras: tuple[tuple[str, ...], ...]  # (n) of each sample's picture, left to right; empty without images
    size: Ints  # (n,) bytes that a sample takes in memory between its batches, about


def open_data(settings: DataSettings, mix: MixSettings | None = None) -> Dataset:
    """The samples that the settings ask for; with `mix` also checked for what an index shows.

    Raises ValueError with table, sample or setting and how to fix it, FileNotFoundError where there is no table.
    """
    dataset = open_dataset(settings)
    if mix is not None:
        check_sides(mix, dataset.rows.simulated)
        _weights(dataset, mix)
    return dataset


def make_feed(dataset: Dataset, needs: Needs) -> Feed:
    """Raises ValueError where samples have no images, cameras or labels that are needed."""
    _check_index(dataset, needs)
    columns: tuple[str, ...] = PLAN_COLUMNS
    if needs.image is not None:
        columns += IMAGE_COLUMNS
    if needs.bev is not None:
        columns += BEV_COLUMNS
    if needs.labels is not None:
        columns += LABEL_COLUMNS
    numbers = np.unique(dataset.rows.file)
    with ThreadPoolExecutor(OPEN_FILES) as pool:
        parts = list(pool.map(lambda number: _file_part(dataset, needs, columns, number), numbers))
    cameras: list[tuple[str, ...]] = [()] * len(dataset)
    size = np.zeros(len(dataset), np.int64)
    for here, names, sizes in parts:
        size[here] = sizes
        for sample, chosen in zip(here.tolist(), names):
            cameras[sample] = chosen
    if needs.bev is not None:
        size += math.prod((len(needs.bev.times_s), *needs.bev.shape))  # its raster is kept beside it
    return Feed(dataset, needs, columns, tuple(cameras), size)


def mixed_samples(feed: Feed, mix: MixSettings) -> Samples:
    """What the order of a feed's samples depends on. Raises ValueError for weights that do not fit them."""
    rows = feed.dataset.rows
    group = np.unique(np.stack([rows.file, rows.group]), axis=1, return_inverse=True)[1].reshape(-1)
    return Samples(rows.simulated, group, feed.size, _weights(feed.dataset, mix))


def _weights(dataset: Dataset, mix: MixSettings) -> Array:
    rows = dataset.rows
    return sample_weights(mix.weights, rows.simulated, rows.round, rows.expert, rows.perturbation_m, rows.reward)


def _check_index(dataset: Dataset, needs: Needs) -> None:
    rows = dataset.rows
    if needs.n_agents and needs.bev is None:
        raise ValueError(f"n_agents={needs.n_agents} are those inside `bev`, and the planner has none")
    bare = np.flatnonzero(rows.image_source == "none")
    if needs.image is not None and len(bare):
        raise ValueError(
            f"{dataset.name(bare[0])}{_and_more(bare)} without images (image_source=none), and the planner needs them: "
            "make the table with render=auto or render=map, or take a planner that needs none, such as ego_mlp"
        )
    other = np.flatnonzero(rows.vocabulary != needs.labels)
    if needs.labels is not None and len(other):
        found = rows.vocabulary[other[0]]
        raise ValueError(
            f"{dataset.name(other[0])}{_and_more(other)} "
            + (f"with labels of vocabulary {found}" if found else "without labels (reward.labels=none)")
            + f", and the planner needs those of {needs.labels}: make the table with "
            + "reward.label_vocabulary=<the planner's vocabulary>, or leave it out"
        )


def _and_more(samples: Ints) -> str:
    return f" and {len(samples) - 1} more are" if len(samples) > 1 else " is"


def _file_part(
    dataset: Dataset, needs: Needs, columns: Sequence[str], number: int
) -> tuple[Ints, list[tuple[str, ...]], Ints]:
    """Of one file the places in the dataset of its samples, their cameras and their sizes."""
    here = np.flatnonzero(dataset.rows.file == number)
    parquet = dataset.files[number].open()
    rows, groups = group_rows(parquet), dataset.rows.group[here]
    kept = np.ones((len(rows), len(columns)))  # share of a column's bytes
    cameras: list[tuple[str, ...]] = [()] * len(here)
    if needs.image is not None:
        places = (np.cumsum(rows) - rows)[groups] + dataset.rows.place[here]
        members = leaves(parquet, ["cameras.name", "cameras.ego_from_camera", "images.camera", "images.time_s"])
        with naming(dataset.files[number].where):
            seen = read_all(parquet, members)
        cameras = _cameras(dataset, here, seen, places, needs.image)
        stored = np.add.reduceat(np.diff(_list(seen, "images").offsets.to_numpy()), np.cumsum(rows) - rows)
        share = rows / np.maximum(np.bincount(groups, minlength=len(rows)), 1)
        wanted = share * np.bincount(groups, weights=[len(names) for names in cameras], minlength=len(rows))
        kept[:, list(columns).index("images.jpeg")] = wanted / np.maximum(stored, 1)
    sizes = (group_bytes(parquet, columns) * kept).sum(axis=1) / rows
    return here, cameras, np.ceil(sizes[groups]).astype(np.int64)


def _cameras(
    dataset: Dataset, samples: Ints, seen: pa.Table, places: Ints, layout: ImageLayout
) -> list[tuple[str, ...]]:
    """The cameras of each sample's picture. Raises ValueError where it has none, or no image of one at now."""
    rig, images = _list(seen, "cameras"), _list(seen, "images")
    names = rig.values.field("name").to_pylist()
    axes = rig.values.field("ego_from_camera").flatten().to_numpy().reshape(-1, 4, 4)[:, :2, 2]
    taken_by = images.values.field("camera").to_pylist()
    at_now = np.abs(images.values.field("time_s").to_numpy()) <= TIME_TOLERANCE_S
    rig_at, images_at = rig.offsets.to_numpy(), images.offsets.to_numpy()
    known: dict[tuple[tuple[str, ...], bytes], tuple[str, ...]] = {}
    found = []
    for sample, place in zip(samples, places):
        there = slice(rig_at[place], rig_at[place + 1])
        key = tuple(names[there]), axes[there].tobytes()
        try:
            if key not in known:
                known[key] = chosen_cameras(key[0], axes[there], layout)
            start, stop = images_at[place], images_at[place + 1]
            have = {taken_by[i] for i in range(start, stop) if at_now[i]}
            if missing := [name for name in known[key] if name not in have]:
                raise ValueError(f"no image of camera {', '.join(missing)} at now; there are {sorted(have)}")
        except ValueError as error:
            raise ValueError(f"{dataset.name(sample)}: {error}") from error
        found.append(known[key])
    return found


def _list(table: pa.Table, name: str) -> pa.ListArray:
    return table[name].combine_chunks()
