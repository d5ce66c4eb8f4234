"""The table `samples_mcap`: for every shard of the table `samples` one MCAP shard with the same samples.

It is a table of its own, with a log as the others have: what the log does not name never happened, and a run claims it.
A shard is named `part-<digest of its Parquet shard>-<its own>.mcap`. So what is missing and what is out of date can be
read from two logs, a shard that is made twice is the same file, and no sample stands in two shards that are named.
"""

import hashlib
import re
import time
from collections.abc import Mapping, Sequence

import pyarrow as pa

from factory.store.location import Location
from factory.store.mcap_shards.shard import McapShard, shard_bytes
from factory.store.parquet_file import Shard, TableSpec, naming, open_parquet, with_partition
from factory.store.schema import SAMPLES, SCHEMA
from factory.store.table import KeyedTable

SAMPLES_MCAP = TableSpec("samples_mcap", SCHEMA, "attempt_id", SAMPLES.partition_by, SAMPLES.properties)
NAMED = re.compile(r"(.*part-[0-9a-f]{32})-([0-9a-f]{32})\.mcap")


class McapTable(KeyedTable):
    """The table `samples_mcap`; it reads MCAP where others read Parquet."""

    def __init__(self, out: Location) -> None:
        """out: the store."""
        super().__init__(out.child(SAMPLES_MCAP.name), SAMPLES_MCAP)

    def read_file(self, path: str, partition: Mapping[str, str], columns: Sequence[str] | None = None) -> pa.Table:
        schema = self.schema_of(columns)
        with naming(f"{self.location.uri}/{path}"):
            shard = open_shard(self.location, path)
            stored = shard.read([leaf for leaf in shard.leaves if leaf.partition(".")[0] in schema.names])
            return with_partition(stored, schema, partition)

    def behind(self, samples: KeyedTable) -> dict[str, Mapping[str, str]]:
        """Path and partition of the shards of `samples` that have none here."""
        have = {source_of(path) for path in self.live_files()}
        return {path: partition for path, partition in samples.live_files().items() if path not in have}

    def outdated(self, samples: KeyedTable) -> list[str]:
        """Shards of what is no shard of `samples` any more."""
        live = samples.live_files()
        return [path for path in self.live_files() if source_of(path) not in live]

    def keep_up(self, samples: KeyedTable, written: Sequence[Shard] = ()) -> None:
        """Take in what was written of shards that still are, and out what is outdated, in one transaction.

        Raises AnotherWriter.
        """
        behind, drop, now_ms = self.behind(samples), self.outdated(samples), int(time.time() * 1000)
        add = [(shard, now_ms) for shard in written if source_of(shard.path) in behind]
        if add or drop:
            self.replace_files(drop, add)


def source_of(path: str) -> str:
    """The Parquet shard of an MCAP shard, relative to its table. Raises ValueError for another name."""
    named = NAMED.fullmatch(path)
    if named is None:
        raise ValueError(f"{path}: not the name of an MCAP shard")
    return f"{named[1]}.parquet"


def open_shard(table: Location, path: str) -> McapShard:
    """Raises ValueError where it is no MCAP shard, or damaged."""
    filesystem, base = table.filesystem()
    return McapShard(filesystem.open_input_file(f"{base}/{path}"))


def write_mcap_shard(out: Location, path: str, partition: Mapping[str, str]) -> Shard:
    """The MCAP shard of a committed Parquet shard, to be committed. Idempotent. Raises OSError."""
    samples = out.child(SAMPLES.name)
    with naming(f"{samples.uri}/{path}"):
        parquet = open_parquet(samples, path)
        data = shard_bytes(parquet)
        keys = tuple(parquet.read(columns=[SAMPLES_MCAP.key])[SAMPLES_MCAP.key].to_pylist())
    name = f"{path.removesuffix('.parquet')}-{hashlib.sha256(data).hexdigest()[:32]}.mcap"
    out.child(SAMPLES_MCAP.name).write(name, data)
    return Shard(name, len(data), partition, keys)
