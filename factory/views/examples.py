"""Pictures of a run for its report: what the cameras saw, and attempts that were turned down, made again.

Rejected attempts are attempted again from their prepared clips, which gives the same result. Which examples are shown
follows from their ids.
"""

from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import islice
from typing import Any, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from factory.graph.steps import PreparedClip, cache_key
from factory.pipeline import FactoryWork, PerturbedClip, perturbed_clip_of
from factory.readers.base import BadClip, ClipRef
from factory.store.location import BadCacheFile
from factory.store.reader import decode_stored_image
from factory.store.samples import Kind, Store
from factory.store.table import fixed_bytes, text_equals
from factory.views.bev import attempt_picture
from factory.views.sample_picture import (
    earlier_images,
    encoded,
    front_camera,
    images_at_now,
    nearer,
    small_jpeg,
)
from factory.views.seen_again import (
    VIEW_COLUMNS,
    CaptionedPicture,
    from_the_side,
    photographed,
    real_and_rendered,
    scene_of,
)
from factory.views.status import counted
from tasks.render.settings import ImageSource

N_EXAMPLES = 6
N_STRIPS = 4
PER_VALUE = 200
MAX_PREPARED_AGAIN = 2  # clips whose prepared form is gone from the cache: a few seconds each
BEV_PX = (640, 640)  # 80 m
CAMERA_PX = 320  # width of a camera frame on the page
SHOWN = ("clip_id", "log_id", "expert", "candidate_index", "stage", "reason", "detail", "settings_hash")
LABELS = ("attempt_id", "clip_id", "log_id", "expert", "round", "image_source")
Row = Mapping[str, Any]
T = TypeVar("T")


@dataclass(frozen=True)
class Picture:
    """A JPEG with its caption; `data` None where there is none, and the caption says why."""

    data: bytes | None
    caption: str
    detail: str = ""


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


def few_of_each(rows: pa.Table, first: str) -> list[dict[str, Any]]:
    """All that `spread` looks at of rows with attempt_ids as their order and a column as its first key."""
    ids, found = rows.select(["attempt_id"]), list[dict[str, Any]]()
    for value in counted(rows[first]):
        places = np.flatnonzero(text_equals(rows[first], value))
        few = pc.select_k_unstable(ids.take(places), PER_VALUE, [("attempt_id", "ascending")])
        found += rows.take(places[few.to_numpy()]).to_pylist()
    return found


def rejected_rows(store: Store) -> list[dict[str, Any]]:
    """Of simulated attempts that were turned down and are no sample, those that `rejected_examples` looks at."""
    names = ("attempt_id", "kind", "expert", "candidate_index", "reason", *SHOWN)
    rows = store.outcomes.read(list(dict.fromkeys(names)), encoded=True)
    simulated = pc.and_(pc.greater_equal(rows["candidate_index"], 0), pc.not_equal(rows["expert"], ""))
    rows = rows.filter(pc.and_(simulated, pc.equal(rows["kind"], Kind.REJECTED.value)))
    taken = np.isin(fixed_bytes(rows["attempt_id"]), store.samples.keys())
    return few_of_each(rows.filter(pa.array(~taken)), "reason")


def rejected_examples(rejected: Sequence[Row], picture: Callable[[Row], Picture | None]) -> list[Picture]:
    """A few of the simulated attempts that were turned down (rows of outcomes).

    picture: of one of them, None where it cannot be made again.
    """
    order = spread(rejected, lambda o: (o["reason"], o["expert"], o["clip_id"]), lambda o: str(o["attempt_id"]))
    made = (found for outcome in order if (found := picture(outcome)) is not None)
    return list(islice(made, N_EXAMPLES))


def strips_of(store: Store, samples: pa.Table, row_of: Callable[[str, Sequence[str]], Row]) -> list[dict[str, Any]]:
    """What the cameras of a few samples saw, each a title, a source and rows of pictures.

    samples: all of them, with LABELS; row_of: some columns of one, by its attempt_id.
    photos: the log's, each followed by the scene seen from its pose, where that is kept; aside: from beside the ego.
    """
    labels = samples.select(LABELS)
    pictured = few_of_each(labels.filter(pa.array(~text_equals(labels["image_source"], "none"))), "image_source")
    order = spread(pictured, lambda r: (r["image_source"], r["expert"], r["clip_id"]), lambda r: str(r["attempt_id"]))
    strips = []
    for row in order[:N_STRIPS]:
        sample = row_of(row["attempt_id"], VIEW_COLUMNS)
        front = front_camera(sample)
        earlier = earlier_images(sample, front) if front is not None else []
        photos, aside = _seen_again(store, sample) if row["image_source"] == ImageSource.RENDER else ((), ())
        rows: dict[str, Sequence[Picture]] = {
            "now": [_frame(image, CAMERA_PX) for image in images_at_now(sample)],
            "earlier": [_frame(image, CAMERA_PX // 2) for image in earlier] if len(earlier) > 1 else [],
            "photos": photos,
            "aside": aside,
        }
        title = f"{row['expert']}, round {row['round']}, log {row['log_id']}, sample {row['attempt_id']}"
        strips.append({"title": title, "source": row["image_source"], "rows": rows})
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
    return tuple(map(_again, shown)), tuple(map(_again, from_the_side(scene, sample)))


def _again(seen: CaptionedPicture) -> Picture:
    return Picture(small_jpeg(seen.pixels, CAMERA_PX), seen.caption)


def _frame(image: Mapping[str, Any], width: int) -> Picture:
    caption = f"{image['camera']} {image['time_s']:+.1f} s"
    try:
        return Picture(small_jpeg(decode_stored_image(image), width), caption)
    except ValueError as error:
        return Picture(None, str(error))


class Again:
    """Prepared clips of a run, from the cache where it holds them, and attempts made again from them."""

    def __init__(self, store: Store, work: FactoryWork, refs: Mapping[str, ClipRef]) -> None:
        self._store, self._work, self._refs = store, work, refs
        self._prepared_again = 0
        self._clip = cache(self._load)

    def picture(self, outcome: Row) -> Picture | None:
        """A rejected attempt; None where its clip is not at hand or it was made with other settings."""
        if outcome["settings_hash"] != self._work.identity.settings_hash or outcome["expert"] not in self._work.names:
            return None
        prepared = self._clip(outcome["clip_id"])
        if prepared is None or outcome["candidate_index"] >= len(prepared.candidates):
            return None
        trace = self._work.trace(prepared, outcome["candidate_index"], outcome["expert"])
        image = attempt_picture(perturbed_clip_of(prepared).clip, trace.candidate, trace.judged, "", BEV_PX)
        caption = f"{outcome['expert']}: {outcome['stage']}.{outcome['reason']}"
        detail = f"{outcome['detail']}; log {outcome['log_id']}; candidate {outcome['candidate_index']}"
        if trace.rejected is not None and trace.rejected.reason != outcome["reason"]:
            detail = f"made again it fell to {trace.rejected.reason}: this attempt is not reproducible. {detail}"
        return Picture(encoded(nearer(image)), caption, detail)

    def _load(self, clip_id: str) -> PreparedClip | None:
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
        return stored if isinstance(stored, PreparedClip) and isinstance(stored.payload, PerturbedClip) else None
