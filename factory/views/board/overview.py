"""The numbers of the overview, from one snapshot: what GET /api/overview answers.

A share or a time that is not defined is null; names end in their unit, `_ms` is since 1970.
"""

import threading
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from factory.store.funnel import Funnel
from factory.store.location import Location
from factory.store.samples import Kind
from factory.store.schema import TableSpec
from factory.store.table import KeyedTable, text_equals
from factory.views.board.gallery import FILTERS
from factory.views.board.watch import Snapshot
from factory.views.pictures import BEV_LEGEND
from factory.views.status import GATE_WORDS, PAPER_CLIP_PERCENT, QUIET, REASON_WORDS, RUNNING, run_state, value_counts
from factory.wording import time_left_text, time_text
from tasks.stages import STAGES

N_BUCKETS = 60
BINS = (40, 24)  # along, aside
REACH_M = (20.0, 2.0)  # where run.json does not say: the paper's
STEPS = {
    "clip": "the clip was read",
    "perturb": "the perturbation held",
    "rollout": "the traffic's answer was simulated",
    "expert": "the expert found a plan",
    "reward": "the reward accepted the drive",
    "render": "the cameras could be rendered",
    "write": "the sample was written",
    "failed": "nothing broke",
}
Json = dict[str, Any]


def overview(shot: Snapshot, where: str, now_s: float) -> Json:
    """All of it; `now_s` since 1970."""
    funnel = shot.funnel
    simulated = [row for row in funnel.rows if row.simulated]
    failed = shot.outcomes.filter(pa.array(text_equals(shot.outcomes["kind"], Kind.FAILED.value)))
    stage_times, of = _stage_times(shot)
    last = shot.run.last
    before = Counter(funnel.clip_outcomes) + Counter(funnel.clips_without_candidates)
    return {
        "version": shot.version,
        "where": where,
        "state": _state(shot, now_s),
        "counts": {
            "samples": shot.samples.num_rows,
            "simulated": pc.sum(pc.greater_equal(shot.samples["candidate_index"], 0)).as_py()
            or 0,  # not a logged drive
            "simulated_attempts": sum(row.tried for row in simulated),
            "attempts": sum(row.tried for row in funnel.rows),
            "rejected": sum(row.rejected for row in funnel.rows),
            "failed": failed.num_rows,  # attempts and clips
            "clips": funnel.clips_prepared,
            "candidates": funnel.candidates,
            "sample_bytes": shot.sample_bytes,
        },
        "facts": _facts(shot),
        "cameras_left_out": funnel.cameras_text,  # empty: none was
        "repaired": funnel.repaired.text,  # empty: nothing was
        "notes": [] if shot.run.goes_on else [*filter(None, [last.get("message")]), *last.get("notes", [])],
        "steps": _steps(funnel),
        "acceptance": _acceptance(funnel),
        "exhausted": funnel.exhausted,  # expert -> walks at the end of their candidates
        "reasons": _reasons(funnel),
        "clip_reasons": [_reason(name, count) for name, count in before.most_common()],
        "gates": [_reason(gate, count, words=GATE_WORDS) for gate, count in funnel.gates.items()],
        "planned": funnel.balance.samples,  # samples: planned = accepted + rejected + failed + pending
        "throughput": _throughput(shot, now_s),
        "stage_times": stage_times,  # worker seconds
        "stage_times_of": of,  # what they are measured on
        "coverage": _coverage(shot),
        "legend": {name: f"rgb{colour}" for name, colour in BEV_LEGEND.items()},
        "facets": {name: sorted(map(str, value_counts(shot.samples[name]))) for name in FILTERS},
    }


def _state(shot: Snapshot, now_s: float) -> Json:
    """How the newest run goes; tone: good, warn or live; left: as its terminal says it."""
    run, (word, tone) = shot.run, run_state(shot.run, shot.last_commit_ms, now_s)
    running, last = word == RUNNING, run.last
    took_ms = 0 if run.goes_on or not last.get("began_ms") else last.get("ended_ms", 0) - last["began_ms"]
    return {
        "word": word,
        "tone": tone,
        "live": run.goes_on,
        "detail": run.current.get("doing", "") if running else QUIET if run.goes_on else "",
        "left": time_left_text(run.current.get("ends_ms"), now_s * 1000) if running else None,
        "took": time_text(took_ms / 1000.0) if took_ms > 0 else None,
        "last_commit_ms": shot.last_commit_ms,
    }


def _facts(shot: Snapshot) -> dict[str, str]:
    """What the tables say about where the samples come from."""
    samples = shot.samples
    sources = Counter(value_counts(samples["image_source"]))
    return {
        "data set": ", ".join(sorted(value_counts(samples["dataset"]))) or "-",
        "logs with samples": str(len(value_counts(samples["log_id"]))),
        "images": ", ".join(f"{name} {count:,}" for name, count in sources.most_common()) or "-",
        "licences": ", ".join(sorted(filter(None, value_counts(samples["licence"])))) or "-",
        "settings": str(shot.runs[-1]["settings_hash"]) if shot.runs else "-",
    }


def _steps(funnel: Funnel) -> list[Json]:
    """Simulated attempts after each stage that turns some down, in the order of the stages."""
    rows = [row for row in funnel.rows if row.simulated]
    dropped: Counter[str] = Counter()
    for row in rows:
        for name, count in row.reasons.items():
            dropped[name.partition(".")[0]] += count
    left = sum(row.accepted for row in rows) + dropped.total()
    steps = [{"name": "tried", "what": "perturbations tried", "left": left, "dropped": 0}]
    known = [stage.name for stage in STAGES]
    for stage in (*known, *sorted(set(dropped) - {*known, "failed"}), "failed"):
        if dropped[stage] or stage in ("expert", "reward", "render"):
            left -= dropped[stage]
            steps.append({"name": stage, "what": STEPS.get(stage, ""), "left": left, "dropped": dropped[stage]})
    return steps


def _acceptance(funnel: Funnel) -> list[Json]:
    """Of each round of each expert; paper: the published share of clips, to hold against the shares of clips."""
    found = []
    for row in funnel.rows:
        published = PAPER_CLIP_PERCENT.get(row.expert, ())
        named = ("expert", "round", "simulated", "tried", "accepted", "rejected", "failed", "clips", "clips_before")
        rates = {name: getattr(row, name) for name in ("attempt_rate", "first_drive_rate", "clip_rate")}
        found.append(
            {name: getattr(row, name) for name in named}
            | {name: None if np.isnan(rate) else rate for name, rate in rates.items()}
            | {"paper": published[row.round] / 100.0 if row.round < len(published) else None}
        )
    return found


def _reason(
    name: str, total: int, by_expert: Mapping[str, int] | None = None, words: Mapping[str, str] = REASON_WORDS
) -> Json:
    """Why attempts, or clips, fell; name: stage.reason, failed.kind or a gate."""
    return {
        "reason": name,
        "words": words.get(name.rpartition(".")[2], ""),
        "total": total,
        "by_expert": dict(by_expert or {}),
    }


def _reasons(funnel: Funnel) -> list[Json]:
    counts: dict[str, Counter[str]] = {}
    for row in funnel.rows:
        for name, count in row.reasons.items():
            counts.setdefault(name, Counter())[row.expert] += count
    order = sorted(counts, key=lambda name: (-counts[name].total(), name))
    return [_reason(name, counts[name].total(), counts[name]) for name in order]


def _throughput(shot: Snapshot, now_s: float) -> Json:
    """Rows by the time of their commit, in buckets."""
    samples = shot.samples["_written_ms"].to_numpy()
    others = shot.outcomes["_written_ms"].to_numpy()
    began = shot.run.current.get("began_ms", 0)
    times = np.concatenate([samples, others])
    times = times[times >= began]
    start = began or int(times.min(initial=int(now_s * 1000)))
    end = int(now_s * 1000) if shot.run.goes_on else int(times.max(initial=start))
    width = max(1.0, (end - start) / 1000.0 / N_BUCKETS)
    edges = start + 1000.0 * width * np.arange(N_BUCKETS + 1)
    edges[-1] += 1.0
    made = int((samples >= start).sum())
    hours = (end - start) / 3.6e6
    return {
        "began_ms": start,
        "ended_ms": end,
        "bucket_s": width,
        "samples": np.histogram(samples, edges)[0].tolist(),
        "attempts": np.histogram(times, edges)[0].tolist(),
        "samples_per_hour": made / hours if hours > 0 else None,
    }


def _stage_times(shot: Snapshot) -> tuple[list[Json], str]:
    spent = shot.run.last.get("seconds")
    if shot.run.goes_on or not spent:
        times = [{"stage": stage, "tasks": n, "seconds": seconds} for stage, (n, seconds) in shot.seconds.items()]
        return times, "the attempts that were turned down so far (accepted ones are timed when the run ends)"
    return [{"stage": stage, **times} for stage, times in spent.items()], "the newest run, all workers"


def _coverage(shot: Snapshot) -> Json:
    """Counts over end points in the frame of the logged pose at T+H; [aside][along], from the right and from behind."""
    settings: Mapping[str, Any] = shot.runs[-1]["settings"] if shot.runs else {}
    along = float(settings.get("perturb.max_longitudinal_m", REACH_M[0]))
    aside = float(settings.get("perturb.max_lateral_m", REACH_M[1]))
    edges = (np.linspace(-aside, aside, BINS[1] + 1), np.linspace(-along, along, BINS[0] + 1))

    def counted(parts: Sequence[np.ndarray]) -> list[list[int]]:
        counts = np.zeros((BINS[1], BINS[0]), int)
        for points in parts:
            counts += np.histogram2d(points[:, 1], points[:, 0], edges)[0].astype(int)
        return counts.tolist()

    beyond = sum(int(np.count_nonzero((np.abs(points) > (along, aside)).any(1))) for points in shot.end_points)
    return {
        "reach_along_m": along,
        "reach_aside_m": aside,
        "candidates": counted(shot.end_points),
        "accepted": counted(shot.accepted_points),
        "beyond": beyond,  # end points outside
    }


# Planners in closed loop, where `python -m planners drive` wrote its drives into the folder of the run.
#
# Its table is read by the columns named here; what the command prints has intervals too, which stand in summary.csv.

FILMS = "films"  # folder below the run, <drive_id>.mp4
MOST_SHOWN = 200  # drives, those that failed first
_TEXTS = ("drive_id", "clip_id", "log_id", "planner", "pictures", "failure_reason", "film")
_FLAGS = ("collision_at_fault", "offroad", "left_corridor_laterally", "offroad_or_collision_at_fault")
_NUMBERS = ("duration_s", "dist_traveled_m", "score", *_FLAGS)
SCHEMA = pa.schema(
    [
        *((name, pa.string()) for name in _TEXTS),
        *((name, pa.float64()) for name in _NUMBERS),
        ("start", pa.int32()),  # -1: from the log
    ]
)
Row = Mapping[str, Any]


class Drives:
    """The drives of one run, read again when some were committed."""

    def __init__(self, out: Location) -> None:
        self._out, self._lock = out, threading.Lock()
        self._table = KeyedTable(out.child("drives"), TableSpec("drives", SCHEMA, "drive_id"))
        self._seen: int | None = None
        self._rows: list[dict[str, Any]] = []

    @property
    def files(self) -> list[str]:
        """Of their table, as it was opened."""
        return sorted(self._table.live_files())

    def rows(self) -> Sequence[Row]:
        """All of them, in the order of their ids; none where nobody has driven."""
        with self._lock:
            self._table.refresh()
            if self._table.version != self._seen:
                self._rows = sorted(self._table.read().to_pylist(), key=lambda row: str(row["drive_id"]))
                self._seen = self._table.version
            return self._rows

    def film(self, drive_id: str) -> bytes | None:
        """The MP4 of a drive; None where it has none."""
        return self._out.read(f"{FILMS}/{drive_id}.mp4")


def drives_as_json(rows: Sequence[Row], with_films: bool = True) -> dict[str, Any]:
    """What GET /api/drives answers: a line for each planner, kind of pictures and of start; and drives one by one."""
    groups: dict[tuple[str, str, str], list[Row]] = {}
    for row in rows:
        start = "logged" if row["start"] < 0 else "perturbed"
        groups.setdefault((row["planner"], row["pictures"], start), []).append(row)
    listed = sorted(rows, key=lambda row: (row["score"], row["drive_id"]))[:MOST_SHOWN]
    facts = [name for name in SCHEMA.names if with_films or name != "film"]
    return {
        "total": len(rows),
        "lines": [_line(*key, group) for key, group in sorted(groups.items())],
        "drives": [{name: row[name] for name in facts} for row in listed],
    }


def _line(planner: str, pictures: str, start: str, rows: Sequence[Row]) -> dict[str, Any]:
    means = {name: sum(row[name] for row in rows) / len(rows) for name in _NUMBERS}
    incidents, metres = (len(rows) * means[name] for name in ("offroad_or_collision_at_fault", "dist_traveled_m"))
    return {
        "planner": planner,
        "pictures": pictures,
        "start": start,
        "drives": len(rows),
        "score": means["score"],
        "collision_at_fault": means["collision_at_fault"],
        "offroad": means["offroad"],
        "left_corridor": means["left_corridor_laterally"],
        "km": metres / 1000.0,
        "m_between_incidents": metres / incidents if incidents else None,
    }
