"""What the tables say of every attempt, as columns of some 60 bytes a row; a walk's part is unpacked when it is asked.

A walk is a (clip_id, expert); the expert "" stands for the clip as a whole.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from factory.store.candidates import Listed
from factory.store.counts.codes import Bytes, Codes, Ints, codes, distinct, fixed_bytes
from factory.store.outcomes import Kind

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
