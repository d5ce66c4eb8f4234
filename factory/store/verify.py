"""Checks a store from its files alone.

Damage is what must not be: a file of a log that is not what was committed; a file that the log names and that is
missing or of another size, content or count, or whose own expert and round are not those that the log says; a key
twice, a round out of order; an episode, a clip's scenes or a prepared clip that is not whole.
Orphans are harmless: files no commit names, left behind by a run that died, and episodes of rows that were replaced;
readers ignore them.
"""

import hashlib
import re
import time
from collections import defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from factory.files import DamagedFile, why_no_hard_links
from factory.store.commit_copies import COPIES, LOG, CommitCopies, DamagedPart
from factory.store.episodes import EPISODES_FOLDER, check_episode, episode_name
from factory.store.location import (
    CLIP_SUFFIX,
    BadCacheFile,
    BadLocation,
    Location,
    SceneFiles,
    Shard,
    check_prepared_clip,
    raising_damaged_file,
    write_shard,
)
from factory.store.samples import CURRENT_RUN, FACTS, IMPORTED, LAST_RUN, QUIET_S, REMADE, RUN_COPY, RUN_FILE, Store
from factory.store.table import KeyedTable, LiveFile, fixed_bytes, packed_tables, text_codes
from tasks.caches import Damaged, parse_json_with_checksum, whole_of_two

TABLES = ("plans", "candidates", "samples", "outcomes")
OF_WALKS = ["clip_id", "expert", "candidate_index", "round", "settings_hash"]
PREPARED, SCENES = "cache/prepared", "scenes"
DRAFT = re.compile(r"\..*\.tmp")  # that a killed run left
OTHER_CONTENT = "its content is not what its name says"
NAMED = re.compile(r"(.*/)?part-([0-9a-f]{32})\.parquet")


@dataclass(frozen=True)
class Verdict:
    """What verify found."""

    n_samples: int
    damage: tuple[str, ...]
    orphans: tuple[str, ...]  # relative to `out`
    files: tuple[str, ...] = ()  # relative to `out`: damaged ones that a repair takes out, to be made again
    missing: tuple[str, ...] = ()  # rounds that a repair took out, until the run's command makes them again


def damaged_logs(out: Location) -> list[DamagedPart]:
    """What of the tables' logs and of run.json is not what was written, relative to `out`; asked before tables open."""
    found = [(name, damage) for name in TABLES for damage in CommitCopies(out.child(name)).damage()]
    return [*(DamagedPart(f"{name}/{damage.name}", damage.problem) for name, damage in found), *_damaged_records(out)]


def _damaged_records(out: Location) -> list[DamagedPart]:
    texts = {name: out.read(name) for name in (RUN_FILE, RUN_COPY)}
    found = [DamagedPart(name, _json_problem(data)) for name, data in texts.items() if data is not None]
    if texts[RUN_FILE] is None and texts[RUN_COPY] is not None:
        found.append(DamagedPart(RUN_FILE, "is missing"))
    return [part for part in found if part.problem]


def _json_problem(data: bytes) -> str:
    try:
        parse_json_with_checksum(data)
    except Damaged as error:
        return f"not readable: {error}"
    return ""


def damaged_beside_logs(out: Location) -> list[DamagedPart]:
    """What can be said without the tables, where their logs are damaged: of shards, which name their content, and of
    what is kept beside them."""
    found = []
    for table in TABLES:
        folder = out.child(table)
        for path in folder.names():
            named = NAMED.fullmatch(path)
            if named and hashlib.sha256(folder.read(path) or b"").hexdigest()[:32] != named[2]:
                found.append(DamagedPart(f"{table}/{path}", OTHER_CONTENT))
    return found + _damaged_kept(out) + _damaged_episodes(out, out.child(EPISODES_FOLDER).names())


def verify(store: Store) -> Verdict:
    """Read every live file, episode and kept file, and hold the tables against each other."""
    damage = [str(found) for found in damaged_logs(store.location)]
    broken: list[DamagedPart] = []
    for table in store.tables:
        broken += _damaged_files(table)
    orphans = orphaned_files(store)
    kept = _damaged_kept(store.location)
    if damage or broken:
        kept += _damaged_episodes(store.location, store.location.child(EPISODES_FOLDER).names())
        damage += [*map(str, (*broken, *kept)), "keys and rounds were not checked: fix the files first"]
        return Verdict(0, tuple(damage), tuple(orphans), tuple(found.name for found in (*broken, *kept)))
    rows: list[pa.Table] = []
    for table in store.tables:
        damage += _duplicate_keys(table, rows if table is store.samples else None)
    missing: list[str] = []
    try:
        unordered, missing = _broken_rows(rows, store)
        damage += unordered
    except DamagedFile as error:
        damage.append(str(error))
    kept += _damaged_episodes(store.location, _live_episodes(store))
    damage += map(str, kept)
    orphans += outdated_episodes(store)
    return Verdict(
        len(store.samples), tuple(damage), tuple(orphans), tuple(found.name for found in kept), tuple(missing)
    )


def orphaned_files(store: Store, replaced: bool = False) -> list[str]:
    """Files in the tables' folders that no log names, relative to `out`; replaced: of the rows before a remake too."""
    orphans, remade = [], [record[REMADE]["versions"] for record in store.runs() if REMADE in record and not replaced]
    for table in store.tables:
        name = table.spec.name
        live = {*table.live_files(), *(file for versions in remade for file in table.at(versions[name]).live_files())}
        files = [file for file in table.location.names() if not file.startswith((f"{LOG}/", f"{COPIES}/"))]
        orphans += [f"{name}/{file}" for file in files if file not in live]
    return orphans


def outdated_episodes(store: Store) -> list[str]:
    """Files beside the episodes that are none of a row that is there, relative to `out`."""
    live = _live_episodes(store)
    return [f"{EPISODES_FOLDER}/{name}" for name in store.location.child(EPISODES_FOLDER).names() if name not in live]


def _live_episodes(store: Store) -> set[str]:
    """Of samples that are there; rows are looked at only where there is an episode."""
    if not store.location.child(EPISODES_FOLDER).names():
        return set()
    rows = store.samples.read(["attempt_id", "settings_hash", "stage_versions"]).to_pylist()
    return {episode_name(row) for row in rows}


def _damaged_files(table: KeyedTable) -> list[DamagedPart]:
    found = []
    for path, file in sorted(table.file_facts().items()):
        try:
            problem = _problem_of(table, path, file)
        except DamagedFile as error:
            problem = str(error).removeprefix(f"{table.location.uri}/{path}: ")
        if problem:
            found.append(DamagedPart(f"{table.spec.name}/{path}", problem))
    return found


def _problem_of(table: KeyedTable, path: str, file: LiveFile) -> str:
    """What is wrong with a file that the log names; nothing where it is whole. Raises DamagedFile."""
    data = table.location.read(path)
    if data is None:
        return "is missing"
    if len(data) != file.n_bytes:
        return f"has {len(data):,} bytes, the log says {file.n_bytes:,}"
    named = NAMED.fullmatch(path)
    if named and hashlib.sha256(data).hexdigest()[:32] != named[2]:
        return OTHER_CONTENT
    with raising_damaged_file(f"{table.location.uri}/{path}"):
        parquet = pq.ParquetFile(pa.BufferReader(data), page_checksum_verification=True)
        if file.n_rows and parquet.metadata.num_rows != file.n_rows:
            return f"has {parquet.metadata.num_rows} rows, the log says {file.n_rows}"
        said = list(file.partition)
        rows = parquet.read(said, use_threads=False) if named else parquet.read()  # the name says the rest of the bytes
        _check_columns(table, file, parquet.schema_arrow.empty_table() if named else rows)
        for name in said:
            values = sorted(map(str, pc.unique(rows[name]).to_pylist()))
            if values != [file.partition[name]]:
                return f"{name} is {', '.join(values)}, the log says {file.partition[name]}"
    return ""


def _check_columns(table: KeyedTable, file: LiveFile, rows: pa.Table) -> None:
    """Raises KeyError or ArrowException where rows are none of the table's."""
    wanted = [field for field in table.spec.schema if field.name not in file.partition]
    for field in wanted:
        if rows.schema.field(field.name).type != field.type:
            rows[field.name].cast(field.type)


def _damaged_kept(out: Location) -> list[DamagedPart]:
    """Prepared clips, the scenes of clips, and what the newest run says of itself."""
    found = []
    prepared, scenes = out.child(PREPARED), out.child(SCENES)
    checks: dict[str, Callable[[str], object]] = {
        PREPARED: lambda key: check_prepared_clip(prepared.read(f"{key}{CLIP_SUFFIX}") or b"", key),
        SCENES: SceneFiles(scenes).load,
    }
    for folder, check in checks.items():
        for name in out.child(folder).names():
            if DRAFT.fullmatch(name):
                continue
            try:
                check(name.removesuffix(CLIP_SUFFIX))
            except (BadCacheFile, FileNotFoundError) as error:  # the latter: a file of another kind of name
                problem = str(error).removeprefix(f"{out.child(folder).uri}/{name}").removeprefix(": ").strip()
                found.append(DamagedPart(f"{folder}/{name}", problem))
    for name in (CURRENT_RUN, LAST_RUN, FACTS):
        if (data := out.read(name)) is not None and (problem := _json_problem(data)):
            found.append(DamagedPart(name, f"{problem}; the next run writes it anew"))
    return found


def _duplicate_keys(table: KeyedTable, kept: list[pa.Table] | None) -> list[str]:
    """Keys that stand twice; kept: takes the columns OF_WALKS, read at the same time."""
    paths, parts, key = [], [np.zeros(0, "S1")], table.spec.key
    for path, rows in table.files([key] if kept is None else [key, *OF_WALKS]):
        paths.append(path)
        parts.append(fixed_bytes(rows[key]))
        if kept is not None:
            kept.append(rows.select(OF_WALKS))
    keys = np.concatenate(parts)
    file = np.repeat(np.arange(len(paths)), [len(keys) for keys in parts[1:]])
    order = np.argsort(keys, kind="stable")
    again = np.sort(order[1:][keys[order[1:]] == keys[order[:-1]]]).tolist()
    return [f"{table.spec.name}/{paths[file[at]]}: key {keys[at].decode()} stands twice" for at in again]


def _broken_rows(parts: Sequence[pa.Table], store: Store) -> tuple[list[str], list[str]]:
    """Of samples, with the columns OF_WALKS: rounds out of order and unknown settings; rounds that are missing."""
    rows = pa.concat_tables([store.samples.schema_of(OF_WALKS, encoded=True).empty_table(), *packed_tables(parts, "")])
    unknown = set(text_codes(rows["settings_hash"])[1]) - {run["settings_hash"] for run in store.runs()}
    named = [f"samples: settings_hash {name} is not in run.json" for name in sorted(unknown)]
    unordered, missing = _broken_rounds(rows, store)
    return [*unordered, *named], missing


def _broken_rounds(rows: pa.Table, store: Store) -> tuple[list[str], list[str]]:
    """Rounds of a walk count 0, 1, 2 ... in the order of its candidates; those of another order, those with some gone.

    Of imported rows they are their source's.
    """
    imported = {run["settings_hash"] for run in store.runs() if IMPORTED in run["settings"]}
    rows = rows.filter(pc.invert(pc.is_in(rows["settings_hash"], value_set=pa.array(sorted(imported), pa.string()))))
    (clip, clip_ids), (expert, experts) = text_codes(rows["clip_id"]), text_codes(rows["expert"])
    candidate, number = (rows[name].to_numpy() for name in ("candidate_index", "round"))
    walk = clip * max(1, len(experts)) + expert
    order = np.lexsort((number, candidate, walk))
    walk, candidate, number = walk[order], candidate[order], number[order]
    first = np.diff(walk, prepend=-1) != 0
    starts = np.flatnonzero(first)
    ordinal = np.arange(len(walk)) - np.repeat(starts, np.diff(starts, append=len(walk)))
    unordered, missing = list[str](), list[str]()
    for broken in np.unique(walk[number != ordinal]).tolist():
        pairs = [(int(c), int(r)) for c, r in zip(candidate[walk == broken], number[walk == broken])]
        of = f"clip {clip_ids[broken // len(experts)]}, expert {experts[broken % len(experts)]}"
        goes_on = all(one[1] < other[1] for one, other in pairwise(pairs))
        (missing if goes_on else unordered).append(f"samples: {of}: candidates and rounds {pairs}")
    return unordered, missing


def _damaged_episodes(out: Location, live: Collection[str]) -> list[DamagedPart]:
    folder, found = out.child(EPISODES_FOLDER), []
    for name in folder.names():
        try:
            if name in live:
                check_episode(folder.read(name) or b"")
        except ValueError as error:
            problem = f"{error}; remove it, the command that made the run writes it again"
            found.append(DamagedPart(f"{EPISODES_FOLDER}/{name}", problem))
    return found


# What is done to a store that no run holds: damaged files out, leftovers away, small shards merged into larger ones.
#
# Each change of a table is one transaction; what samples there are is changed by none but those that were damaged.

TEMPORARY = re.compile(r"(.*/)?(\..*\.tmp|\.trial-[0-9a-f]+|_commit_.*\.tmp|.*\.draft)")
FULL_BYTES = 128 * 2**20  # of a shard, as a run closes it
SMALL = 0.5  # of that: shards below are merged
HELD_BYTES = 512 * 2**20  # of rows in memory, where they take much less in their files


class RunInProgress(RuntimeError):
    """A run writes to the store."""


def claim_for_upkeep(store: Store) -> None:
    """Before a change: claim the tables as a run does, so that one which was quiet for long commits nothing any more,
    no file that is cleaned away among it. Raises RunGoesOn as `refuse_held` does, BadLocation and AnotherWriter."""
    refuse_while_running(store)
    if store.location.folder is not None and (no_links := why_no_hard_links(store.location.folder)):
        raise BadLocation(no_links)
    store.claim(create=False)


def refuse_while_running(store: Store) -> None:
    """Raises RunGoesOn where a run has begun, not ended, and done something lately."""
    run = store.newest_run()
    quiet_s = run.heard_s_ago(store.last_commit_ms(), time.time())
    if run.goes_on and quiet_s < QUIET_S:
        raise RunInProgress(
            f"{store.location.uri}: a run is writing here; wait until it has ended. "
            f"If it was killed, give its command again, or wait {(QUIET_S - quiet_s) / 60:.0f} minutes"
        )


def restore_logs(out: Location) -> list[str]:
    """Put damaged files of the tables' logs and run.json back as they were, where anything tells it; their names."""
    return [damage.name for damage in damaged_logs(out) if _restored(out, damage)]


def _restored(out: Location, damage: DamagedPart) -> bool:
    if damage.name not in (RUN_FILE, RUN_COPY):
        table, _, name = damage.name.partition("/")
        return CommitCopies(out.child(table)).restore(DamagedPart(name, damage.problem))
    first, second = (out.read(name) or b"" for name in (RUN_FILE, RUN_COPY))
    whole = next((text for text in (first, second) if not _json_problem(text)), None)
    whole = whole or whole_of_two(first, second, lambda tried: not _json_problem(tried))
    if whole is None:
        return False
    out.write(damage.name, whole)
    return True


def drop_damaged(store: Store, verdict: Verdict) -> None:
    """Take the damaged files of a verdict out of their tables, a transaction each, and away."""
    for table in store.tables:
        if drop := [path for path in table.live_files() if f"{table.spec.name}/{path}" in verdict.files]:
            table.replace_files(drop)
    for name in verdict.files:
        if store.location.has(name):
            store.location.remove(name)


def old_leftovers(store: Store, older_s: float, now_s: float, replaced: bool = False) -> list[str]:
    """Temporary files and orphans that were last written so long ago, relative to `out`; replaced: as of these."""
    ages = store.location.ages_s(now_s)
    orphans = {*orphaned_files(store, replaced), *outdated_episodes(store)}
    inner = tuple(f"{name}/{folder}/" for name in TABLES for folder in (LOG, COPIES))
    return sorted(
        name
        for name, age_s in ages.items()
        if age_s >= older_s and (TEMPORARY.fullmatch(name) or (name in orphans and not name.startswith(inner)))
    )


def compact(store: Store) -> Iterator[tuple[str, int, int]]:
    """Merge the small files of each partition of each table: its name, how many files it had, and has. Raises
    DamagedFile, before anything of its table is done.

    The rows keep their bytes and the times at which they came into the table.
    """
    for table in store.tables:
        facts = table.file_facts()
        drop: list[str] = []
        add: list[tuple[Shard, int]] = []
        for group in _files_to_merge(table):
            for paths, rows in _held_together(table, facts, group):
                shard = write_shard(table.location, table.spec, rows)
                add.append((shard, max(facts[path].written_ms for path in paths)))
                drop += paths
                del rows  # before the next are read
        if add:
            table.replace_files(drop, add)
        yield table.spec.name, len(facts), len(table.file_facts())


def _held_together(
    table: KeyedTable, facts: Mapping[str, LiveFile], group: Sequence[str]
) -> Iterator[tuple[list[str], pa.Table]]:
    """Files of a group, two or more each, and their rows, HELD_BYTES of memory at a time."""
    paths, parts, held = list[str](), list[pa.Table](), 0
    for path in group:
        paths.append(path)
        parts.append(table.read_file(path, facts[path].partition))
        held += parts[-1].nbytes
        if path == group[-1] or held >= HELD_BYTES:
            if len(paths) > 1:
                yield paths, pa.concat_tables(parts)
            paths, parts, held = [], [], 0


def _files_to_merge(table: KeyedTable) -> list[list[str]]:
    """Files to be merged into one, two or more each; of a partition, in the order of their names."""
    partitions: dict[tuple[str, ...], list[tuple[str, int]]] = defaultdict(list)
    for path, file in sorted(table.file_facts().items()):
        if file.n_bytes < SMALL * FULL_BYTES:
            partitions[tuple(file.partition.values())].append((path, file.n_bytes))
    groups: list[list[str]] = []
    for files in partitions.values():
        held = FULL_BYTES  # so that the first opens a group
        for path, n_bytes in files:
            if held + n_bytes > FULL_BYTES:
                groups.append([])
                held = 0
            groups[-1].append(path)
            held += n_bytes
    return [group for group in groups if len(group) > 1]
