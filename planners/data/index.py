"""What there is to learn from, checked before the first batch: the samples of several tables, as an index in memory.

Opening reads columns of a few bytes a sample and decodes nothing. Samples are in the order of their attempt_id, so that
nothing depends on the files they stand in. What is wrong with the data is said by table, sample and setting; a `Feed`
is what a planner's needs make of it.
"""

import hashlib
import logging
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, fields, replace

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from factory.store.location import Location, raising_damaged_file
from factory.store.reader import TIME_TOLERANCE_S, row_group_sizes
from factory.store.schema import LABEL_COLUMNS
from planners.data.batch import ImageLayout, Needs, TrainingData
from planners.data.files import SampleFile, files_of, group_bytes, leaf_paths, read_all
from planners.data.images import chosen_cameras
from planners.data.mix import MixSettings, OrderInputs, check_sides
from tasks.settings import constant
from tasks.world.arrays import F32, Array, Bools, Ints, ShortInts

log = logging.getLogger(__name__)

HUMAN = "human"
INDEX_COLUMNS = (
    "attempt_id",
    "clip_id",
    "log_id",
    "settings_hash",
    "stage_versions",
    "image_source",
    "psnr",
    "label_vocabulary",
)
OPEN_FILES = 8  # at a time, while their columns are read

Tables = str | tuple[str, ...]


@dataclass(frozen=True)
class DataSettings:
    """Which samples. Tables are runs' `out` folders or URLs; one may stand under real and sim."""

    real: Tables = ()  # their rows with expert=human are the real samples
    sim: Tables = ()  # their other rows are the simulated samples
    val: Tables = ()  # tables that nothing is learned from
    max_round: int | None = None  # simulated samples of rounds 0 .. this
    experts: tuple[str, ...] = ()  # simulated samples of these; empty: of all
    psnr_min: float | None = None  # [dB] simulated samples of blocks reconstructed at least this well
    psnr_max: float | None = None  # [dB] and worse than this
    real_share: float = 1.0  # of the real clips; simulated samples of other clips are left out too
    limit_sim: int | None = None  # as many simulated samples, drawn from those that the rest leaves
    without_logs: tuple[str, ...] = ()  # ids of logs whose samples are left out, such as those held out
    seed: int = constant(0)  # of the two draws; a smaller share or limit is a part of a larger one
    storage_options: dict[str, str] = field(default_factory=dict)  # of object stores, as deltalake calls them
    pictures: str | None = None  # folder of this machine for decoded pictures, see planners.data.images
    pictures_gb: float = 100.0  # that it takes at most, 10^9 bytes; what is beyond is decoded in every pass

    def __post_init__(self) -> None:
        if not 0.0 < self.real_share <= 1.0:
            raise ValueError(f"real_share={self.real_share}: must be above 0 and at most 1")
        if self.limit_sim is not None and self.limit_sim < 1:
            raise ValueError(f"limit_sim={self.limit_sim}: must be at least 1; data.sim=[] leaves simulation out")
        if self.pictures is not None and "://" in self.pictures:
            raise ValueError(f"data.pictures={self.pictures}: must be a folder of this machine")

    def tables(self, part: str) -> tuple[str, ...]:
        """The tables of `real`, `sim` or `val`."""
        tables: Tables = getattr(self, part)
        return (tables,) if isinstance(tables, str) else tuple(tables)


@dataclass(frozen=True, eq=False)
class SampleRows:
    """Columns of n samples."""

    attempt_id: NDArray[np.str_]  # (n,)
    clip_id: NDArray[np.str_]
    log_id: NDArray[np.str_]
    revision: NDArray[np.str_]  # what they were made under: settings and stage versions
    expert: NDArray[np.str_]
    round: ShortInts
    simulated: Bools
    psnr: Array  # [dB] NaN where there is none
    image_source: NDArray[np.str_]
    vocabulary: NDArray[np.str_]  # digest of the labels' trajectories, empty where there are no labels
    file: Ints  # place in Dataset.files
    group: Ints  # row group of the file
    place: Ints  # row of the row group

    def __len__(self) -> int:
        return len(self.attempt_id)

    def select(self, which: Ints | Bools) -> "SampleRows":
        """Some of them, in the order of `which`."""
        return SampleRows(**{f.name: getattr(self, f.name)[which] for f in fields(self)})


@dataclass(frozen=True, eq=False)
class Dataset:
    """The samples of one training or evaluation, in the order of their attempt_id."""

    settings: DataSettings
    files: tuple[SampleFile, ...]
    rows: SampleRows

    def __len__(self) -> int:
        return len(self.rows)

    def name(self, sample: int) -> str:
        """Table and id of a sample, for messages."""
        return f"{self.files[self.rows.file[sample]].table}: sample {self.rows.attempt_id[sample]}"

    @property
    def digest(self) -> str:
        """Of the samples and what they were made under; not of the files they stand in."""
        sha = hashlib.sha256()
        for column in (self.rows.attempt_id, self.rows.revision):
            sha.update("\n".join(column.tolist()).encode() + b"\x1f")
        return sha.hexdigest()[:16]

    @property
    def label_vocabulary(self) -> str | None:
        """Digest of the vocabulary that all are labelled with, in words where it is not one; None: no labels."""
        counts = Counter(self.rows.vocabulary.tolist())
        without = counts.pop("", 0)
        if not counts:
            return None
        return " and ".join(sorted(counts)) + (f" ({without} of {len(self)} samples without)" if without else "")

    def training_data(self) -> TrainingData:
        """What a planner may look at when it is built."""
        return TrainingData(self.labels_2hz, self.label_vocabulary)

    def labels_2hz(self) -> F32:
        """(n, 8, 3) label poses at 0.5 .. 4.0 s of all samples, read from the files."""
        labels = np.empty((len(self), 8, 3), np.float32)
        for number in np.unique(self.rows.file):
            here = np.flatnonzero(self.rows.file == number)
            with raising_damaged_file(self.files[number].where):
                parquet = self.files[number].open()
                stored = parquet.read(columns=leaf_paths(parquet, ["label_2hz"]))["label_2hz"].combine_chunks()
                starts = np.concatenate([[0], np.cumsum(row_group_sizes(parquet))])
                values = stored.flatten().flatten().to_numpy().reshape(-1, 8, 3)
                labels[here] = values[starts[self.rows.group[here]] + self.rows.place[here]]
        return labels

    def text(self) -> str:
        """Counts by side, expert and round, a line each."""
        lines = []
        for name, part in (("real", ~self.rows.simulated), ("simulated", self.rows.simulated)):
            rows = self.rows.select(part)
            lines.append(f"{name}: {len(rows)} samples of {len(set(rows.clip_id.tolist()))} clips")
            for expert in sorted(set(rows.expert[rows.simulated].tolist())):
                rounds = np.bincount(rows.round[rows.expert == expert])
                shown = ", ".join(f"{count} of round {i}" for i, count in enumerate(rounds) if count)
                lines.append(f"  {expert}: {rounds.sum()} ({shown})")
        return "\n".join(lines)


def open_dataset(settings: DataSettings) -> Dataset:
    """The samples that the settings ask for.

    Raises ValueError, with table and setting, for tables without the columns, a sample that stands in two of them, or
    a side of which nothing is left; FileNotFoundError where there is no table.
    """
    sides: dict[str, set[bool]] = {}  # table -> whether its simulated, its real rows are wanted
    for part, simulated in (("real", False), ("sim", True)):
        for table in settings.tables(part):
            uri = Location.parse(table, settings.storage_options).uri
            if simulated in sides.setdefault(uri, set()):
                raise ValueError(f"data.{part} names {table} twice")
            sides[uri].add(simulated)
    if not sides:
        raise ValueError("there are no samples to read: give data.real=[<out of a run>], data.sim=[...] or both")
    files, wanted = [], []
    for uri, kinds in sides.items():
        found = [file for file in files_of(uri, settings.storage_options) if (file.expert != HUMAN) in kinds]
        files += found
        wanted.append((uri, kinds, {file.expert != HUMAN for file in found}))
    for uri, kinds, there in wanted:
        for simulated in sorted(kinds - there):
            name = "data.sim: no simulated samples" if simulated else "data.real: no samples with expert=human"
            raise ValueError(f"{name} in {uri}")
    with ThreadPoolExecutor(OPEN_FILES) as pool:
        parts = list(pool.map(_rows_of, files, range(len(files))))
    rows = SampleRows(**{f.name: np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(SampleRows)})
    rows = rows.select(np.argsort(rows.attempt_id, kind="stable"))
    dataset = Dataset(settings, tuple(files), rows)
    twice = np.flatnonzero(rows.attempt_id[1:] == rows.attempt_id[:-1])
    if len(twice):
        both = " and ".join(files[f].table for f in rows.file[twice[0] : twice[0] + 2])
        raise ValueError(f"sample {rows.attempt_id[twice[0]]} and {len(twice) - 1} more stand twice, in {both}")
    return replace(dataset, rows=rows.select(_rows_passing(settings, rows)))


def _rows_of(file: SampleFile, number: int) -> SampleRows:
    """The index columns of one file. Raises ValueError naming missing ones."""
    parquet = file.open()
    try:
        columns = leaf_paths(parquet, INDEX_COLUMNS)
    except ValueError as error:
        raise ValueError(f"{file.table}: {error} in {file.path}; make the table again with this version") from error
    with raising_damaged_file(file.where):
        table = read_all(parquet, columns).combine_chunks()
        return _index_of(file, number, parquet, table)


def _index_of(file: SampleFile, number: int, parquet: pq.ParquetFile, table: pa.Table) -> SampleRows:
    counts, n = row_group_sizes(parquet), table.num_rows

    def text(name: str) -> NDArray[np.str_]:
        return np.array(pc.fill_null(table[name], "").to_pylist(), dtype=np.str_)

    starts = np.cumsum(counts) - counts
    return SampleRows(
        attempt_id=text("attempt_id"),
        clip_id=text("clip_id"),
        log_id=text("log_id"),
        revision=np.char.add(np.char.add(text("settings_hash"), " "), text("stage_versions")),
        expert=np.full(n, file.expert),
        round=np.full(n, file.round, np.int32),
        simulated=np.full(n, file.expert != HUMAN),
        psnr=pc.fill_null(table["psnr"], float("nan")).to_numpy(),
        image_source=text("image_source"),
        vocabulary=text("label_vocabulary"),
        file=np.full(n, number, np.int64),
        group=np.repeat(np.arange(len(counts)), counts),
        place=np.arange(n) - np.repeat(starts, counts),
    )


def _rows_passing(settings: DataSettings, rows: SampleRows) -> Ints:
    """Places of the rows that the filters leave. Raises ValueError naming the filter that leaves too few."""
    sim = rows.simulated
    if unknown := sorted(set(settings.experts) - set(rows.expert[sim].tolist())):
        have = sorted(set(rows.expert[sim].tolist()))
        raise ValueError(f"data.experts: no simulated samples of {', '.join(unknown)}; there are those of {have}")
    kept = np.ones(len(rows), bool)
    filters: Mapping[str, Bools | None] = {
        "max_round": None if settings.max_round is None else rows.round <= settings.max_round,
        "experts": np.isin(rows.expert, settings.experts) if settings.experts else None,
        "psnr_min": None if settings.psnr_min is None else rows.psnr >= settings.psnr_min,  # NaN: no
        "psnr_max": None if settings.psnr_max is None else rows.psnr < settings.psnr_max,
        "without_logs": ~np.isin(rows.log_id, settings.without_logs) if settings.without_logs else None,
        "real_share": _of_kept_clips(settings, rows) if settings.real_share < 1.0 else None,
    }
    for name, passes in filters.items():
        if passes is None:
            continue
        kept &= passes if name in ("real_share", "without_logs") else passes | ~sim
        for simulated, side in ((False, "real"), (True, "simulated")):
            if (sim == simulated).any() and not (kept & (sim == simulated)).any():
                raise ValueError(f"data.{name}={getattr(settings, name)} leaves no {side} samples")
    if settings.limit_sim is not None:
        there = np.flatnonzero(kept & sim)
        if len(there) < settings.limit_sim:
            raise ValueError(f"data.limit_sim={settings.limit_sim}, but there are {len(there)} simulated samples")
        drawn = _shuffled_places(rows.attempt_id[there].tolist(), settings.seed)[: settings.limit_sim]
        kept[there] = False
        kept[there[drawn]] = True
    return np.flatnonzero(kept)


def _of_kept_clips(settings: DataSettings, rows: SampleRows) -> Bools:
    """Whether a row's clip is among the share of the real clips. Raises ValueError where there are none."""
    clips = sorted(set(rows.clip_id[~rows.simulated].tolist()))
    if not clips:
        raise ValueError(
            f"data.real_share={settings.real_share} is of the real clips, and there are none: see data.real"
        )
    drawn = _shuffled_places(clips, settings.seed)[: max(1, round(settings.real_share * len(clips)))]
    return np.isin(rows.clip_id, [clips[i] for i in drawn])


def _shuffled_places(names: Sequence[str], seed: int) -> list[int]:
    """Places of names in an order drawn by the seed, in which every name's rank among others is its own chance."""

    def chance(place: int) -> bytes:
        return hashlib.sha256(f"{seed}\x1f{names[place]}".encode()).digest()

    return sorted(range(len(names)), key=chance)


PLAN_COLUMNS = ("command", "ego_status", "ego_history_2hz", "label_2hz", "label_10hz")
PICTURE_COLUMNS = ("cameras.name", "cameras.ego_from_camera", "images.camera", "images.time_s", "cameras_left_out")
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
    return dataset


def make_feed(dataset: Dataset, needs: Needs) -> Feed:
    """Raises ValueError where samples have no images, cameras or labels that are needed."""
    _check_index(dataset, needs)
    columns: tuple[str, ...] = PLAN_COLUMNS
    if needs.image is not None:
        columns += IMAGE_COLUMNS
    if needs.bev is not None:
        columns += BEV_COLUMNS
    if needs.command != "navsim" and "route_centerline" not in columns:
        columns += ("route_centerline",)
    if needs.labels is not None:
        columns += LABEL_COLUMNS
    numbers = np.unique(dataset.rows.file)
    with ThreadPoolExecutor(OPEN_FILES) as pool:
        parts = list(pool.map(lambda number: _file_part(dataset, needs, columns, number), numbers))
    cameras: list[tuple[str, ...] | None] = [()] * len(dataset)
    size = np.zeros(len(dataset), np.int64)
    for here, names, sizes in parts:
        size[here] = sizes
        for sample, chosen in zip(here.tolist(), names):
            cameras[sample] = chosen
    seen = np.flatnonzero([chosen is not None for chosen in cameras])
    if len(seen) < len(dataset):
        dataset, size = _without_unseen(dataset, seen), size[seen]
    if needs.bev is not None:
        size += math.prod((len(needs.bev.times_s), *needs.bev.shape))  # its raster is kept beside it
    return Feed(dataset, needs, columns, tuple(chosen for chosen in cameras if chosen is not None), size)


def _without_unseen(dataset: Dataset, seen: Ints) -> Dataset:
    """The samples of which every camera of the picture was drawn; how many were not is told.

    Raises ValueError where none is left.
    """
    said = f"{len(dataset) - len(seen)} of {len(dataset)} samples: their block shows a camera of the picture too poorly"
    how = "planner.settings.image.cameras=[...] names others, a table of render.camera_psnr_min=0 has all"
    if len(seen) == 0:
        raise ValueError(f"{said} (cameras_left_out): {how}")
    log.warning("left out %s (cameras_left_out); %s", said, how)
    return replace(dataset, rows=dataset.rows.select(seen))


def order_inputs(feed: Feed) -> OrderInputs:
    """What the order of a feed's samples depends on."""
    rows = feed.dataset.rows
    group = np.unique(np.stack([rows.file, rows.group]), axis=1, return_inverse=True)[1].reshape(-1)
    return OrderInputs(rows.simulated, group, feed.size)


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
) -> tuple[Ints, list[tuple[str, ...] | None], Ints]:
    """Of one file the places in the dataset of its samples, their cameras (see `_cameras`) and their sizes."""
    here = np.flatnonzero(dataset.rows.file == number)
    parquet = dataset.files[number].open()
    rows, groups = row_group_sizes(parquet), dataset.rows.group[here]
    kept = np.ones((len(rows), len(columns)))  # share of a column's bytes
    cameras: list[tuple[str, ...] | None] = [()] * len(here)
    if needs.image is not None:
        places = (np.cumsum(rows) - rows)[groups] + dataset.rows.place[here]
        members = leaf_paths(parquet, PICTURE_COLUMNS)
        with raising_damaged_file(dataset.files[number].where):
            seen = read_all(parquet, members)
        cameras = _cameras(dataset, here, seen, places, needs.image)
        stored = np.add.reduceat(np.diff(_list(seen, "images").offsets.to_numpy()), np.cumsum(rows) - rows)
        share = rows / np.maximum(np.bincount(groups, minlength=len(rows)), 1)
        wanted = share * np.bincount(groups, weights=[len(names or ()) for names in cameras], minlength=len(rows))
        kept[:, list(columns).index("images.jpeg")] = wanted / np.maximum(stored, 1)
    sizes = (group_bytes(parquet, columns) * kept).sum(axis=1) / rows
    return here, cameras, np.ceil(sizes[groups]).astype(np.int64)


def _cameras(
    dataset: Dataset, samples: Ints, seen: pa.Table, places: Ints, layout: ImageLayout
) -> list[tuple[str, ...] | None]:
    """The cameras of each sample's picture; None where the row says that one of them was left out.

    Raises ValueError where it has none, or no image of one at now.
    """
    rig, images = _list(seen, "cameras"), _list(seen, "images")
    names = rig.values.field("name").to_pylist()
    axes = rig.values.field("ego_from_camera").flatten().to_numpy().reshape(-1, 4, 4)[:, :2, 2]
    taken_by = images.values.field("camera").to_pylist()
    at_now = np.abs(images.values.field("time_s").to_numpy()) <= TIME_TOLERANCE_S
    rig_at, images_at = rig.offsets.to_numpy(), images.offsets.to_numpy()
    left_out = seen["cameras_left_out"].to_pylist()
    known: dict[tuple[tuple[str, ...], bytes], tuple[str, ...]] = {}
    found: list[tuple[str, ...] | None] = []
    for sample, place in zip(samples, places):
        there = slice(rig_at[place], rig_at[place + 1])
        key = tuple(names[there]), axes[there].tobytes()
        try:
            if key not in known:
                known[key] = chosen_cameras(key[0], axes[there], layout)
            start, stop = images_at[place], images_at[place + 1]
            have = {taken_by[i] for i in range(start, stop) if at_now[i]}
            missing = [name for name in known[key] if name not in have]
            if missing and {*missing} <= {one["camera"] for one in left_out[place] or ()}:
                found.append(None)
                continue
            if missing:
                raise ValueError(f"no image of camera {', '.join(missing)} at now; there are {sorted(have)}")
        except ValueError as error:
            raise ValueError(f"{dataset.name(sample)}: {error}") from error
        found.append(known[key])
    return found


def _list(table: pa.Table, name: str) -> pa.ListArray:
    return table[name].combine_chunks()
