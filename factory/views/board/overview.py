"""The numbers of the overview, from one snapshot: what GET /api/overview answers.

Every type is a frozen dataclass whose fields are the JSON's. A share that is not defined is null.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from factory.store.funnel import Funnel, funnel_of_rows
from factory.store.outcomes import Kind
from factory.views.board.watch import Snapshot
from factory.views.report_words import GATE_WORDS, PAPER_CLIP_PERCENT, REASON_WORDS, STATUS

STAGES = ("clip", "perturb", "rollout", "expert", "reward", "render", "write")  # in the order of an attempt
QUIET_S = 900.0  # a run that commits nothing for so long is said to be quiet
N_BUCKETS = 60
N_FAILED = 50
BINS = (40, 24)  # along, aside
REACH_M = (20.0, 2.0)  # where run.json does not say: the paper's


@dataclass(frozen=True)
class State:
    """How the newest run goes."""

    word: str
    tone: str  # good | warn | bad | live
    live: bool
    detail: str
    last_commit_ms: int  # since 1970; 0: nothing yet


@dataclass(frozen=True)
class Counts:
    """Of the whole store."""

    samples: int
    simulated: int  # samples that are not a logged drive
    simulated_attempts: int
    attempts: int
    rejected: int
    failed: int  # attempts and clips
    clips: int  # with a row of candidates
    candidates: int
    sample_bytes: int


@dataclass(frozen=True)
class Step:
    """One bar of the funnel by stage: what is left after it."""

    name: str
    what: str
    left: int
    dropped: int


@dataclass(frozen=True)
class Acceptance:
    """One round of one expert."""

    expert: str
    round: int
    tried: int
    accepted: int
    rejected: int
    failed: int
    clips: int
    clips_before: int
    attempt_rate: float | None
    first_try_rate: float | None
    clip_rate: float | None
    paper: float | None  # published share of clips, to hold against clip_rate and first_try_rate


@dataclass(frozen=True)
class Reason:
    """Why attempts, or clips, fell."""

    reason: str  # stage.reason or failed.kind
    words: str
    total: int
    by_expert: Mapping[str, int]


@dataclass(frozen=True)
class Throughput:
    """Rows by the time of their commit."""

    began_ms: int
    ended_ms: int
    bucket_s: float
    samples: Sequence[int]  # per bucket
    attempts: Sequence[int]
    samples_per_hour: float | None
    walks_done: int | None  # of a live run: (clip, expert) walks that ended since it began
    walks: int | None
    eta_s: float | None  # null too where the run is quiet


@dataclass(frozen=True)
class StageTime:
    """Worker seconds of one stage."""

    stage: str
    tasks: int
    seconds: float


@dataclass(frozen=True)
class Coverage:
    """Counts over end points in the frame of the logged pose at T+H; [aside][along], from the right and from behind."""

    reach_along_m: float
    reach_aside_m: float
    candidates: Sequence[Sequence[int]]
    accepted: Sequence[Sequence[int]]
    beyond: int  # end points outside


@dataclass(frozen=True)
class Overview:
    """Everything on the first page."""

    version: str
    taken_ms: int
    where: str
    state: State
    counts: Counts
    facts: Mapping[str, str]
    notes: Sequence[str]
    steps: Sequence[Step]
    acceptance: Sequence[Acceptance]
    exhausted: Mapping[str, int]  # expert -> walks at the end of their candidates
    reasons: Sequence[Reason]
    clip_reasons: Sequence[Reason]
    gates: Sequence[Reason]
    throughput: Throughput
    stage_times: Sequence[StageTime]
    stage_times_of: str  # what they are measured on
    coverage: Coverage
    failed_kinds: Mapping[str, int]
    facets: Mapping[str, Sequence[str]]  # what the gallery can be filtered by


def overview(shot: Snapshot, where: str, now_s: float) -> Overview:
    """All of it; `now_s` since 1970."""
    funnel = _funnel(shot)
    rows = funnel.rows
    simulated = [row for row in rows if row.simulated]
    failed = [row for row in shot.outcome_rows if row["kind"] == Kind.FAILED]
    stage_times, of = _stage_times(shot)
    return Overview(
        version=shot.version,
        taken_ms=int(shot.taken_s * 1000),
        where=where,
        state=_state(shot, now_s),
        counts=Counts(
            samples=shot.samples.num_rows,
            simulated=sum(row["candidate_index"] >= 0 for row in shot.sample_rows),
            simulated_attempts=sum(r.accepted + r.rejected + r.failed for r in simulated),
            attempts=sum(r.accepted + r.rejected + r.failed for r in rows),
            rejected=sum(r.rejected for r in rows),
            failed=len(failed),
            clips=funnel.clips_prepared,
            candidates=funnel.candidates,
            sample_bytes=shot.sample_bytes,
        ),
        facts=_facts(shot),
        notes=[*([shot.last["message"]] if shot.last.get("message") else []), *shot.last.get("notes", [])],
        steps=steps_of(funnel),
        acceptance=_acceptance(funnel),
        exhausted=funnel.exhausted,
        reasons=_reasons(funnel),
        clip_reasons=[
            _reason(name, count)
            for name, count in (Counter(funnel.clip_outcomes) + Counter(funnel.clips_without_candidates)).most_common()
        ],
        gates=[Reason(gate, GATE_WORDS.get(gate, ""), count, {}) for gate, count in funnel.gates.items()],
        throughput=_throughput(shot, now_s),
        stage_times=stage_times,
        stage_times_of=of,
        coverage=_coverage(shot),
        failed_kinds=dict(Counter(row["error_kind"] for row in failed).most_common()),
        facets={
            name: sorted({str(row[name]) for row in shot.sample_rows})
            for name in ("expert", "round", "image_source", "command", "split", "log_id")
        },
    )


@lru_cache(maxsize=2)
def _cached_funnel(held: "_Held") -> Funnel:
    shot = held.shot
    lists = shot.candidates.select(["clip_id", "n_candidates", "gate_counts", "stage", "reason"]).to_pylist()
    return funnel_of_rows(shot.sample_rows, shot.outcome_rows, lists, shot.runs)


class _Held:
    """A snapshot that is itself and no other: equal by identity."""

    def __init__(self, shot: Snapshot) -> None:
        self.shot = shot

    def __hash__(self) -> int:
        return id(self.shot)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Held) and other.shot is self.shot


def _funnel(shot: Snapshot) -> Funnel:
    return _cached_funnel(_Held(shot))


def _state(shot: Snapshot, now_s: float) -> State:
    last_ms = shot.last_commit_ms
    if shot.live:
        if _quiet(shot, now_s):
            text = "nothing was committed for a while: a long reconstruction, or the run is gone; then run it again"
            return State("quiet", "warn", True, text, last_ms)
        return State("running", "live", True, "", last_ms)
    word, tone = STATUS.get(shot.last.get("exit_code", -1), ("no run has told how it ended", "warn"))
    return State(word, tone, False, "", last_ms)


def _quiet(shot: Snapshot, now_s: float) -> bool:
    return now_s - max(shot.last_commit_ms, shot.current.get("began_ms", 0)) / 1000.0 > QUIET_S


def _facts(shot: Snapshot) -> dict[str, str]:
    """What the tables say about where the samples come from."""
    sources = Counter(row["image_source"] for row in shot.sample_rows)
    return {
        "data set": ", ".join(sorted({row["dataset"] for row in shot.sample_rows})) or "-",
        "logs with samples": str(len({row["log_id"] for row in shot.sample_rows})),
        "images": ", ".join(f"{name} {count:,}" for name, count in sources.most_common()) or "-",
        "licences": ", ".join(sorted({row["licence"] for row in shot.sample_rows if row["licence"]})) or "-",
        "settings": str(shot.runs[-1]["settings_hash"]) if shot.runs else "-",
    }


def steps_of(funnel: Funnel) -> list[Step]:
    """Simulated attempts after each stage that turns some down, in the order of the stages."""
    rows = [row for row in funnel.rows if row.simulated]
    dropped: Counter[str] = Counter()
    for row in rows:
        for name, count in row.reasons.items():
            dropped[name.partition(".")[0]] += count
    left = sum(row.accepted for row in rows) + dropped.total()
    steps = [Step("tried", "perturbations tried", left, 0)]
    words = {
        "clip": "the clip was read",
        "perturb": "the perturbation held",
        "rollout": "the traffic's answer was simulated",
        "expert": "the expert found a plan",
        "reward": "the reward accepted the drive",
        "render": "the cameras could be rendered",
        "write": "the sample was written",
        "failed": "nothing broke",
    }
    order = [*STAGES, *sorted(set(dropped) - {*STAGES, "failed"}), "failed"]
    for stage in order:
        if dropped[stage] or stage in ("expert", "reward", "render"):
            left -= dropped[stage]
            steps.append(Step(stage, words.get(stage, ""), left, dropped[stage]))
    return steps


def _acceptance(funnel: Funnel) -> list[Acceptance]:
    found = []
    for row in funnel.rows:
        published = PAPER_CLIP_PERCENT.get(row.expert, ())
        found.append(
            Acceptance(
                row.expert,
                row.round,
                row.accepted + row.rejected + row.failed,
                row.accepted,
                row.rejected,
                row.failed,
                row.clips,
                row.clips_before,
                _share(row.attempt_rate),
                _share(row.first_try_rate),
                _share(row.clip_rate),
                published[row.round] / 100.0 if row.round < len(published) else None,
            )
        )
    return found


def _share(rate: float) -> float | None:
    return None if rate != rate else rate


def _reason(name: str, total: int, by_expert: Mapping[str, int] | None = None) -> Reason:
    return Reason(name, REASON_WORDS.get(name.rpartition(".")[2], ""), total, dict(by_expert or {}))


def _reasons(funnel: Funnel) -> list[Reason]:
    counts: dict[str, Counter[str]] = {}
    for row in funnel.rows:
        for name, count in row.reasons.items():
            counts.setdefault(name, Counter())[row.expert] += count
    order = sorted(counts, key=lambda name: (-counts[name].total(), name))
    return [_reason(name, counts[name].total(), counts[name]) for name in order]


def _throughput(shot: Snapshot, now_s: float) -> Throughput:
    samples = shot.samples["_written_ms"].to_numpy()
    others = shot.outcomes["_written_ms"].to_numpy()
    began = shot.current.get("began_ms", 0)
    times = np.concatenate([samples, others])
    times = times[times >= began]
    start = began or int(times.min(initial=int(now_s * 1000)))
    end = int(now_s * 1000) if shot.live else int(times.max(initial=start))
    width = max(1.0, (end - start) / 1000.0 / N_BUCKETS)
    edges = start + 1000.0 * width * np.arange(N_BUCKETS + 1)
    edges[-1] += 1.0
    made = int((samples >= start).sum())
    hours = (end - start) / 3.6e6
    done, walks, eta = _walks(shot, began, (end - start) / 1000.0) if shot.live else (None, None, None)
    return Throughput(
        start,
        end,
        width,
        np.histogram(samples, edges)[0].tolist(),
        np.histogram(times, edges)[0].tolist(),
        made / hours if hours > 0 else None,
        done,
        walks,
        None if _quiet(shot, now_s) else eta,
    )


def _walks(shot: Snapshot, began_ms: int, elapsed_s: float) -> tuple[int, int, float | None]:
    """Walks that ended since the run began, those it had before it, and the seconds left at this rate."""
    rounds, experts = shot.current["rounds"], shot.current["experts"]
    ended = {
        (row["clip_id"], row["expert"])
        for row in shot.sample_rows
        if row["_written_ms"] >= began_ms and (row["candidate_index"] < 0 or row["round"] >= rounds - 1)
    }
    for row in shot.outcome_rows:
        if row["_written_ms"] >= began_ms and (row["kind"] in (Kind.EXHAUSTED, Kind.FAILED) or not row["expert"]):
            ended |= {(row["clip_id"], expert) for expert in ([row["expert"]] if row["expert"] else experts)}
        elif row["_written_ms"] >= began_ms and row["candidate_index"] < 0:
            ended.add((row["clip_id"], row["expert"]))
    walks = max(int(shot.current["walks_left"]), len(ended))
    return len(ended), walks, (walks - len(ended)) * elapsed_s / len(ended) if ended else None


def _stage_times(shot: Snapshot) -> tuple[list[StageTime], str]:
    if shot.live or not shot.last.get("seconds"):
        times = [StageTime(stage, n, seconds) for stage, (n, seconds) in shot.seconds.items()]
        return times, "the attempts that were turned down so far (accepted ones are timed when the run ends)"
    spent = shot.last["seconds"].items()
    return [StageTime(stage, int(s["tasks"]), float(s["seconds"])) for stage, s in spent], "the newest run, all workers"


def _coverage(shot: Snapshot) -> Coverage:
    settings: Mapping[str, Any] = shot.runs[-1]["settings"] if shot.runs else {}
    along = float(settings.get("perturb.max_longitudinal_m", REACH_M[0]))
    aside = float(settings.get("perturb.max_lateral_m", REACH_M[1]))
    edges = (np.linspace(-aside, aside, BINS[1] + 1), np.linspace(-along, along, BINS[0] + 1))
    ends = [row["candidate_end"][:2] for row in shot.sample_rows if row["candidate_end"] is not None]
    accepted = np.asarray(ends, np.float64).reshape(-1, 2)

    def counted(points: np.ndarray) -> list[list[int]]:
        return np.histogram2d(points[:, 1], points[:, 0], edges)[0].astype(int).tolist()

    inside = (np.abs(shot.end_points[:, 0]) <= along) & (np.abs(shot.end_points[:, 1]) <= aside)
    return Coverage(along, aside, counted(shot.end_points), counted(accepted), int((~inside).sum()))
