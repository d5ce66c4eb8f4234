"""A store: the tables plans, candidates, samples and outcomes, the cache beside them, and what they say is done.

The sample commit is the truth. A group of results is committed in the order candidates, samples, outcomes, so that a
crash in between loses at most the outcomes, whose attempts the next run tries again with the same result.
"""

import hashlib
import json
import os
import re
from collections import defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from enum import StrEnum
from typing import Any, Literal

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from factory.files import DamagedFile
from factory.store.location import ClipCache, Location, Shard, write_shard
from factory.store.schema import (
    LICENCES_PROPERTY,
    SAMPLES,
    SCHEMA_VERSION,
    UNLISTED,
    RunIdentity,
    TableSpec,
    canonical_json,
    schema_of,
    why_other_schema,
)
from factory.store.table import Bytes, Codes, Ints, KeyedTable, distinct_rows, fixed_bytes, text_codes
from tasks.caches import MEMBER, Damaged, json_with_checksum, parse_json_with_checksum
from tasks.world.repair.records import Repair, RepairCount

# What became of attempts: the tables `outcomes`, `candidates` and `plans`, and the history that a run goes on from.

# The table `outcomes`: what became of every attempt that is not a sample, one row per attempt_id.
#
# A row about a clip as a whole (a bad file, a standing ego) has candidate -1 and no expert; `exhausted` stands behind
# the last candidate of a walk. A newer outcome of the same attempt replaces the older one. Timings live here and
# nowhere else.


class Kind(StrEnum):
    ACCEPTED = "accepted"  # stands in `samples`, never here
    REJECTED = "rejected"
    FAILED = "failed"
    EXHAUSTED = "exhausted"


class ErrorKind(StrEnum):
    NONE = ""
    INPUT = "input"  # the clip is broken: waits for retry or a raised stage version
    BUG = "bug"  # the code raised: likewise
    MACHINE = "machine"  # the machine is ill (factory.files): the next run tries again, however often
    SYSTEM = "system"  # a worker died at it, a file could not be read: the next run tries again
    LIMIT = "limit"  # ended over its seconds or its memory: the next run tries again
    POISON = "poison"  # failed(system | limit) in QUARANTINE_AFTER runs: waits like a bug


QUARANTINE_AFTER = 3  # runs, each with Ray's own retries


@dataclass(frozen=True)
class Outcome:
    """One row of the table."""

    attempt_id: str
    clip_id: str
    dataset: str
    log_id: str
    expert: str
    expert_digest: str
    candidate_index: int
    kind: str  # Kind
    settings_hash: str
    stage_versions: str  # canonical JSON
    stage: str = ""  # rejected: by which stage; failed: in which task of an attempt, where that is known
    reason: str = ""  # rejected: why
    detail: str = ""
    error_kind: str = ""  # ErrorKind
    error: str = ""  # last lines of the traceback
    tries: int = 1  # runs that tried it; failed(machine): those that count
    n_tried: int = 0  # exhausted: length of the candidate list
    subscores: dict[str, float] = field(default_factory=dict)  # rejected: as far as known
    seconds: dict[str, float] = field(default_factory=dict)  # stage -> seconds


OUTCOME_SCHEMA = schema_of(Outcome)
OUTCOMES = TableSpec("outcomes", OUTCOME_SCHEMA, "attempt_id")


def outcomes_table(outcomes: Sequence[Outcome]) -> pa.Table:
    """Column by column: a row holds nothing that had to be copied first."""
    columns = [pa.array([getattr(row, field.name) for row in outcomes], field.type) for field in OUTCOME_SCHEMA]
    return pa.Table.from_arrays(columns, schema=OUTCOME_SCHEMA)


# The table `candidates`: one row per prepared clip with its ordered candidate list, what each gate dropped and what was
# repaired in its log.


@dataclass(frozen=True)
class CandidateRow:
    """One perturbation that passed every gate and filter, in the order in which walks try it."""

    index: int  # place in the clip's ordered list, 0 ...
    vocabulary_index: int  # -1: the log itself; -2 - n: start n of the clip's own
    end_x: float  # [m] LQR-reached end pose, frame of the logged pose at T+H
    end_y: float  # [m]
    end_heading: float  # [rad]
    end_speed: float  # [m/s]
    cell: tuple[int, int]  # (longitudinal, lateral) cell of the interleaved grid
    score: float  # EPDMS (/14) against log replay
    reactive_score: float  # EPDMS (/14) among reacting agents


@dataclass(frozen=True)
class ClipCandidates:
    """One row of the table."""

    clip_id: str
    dataset: str
    log_id: str
    content_digest: str
    prepare_digest: str
    vocabulary_digest: str
    gate_counts: dict[str, int]
    candidates: tuple[CandidateRow, ...]
    stage: str = ""  # why there are none
    reason: str = ""
    repairs: tuple[RepairCount, ...] = ()  # as in the clip's samples; here also of a clip that has none
    repair_records: tuple[Repair, ...] = ()  # one by one, the first MOST_RECORDS


CAMERA_LEFT_OUT = "camera "  # with its name a key of gate_counts, 1 where the clip's block shows it too poorly
MOST_RECORDS = 200  # of a clip; some 10 kB


@dataclass(frozen=True, slots=True)
class CandidateSummary:
    """What a run must know of a clip's row; the candidates themselves stay in the table and in the prepared clip."""

    prepare_digest: str
    content_digest: str
    n_candidates: int


CANDIDATE_SCHEMA = schema_of(ClipCandidates)
CANDIDATE_SCHEMA = CANDIDATE_SCHEMA.insert(
    CANDIDATE_SCHEMA.get_field_index("candidates"), pa.field("n_candidates", pa.int32())
)
CANDIDATES = TableSpec("candidates", CANDIDATE_SCHEMA, "clip_id")


def candidates_table(rows: Sequence[ClipCandidates]) -> pa.Table:
    nested = ("candidates", "repairs", "repair_records")
    return pa.Table.from_pylist(
        [
            vars(row)
            | {name: [vars(each) for each in getattr(row, name)] for name in nested}
            | {"n_candidates": len(row.candidates)}
            for row in rows
        ],
        schema=CANDIDATE_SCHEMA,
    )


# The table `plans`: what runs set out to do, one row for each different answer, there before its first task is begun.
#
# What is planned under an `out` is all of them together: for each clip and expert the most rounds that any run asked
# for. A plan is named by its content, so that the same command again finds its own.

PLAN_SCHEMA = pa.schema(
    [
        pa.field("plan_id", pa.string()),
        pa.field("rounds", pa.map_(pa.string(), pa.int32())),  # expert -> samples of each clip
        pa.field("clip_ids", pa.list_(pa.string())),
    ]
)
PLANS = TableSpec("plans", PLAN_SCHEMA, "plan_id")


def plans_of(table: KeyedTable, clip_ids: Collection[str] | None = None) -> pa.Table:
    """All plans, or as if some clips were all that there are."""
    plans = table.read()
    if clip_ids is None:
        return plans
    chosen = set(clip_ids)
    rows = [row | {"clip_ids": [clip for clip in row["clip_ids"] if clip in chosen]} for row in plans.to_pylist()]
    return pa.Table.from_pylist(rows, schema=PLAN_SCHEMA)


# What the tables say of every attempt, as columns of some 60 bytes a row; a walk's part is unpacked when it is asked.
#
# A walk is a (clip_id, expert); the expert "" stands for the clip as a whole.

MADE_BY = ["expert", "expert_digest", "settings_hash", "stage_versions"]
STATE = ["attempt_id", "clip_id", *MADE_BY, "candidate_index"]
SAMPLE_STATE = [*STATE, "round"]
OUTCOME_STATE = [*STATE, "kind", "error_kind", "tries"]


@dataclass(frozen=True, slots=True)
class PastAttempt:
    """What the tables say about one attempt."""

    attempt_id: str
    kind: Kind
    current: bool  # made under the run's own settings, versions and expert inputs
    round: int = -1  # accepted: its round
    error_kind: str = ""  # failed: ErrorKind
    tries: int = 0  # failed: runs that tried it
    stage_versions: str = ""  # under which


@dataclass(frozen=True)
class History:
    """Rows by walk, in a walk outcomes before samples; all arrays (N,) but `starts` (W + 1,), W walks."""

    candidates: Mapping[str, CandidateSummary] = field(default_factory=dict)  # clip_id -> what is known of its list
    clip_ids: Mapping[str, int] = field(default_factory=dict)
    experts: tuple[str, ...] = ()
    starts: Ints = field(default_factory=lambda: np.zeros(1, np.int64))  # by clip, then expert
    attempt_id: Bytes = field(default_factory=lambda: np.zeros(0, "S1"))
    candidate: NDArray[np.int32] = field(default_factory=lambda: np.zeros(0, np.int32))
    current: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, bool))
    became: NDArray[np.int32] = field(default_factory=lambda: np.zeros(0, np.int32))  # place in `fates`
    fates: tuple[tuple[Kind, int, str, int, str], ...] = ()  # kind, round, error_kind, tries, stage_versions

    def past_attempts(self, clip_id: str, expert: str) -> dict[int, PastAttempt]:
        """Candidate -> what became of it; a current row hides one that is not."""
        known: dict[int, PastAttempt] = {}
        rows = self._rows(clip_id, expert)
        for candidate, key, current, became in zip(
            self.candidate[rows].tolist(),
            self.attempt_id[rows].tolist(),
            self.current[rows].tolist(),
            self.became[rows].tolist(),
        ):
            there = known.get(candidate)
            if there is None or current or not there.current:
                kind, round_, error_kind, tries, versions = self.fates[became]
                known[candidate] = PastAttempt(key.decode(), kind, current, round_, error_kind, tries, versions)
        return known

    def stale_ids(self, clip_id: str, expert: str) -> frozenset[str]:
        """attempt_ids of rows that are not current."""
        rows = self._rows(clip_id, expert)
        return frozenset(key.decode() for key in self.attempt_id[rows][~self.current[rows]].tolist())

    def experts_of(self, clip_ids: Collection[str]) -> set[str]:
        """That have rows of some of these clips."""
        return {expert for expert in self.experts if not self.clips_of([expert]).isdisjoint(clip_ids)}

    def clips_of(self, experts: Collection[str], stale: bool = False) -> set[str]:
        """clip_ids that some of these experts have rows of; stale: rows that are not current."""
        which = np.flatnonzero(~self.current) if stale else np.arange(len(self.current))
        walks = np.unique(np.searchsorted(self.starts, which, side="right") - 1)
        numbers = [number for number, expert in enumerate(self.experts) if expert in experts]
        clips = set(np.unique(walks[np.isin(walks % max(1, len(self.experts)), numbers)] // max(1, len(self.experts))))
        return {clip_id for clip_id, number in self.clip_ids.items() if number in clips}

    def complete_walks(self, expert: str, first: int, wanted: int) -> dict[str, tuple[int, int]]:
        """clip_id -> samples, attempts of those walks of an expert that show at once that they have all they should.

        All their rows are current and none failed; candidates are `first`, first + 1 and so on, one row each, and the
        accepted ones stand in rounds 0, 1 and so on, to `wanted` of them at least.
        """
        if expert not in self.experts:
            return {}
        walks = np.arange(self.experts.index(expert), len(self.starts) - 1, len(self.experts))
        lengths = self.starts[walks + 1] - self.starts[walks]
        starts = np.cumsum(lengths) - lengths  # of walks among the expert's own rows
        walk, ordinal = np.repeat(np.arange(len(walks)), lengths), np.arange(lengths.sum()) - np.repeat(starts, lengths)
        rows = np.repeat(self.starts[walks], lengths) + ordinal
        rows = rows[np.lexsort((self.candidate[rows], walk))]
        became, kinds = self.became[rows], [fate[0] for fate in self.fates]
        accepted = np.array([kind is Kind.ACCEPTED for kind in kinds])[became]
        settled = np.array([kind in (Kind.ACCEPTED, Kind.REJECTED) for kind in kinds])[became]
        number = np.array([fate[1] for fate in self.fates])[became]
        made = np.cumsum(accepted)
        before = made - accepted - np.repeat((made - accepted)[starts[lengths > 0]], lengths[lengths > 0])
        in_order = (self.candidate[rows] == first + ordinal) & (~accepted | (number == before))
        broken = np.bincount(walk[~(settled & in_order & self.current[rows])], minlength=len(walks))
        samples = np.bincount(walk[accepted], minlength=len(walks))
        clip_ids = list(self.clip_ids)
        which = np.flatnonzero((broken == 0) & (samples >= wanted))
        found = zip(which.tolist(), samples[which].tolist(), lengths[which].tolist())
        return {clip_ids[clip]: (n_samples, n) for clip, n_samples, n in found}

    def _rows(self, clip_id: str, expert: str) -> slice:
        clip = self.clip_ids.get(clip_id)
        if clip is None or expert not in self.experts:
            return slice(0, 0)
        walk = clip * len(self.experts) + self.experts.index(expert)
        return slice(self.starts[walk], self.starts[walk + 1])


def build_history(
    outcomes: pa.Table,
    samples: pa.Table,
    candidates: Mapping[str, CandidateSummary],
    made_by: tuple[str, str],
    expert_digests: Mapping[str, str],
) -> History:
    """From rows with the columns OUTCOME_STATE and SAMPLE_STATE; made_by: settings hash and stage versions of the run.

    Samples win over outcomes of the same attempt.
    """
    rows = pa.concat_tables([outcomes.select(STATE), samples.select(STATE)])
    clip, clip_ids = text_codes(rows["clip_id"])
    columns = [text_codes(rows[name]) for name in MADE_BY]
    (expert, experts), (versions, version_texts) = columns[0], columns[3]
    made, at = distinct_rows([numbers for numbers, _ in columns])
    texts = [[words[i] for i, (_, words) in zip(row, columns)] for row in made.tolist()]
    is_current = [(s, v) == made_by and digest == expert_digests.get(e, digest) for e, digest, s, v in texts]
    became, fates = _outcome_codes(outcomes, samples, versions, version_texts)
    place = clip * max(1, len(experts)) + expert
    order = np.argsort(place, kind="stable")
    n_walks = len(clip_ids) * max(1, len(experts))
    return History(
        candidates,
        {clip_id: number for number, clip_id in enumerate(clip_ids)},
        experts,
        np.searchsorted(place[order], np.arange(n_walks + 1)),
        fixed_bytes(rows["attempt_id"])[order],
        rows["candidate_index"].to_numpy()[order],
        np.array(is_current, bool)[at[order]],
        became[order],
        fates,
    )


def _outcome_codes(
    outcomes: pa.Table, samples: pa.Table, versions: Codes, version_texts: Sequence[str]
) -> tuple[NDArray[np.int32], tuple[tuple[Kind, int, str, int, str], ...]]:
    """What became of each row, as a place among the few different fates."""
    n = samples.num_rows
    kind, kinds = text_codes(outcomes["kind"])
    error, errors = text_codes(outcomes["error_kind"])
    made, at = distinct_rows(
        [
            np.concatenate([kind, np.full(n, len(kinds))]),
            np.concatenate([np.zeros(len(kind), np.int64), samples["round"].to_numpy().astype(np.int64) + 1]),
            np.concatenate([error, np.full(n, len(errors))]),
            np.concatenate([outcomes["tries"].to_numpy().astype(np.int64), np.zeros(n, np.int64)]),
            versions,
        ]
    )
    fates = tuple(
        (Kind((*kinds, Kind.ACCEPTED)[k]), round_ - 1, (*errors, "")[e], tries, version_texts[v])
        for k, round_, e, tries, v in made.tolist()
    )
    return at.astype(np.int32), fates


OnChange = Literal["stop", "keep", "redo"]
QUIET_S = 900.0  # a run that said it began and was not heard of for so long is taken for gone
RUN_FILE = "run.json"
RUN_COPY = "samples/_commits/run.json"  # the same once more: nothing else of a run tells what is in it
CURRENT_RUN = "current_run.json"  # what the newest run set out to do; over once last_run.json has its began_ms
LAST_RUN = "last_run.json"
FACTS = "report.json"  # what only the newest run knows: its facts, and what its reader left out
REMADE = "remade"  # of a record in run.json: which stages its run made again of earlier rows, and where these are
IMPORTED = "import.source"  # a setting that tables of others' rows have, and no run
WAYS_OUT = "Go on with on_change=keep, replace with on_change=redo, or choose another out"
SHOWN = 3  # changed settings that a message names
MADE_UNDER = ["attempt_id", "expert", "expert_digest", "settings_hash", "stage_versions"]


def imported_from(runs: Sequence[Mapping[str, Any]]) -> str | None:
    """Whose rows a table's are, by its records (Store.runs); None for those of a run."""
    return runs[-1]["settings"].get(IMPORTED) if runs else None


class ChangedRun(ValueError):
    """The run's settings, versions or expert inputs differ from the table's; the message says where."""


class OtherSchema(ChangedRun):
    """The tables are of another version of the schema; the message names both and says how to make them again."""


def refuse_other_schema(out: Location) -> None:
    """Raises OtherSchema by run.json alone, that of earlier versions without a checksum too; opens no table."""
    data = out.read(RUN_FILE)
    if data is None:
        return
    try:
        version = (parse_json_with_checksum(data) if f'"{MEMBER}"'.encode() in data else json.loads(data))[
            "schema_version"
        ]
    except (ValueError, KeyError, TypeError):  # damaged: who needs the records says so
        return
    if other := why_other_schema(out.uri, version):
        raise OtherSchema(other)


class NewestRun:
    """What the newest run set out to do (current_run.json), and what the last that ended did (last_run.json)."""

    def __init__(self, current: bytes | None, last: bytes | None) -> None:
        self.damaged: list[str] = []  # of the two, by name: read as empty, so nothing is known of the run by them
        self.current, self.last = self._fields_of(CURRENT_RUN, current), self._fields_of(LAST_RUN, last)

    def _fields_of(self, name: str, data: bytes | None) -> dict[str, Any]:
        try:
            return {} if data is None else parse_json_with_checksum(data)
        except Damaged:
            self.damaged.append(name)
            return {}

    @property
    def goes_on(self) -> bool:
        """It has begun and nothing tells its end: neither its own, nor that of a later one which never began.

        No, where one of the two is damaged: what repairs a store (and claims its tables first) must not wait for it.
        """
        if self.damaged:
            return False
        began, ended = self.current.get("began_ms", 0), self.last
        stopped_later = not ended.get("began_ms") and ended.get("ended_ms", 0) >= began
        return bool(began) and began != ended.get("began_ms") and not stopped_later

    def heard_s_ago(self, committed_ms: int, now_s: float) -> float:
        """Since it began, last said how far it is, or committed something."""
        return now_s - max(committed_ms, self.current.get("began_ms", 0), self.current.get("said_ms", 0)) / 1e3


class Store:
    """One run's view of everything under `out`. Opening writes nothing, and raises OtherSchema before any table is."""

    def __init__(
        self, out: str | os.PathLike[str] | Location, storage_options: Mapping[str, str] | None = None
    ) -> None:
        self.location = out if isinstance(out, Location) else Location.parse(out, storage_options)
        refuse_other_schema(self.location)
        self.samples = KeyedTable(self.location.child("samples"), SAMPLES)
        self.candidates = KeyedTable(self.location.child("candidates"), CANDIDATES)
        self.outcomes = KeyedTable(self.location.child("outcomes"), OUTCOMES)
        self.plans = KeyedTable(self.location.child("plans"), PLANS)

    @property
    def tables(self) -> tuple[KeyedTable, ...]:
        """In the order in which they are written."""
        return self.plans, self.candidates, self.samples, self.outcomes

    @property
    def cache(self) -> ClipCache:
        return ClipCache(self.location.child("cache/prepared"))

    def checked_records(
        self, identity: RunIdentity, expert_digests: Mapping[str, str], on_change: OnChange, names: Collection[str] = ()
    ) -> list[dict[str, Any]]:
        """Hold the run against the newest record of run.json; the records as they are to be, with this run's as newest.

        A record's on_change says whether rows of older records may stand among its own ("keep"); its expert digests
        are those of all experts so far. Writes nothing. Raises ChangedRun where they differ, on_change is "stop" and
        there are samples; without one the run starts over. names: of its clips' readers.
        """
        for expert in expert_digests:
            if not re.fullmatch(r"[A-Za-z0-9_-]+", expert):
                raise ChangedRun(f"expert {expert!r}: a name is letters, digits, _ and - (it becomes a folder)")
        for table in self.tables:
            if (lost := table.lost_commit()) is not None:
                where = f"{table.location.uri}: commit {lost} is gone from the table's log"
                raise ChangedRun(f"{where}; python -m factory verify out={self.location.uri} repair=true puts it back")
        records = self.runs()
        record: dict[str, Any] = {
            "settings": dict(identity.settings),
            "settings_hash": identity.settings_hash,
            "stage_versions": dict(identity.stage_versions),
            "vocabulary_digest": identity.vocabulary_digest,
            "prepare_digest": identity.prepare_digest,
            "expert_digests": dict(expert_digests),
            "on_change": on_change,
        }
        record = json.loads(canonical_json(record))
        if not records and (len(self.samples) or len(self.outcomes)):
            raise ChangedRun(
                f"{self.location.uri}: {RUN_FILE} is missing beside tables with rows; python -m factory verify "
                f"out={self.location.uri} repair=true puts it back"
            )
        if records:
            changes = record_differences(records[-1], record)
            if changes and on_change == "stop" and not len(self.samples):
                return [record]  # nothing stands on the settings that were: they were tried, found wrong and corrected
            if changes and on_change == "stop":
                raise ChangedRun(self._why_changed(changes, names))
            record["expert_digests"] = records[-1]["expert_digests"] | record["expert_digests"]
            if identity.prepare_digest == UNLISTED:  # lists of earlier runs stay what they are
                record["prepare_digest"] = records[-1]["prepare_digest"]
            if on_change == "stop":
                record["on_change"] = records[-1]["on_change"]
            if not changes:
                record |= {name: value for name, value in records[-1].items() if name == REMADE}
                records = records[:-1]
        return [*records, record]

    def _why_changed(self, changes: Sequence[str], names: Collection[str]) -> str:
        more = [f"and {len(changes) - SHOWN} more"] if len(changes) > SHOWN else []
        shown, there = "; ".join([*changes[:SHOWN], *more]), self.samples.read(["dataset"])["dataset"].to_pylist()
        if names and set(names).isdisjoint(there):
            holds = f"holds samples of {', '.join(sorted(set(there)))}, made with other settings ({shown})"
            return f"{self.location.uri} {holds}: choose another out for {', '.join(sorted(names))}"
        return f"{self.location.uri} was made with other settings: {shown}. {WAYS_OUT}"

    def starts_over(self, records: Sequence[Mapping[str, object]]) -> bool:
        """Whether `records` of checked_records() take the place of settings that made no sample."""
        known = self.runs()
        return bool(known) and len(records) == 1 and bool(record_differences(known[-1], records[0]))

    def begin_run(self, records: Sequence[Mapping[str, object]]) -> bool:
        """The first writes of a run: fence off older runs, record its settings, tidy up after a crash.

        Of two runs the one that begins later wins: whatever the older has not committed by now it never will. Of runs
        that begin at once it is the one whose claim comes last in the log of candidates. True: another run committed
        something since this store was opened, so that what was known of it is out of date. Raises AnotherWriter.

        A run that starts over drops what became of attempts under the settings that were. A crash between two commits
        leaves a failed outcome beside the sample that its retry became; it goes. One that is newer than the sample of
        the same attempt, of a redo that failed, stays.
        """
        starts_over = self.starts_over(records)
        before = [set(table.live_files()) for table in self.tables]
        self.claim()
        moved = [set(table.live_files()) for table in self.tables] != before
        if starts_over:
            for table in (self.plans, self.candidates, self.outcomes):
                table.commit([], drop=list(table))
        if list(records) != self.runs() or not self.location.has(RUN_COPY):
            document = json.loads(canonical_json({"schema_version": SCHEMA_VERSION, "runs": list(records)}))
            for name in (RUN_COPY, RUN_FILE):
                self.location.write(name, json_with_checksum(document).encode())
        twice = {key.decode() for key in np.intersect1d(self.outcomes.keys(), self.samples.keys(), True).tolist()}
        if twice:
            age = run_number_lookup(records)
            samples, outcomes = (
                {
                    row["attempt_id"]: age(row)
                    for row in table.read(MADE_UNDER).to_pylist()
                    if row["attempt_id"] in twice
                }
                for table in (self.samples, self.outcomes)
            )
            self.outcomes.commit([], drop=[key for key in twice if outcomes[key] <= samples[key]])
        return moved

    def claim(self, create: bool = True) -> None:
        """Fence off every run that began earlier: it commits nothing any more. Raises AnotherWriter.

        create: tables that are not there yet; else they are left out.
        """
        tables = (self.candidates, self.plans, self.samples, self.outcomes)
        above = max(table.epoch for table in tables)  # which differ only where one was put back or made anew
        epoch = None
        for table in tables:
            if create or table.version is not None:
                epoch = table.claim(epoch, above)

    def runs(self) -> list[dict[str, Any]]:
        """The settings the rows were made with, oldest first. Raises DamagedFile for an unreadable run.json."""
        data = self.location.read(RUN_FILE)
        if data is None:
            return []
        try:
            return list(parse_json_with_checksum(data)["runs"])
        except (ValueError, KeyError, TypeError) as error:
            raise DamagedFile(f"{self.location.uri}/{RUN_FILE}: not readable: {error}") from error

    def document(self, name: str) -> dict[str, Any]:
        """A JSON file that runs leave beside the tables, empty where there is none. Raises DamagedFile."""
        data = self.location.read(name)
        try:
            return {} if data is None else parse_json_with_checksum(data)
        except Damaged as error:
            raise DamagedFile(f"{self.location.uri}/{name}: not readable: {error}") from error

    def last_commit_ms(self) -> int:
        """Of any table, since 1970; 0: nothing was committed."""
        files = (file for table in self.tables for file in table.file_facts().values())
        return max((file.written_ms for file in files), default=0)

    def newest_run(self) -> NewestRun:
        """As its files say it."""
        return NewestRun(*(self.location.read(name) for name in (CURRENT_RUN, LAST_RUN)))

    def history(self, identity: RunIdentity, expert_digests: Mapping[str, str]) -> History:
        """Everything the tables know, samples winning over outcomes of the same attempt."""
        listed = self.candidates.read(["clip_id", *(field.name for field in fields(CandidateSummary))]).to_pylist()
        return build_history(
            self.outcomes.read(OUTCOME_STATE, encoded=True),
            self.samples.read(SAMPLE_STATE, encoded=True),
            {row.pop("clip_id"): CandidateSummary(**row) for row in listed},
            (identity.settings_hash, identity.versions_json),
            expert_digests,
        )

    def record_plan(self, rounds: Mapping[str, int], clip_ids: Sequence[str]) -> None:
        """Write down what a run sets out to do, expert -> samples of each clip; nothing where that is known already.

        Raises AnotherWriter.
        """
        clips, wanted = sorted(clip_ids), dict(sorted(rounds.items()))
        text = "\x1f".join((*(f"{expert} {n}" for expert, n in wanted.items()), "", *clips))
        plan_id = hashlib.sha256(text.encode()).hexdigest()[:16]
        if plan_id not in self.plans:
            row = {"plan_id": plan_id, "rounds": wanted, "clip_ids": clips}
            table = pa.Table.from_pylist([row], schema=PLAN_SCHEMA)
            self.plans.commit([write_shard(self.plans.location, PLANS, table)])

    def commit(
        self,
        candidates: Sequence[ClipCandidates],
        shards: Sequence[Shard],
        outcomes: Sequence[Outcome],
        replaced: Sequence[str] = (),
        unlisted: Sequence[str] = (),
        licences: Collection[str] = (),
    ) -> None:
        """Commit one group of results, in place of the rows of attempts `replaced` and the lists of clips `unlisted`.

        Raises DuplicateKey and AnotherWriter.
        """
        lists = [write_shard(self.candidates.location, CANDIDATES, candidates_table(candidates))] if candidates else []
        self.candidates.commit(lists, drop=[*unlisted, *(row.clip_id for row in candidates)])
        accepted = [key for shard in shards for key in shard.keys]
        # The table's own metadata names every licence of its rows, before the first such row is there.
        known = self.samples.properties.get(LICENCES_PROPERTY, "")
        named = "; ".join(sorted({line for line in (*known.split("; "), *licences) if line}))
        if named != known:
            self.samples.set_property(LICENCES_PROPERTY, named)
        self.samples.commit(shards, drop=replaced)
        # A failed outcome stands until its attempt succeeds: then it goes, and it never stands twice.
        files = [write_shard(self.outcomes.location, OUTCOMES, outcomes_table(outcomes))] if outcomes else []
        self.outcomes.commit(files, drop=[*accepted, *replaced, *(o.attempt_id for o in outcomes)])


def run_number_lookup(records: Sequence[Mapping[str, Any]]) -> Callable[[Mapping[str, Any]], int]:
    """Of a row with the columns MADE_UNDER: the place of the newest record that it could be made under, -1 for none."""
    made: dict[tuple[str, str], list[tuple[int, Mapping[str, str]]]] = defaultdict(list)
    for number, record in enumerate(records):
        key = record["settings_hash"], canonical_json(record["stage_versions"])
        made[key].insert(0, (number, record["expert_digests"]))

    def of(row: Mapping[str, Any]) -> int:
        expert, digest = row["expert"], row["expert_digest"]
        found = made.get((row["settings_hash"], row["stage_versions"]), [])
        return next((number for number, digests in found if digests.get(expert, digest) == digest), -1)

    return of


def record_differences(old: Mapping[str, object], new: Mapping[str, object]) -> list[str]:
    """What differs between two records of run.json, in words; an expert that only one of them has is no difference."""
    found = []
    for part, word in (("settings", ""), ("stage_versions", "stage version "), ("expert_digests", "inputs of expert ")):
        a, b = dict(old[part]), dict(new[part])  # type: ignore[call-overload]
        names = sorted(set(a) & set(b)) if part == "expert_digests" else sorted(set(a) | set(b))
        found += [line for n in names for line in _changes(f"{word}{n}", a.get(n, "not set"), b.get(n, "not set"))]
    for part, word in (("vocabulary_digest", "vocabulary"), ("prepare_digest", "what perturb depends on")):
        if (
            old[part] != new[part]
            and not any(line.startswith(f"{word}: ") for line in found)
            and UNLISTED not in (old[part], new[part])
            and not (part == "prepare_digest" and found)
        ):
            found.append(f"{word}: {old[part]} -> {new[part]}")
    return found


def _changes(name: str, old: object, new: object) -> Iterator[str]:
    """What differs between two values of a setting, within groups by their keys."""
    if isinstance(old, Mapping) and isinstance(new, Mapping):
        for key in sorted({*old, *new}):
            yield from _changes(f"{name}.{key}", old.get(key, "not set"), new.get(key, "not set"))
    elif old != new:
        yield f"{name}: {old} -> {new}"
