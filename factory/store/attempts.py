"""What became of attempts: the tables `outcomes`, `candidates` and `plans`, and the history that a run goes on from."""

import hashlib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields
from enum import StrEnum

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from factory.store.codes import Bytes, Codes, Ints, codes, distinct, fixed_bytes
from factory.store.parquet_file import TableSpec
from factory.store.schema import schema_of
from factory.store.table import KeyedTable

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
    MACHINE = "machine"  # the machine is ill (factory.store.disk): the next run tries again, however often
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


# The table `candidates`: one row per prepared clip with its ordered candidate list and what each gate dropped.


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


@dataclass(frozen=True, slots=True)
class Listed:
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
    return pa.Table.from_pylist(
        [
            vars(row) | {"candidates": [vars(each) for each in row.candidates], "n_candidates": len(row.candidates)}
            for row in rows
        ],
        schema=CANDIDATE_SCHEMA,
    )


def listed_of(table: KeyedTable) -> dict[str, Listed]:
    """clip_id -> what the table says of the clip."""
    rows = table.read(["clip_id", *(field.name for field in fields(Listed))])
    return {row.pop("clip_id"): Listed(**row) for row in rows.to_pylist()}


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


def plan_table(rounds: Mapping[str, int], clip_ids: Sequence[str]) -> pa.Table:
    """One plan as a row."""
    clips, wanted = sorted(clip_ids), dict(sorted(rounds.items()))
    text = "\x1f".join((*(f"{expert} {n}" for expert, n in wanted.items()), "", *clips))
    row = {"plan_id": hashlib.sha256(text.encode()).hexdigest()[:16], "rounds": wanted, "clip_ids": clips}
    return pa.Table.from_pylist([row], schema=PLAN_SCHEMA)


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
class Past:
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

    candidates: Mapping[str, Listed] = field(default_factory=dict)  # clip_id -> what is known of its list
    clip_ids: Mapping[str, int] = field(default_factory=dict)
    experts: tuple[str, ...] = ()
    starts: Ints = field(default_factory=lambda: np.zeros(1, np.int64))  # by clip, then expert
    attempt_id: Bytes = field(default_factory=lambda: np.zeros(0, "S1"))
    candidate: NDArray[np.int32] = field(default_factory=lambda: np.zeros(0, np.int32))
    current: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, bool))
    became: NDArray[np.int32] = field(default_factory=lambda: np.zeros(0, np.int32))  # place in `fates`
    fates: tuple[tuple[Kind, int, str, int, str], ...] = ()  # kind, round, error_kind, tries, stage_versions

    def known(self, clip_id: str, expert: str) -> dict[int, Past]:
        """Candidate -> what became of it; a current row hides one that is not."""
        known: dict[int, Past] = {}
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
                known[candidate] = Past(key.decode(), kind, current, round_, error_kind, tries, versions)
        return known

    def stale(self, clip_id: str, expert: str) -> frozenset[str]:
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

    def complete(self, expert: str, first: int, wanted: int) -> dict[str, tuple[int, int]]:
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


NOTHING = History()


def history_of(
    outcomes: pa.Table,
    samples: pa.Table,
    candidates: Mapping[str, Listed],
    made_by: tuple[str, str],
    expert_digests: Mapping[str, str],
) -> History:
    """From rows with the columns OUTCOME_STATE and SAMPLE_STATE; made_by: settings hash and stage versions of the run.

    Samples win over outcomes of the same attempt.
    """
    rows = pa.concat_tables([outcomes.select(STATE), samples.select(STATE)])
    clip, clip_ids = codes(rows["clip_id"])
    columns = [codes(rows[name]) for name in MADE_BY]
    (expert, experts), (versions, version_texts) = columns[0], columns[3]
    made, at = distinct([numbers for numbers, _ in columns])
    texts = [[words[i] for i, (_, words) in zip(row, columns)] for row in made.tolist()]
    is_current = [(s, v) == made_by and digest == expert_digests.get(e, digest) for e, digest, s, v in texts]
    became, fates = _fates(outcomes, samples, versions, version_texts)
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


def _fates(
    outcomes: pa.Table, samples: pa.Table, versions: Codes, version_texts: Sequence[str]
) -> tuple[NDArray[np.int32], tuple[tuple[Kind, int, str, int, str], ...]]:
    """What became of each row, as a place among the few different fates."""
    n = samples.num_rows
    kind, kinds = codes(outcomes["kind"])
    error, errors = codes(outcomes["error_kind"])
    made, at = distinct(
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
