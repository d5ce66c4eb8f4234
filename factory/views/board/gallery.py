"""Samples by page, one sample whole, and failed attempts: GET /api/samples, /api/samples/<id>, /api/failed."""

import threading
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache, partial
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from factory.readers.pictures import read_header
from factory.store.location import open_parquet, with_partition_columns
from factory.store.reader import decode_stored_image, find_row_group
from factory.store.samples import Kind, Store
from factory.store.schema import AGENT_STEPS, SAMPLES, SCHEMA, table_to_rows
from factory.store.table import KeyedTable, text_equals
from factory.views.board.watch import Snapshot
from factory.views.episode_messages import episode_of
from factory.views.pictures import (
    BEV_COLUMNS,
    crop_to_60_m,
    encode_image,
    front_camera,
    images_at_now,
    sample_bev,
    small_jpeg,
)
from factory.views.sample_text import logged_drive, sample_facts
from factory.views.status import REASON_WORDS, how_to_retry, outcome_text
from tasks.subscores import SUBSCORES
from tasks.world.arrays import Ints

FILTERS = ("expert", "round", "image_source", "command", "split", "log_id")
SIMULATED = "simulated"  # simulated=1: no logged drives
ORDERS: Mapping[str, Sequence[tuple[str, str]]] = {  # sort keys
    "newest": [],
    "worst": [("stage2_score", "ascending")],
    "best": [("stage2_score", "descending")],
}
MOST_A_PAGE = 60
CARD = (
    *("attempt_id", "clip_id", "log_id", "expert", "round", "candidate_index"),
    *("command", "image_source", "stage1_score", "stage2_score"),
)
FAILED = ("attempt_id", "log_id", "clip_id", "expert", "candidate_index", "tries", "error")
LINEAGE = (
    *("attempt_id", "clip_id", "dataset", "log_id", "split", "licence", "expert", "expert_digest", "round"),
    *("candidate_index", "vocabulary_index", "vocabulary_digest", "settings_hash", "stage_versions"),
    *("content_digest", "asset_digest", "label_vocabulary"),
)
Json = dict[str, Any]
Row = Mapping[str, Any]


class BadRequest(ValueError):
    """A question that cannot be answered as it is put; the message says why."""


class NotFound(LookupError):
    """What was asked for is not in the tables; the message says so."""


def filtered_order(shot: Snapshot, wanted: Mapping[str, str], order: str = "newest") -> Ints:
    """Places in `samples` of the rows that fit, in order. Raises BadRequest for an unknown filter or order."""
    if order not in ORDERS:
        raise BadRequest(f"order={order}: must be one of {', '.join(ORDERS)}")
    rows, fits = shot.samples, np.ones(shot.samples.num_rows, bool)
    for name, value in wanted.items():
        if name == SIMULATED:
            fits &= rows["candidate_index"].to_numpy() >= 0
            continue
        if name not in FILTERS:
            raise BadRequest(f"{name}: samples can be filtered by {', '.join((*FILTERS, SIMULATED))}")
        if name == "round" and not value.isdecimal():
            raise BadRequest(f"round={value}: must be a number")
        fits &= rows[name].to_numpy() == int(value) if name == "round" else text_equals(rows[name], value)
    places = shot.newest_first[fits[shot.newest_first]]
    if not ORDERS[order]:
        return places
    keys = rows.select([name for name, _ in ORDERS[order]]).take(places)
    return places[np.asarray(pc.sort_indices(keys, sort_keys=ORDERS[order]))]  # stable: of equals the newest first


def gallery(shot: Snapshot, wanted: Mapping[str, str], page: int = 1, size: int = 12, order: str = "newest") -> Json:
    """One page of cards, counted from 1; beyond the last it is empty. Raises BadRequest."""
    places = filtered_order(shot, wanted, order)
    return {"version": shot.version, **_page(shot.samples, places, page, size, lambda row: gallery_card(shot, row))}


def failures(shot: Snapshot, page: int = 1, size: int = 50) -> Json:
    """A page of failed attempts with their errors, by log; of a failed clip `expert` is empty. Raises BadRequest."""
    rows = shot.outcomes.filter(pa.array(text_equals(shot.outcomes["kind"], Kind.FAILED.value)))
    by = [("log_id", "ascending"), ("clip_id", "ascending"), ("attempt_id", "ascending")]
    texts = pa.table({name: rows[name].cast(pa.string()) for name, _ in by})  # which can be sorted
    order = np.asarray(pc.sort_indices(texts, sort_keys=by))

    def failure(row: Row) -> Json:
        kind = row["error_kind"]
        known = {"kind": kind, "words": REASON_WORDS.get(kind, ""), "retry": how_to_retry(kind, shot.runs)}
        return {name: row[name] for name in FAILED} | known

    return _page(rows, order, page, size, failure, most=size)


def _page(
    rows: pa.Table, order: Ints, page: int, size: int, item: Callable[[Row], Json], most: int = MOST_A_PAGE
) -> Json:
    """order: places in `rows`, of which a page's are unpacked."""
    if page < 1 or not 1 <= size <= most:
        raise BadRequest(f"page={page} size={size}: pages begin at 1, a page holds 1 to {most}")
    items = [item(row) for at in order[(page - 1) * size :][:size] for row in rows.slice(at, 1).to_pylist()]
    pages = max(1, -(-len(order) // size))
    return {"total": len(order), "page": page, "pages": pages, "size": size, "items": items}


def gallery_card(shot: Snapshot, row: Row) -> Json:
    """The card of a sample's row; file: in a picture's address, where it changes when the row does."""
    file = shot.sample_paths[row["_file"]].rpartition("part-")[2][:8]
    return {name: row[name] for name in CARD} | {"file": file, "written_ms": row["_written_ms"]}


def newest_first_place(shot: Snapshot, attempt_id: str) -> int:
    """Its place in `newest_first`. Raises NotThere, which says what became of the attempt if anything did."""
    at = pc.index(shot.samples["attempt_id"], attempt_id).as_py()
    if at >= 0:
        return int(np.flatnonzero(shot.newest_first == at)[0])
    other = shot.outcomes.filter(pc.equal(shot.outcomes["attempt_id"], attempt_id)).to_pylist()
    raise NotFound(outcome_text(other[0]) if other else f"no sample {attempt_id}")


def sample_page(shot: Snapshot, attempt_id: str, row: Row, candidates: KeyedTable) -> Json:
    """One sample's page from its whole row; newer, older: its neighbours in the gallery. Raises NotThere."""
    at = newest_first_place(shot, attempt_id)
    card = gallery_card(shot, shot.newest(at))

    def neighbour(place: int) -> str | None:
        return shot.newest(place)["attempt_id"] if 0 <= place < shot.samples.num_rows else None

    return {
        "item": card,
        "facts": sample_facts(row),
        "scores": [
            {"name": name}  # null: not defined, or it never failed
            | {stage: row[f"{stage}_{name}"] for stage in ("stage1", "stage2")}
            | {f"{stage}_fails_s": row.get(f"{stage}_{name}_fails_s") for stage in ("stage1", "stage2")}
            for name in (*SUBSCORES, "score")
        ],
        "images": [
            {"index": i, "camera": image["camera"], "time_s": float(image["time_s"])}
            for i, image in enumerate(row["images"] or ())
        ],
        "lineage": {name: "-" if row[name] in (None, "") else str(row[name]) for name in LINEAGE}
        | {"clip begins": f"{row['clip_start_s']:.1f} s into the log", "now": f"{row['now_s']:.1f} s later"},
        "siblings": _candidates_of_walk(shot, card, candidates),
        "newer": neighbour(at - 1),
        "older": neighbour(at + 1),
    }


def _candidates_of_walk(shot: Snapshot, card: Row, candidates: KeyedTable) -> list[Json]:
    """All candidates of the clip in the order of the walk, with what this expert made of them."""

    def of_walk(rows: pa.Table) -> list[Json]:
        mine = text_equals(rows["clip_id"], card["clip_id"]) & text_equals(rows["expert"], card["expert"])
        return [row for at in np.flatnonzero(mine) for row in rows.slice(at, 1).to_pylist()]

    known: dict[int, Json] = {}
    for row in of_walk(shot.outcomes):
        if row["kind"] != Kind.EXHAUSTED:
            failed = row["kind"] == Kind.FAILED
            reason = f"failed.{row['error_kind']}" if failed else f"{row['stage']}.{row['reason']}"
            known[row["candidate_index"]] = {
                "attempt_id": row["attempt_id"],
                "kind": row["kind"],
                "reason": reason,
                "words": REASON_WORDS.get(reason.rpartition(".")[2], ""),
                "detail": "".join(row["error"].strip().splitlines()[-1:]) if failed else row["detail"],
            }
    for row in of_walk(shot.samples):
        accepted = {"attempt_id": row["attempt_id"], "kind": "accepted", "round": row["round"]}
        known[row["candidate_index"]] = accepted
    ends = _candidate_ends(shot, card["clip_id"], candidates) if card["candidate_index"] >= 0 else {}
    blank = {"attempt_id": "", "kind": "untried", "round": None, "reason": "", "words": "", "detail": ""}
    return [
        {"candidate_index": i, **blank, **known.get(i, {}), "end_x_m": x, "end_y_m": y}
        for i in sorted({*known, *ends})
        for x, y in [ends.get(i, (None, None))]
    ]


def _candidate_ends(shot: Snapshot, clip_id: str, table: KeyedTable) -> dict[int, tuple[float, float]]:
    """Candidate -> where it ends, from the clip's own file."""
    at = shot.candidates.filter(pc.equal(shot.candidates["clip_id"], clip_id)).to_pylist()
    if not at:
        return {}
    path = shot.candidate_paths[at[0]["_file"]]
    (listed,) = table.read_file(path, {}, ["candidates"])["candidates"].slice(at[0]["_row"], 1).to_pylist()
    return {c["index"]: (c["end_x"], c["end_y"]) for c in listed}


# Pictures of samples, made when they are asked for and kept in bounded memory: GET /picture/<attempt_id>/<name>.
#
#     front.jpg           what the camera that looks ahead saw at now
#     <n>.jpg             the n-th stored image, n as in the sample's `images`
#     bev.jpg             seen from above; step=0..55 (-1.5 .. 4.0 s at 10 Hz, 15 is now), size=300, or 600 with the who
#                         logged drive, for which the prepared clip is read: 70 ms, too long for a gallery's page
#
# A sample's row is read by its file and row group: one group, never a file, and the latest groups are kept. Stored
# JPEGs go out as they are, unless they are wider than WIDE_PX and small=1 asks for less.

LARGE_PX = 600
BEV_SIZES = (300, LARGE_PX)  # divisible by 3 and 4
WIDE_PX = 640
KEPT_PICTURES = 512  # of some 20 to 300 kB
KEPT_GROUPS = 24  # row groups, some 4 MB each: neighbours in the gallery stand in one
KEPT_FILES = 16  # their footers
KEPT_DRIVES = 4096  # logs' drives of 2 kB, read from prepared clips
MADE_FROM = ("clip_id", "settings_hash")  # what tells a row's prepared clip
COLUMNS = tuple(name for name in SCHEMA.names if name not in ("label_subscores", "label_progress"))  # of a row
Sample = Mapping[str, Any]
Place = tuple[str, int, tuple[tuple[str, object], ...]]  # file, row in it, what the file's path says


class Pictures:
    """Of one store's samples."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._lock = threading.Lock()
        self._file = lru_cache(KEPT_FILES)(partial(open_parquet, store.samples.location))
        self._group = lru_cache(KEPT_GROUPS)(self._read_group)
        self._logged = lru_cache(KEPT_DRIVES)(partial(logged_drive, store))
        self._front = lru_cache(KEPT_PICTURES)(self._make_front)
        self._image = lru_cache(KEPT_PICTURES)(self._make_image)
        self._bev = lru_cache(KEPT_PICTURES)(self._make_bev)

    def row(self, shot: Snapshot, attempt_id: str, columns: Sequence[str] = COLUMNS) -> Sample:
        """Some columns of one sample. Raises NotThere."""
        return self._row(_place(shot, attempt_id), columns)

    def front(self, shot: Snapshot, attempt_id: str) -> bytes:
        """JPEG, small. Raises NotThere where the sample has no image."""
        return self._front(_place(shot, attempt_id))

    def image(self, shot: Snapshot, attempt_id: str, index: int, small: bool = False) -> bytes:
        """JPEG of the n-th stored image. Raises NotThere."""
        return self._image(_place(shot, attempt_id), index, small)

    def bev(self, shot: Snapshot, attempt_id: str, size_px: int, step: int) -> bytes:
        """JPEG, square. Raises BadRequest for another size or step, NotThere."""
        if size_px not in BEV_SIZES or not 0 <= step < AGENT_STEPS:
            raise BadRequest(f"size={size_px} step={step}: size is one of {BEV_SIZES}, step 0 to {AGENT_STEPS - 1}")
        return self._bev(_place(shot, attempt_id), size_px, step)

    def episode(self, shot: Snapshot, attempt_id: str) -> bytes:
        """The sample as an MCAP file, see docs/formats.md. Raises NotThere, also for a row that makes none."""
        row = self.row(shot, attempt_id)
        try:
            return episode_of(row, self._logged(*(row[name] for name in MADE_FROM)))
        except ValueError as error:
            raise NotFound(f"{attempt_id} makes no episode: {error}") from error

    def _row(self, place: Place, columns: Sequence[str]) -> Sample:
        path, row, partition = place
        with self._lock:  # the pictures of a page ask at once; one of them reads for all
            group, row = find_row_group(self._file(path), row)
            stored = self._group(path, group, tuple(name for name, _ in partition))
        schema = pa.schema([SCHEMA.field(name) for name in columns])
        return table_to_rows(with_partition_columns(stored.slice(row, 1), schema, dict(partition)))[0]

    def _read_group(self, path: str, group: int, in_path: Sequence[str]) -> pa.Table:
        return self._file(path).read_row_group(group, columns=[name for name in COLUMNS if name not in in_path])

    def _make_front(self, place: Place) -> bytes:
        row = self._row(place, ("attempt_id", "cameras", "images", "image_source"))
        name = front_camera(row)
        found = [image for image in images_at_now(row) if image["camera"] == name]
        if not found:
            raise NotFound(f"{row['attempt_id']} has no image: image_source is {row['image_source']}")
        return _jpeg(found[0], small=True)

    def _make_image(self, place: Place, index: int, small: bool) -> bytes:
        row = self._row(place, ("attempt_id", "images"))
        images = row["images"] or ()
        if index >= len(images):
            raise NotFound(f"{row['attempt_id']} has {len(images)} images, none of number {index}")
        return _jpeg(images[index], small)

    def _make_bev(self, place: Place, size_px: int, step: int) -> bytes:
        size = (size_px * 4 // 3,) * 2  # `nearer` keeps three quarters
        row = self._row(place, (*BEV_COLUMNS, *MADE_FROM))
        logged = self._logged(*(row[name] for name in MADE_FROM)) if size_px == LARGE_PX else None
        return encode_image(crop_to_60_m(sample_bev(row, logged, size, step=step, legend=False)))


def _place(shot: Snapshot, attempt_id: str) -> Place:
    row = shot.newest(newest_first_place(shot, attempt_id))
    partition = tuple((name, row[name]) for name in SAMPLES.partition_by)
    return shot.sample_paths[row["_file"]], row["_row"], partition


def _jpeg(image: Mapping[str, Any], small: bool) -> bytes:
    """As it is stored, or not wider than WIDE_PX. Raises NotThere where it cannot be decoded to be made smaller."""
    if not small:
        return bytes(image["jpeg"])
    try:
        pixels = decode_stored_image(image) if read_header(image["jpeg"])[1][0] > WIDE_PX else None
    except ValueError as error:
        raise NotFound(str(error)) from error
    if pixels is None:
        return bytes(image["jpeg"])
    return small_jpeg(pixels, WIDE_PX)
