"""The samples of several tables that the settings ask for, as an index in memory.

Opening reads columns of a few bytes a sample and decodes nothing. Samples are in the order of their attempt_id, so that
nothing depends on the files they stand in.
"""

import hashlib
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, fields, replace

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from factory.store.location import Location
from factory.store.parquet_file import naming
from factory.store.reader import Format, StoredFile, group_rows
from planners.data.batch import TrainingData
from planners.data.files import SampleFile, files_of, leaves, read_all
from tasks.world.arrays import F32, Array, Bools, Ints, ShortInts

HUMAN = "human"
INDEX_COLUMNS = (
    "attempt_id",
    "clip_id",
    "settings_hash",
    "stage_versions",
    "candidate_end",
    "stage2_score",
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
    seed: int = 0  # of the two draws; a smaller share or limit is a part of a larger one
    storage_options: dict[str, str] = field(default_factory=dict)  # of object stores, as deltalake calls them
    format: Format = "parquet"  # mcap: read the MCAP shards of a run with store.episodes=all; batches are the same
    copy: str | None = None  # folder of this machine for a compact copy of what is read, see planners.data.local_copy
    pictures: str | None = None  # folder of this machine for decoded pictures, see planners.data.pictures
    pictures_gb: float = 100.0  # that it takes at most, 10^9 bytes; what is beyond is decoded in every pass

    def __post_init__(self) -> None:
        if not 0.0 < self.real_share <= 1.0:
            raise ValueError(f"real_share={self.real_share}: must be above 0 and at most 1")
        if self.limit_sim is not None and self.limit_sim < 1:
            raise ValueError(f"limit_sim={self.limit_sim}: must be at least 1; data.sim=[] leaves simulation out")
        for name in ("copy", "pictures"):
            folder = getattr(self, name)
            if folder is not None and "://" in folder:
                raise ValueError(f"data.{name}={folder}: must be a folder of this machine")

    def tables(self, part: str) -> tuple[str, ...]:
        """The tables of `real`, `sim` or `val`."""
        tables: Tables = getattr(self, part)
        return (tables,) if isinstance(tables, str) else tuple(tables)


@dataclass(frozen=True, eq=False)
class SampleRows:
    """Columns of n samples."""

    attempt_id: NDArray[np.str_]  # (n,)
    clip_id: NDArray[np.str_]
    revision: NDArray[np.str_]  # what they were made under: settings and stage versions
    expert: NDArray[np.str_]
    round: ShortInts
    simulated: Bools
    perturbation_m: Array  # (n, 2) longitudinal, lateral end in the frame of the log's; NaN human
    reward: Array  # stage2_score, NaN where there is none
    psnr: Array  # [dB] NaN where there is none
    image_source: NDArray[np.str_]
    vocabulary: NDArray[np.str_]  # digest of the labels' trajectories, empty where there are no labels
    file: Ints  # place in Dataset.files
    group: Ints  # row group of the file
    place: Ints  # row of the row group

    def __len__(self) -> int:
        return len(self.attempt_id)

    def taken(self, which: Ints | Bools) -> "SampleRows":
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
            with naming(self.files[number].where):
                parquet = self.files[number].open()
                stored = parquet.read(columns=leaves(parquet, ["label_2hz"]))["label_2hz"].combine_chunks()
                starts = np.concatenate([[0], np.cumsum(group_rows(parquet))])
                values = stored.flatten().flatten().to_numpy().reshape(-1, 8, 3)
                labels[here] = values[starts[self.rows.group[here]] + self.rows.place[here]]
        return labels

    def text(self) -> str:
        """Counts by side, expert and round, a line each."""
        lines = []
        for name, part in (("real", ~self.rows.simulated), ("simulated", self.rows.simulated)):
            rows = self.rows.taken(part)
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
        found = [
            file for file in files_of(uri, settings.storage_options, settings.format) if (file.expert != HUMAN) in kinds
        ]
        files += found
        wanted.append((uri, kinds, {file.expert != HUMAN for file in found}))
    for uri, kinds, there in wanted:
        for simulated in sorted(kinds - there):
            name = "data.sim: no simulated samples" if simulated else "data.real: no samples with expert=human"
            raise ValueError(f"{name} in {uri}")
    with ThreadPoolExecutor(OPEN_FILES) as pool:
        parts = list(pool.map(_rows_of, files, range(len(files))))
    rows = SampleRows(**{f.name: np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(SampleRows)})
    rows = rows.taken(np.argsort(rows.attempt_id, kind="stable"))
    dataset = Dataset(settings, tuple(files), rows)
    twice = np.flatnonzero(rows.attempt_id[1:] == rows.attempt_id[:-1])
    if len(twice):
        both = " and ".join(files[f].table for f in rows.file[twice[0] : twice[0] + 2])
        raise ValueError(f"sample {rows.attempt_id[twice[0]]} and {len(twice) - 1} more stand twice, in {both}")
    return replace(dataset, rows=rows.taken(_kept(settings, rows)))


def _rows_of(file: SampleFile, number: int) -> SampleRows:
    """The index columns of one file. Raises ValueError naming missing ones."""
    parquet = file.open()
    try:
        columns = leaves(parquet, INDEX_COLUMNS)
    except ValueError as error:
        raise ValueError(f"{file.table}: {error} in {file.path}; make the table again with this version") from error
    with naming(file.where):
        table = read_all(parquet, columns).combine_chunks()
        return _index_of(file, number, parquet, table)


def _index_of(file: SampleFile, number: int, parquet: StoredFile, table: pa.Table) -> SampleRows:
    counts, n = group_rows(parquet), table.num_rows

    def text(name: str) -> NDArray[np.str_]:
        return np.array(pc.fill_null(table[name], "").to_pylist(), dtype=np.str_)

    def number_or_nan(name: str) -> Array:
        return pc.fill_null(table[name], float("nan")).to_numpy()

    end = table["candidate_end"].combine_chunks()
    perturbation_m = np.full((n, 2), np.nan)
    perturbation_m[end.is_valid().to_numpy(zero_copy_only=False)] = _flat(end).reshape(-1, 4)[:, :2]
    starts = np.cumsum(counts) - counts
    return SampleRows(
        attempt_id=text("attempt_id"),
        clip_id=text("clip_id"),
        revision=np.char.add(np.char.add(text("settings_hash"), " "), text("stage_versions")),
        expert=np.full(n, file.expert),
        round=np.full(n, file.round, np.int32),
        simulated=np.full(n, file.expert != HUMAN),
        perturbation_m=perturbation_m,
        reward=number_or_nan("stage2_score"),
        psnr=number_or_nan("psnr"),
        image_source=text("image_source"),
        vocabulary=text("label_vocabulary"),
        file=np.full(n, number, np.int64),
        group=np.repeat(np.arange(len(counts)), counts),
        place=np.arange(n) - np.repeat(starts, counts),
    )


def _flat(lists: pa.ListArray | pa.ChunkedArray) -> Array:
    arrays = lists.chunks if isinstance(lists, pa.ChunkedArray) else [lists]
    return np.concatenate([np.zeros(0), *(array.flatten().to_numpy() for array in arrays)])


def _kept(settings: DataSettings, rows: SampleRows) -> Ints:
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
        "real_share": _of_kept_clips(settings, rows) if settings.real_share < 1.0 else None,
    }
    for name, passes in filters.items():
        if passes is None:
            continue
        kept &= passes if name == "real_share" else passes | ~sim
        for simulated, side in ((False, "real"), (True, "simulated")):
            if (sim == simulated).any() and not (kept & (sim == simulated)).any():
                raise ValueError(f"data.{name}={getattr(settings, name)} leaves no {side} samples")
    if settings.limit_sim is not None:
        there = np.flatnonzero(kept & sim)
        if len(there) < settings.limit_sim:
            raise ValueError(f"data.limit_sim={settings.limit_sim}, but there are {len(there)} simulated samples")
        drawn = _by_lot(rows.attempt_id[there].tolist(), settings.seed)[: settings.limit_sim]
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
    drawn = _by_lot(clips, settings.seed)[: max(1, round(settings.real_share * len(clips)))]
    return np.isin(rows.clip_id, [clips[i] for i in drawn])


def _by_lot(names: Sequence[str], seed: int) -> list[int]:
    """Places of names in an order drawn by the seed, in which every name's rank among others is its own chance."""

    def chance(place: int) -> bytes:
        return hashlib.sha256(f"{seed}\x1f{names[place]}".encode()).digest()

    return sorted(range(len(names)), key=chance)
