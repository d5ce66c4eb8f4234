"""What is done to a store that no run holds: damaged files out, leftovers away, small shards merged into larger ones.

Each change of a table is one transaction; what samples there are is changed by none but those that were damaged.
"""

import re
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass

import pyarrow as pa

from factory.store.disk import why_no_links
from factory.store.location import BadLocation, Location
from factory.store.mcap_files import McapTable, write_mcap_shard
from factory.store.parquet_file import Shard, write_shard
from factory.store.samples import Store
from factory.store.table import COPIES, LOG, CommitCopies, KeyedTable
from factory.store.verify import TABLES, Verdict, damaged_logs, orphaned, outdated_episodes, tables_in

TEMPORARY = re.compile(r"(.*/)?(\..*\.tmp|\.trial-[0-9a-f]+|_commit_.*\.tmp|.*\.draft)")
FULL_BYTES = 128 * 2**20  # of a shard, as a run closes it
SMALL = 0.5  # of that: shards below are merged
QUIET_S = 900.0  # a run that said it began and has committed nothing for so long is taken for gone


class RunGoesOn(RuntimeError):
    """A run writes to the store."""


@dataclass(frozen=True)
class Merged:
    """What became of the files of one table."""

    table: str
    before: int  # files
    after: int


def hold(store: Store) -> None:
    """Before a change: claim the tables as a run does, so that one which was quiet for long commits nothing any more,
    no file that is cleaned away among it. Raises RunGoesOn as `refuse_held` does, BadLocation and AnotherWriter."""
    refuse_held(store)
    if store.location.folder is not None and (no_links := why_no_links(store.location.folder)):
        raise BadLocation(no_links)
    store.claim(create=False)
    mcap = McapTable(store.location)
    if mcap.version is not None:
        mcap.claim(store.samples.epoch)


def refuse_held(store: Store) -> None:
    """Raises RunGoesOn where a run has begun, not ended, and done something lately."""
    current, last = store.began_ms(), store.began_ms(ended=True)
    written = (file.written_ms for table in store.tables for file in table.file_facts().values())
    quiet_s = time.time() - max([current, *written]) / 1e3
    if current and current != last and quiet_s < QUIET_S:
        raise RunGoesOn(
            f"{store.location.uri}: a run is writing here; wait until it has ended. "
            f"If it was killed, give its command again, or wait {(QUIET_S - quiet_s) / 60:.0f} minutes"
        )


def restore_logs(out: Location) -> list[str]:
    """Put damaged files of the tables' logs back as they were committed; their names."""
    found = damaged_logs(out)
    for name, damage in found:
        CommitCopies(out.child(name)).restore(damage)
    return [f"{name}/{damage.name}" for name, damage in found]


def drop_damaged(store: Store, verdict: Verdict) -> None:
    """Take the damaged files of a verdict out of their tables, a transaction each, and away."""
    for table in tables_in(store):
        if drop := [path for path in table.live_files() if f"{table.spec.name}/{path}" in verdict.files]:
            table.replace_files(drop)
    for name in verdict.files:
        if store.location.has(name):
            store.location.remove(name)


def leftovers(store: Store, older_s: float, now_s: float) -> list[str]:
    """Temporary files and orphans that were last written so long ago, relative to `out`."""
    ages = store.location.ages_s(now_s)
    orphans = {*orphaned(store), *outdated_episodes(store)}
    inner = tuple(f"{name}/{folder}/" for name in TABLES for folder in (LOG, COPIES))
    return sorted(
        name
        for name, age_s in ages.items()
        if age_s >= older_s and (TEMPORARY.fullmatch(name) or (name in orphans and not name.startswith(inner)))
    )


def compact(store: Store, full_bytes: int = FULL_BYTES) -> Iterator[Merged]:
    """Merge the small files of each partition of each table. Raises DamagedFile, before anything of its table is done.

    The rows keep their bytes and the times at which they came into the table. MCAP shards, where there are any, follow
    those of samples: they are written before these are committed, and committed right after them.
    """
    mcap = McapTable(store.location)
    followers: list[Shard] = []
    for table in store.tables:
        facts = table.file_facts()
        drop: list[str] = []
        add: list[tuple[Shard, int]] = []
        for group in _groups(table, full_bytes):
            rows = pa.concat_tables([table.read_file(path, facts[path].partition) for path in group])
            shard = write_shard(table.location, table.spec, rows)
            add.append((shard, max(facts[path].written_ms for path in group)))
            drop += group
        if table is store.samples and mcap.version is not None:
            merged = {shard.path: shard.partition for shard, _ in add}
            others = {path: of for path, of in mcap.behind(table).items() if path not in drop}
            followers = [write_mcap_shard(store.location, path, of) for path, of in (merged | others).items()]
        if add:
            table.replace_files(drop, add)
        yield Merged(table.spec.name, len(facts), len(table.file_facts()))
        if table is store.samples and mcap.version is not None:
            there = len(mcap.live_files())
            mcap.keep_up(table, followers)
            yield Merged(mcap.spec.name, there, len(mcap.live_files()))


def _groups(table: KeyedTable, full_bytes: int) -> list[list[str]]:
    """Files to be merged into one, two or more each; of a partition, in the order of their names."""
    partitions: dict[tuple[str, ...], list[tuple[str, int]]] = defaultdict(list)
    for path, file in sorted(table.file_facts().items()):
        if file.n_bytes < SMALL * full_bytes:
            partitions[tuple(file.partition.values())].append((path, file.n_bytes))
    groups: list[list[str]] = []
    for files in partitions.values():
        held = full_bytes  # so that the first opens a group
        for path, n_bytes in files:
            if held + n_bytes > full_bytes:
                groups.append([])
                held = 0
            groups[-1].append(path)
            held += n_bytes
    return [group for group in groups if len(group) > 1]
