"""A run's samples into SimScale's layout: streamed, by workers, gone on with where it was stopped."""

import hashlib
import json
import os
import socket
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from factory.datasets.navsim.frames import (
    BLACK,
    CONFIG,
    DRIVOR_EXPERT,
    DRIVOR_ROUNDS,
    MOTION,
    N_HISTORY,
    NAMING,
    RELEASED,
    REWARDS,
    CannotExport,
    ExportSettings,
    SplitNames,
    black_picture,
    consumer_of,
    is_simulated,
    openscene_frames,
    public_map_location,
    sample_names,
    sample_pictures,
    split_names,
)
from factory.datasets.navsim.pickles import dumps, reward_arrays, write_pickled_dict
from factory.files import atomic_file, file_digest, naming_disk_errors
from factory.store.location import Location, open_parquet
from factory.store.reader import Sample, read_rows
from factory.store.schema import LABEL_COLUMNS, canonical_json
from factory.store.table import KeyedTable
from factory.wording import rate_text, time_text
from tasks.world.arrays import Array

# What an export has written: a journal while it goes on, a manifest of the same lines when it is done.
#
# The first line is a header with the settings, each further one a log with its files, or files of all logs. A log
# stands in the journal once all its files are whole, so that a killed export goes on behind it.

MANIFEST, JOURNAL = "manifest.jsonl", ".journal.jsonl"
FORMAT = "simscale-1"


@dataclass(frozen=True)
class WrittenFile:
    """One file, by its path below the export's folder."""

    path: str
    bytes: int
    sha256: str


@dataclass(frozen=True)
class WrittenLog:
    """A log that is whole."""

    folder: str  # of its split
    log: str
    token: str
    attempt_id: str
    made_of: str  # digest of what the row was made under; a row that was made again is written again
    data_split: str  # train, val or test
    has_route: bool  # else the public loader leaves it out
    image_source: str
    sizes: tuple[str, ...]  # of the pictures as written
    distorted: bool  # these are as a lens makes them
    absent_pictures: int  # of those that the consumer opens
    left_out_cameras: tuple[str, ...]
    files: tuple[WrittenFile, ...]  # the pickle last


def write_file(root: Path, path: str, data: bytes) -> WrittenFile:
    """A whole file or none. Raises DiskFull."""
    with atomic_file(root / path, len(data)) as draft:
        draft.write_bytes(data)
    return WrittenFile(path, len(data), hashlib.sha256(data).hexdigest())


class Journal:
    """The lines of an export in its folder, begun or gone on with."""

    def __init__(self, root: Path, settings: Mapping[str, Any]) -> None:
        """Raises ValueError where the folder holds an export with other settings, OSError where it is no folder."""
        self.root, self.settings = root, json.loads(canonical_json(settings))
        self.logs: dict[tuple[str, str], WrittenLog] = {}  # by folder and log
        self.facts: dict[str, Any] = {}  # of a finished export: what its header says
        self.files: list[WrittenFile] = []  # of a finished export: those of all logs
        root.mkdir(parents=True, exist_ok=True)
        self.interrupted = (root / JOURNAL).exists()
        for name in (MANIFEST, JOURNAL):
            self._read(root / name)

    def open(self) -> None:
        """From here on what is written is noted. Raises DiskFull."""
        if not (self.root / JOURNAL).exists():
            self._append({"format": FORMAT, "settings": self.settings})

    def add(self, logs: Iterable[WrittenLog]) -> None:
        """Logs whose files are whole. Raises DiskFull."""
        for log in logs:
            self.logs[log.folder, log.log] = log
            self._append({"log": asdict(log)})

    def is_whole(self, file: WrittenFile) -> bool:
        """Whether a file is still there, by its size."""
        path = self.root / file.path
        return path.exists() and path.stat().st_size == file.bytes

    def finish(self, facts: Mapping[str, Any], logs: Iterable[WrittenLog], files: Iterable[WrittenFile]) -> WrittenFile:
        """Replace the journal by the manifest, its lines in order."""
        header = {"format": FORMAT, "settings": self.settings, **facts}
        lines = [header, *({"log": asdict(log)} for log in logs), *({"file": asdict(file)} for file in files)]
        data = "".join(canonical_json(line) + "\n" for line in lines).encode()
        written = write_file(self.root, MANIFEST, data)
        (self.root / JOURNAL).unlink(missing_ok=True)
        return written

    def _read(self, path: Path) -> None:
        if not path.exists():
            return
        data = path.read_bytes()
        whole = data.rfind(b"\n") + 1  # behind it stands half a line of an export that was killed
        if whole < len(data):
            os.truncate(path, whole)
        if whole == 0:
            path.unlink()
            return
        header, *rest = (json.loads(line) for line in data[:whole].splitlines())
        if {"consumer": "simscale"} | header["settings"] != self.settings:
            raise ValueError(f"{path}: is of an export with other settings, {header['settings']}: name another folder")
        self.facts |= header
        for entry in rest:
            if "log" in entry:
                log = _written(entry["log"])
                self.logs[log.folder, log.log] = log
            else:
                self.files.append(WrittenFile(**entry["file"]))

    def _append(self, line: Mapping[str, Any]) -> None:
        path, data = self.root / JOURNAL, canonical_json(line) + "\n"
        with naming_disk_errors(path, len(data)), path.open("a") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())


def _written(stored: Mapping[str, Any]) -> WrittenLog:
    files = tuple(WrittenFile(**file) for file in stored["files"])
    lists = {name: tuple(stored[name]) for name in ("sizes", "left_out_cameras")}
    return WrittenLog(**{**stored, **lists, "files": files})


# The YAML files that name a split's logs and tokens to the public code.

LISTS = {"test": "test_logs", "train": "train_logs", "val": "val_logs"}  # by a sample's split


def scene_filter_yaml(scenes: Sequence[tuple[str, str]], n_future: int) -> str:
    """Of navsim.common.dataclasses.SceneFilter; unknown keys would be refused (NS dataclasses.py:733-778).

    scenes: log and token of each; n_future: frames.
    """
    return "".join(
        (
            "_convert_: all\n_target_: navsim.common.dataclasses.SceneFilter\nframe_interval: 1\nhas_route: true\n",
            _list("log_names", (log for log, _ in scenes)),
            f"max_scenes: null\nnum_future_frames: {n_future}\nnum_history_frames: {N_HISTORY}\n",
            _list("tokens", (token for _, token in scenes)),
        )
    )


def _list(key: str, values: Iterable[str]) -> str:
    """In double quotes: a token of digits alone, or one with an e among them, would be read as a number."""
    listed = list(values)
    return f"{key}:\n" + "".join(f'- "{value}"\n' for value in listed) if listed else f"{key}: []\n"


def vocabulary_path(k: int) -> str:
    """Where the released configuration looks for its trajectories (gtrs_dense_vov.yaml:23)."""
    return f"devkit/traj_final/{k}.npy"


PLANNED = (
    *(*NAMING, "attempt_id", "settings_hash", "stage_versions", "split", "map_location"),
    *("licence", "label_vocabulary", "label_traffic"),
)
KEPT = ("attempt_id", "candidate_index", "expert", "round", "licence", "label_vocabulary", "label_traffic")
DRAWN = (
    *("command", "image_source", "cameras", "light_lane_ids", "light_states", "route_roadblock_ids", "agent_ids"),
    *("agent_kinds", "agent_boxes", "agent_velocities", "agent_valid", "agent_heights", "agent_center_z"),
)
SAY_EVERY_S = 10.0
Say = Callable[[str], None]
WriteGroup = Callable[["RowGroup"], list["WrittenLog"]]
Each = Callable[[WriteGroup, Iterable["RowGroup"]], Generator[list["WrittenLog"], None, None]]  # in any order


@dataclass(frozen=True)
class RowGroup:
    """One row group of the table, and which of its rows are wanted."""

    path: str
    partition: Mapping[str, str]
    number: int
    rows: tuple[int, ...]

    def __str__(self) -> str:
        return f"{self.path}, row group {self.number}"


@dataclass(frozen=True)
class PlannedSample:
    """One sample, before it is read whole."""

    split: SplitNames
    log: str
    token: str
    made_of: str
    row: Sample = field(repr=False)  # its columns PLANNED, then KEPT alone
    path: str  # of its file,
    group: int  # its row group there,
    number: int  # and its place in that

    @property
    def key(self) -> tuple[str, str]:
        return self.split.folder, self.log


@dataclass(frozen=True)
class ExportSummary:
    """What an export did."""

    written: int  # logs, by this call
    logs: int  # in all
    n_bytes: int  # of all files
    notes: tuple[str, ...]  # what its user should know


def in_this_process(write: WriteGroup, groups: Iterable[RowGroup]) -> Generator[list[WrittenLog], None, None]:
    """In this process."""
    yield from map(write, groups)


def export(
    table: KeyedTable,
    to: Path,
    settings: ExportSettings,
    trajectories: Array | None = None,
    each: Each = in_this_process,
    say: Say = print,
) -> ExportSummary:
    """Write all samples that `settings` choose below `to`; what a call before has written stays.

    trajectories (K, 40, 3): of the labels' vocabulary, where they are known. each: how row groups are dealt to workers,
    which must see `to` by the same path. Raises CannotExport for samples that cannot be written, ValueError where `to`
    holds another export, OSError where the disk cannot be written or is full, and what `each` does.
    """
    planned = plan_export(table, settings)
    journal = Journal(to, asdict(settings))
    splits: dict[SplitNames, list[PlannedSample]] = defaultdict(list)
    for sample in planned.values():
        splits[sample.split].append(sample)
    if settings.consumer == "drivor":  # it opens all five rounds, also those that hold nothing
        for number in DRIVOR_ROUNDS:
            splits.setdefault(split_names({"expert": DRIVOR_EXPERT, "candidate_index": 0, "round": number}), [])
        trajectories = None  # nor does it read rewards: it scores its own plans
    stale = _tidy(journal, planned, splits)
    todo = [sample for sample in planned.values() if not _is_whole(journal, sample)]
    say(f"{len(planned):,} samples chosen, {len(planned) - len(todo):,} of them are there already")
    wanted = set() if trajectories is None else {vocabulary_path(len(trajectories))}
    is_whole = bool(journal.files) and all(journal.is_whole(file) for file in journal.files)
    if not (todo or stale or journal.interrupted) and is_whole and wanted <= {file.path for file in journal.files}:
        return _summary(journal, 0, journal.facts, journal.files)
    journal.open()
    _write_logs(table, journal, settings, todo, each, say)
    logs = [journal.logs[key] for key in sorted(planned)]
    say("splits, rewards, checksums")
    files = [*_write_split_files(to, settings, logs, splits)]
    rewards, without = _reward_files(table, to, splits) if settings.consumer == "simscale" else ([], 0)
    files += rewards
    if trajectories is not None:
        data = BytesIO()
        np.save(data, trajectories.astype(np.float32))
        files.append(write_file(to, vocabulary_path(len(trajectories)), data.getvalue()))
    facts = _facts(planned, logs, without)
    journal.finish(facts, logs, files)
    return _summary(journal, len(todo), facts, files)


def plan_export(table: KeyedTable, settings: ExportSettings) -> dict[tuple[str, str], PlannedSample]:
    """Every chosen sample by its split's folder and log. Raises CannotExport where names clash or none is chosen."""
    found: dict[tuple[str, str], PlannedSample] = {}
    seen: dict[str, set[str]] = defaultdict(set)
    tokens: dict[tuple[str, str], str] = {}
    for sample in _all_rows(table, settings):
        row = sample.row
        for name, value in (("expert", row["expert"]), ("round", str(row["round"])), ("split", row["split"])):
            seen[name].add(value)
        if not _chosen(row, settings):
            continue
        if settings.consumer == "drivor" and row["round"] not in DRIVOR_ROUNDS:
            raise CannotExport(
                f"sample {row['attempt_id']}: of round {row['round']}, and DrivoR reads 0 to 4: round=0,1"
            )
        public_map_location(row, settings)
        here = (sample.split.folder, sample.token)
        if sample.key in found or here in tokens:
            other = tokens.get(here) or found[sample.key].row["attempt_id"]
            raise CannotExport(
                f"samples {other} and {row['attempt_id']} would both be {sample.token} of {sample.split.folder}: two "
                "clips of one log at one time"
            )
        kept = replace(sample, row={name: row[name] for name in KEPT})
        found[sample.key], tokens[here] = kept, row["attempt_id"]
    if not found:
        chosen = {"expert": settings.experts, "round": settings.rounds, "split": settings.splits}
        asked = ", ".join(f"{name}={','.join(map(str, values))}" for name, values in chosen.items() if values)
        there = "; ".join(f"{name}: {', '.join(sorted(values))}" for name, values in sorted(seen.items()))
        raise CannotExport(f"no sample{' of ' + asked if asked else ''}; there are {there or 'none at all'}")
    for expert in settings.experts:
        if expert not in seen["expert"]:
            raise CannotExport(f"no sample of expert {expert}; there are {', '.join(sorted(seen['expert']))}")
    return found


def write_row_group(table: Location, root: Path, settings: ExportSettings, group: RowGroup) -> list[WrittenLog]:
    """Write the logs and pictures of one row group's wanted rows; each pickle last. For workers anywhere.

    Raises CannotExport, DiskFull.
    """
    columns = tuple(dict.fromkeys((*PLANNED, *MOTION, *DRAWN)))
    try:
        file = open_parquet(table, group.path)
    except FileNotFoundError as error:
        here = socket.gethostname()
        raise CannotExport(f"{table.uri}/{group.path}: not there for {here}: every worker must see the run") from error
    rows = read_rows(file, group.number, group.partition, columns)
    return [_write_log(root, settings, rows[i]) for i in group.rows]


def _write_log(root: Path, settings: ExportSettings, row: Sample) -> WrittenLog:
    names, split = sample_names(row, settings), split_names(row, settings.tag)
    seen = sample_pictures(row, names, settings)
    frames = openscene_frames(row, names, seen.cams, settings)
    files = [write_file(root, split.picture(path), jpeg) for path, jpeg in seen.pictures]
    files.append(write_file(root, split.log(names.log), dumps(frames)))
    return WrittenLog(
        split.folder,
        names.log,
        names.token,
        row["attempt_id"],
        _made_of(row),
        row["split"],
        len(row["route_roadblock_ids"]) > 0,
        row["image_source"],
        seen.sizes,
        seen.distorted,
        seen.absent,
        seen.left_out,
        tuple(files),
    )


def _write_logs(
    table: KeyedTable, journal: Journal, settings: ExportSettings, todo: Sequence[PlannedSample], each: Each, say: Say
) -> None:
    live = table.live_files()
    wanted: dict[tuple[str, int], list[int]] = defaultdict(list)
    for sample in todo:
        wanted[sample.path, sample.group].append(sample.number)
    groups = [
        RowGroup(path, dict(live[path]), number, tuple(sorted(rows))) for (path, number), rows in sorted(wanted.items())
    ]
    work = partial(write_row_group, table.location, journal.root, settings)
    began = said = time.monotonic()
    done = 0
    with closing(each(work, groups)) as results:
        for written in results:
            journal.add(written)
            done, now = done + len(written), time.monotonic()
            if now - said > SAY_EVERY_S:
                said, rate = now, done / (now - began)
                left = time_text((len(todo) - done) / rate)
                say(f"{done:,} of {len(todo):,} logs, {rate_text(rate, ' logs')}, {left} left")


def _all_rows(table: KeyedTable, settings: ExportSettings) -> Iterator[PlannedSample]:
    for path, partition in sorted(table.live_files().items()):
        file = open_parquet(table.location, path)
        for group in range(file.metadata.num_row_groups):
            for number, row in enumerate(read_rows(file, group, partition, PLANNED)):
                names = sample_names(row, settings)
                yield PlannedSample(
                    split_names(row, settings.tag), names.log, names.token, _made_of(row), row, path, group, number
                )


def _chosen(row: Sample, settings: ExportSettings) -> bool:
    experts = (DRIVOR_EXPERT,) if settings.consumer == "drivor" else settings.experts
    wanted = (experts, row["expert"]), (settings.rounds, row["round"]), (settings.splits, row["split"])
    return all(not values or value in values for values, value in wanted)


def _made_of(row: Sample) -> str:
    return canonical_json([row["attempt_id"], row["settings_hash"], row["stage_versions"]])


def _summary(journal: Journal, written: int, facts: Mapping[str, Any], files: Sequence[WrittenFile]) -> ExportSummary:
    n_bytes = sum(file.bytes for file in (*files, *(file for log in journal.logs.values() for file in log.files)))
    notes = _notes(facts, [file.path for file in files], journal.settings["consumer"])
    return ExportSummary(written, len(journal.logs), n_bytes, tuple(notes))


def _is_whole(journal: Journal, sample: PlannedSample) -> bool:
    """Written before, of the same row, and its pickle is still there."""
    log = journal.logs.get(sample.key)
    return log is not None and log.made_of == sample.made_of and journal.is_whole(log.files[-1])


def _tidy(journal: Journal, planned: Mapping[tuple[str, str], PlannedSample], splits: Iterable[SplitNames]) -> bool:
    """Take away the logs of rows that are no more, and what a killed export had half written; whether there were."""
    stale = sorted(journal.logs.keys() - planned.keys())
    for key in stale:
        for file in journal.logs.pop(key).files:
            (journal.root / file.path).unlink(missing_ok=True)
    if journal.interrupted:
        for folder in (folder for split in splits for folder in (Path(split.log("")).parent, split.picture(""))):
            for draft in (journal.root / folder).rglob(".*.tmp"):
                draft.unlink()
    return bool(stale)


def _write_split_files(
    root: Path, settings: ExportSettings, logs: Sequence[WrittenLog], splits: Iterable[SplitNames]
) -> Iterator[WrittenFile]:
    """The YAML files of each split, of the logs that the public loader takes, and its black picture."""
    n_future, drivor = consumer_of(settings).n_future, settings.consumer == "drivor"
    all_taken: list[WrittenLog] = []
    for split in sorted(splits):
        of_split = [log for log in logs if log.folder == split.folder]
        taken = [log for log in of_split if log.has_route]
        all_taken += taken
        # What run_dataset_caching takes as train_test_split; data_split is the folder that the logs really lie in.
        yield from _write_split(root, "train_test_split", split.yaml, split.folder, taken, n_future)
        # Which logs a training takes, and which it validates on (SS training/dataset.py:129-146).
        lists = (_list(key, (log.log for log in taken if log.data_split == name)) for name, key in LISTS.items())
        yield write_file(root, split.log_split, "".join(lists).encode())
        if any(log.absent_pictures for log in of_split) and (drivor or settings.missing == "black"):
            yield write_file(root, split.picture(BLACK), black_picture())
        if drivor:
            yield from _write_split(root, SYNTHETIC, split.folder, split.folder, taken, n_future)
            for folder in (Path(split.log("")).parent, split.picture("")):
                (root / folder).mkdir(parents=True, exist_ok=True)
            if not taken:  # a cache of nothing, which nobody can make: without it the agent does not start
                yield write_file(root, f"exp/train_metric_{split.folder}/metadata/none.csv", b"file_name\n")
    if drivor:
        whole = f"synthetic_reaction_{RELEASED[DRIVOR_EXPERT]}_v1.0"
        yield from _write_split(root, SYNTHETIC, whole, whole, all_taken, n_future)


SYNTHETIC = "train_test_split_synthetic"  # DrivoR's group of configurations


def _write_split(
    root: Path, group: str, name: str, folder: str, logs: Sequence[WrittenLog], n_future: int
) -> Iterator[WrittenFile]:
    """A scene filter, and the split that names it and the logs' folder."""
    scenes = scene_filter_yaml([(log.log, log.token) for log in logs], n_future)
    yield write_file(root, f"{CONFIG}/common/{group}/scene_filter/{name}.yaml", scenes.encode())
    content = f"data_split: {folder}\ndefaults:\n- scene_filter: {name}\n"
    yield write_file(root, f"{CONFIG}/common/{group}/{name}.yaml", content.encode())


def _reward_files(
    table: KeyedTable, root: Path, splits: Mapping[SplitNames, Sequence[PlannedSample]]
) -> tuple[list[WrittenFile], int]:
    """The rewards of each split, those of simulated rounds with all earlier ones; how many samples have no labels."""
    digests = {sample.row["label_vocabulary"] for of_split in splits.values() for sample in of_split} - {None}
    if len(digests) > 1:
        raise CannotExport(f"the samples' labels are of {len(digests)} vocabularies: {', '.join(sorted(digests))}")
    files: list[WrittenFile] = []
    earlier: dict[str, Path] = {}  # by expert, of the newest round so far
    without = 0
    for split, of_split in sorted(splits.items(), key=lambda item: (item[1][0].row["expert"], item[1][0].row["round"])):
        first = of_split[0].row
        labelled = [sample for sample in of_split if sample.row["label_vocabulary"] is not None]
        without += len(of_split) - len(labelled)
        before = earlier.get(first["expert"]) if is_simulated(first) else None
        if not labelled and before is None:
            continue
        path = root / split.rewards
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_file(path, 0) as draft:
            # Cumulative: SimScale opens the last round's for each of the rounds (gtrs_agent.py:231-235).
            rewards = ((token, reward_arrays(row)) for token, row in _labelled(table, labelled))
            with draft.open("w+b") as file:
                write_pickled_dict(file, rewards, before)
        files.append(WrittenFile(split.rewards, path.stat().st_size, file_digest(path)))
        earlier[first["expert"]] = path
    return files, without


def _labelled(table: KeyedTable, samples: Iterable[PlannedSample]) -> Iterator[tuple[str, Sample]]:
    """Tokens and rows with their labels, one row group in memory."""
    live = table.live_files()
    wanted: dict[tuple[str, int], list[PlannedSample]] = defaultdict(list)
    for sample in samples:
        wanted[sample.path, sample.group].append(sample)
    for (path, group), here in sorted(wanted.items()):
        rows = read_rows(open_parquet(table.location, path), group, live[path], ("attempt_id", *LABEL_COLUMNS))
        yield from ((sample.token, rows[sample.number]) for sample in sorted(here, key=lambda sample: sample.number))


def _facts(
    planned: Mapping[tuple[str, str], PlannedSample], logs: Sequence[WrittenLog], without_rewards: int
) -> dict[str, Any]:
    """What the manifest says of all of it."""
    rows = [sample.row for sample in planned.values()]
    return {
        "logs": dict(sorted(Counter(log.folder for log in logs).items())),
        "without_route": sum(not log.has_route for log in logs),
        "image_sources": dict(sorted(Counter(log.image_source for log in logs).items())),
        "picture_sizes": sorted({size for log in logs for size in log.sizes}),
        "distorted_logs": sum(log.distorted for log in logs),
        "logs_with_absent_pictures": sum(log.absent_pictures > 0 for log in logs),
        "cameras_left_out": sorted({name for log in logs for name in log.left_out_cameras}),
        "licences": sorted({row["licence"] for row in rows}),
        "vocabulary": next((row["label_vocabulary"] for row in rows if row["label_vocabulary"]), None),
        "label_traffic": sorted({row["label_traffic"] for row in rows if row["label_traffic"]}),
        "without_rewards": without_rewards,
    }


def _notes(facts: Mapping[str, Any], files: Sequence[str], consumer: str) -> Iterator[str]:
    """What a training would stumble over."""
    rewards = any(path.startswith(REWARDS) for path in files)
    if n := facts["without_route"]:
        yield f"{n:,} logs have no route: the public loader leaves them out, and so do the lists of splits"
    if n := facts["logs_with_absent_pictures"]:
        yield f"{n:,} logs lack pictures that the released agents open"
    if consumer == "drivor":
        yield "samples end 4 s after now: in a log's fifth second everyone goes straight on at the last velocity"
    elif odd := [size for size in facts["picture_sizes"] if size != "1920x1080"]:
        yield f"pictures are {', '.join(odd)}: the released agents cut them as if they were 1920x1080; see resize=true"
    if names := facts["cameras_left_out"]:
        yield f"cameras {', '.join(names)} stand for none of NAVSIM's eight and are left out"
    if consumer == "drivor":
        return
    if not rewards:
        yield "no sample has vocabulary labels: there are no rewards, which GTRS needs and the other planners do not"
    elif n := facts["without_rewards"]:
        yield f"{n:,} samples have no labels: GTRS would stop at their tokens"
    if rewards and not any(path.endswith(".npy") for path in files):
        yield f"the trajectories of vocabulary {facts['vocabulary']} are not known here: give vocabulary=<its .npy>"
