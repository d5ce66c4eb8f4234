"""Rows of others' samples into a store: each once, those that are there already skipped, bad ones counted as failed."""

import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass

import pyarrow as pa

from factory.exits import COMPLETE, COMPLETE_WITH_FAILURES, INTERRUPTED, calling_on_stop_signal
from factory.files import DiskFull
from factory.graph.driver import SHARD_BYTES
from factory.graph.execute import RunSummary, record_summary
from factory.graph.progress import Counter, RunTotals
from factory.readers.base import BadClip, failing_as
from factory.store.location import Shard, write_shard
from factory.store.samples import IMPORTED, ChangedRun, ErrorKind, Kind, Outcome, Store
from factory.store.schema import SAMPLES, UNLISTED, BadRow, RunIdentity, Stamp, attempt_id, sample_row_to_table

VERSION = 1  # of what an import makes of a file; stands in stage_versions
NO_VOCABULARY = ""  # in vocabulary_digest: what perturbed the ego is not known
Make = Callable[[], Mapping[str, object]]


@dataclass(frozen=True)
class Entry:
    """One row to be, named before its file is opened."""

    clip_id: str
    dataset: str
    log_id: str
    expert: str
    round: int
    candidate_index: int
    make: Make  # everything but the Stamp's columns; whatever it raises fails the row

    def stamp(self, identity: RunIdentity) -> Stamp:
        """The bookkeeping of the row."""
        source = str(identity.settings[IMPORTED])
        key = attempt_id(self.clip_id, self.candidate_index, NO_VOCABULARY, self.expert, source)
        return Stamp(
            attempt_id=key,
            expert=self.expert,
            expert_digest=source,
            round=self.round,
            candidate_index=self.candidate_index,
            vocabulary_digest=NO_VOCABULARY,
            settings_hash=identity.settings_hash,
            stage_versions=identity.versions_json,
        )


def identity_of(source: str, settings: Mapping[str, object]) -> RunIdentity:
    """What imported rows are made under: where from, and what was asked for."""
    said = {IMPORTED: source} | {f"import.{name}": value for name, value in settings.items()}
    return RunIdentity(said, {"import": VERSION}, NO_VOCABULARY, UNLISTED)


def import_rows(store: Store, identity: RunIdentity, entries: Sequence[Entry]) -> RunSummary:
    """Write the rows that the store has not, in files of up to 128 MB, each committed with the failures before it.

    Raises ChangedRun where the store holds rows of anything else.
    """
    began_ms = int(time.time() * 1000)
    stamps = [entry.stamp(identity) for entry in entries]
    if (known := store.runs()) and known[-1]["settings_hash"] != identity.settings_hash and len(store.samples):
        raise ChangedRun(f"{store.location.uri} holds rows of another run or import: choose another out")
    records = store.checked_records(identity, {stamp.expert: stamp.expert_digest for stamp in stamps}, "stop")
    waiting = [pair for pair in zip(entries, stamps) if pair[1].attempt_id not in store.samples]
    summary = RunSummary(COMPLETE, executed=RunTotals(found_done=len(entries) - len(waiting)), began_ms=began_ms)
    counts = dict.fromkeys((kind.value for kind in Kind), 0)
    stopped: list[bool] = []
    began = time.monotonic()
    try:
        store.begin_run(records)
        batch = _Batch(store)
        with calling_on_stop_signal(lambda: stopped.append(True)), Counter("imported", len(waiting)) as progress:
            for done, (entry, stamp) in enumerate(waiting, start=1):
                failed = _try(batch, entry, stamp)
                counts[Kind.FAILED if failed else Kind.ACCEPTED] += 1
                progress.show(done, f"{counts[Kind.FAILED]} failed")
                summary.executed.attempts += 1
                if stopped:
                    break
            batch.commit()
        if stopped:
            summary.exit_code, summary.message = INTERRUPTED, "interrupted; run the same command again to go on"
        elif counts[Kind.FAILED]:
            summary.exit_code = COMPLETE_WITH_FAILURES
    except DiskFull as error:
        summary.exit_code, summary.message = INTERRUPTED, f"{error}; free disk space and run the same command again"
    summary.counts = counts
    summary.seconds = {"import": (summary.executed.attempts, time.monotonic() - began)}
    record_summary(store, summary)
    return summary


class _Batch:
    """What the next commit holds."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._rows: dict[tuple[int, str], list[pa.Table]] = defaultdict(list)
        self._bytes: dict[tuple[int, str], int] = defaultdict(int)  # of them; Arrow counts anew whenever it is asked
        self._failed: list[Outcome] = []
        self._licences: set[str] = set()

    def add(self, rows: pa.Table, partition: tuple[int, str], licence: str) -> None:
        """Commits where the partition is large enough for a file."""
        self._rows[partition].append(rows)
        self._bytes[partition] += rows.nbytes
        self._licences.add(licence)
        if self._bytes[partition] >= SHARD_BYTES:
            self.commit()

    def fail(self, outcome: Outcome) -> None:
        self._failed.append(outcome)

    def commit(self) -> None:
        """Everything gathered. Raises DiskFull and the store's errors."""
        shards: list[Shard] = [
            write_shard(self._store.samples.location, SAMPLES, pa.concat_tables(rows).combine_chunks())
            for _, rows in sorted(self._rows.items())
        ]
        self._store.commit([], shards, self._failed, licences=self._licences)
        self._rows.clear()
        self._bytes.clear()
        self._failed, self._licences = [], set()


def _try(batch: _Batch, entry: Entry, stamp: Stamp) -> bool:
    """Whether it failed, as an outcome of its own."""
    try:
        with failing_as(f"log {entry.log_id}"):
            row = entry.make()
        batch.add(sample_row_to_table([{**row, **asdict(stamp)}]), (entry.round, entry.expert), str(row["licence"]))
        return False
    except (BadClip, BadRow) as error:
        batch.fail(
            Outcome(
                attempt_id=stamp.attempt_id,
                clip_id=entry.clip_id,
                dataset=entry.dataset,
                log_id=entry.log_id,
                expert=entry.expert,
                expert_digest=stamp.expert_digest,
                candidate_index=entry.candidate_index,
                kind=Kind.FAILED,
                settings_hash=stamp.settings_hash,
                stage_versions=stamp.stage_versions,
                error_kind=ErrorKind.INPUT,
                error=str(error),
            )
        )
        return True
