"""Writes report.html: what a store holds and how the newest run went, for people to look at.

Numbers come from the tables alone. Accepted examples are drawn from their sample rows; rejected ones are attempted
again from their prepared clips, which gives the same result. Which examples are shown follows from their ids.
"""

import json
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from factory.clips.reader import BadClip, ClipRef
from factory.funnel import funnel_of
from factory.look.drawing import attempt_picture
from factory.look.report_page import FailedRow, Picture, Report, Strip, page
from factory.look.report_plot import EndPoint
from factory.look.report_words import STATUS
from factory.look.sample_picture import (
    BEV_COLUMNS,
    decoded,
    earlier_images,
    encoded,
    fitted,
    front_camera,
    images_at_now,
    nearer,
    sample_bev,
)
from factory.look.seen_again import VIEW_COLUMNS, Seen, from_the_side, photographed, real_and_rendered, scene_of
from factory.pipeline import FactoryWork, PerturbedClip
from factory.settings import Run
from factory.steps import cache_key
from factory.store.cache import BadCacheFile
from factory.store.outcomes import Kind
from factory.store.reader import SampleTable
from factory.store.samples import Store
from factory.work import LOGGED, PreparedClip
from tasks.perturb import PerturbSettings
from tasks.render.settings import ImageSource
from tasks.world.clip import NOW
from tasks.world.vehicle import HEADING

FILE = "report.html"
N_EXAMPLES = 6
N_STRIPS = 4
N_FAILED = 50
PER_VALUE = 200
MAX_PREPARED_AGAIN = 2  # clips whose prepared form is gone from the cache: a few seconds each
BEV_PX = (640, 640)  # 80 m
CAMERA_PX = 320  # width of a camera frame on the page
LABELS = ("attempt_id", "clip_id", "log_id", "dataset", "licence", "expert", "round", "candidate_index", "image_source")
OUTCOME_LABELS = (
    "attempt_id",
    "clip_id",
    "log_id",
    "expert",
    "candidate_index",
    "kind",
    "settings_hash",
    "stage",
    "reason",
    "detail",
    "error_kind",
    "error",
    "tries",
)
Row = Mapping[str, Any]
T = TypeVar("T")


@dataclass(frozen=True)
class RunFacts:
    """What the page says that no table holds."""

    facts: Mapping[str, str] = field(default_factory=dict)
    grid: PerturbSettings = field(default_factory=PerturbSettings)
    filtered_windows: Mapping[str, int] = field(default_factory=dict)
    skipped_logs: Mapping[str, str] = field(default_factory=dict)
    broken_logs: Mapping[str, str] = field(default_factory=dict)
    settings: Mapping[str, object] = field(default_factory=dict)


def write_report(store: Store, assembled: Run) -> str:
    """Write <out>/report.html; the line that says where it is and how to look further."""
    refs = {ref.clip_id: ref for ref in assembled.index.refs}
    again = Again(store, assembled.work, refs)
    report = gather(store, facts_of(assembled), again.picture, again.logged)
    store.location.write(FILE, page(report).encode())
    where = store.location.uri
    return f"report: {where}/{FILE}\nlook at samples: python -m factory.show out={where} [sample=0 | failed=true]"


def facts_of(assembled: Run) -> RunFacts:
    """Of a configured run."""
    config, index, work = assembled.config, assembled.index, assembled.work
    n_found = len(index.refs) + len(index.broken)
    planned = n_found if config.limit is None else min(config.limit, n_found)
    return RunFacts(
        facts={
            "data set": str(config.clips.get("name", assembled.reader.name)),
            "clips of the newest run": f"{planned} of {n_found} found",
            "rounds": str(config.rounds),
            "experts": ", ".join(config.experts),
            "vocabulary": f"{len(work.vocabulary.trajectories)} trajectories, {Path(work.vocabulary.source).name}, "
            f"digest {work.vocabulary.digest}",
            "settings hash": work.identity.settings_hash,
        },
        grid=config.perturb,
        filtered_windows=index.dropped,
        skipped_logs=index.skipped_logs,
        broken_logs={f"{ref.log_id} at {ref.start_ms} ms": why for ref, why in index.broken.items()},
        settings=work.identity.settings,
    )


def gather(
    store: Store,
    run: RunFacts,
    rejected_picture: Callable[[Row], Picture | None],
    logged: Callable[[str], NDArray[np.float64] | None],
) -> Report:
    """Everything on the page.

    Args:
        store: the tables.
        run: what they do not hold.
        rejected_picture: the picture of a rejected attempt (a row of outcomes), None where it cannot be made again.
        logged: clip_id -> the log's drive from T on (M, >=3), world frame, None where it is not at hand.
    """
    last = json.loads(store.location.read("last_run.json") or b"{}")
    labels = store.samples.read(LABELS).to_pylist()
    taken = {row["attempt_id"] for row in labels}
    outcomes = [  # a failure beside a sample of its id is a redo that failed: it stays to be seen
        row
        for row in store.outcomes.read(OUTCOME_LABELS).to_pylist()
        if row["attempt_id"] not in taken or row["kind"] == Kind.FAILED
    ]
    rejected = [o for o in outcomes if o["kind"] == Kind.REJECTED and o["expert"] and o["candidate_index"] >= 0]
    failed = sorted((o for o in outcomes if o["kind"] == Kind.FAILED), key=lambda o: o["attempt_id"])
    word, tone = STATUS.get(last.get("exit_code"), ("unfinished", "bad"))
    return Report(
        where=store.location.uri,
        status=word,
        status_tone=tone,
        facts={
            **run.facts,
            "exit code": str(last.get("exit_code", "-")),
            "licences": ", ".join(sorted({row["licence"] for row in labels if row["licence"]})) or "-",
        },
        funnel=funnel_of(store),
        sources=dict(Counter(row["image_source"] for row in labels)),
        stage_seconds={stage: (int(s["tasks"]), float(s["seconds"])) for stage, s in last.get("seconds", {}).items()},
        notes=[*([last["message"]] if last.get("message") else []), *last.get("notes", [])],
        examples=[
            *_accepted_examples(store, labels, logged),
            *_rejected_examples(rejected, rejected_picture),
        ],
        n_rejected=len(rejected),
        strips=_strips(store, labels),
        end_points=_end_points(store, labels, outcomes),
        grid=run.grid,
        failed=[
            FailedRow(o["log_id"], o["clip_id"], o["expert"], o["error_kind"], o["tries"], o["error"])
            for o in failed[:N_FAILED]
        ],
        n_failed=len(failed),
        filtered_windows=run.filtered_windows,
        skipped_logs=run.skipped_logs,
        broken_logs=run.broken_logs,
        settings={name: str(value) for name, value in run.settings.items()},
    )


def spread(rows: Iterable[T], keys: Callable[[T], Sequence[Hashable]], order: Callable[[T], str]) -> list[T]:
    """A few rows, each next one the least like those before it: fewest repeats over its keys, then `order`.

    The same rows in any order give the same list. Of each value of the first key at most PER_VALUE rows are looked at,
    so that a table of any size costs one pass.
    """
    seen: Counter[Hashable] = Counter()
    left: list[tuple[tuple[tuple[int, Hashable], ...], T]] = []
    for row in sorted(rows, key=order):
        slots = tuple(enumerate(keys(row)))
        seen[slots[0]] += 1
        if seen[slots[0]] <= PER_VALUE:
            left.append((slots, row))
    used: Counter[tuple[int, Hashable]] = Counter()
    chosen: list[T] = []
    while left and len(chosen) < 4 * N_EXAMPLES:  # some of them may turn out not to be drawable
        best = min(range(len(left)), key=lambda i: (sum(used[slot] for slot in left[i][0]), i))
        slots, row = left.pop(best)
        chosen.append(row)
        used.update(slots)
    return chosen


def _accepted_examples(
    store: Store, labels: Sequence[Row], logged: Callable[[str], NDArray[np.float64] | None]
) -> list[Picture]:
    if not labels:
        return []
    table = SampleTable(store.location.uri, store.location.options)
    simulated = [row for row in labels if row["expert"] not in LOGGED]
    order = spread(simulated, lambda r: (r["expert"], r["clip_id"], r["round"]), lambda r: str(r["attempt_id"]))
    pictures = []
    for row in order[:N_EXAMPLES]:
        columns = (*BEV_COLUMNS, "stage1_score", "stage2_score", "command")
        sample = table.sample(row["attempt_id"], columns)
        image = sample_bev(sample, logged(row["clip_id"]), BEV_PX)
        scores = f"EPDMS {_score(sample['stage1_score'])} perturbed, {_score(sample['stage2_score'])} expert"
        pictures.append(
            Picture(
                encoded(nearer(image)),
                f"{row['expert']}, round {row['round']}",
                f"{scores}; {sample['command']}; log {row['log_id']}; sample {row['attempt_id']}",
                "accepted",
            )
        )
    return pictures


def _rejected_examples(rejected: Sequence[Row], picture: Callable[[Row], Picture | None]) -> list[Picture]:
    order = spread(rejected, lambda o: (o["reason"], o["expert"], o["clip_id"]), lambda o: str(o["attempt_id"]))
    made = (found for outcome in order if (found := picture(outcome)) is not None)
    return list(islice(made, N_EXAMPLES))


def _strips(store: Store, labels: Sequence[Row]) -> list[Strip]:
    pictured = [row for row in labels if row["image_source"] != "none"]
    if not pictured:
        return []
    table = SampleTable(store.location.uri, store.location.options)
    order = spread(pictured, lambda r: (r["image_source"], r["expert"], r["clip_id"]), lambda r: str(r["attempt_id"]))
    strips = []
    for row in order[:N_STRIPS]:
        sample = table.sample(row["attempt_id"], VIEW_COLUMNS)
        front = front_camera(sample)
        earlier = earlier_images(sample, front) if front is not None else []
        strips.append(
            Strip(
                f"{row['expert']}, round {row['round']}, log {row['log_id']}, sample {row['attempt_id']}",
                row["image_source"],
                tuple(_frame(image, CAMERA_PX) for image in images_at_now(sample)),
                tuple(_frame(image, CAMERA_PX // 2) for image in earlier) if len(earlier) > 1 else (),
                *(_seen_again(store, sample) if row["image_source"] == ImageSource.RENDER else ()),
            )
        )
    return strips


def _seen_again(store: Store, sample: Row) -> tuple[tuple[Picture, ...], tuple[Picture, ...]]:
    """Photos with their renderings, and now from the side; nothing where the scene is not at hand."""
    scene = scene_of(store, str(sample["asset_digest"]))
    if scene is None:
        return (), ()
    photos = photographed(store, sample, scene)
    now_s = sample["clip_start_s"] + sample["now_s"]
    pairs = [] if photos is None else real_and_rendered(scene, photos, now_s, (front_camera(photos) or "",))
    shown = [seen for pair in pairs for seen in pair]
    return tuple(_again(seen) for seen in shown), tuple(_again(seen) for seen in from_the_side(scene, sample))


def _again(seen: Seen) -> Picture:
    height = round(CAMERA_PX * seen.pixels.shape[0] / seen.pixels.shape[1])
    return Picture(encoded(fitted(seen.pixels, CAMERA_PX, height)), seen.caption)


def _frame(image: Mapping[str, Any], width: int) -> Picture:
    caption = f"{image['camera']} {image['time_s']:+.1f} s"
    try:
        pixels = decoded(image)
    except ValueError as error:
        return Picture(None, str(error))
    return Picture(encoded(fitted(pixels, width, round(width * pixels.shape[0] / pixels.shape[1]))), caption)


def _end_points(store: Store, labels: Sequence[Row], outcomes: Sequence[Row]) -> list[EndPoint]:
    fates = {(o["clip_id"], o["candidate_index"]): "failed" for o in outcomes if o["kind"] == Kind.FAILED}
    fates |= {(o["clip_id"], o["candidate_index"]): "rejected" for o in outcomes if o["kind"] == Kind.REJECTED}
    fates |= {(row["clip_id"], row["candidate_index"]): "accepted" for row in labels}
    lists = sorted(store.candidates.read(["clip_id", "candidates"]).to_pylist(), key=lambda row: str(row["clip_id"]))
    return [
        EndPoint(c["end_x"], c["end_y"], tuple(c["cell"]), fates.get((row["clip_id"], c["index"]), "untried"))
        for row in lists
        for c in row["candidates"]
    ]


def _score(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


class Again:
    """Prepared clips of a run, from the cache where it holds them, and attempts made again from them."""

    def __init__(self, store: Store, work: FactoryWork, refs: Mapping[str, ClipRef]) -> None:
        self._store, self._work, self._refs = store, work, refs
        self._prepared_again = 0
        self._known: dict[str, PerturbedClip | None] = {}

    def logged(self, clip_id: str) -> NDArray[np.float64] | None:
        """(81, 3) the log's drive from T to T+2H, world frame."""
        clip = self._clip(clip_id)
        return None if clip is None else clip.clip.ego_states[NOW:, : HEADING + 1]

    def picture(self, outcome: Row) -> Picture | None:
        """A rejected attempt; None where its clip is not at hand or it was made with other settings."""
        if outcome["settings_hash"] != self._work.identity.settings_hash or outcome["expert"] not in self._work.experts:
            return None
        payload = self._clip(outcome["clip_id"])
        if payload is None or outcome["candidate_index"] >= len(payload.candidates):
            return None
        trace = self._work.trace(payload, outcome["candidate_index"], outcome["expert"])
        image = attempt_picture(payload.clip, trace.candidate, trace.judged, "", BEV_PX)
        caption = f"{outcome['expert']}: {outcome['stage']}.{outcome['reason']}"
        detail = f"{outcome['detail']}; log {outcome['log_id']}; candidate {outcome['candidate_index']}"
        if trace.rejected is not None and trace.rejected.reason != outcome["reason"]:
            detail = f"made again it fell to {trace.rejected.reason}: this attempt is not reproducible. {detail}"
        return Picture(encoded(nearer(image)), caption, detail, "rejected")

    def _clip(self, clip_id: str) -> PerturbedClip | None:
        if clip_id not in self._known:
            self._known[clip_id] = self._load(clip_id)
        return self._known[clip_id]

    def _load(self, clip_id: str) -> PerturbedClip | None:
        try:
            stored = self._store.cache.load(cache_key(clip_id, self._work.identity.prepare_digest))
        except BadCacheFile:
            stored = None  # the next run prepares it again and says so
        if stored is None and clip_id in self._refs and self._prepared_again < MAX_PREPARED_AGAIN:
            self._prepared_again += 1
            try:
                stored = self._work.prepare(self._refs[clip_id])
            except BadClip:
                return None
        payload = stored.payload if isinstance(stored, PreparedClip) else None
        return payload if isinstance(payload, PerturbedClip) else None
