"""Samples by page, one sample whole, and failed attempts: GET /api/samples, /api/samples/<id>, /api/failed."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from factory.store.outcomes import Kind
from factory.store.table import KeyedTable
from factory.views.board.watch import Snapshot
from factory.views.report_words import REASON_WORDS, to_the_side, turned
from factory.views.status import RETRY
from tasks.subscores import SUBSCORES

FILTERS = ("expert", "round", "image_source", "command", "split", "log_id")
SIMULATED = "simulated"  # simulated=1: no logged drives
ORDERS: Mapping[str, Sequence[tuple[str, str]]] = {  # sort keys
    "newest": [],
    "worst": [("stage2_score", "ascending")],
    "best": [("stage2_score", "descending")],
}
MOST_A_PAGE = 60


class BadRequest(ValueError):
    """A question that cannot be answered as it is put; the message says why."""


class NotThere(LookupError):
    """What was asked for is not in the tables; the message says so."""


@dataclass(frozen=True)
class Item:
    """One card."""

    attempt_id: str
    file: str  # beginning of its file's digest: in a picture's address it changes when the row does
    clip_id: str
    log_id: str
    expert: str
    round: int
    candidate_index: int
    command: str
    image_source: str
    stage1_score: float | None
    stage2_score: float | None
    written_ms: int


@dataclass(frozen=True)
class Page:
    """Some samples of those that fit."""

    version: str
    total: int
    page: int
    pages: int
    size: int
    items: Sequence[Item]


@dataclass(frozen=True)
class Image:
    """What is known of one stored image."""

    index: int
    camera: str
    time_s: float


@dataclass(frozen=True)
class Score:
    """A sub-score of both stages; null: not defined, or it never failed."""

    name: str
    stage1: float | None
    stage1_fails_s: float | None
    stage2: float | None
    stage2_fails_s: float | None


@dataclass(frozen=True)
class Sibling:
    """Another attempt of the clip and expert, or this one."""

    candidate_index: int
    attempt_id: str
    kind: str  # accepted | rejected | failed | untried
    round: int | None
    reason: str
    words: str
    detail: str
    end_x_m: float | None
    end_y_m: float | None


@dataclass(frozen=True)
class Whole:
    """One sample's page."""

    item: Item
    facts: Mapping[str, str]
    scores: Sequence[Score]
    images: Sequence[Image]
    lineage: Mapping[str, str]
    siblings: Sequence[Sibling]
    newer: str | None  # attempt_id of the neighbour in the gallery of all samples
    older: str | None


@dataclass(frozen=True)
class Failure:
    """A failed attempt, or a failed clip where `expert` is empty."""

    attempt_id: str
    log_id: str
    clip_id: str
    expert: str
    candidate_index: int
    kind: str
    words: str
    retry: str
    tries: int
    error: str


@dataclass(frozen=True)
class Failures:
    """A page of them."""

    total: int
    page: int
    pages: int
    items: Sequence[Failure]


def chosen(shot: Snapshot, wanted: Mapping[str, str], order: str = "newest") -> pa.Table:
    """Rows that fit, in order. Raises BadRequest for an unknown filter or order."""
    if order not in ORDERS:
        raise BadRequest(f"order={order}: must be one of {', '.join(ORDERS)}")
    rows = shot.newest_first
    for name, value in wanted.items():
        if name == SIMULATED:
            rows = rows.filter(pc.greater_equal(rows["candidate_index"], 0))
            continue
        if name not in FILTERS:
            raise BadRequest(f"{name}: samples can be filtered by {', '.join((*FILTERS, SIMULATED))}")
        if name == "round" and not value.isdecimal():
            raise BadRequest(f"round={value}: must be a number")
        rows = rows.filter(pc.equal(rows[name], int(value) if name == "round" else value))
    if not ORDERS[order]:
        return rows
    return rows.sort_by([*ORDERS[order], ("_written_ms", "descending"), ("attempt_id", "ascending")])


def gallery(shot: Snapshot, wanted: Mapping[str, str], page: int = 1, size: int = 12, order: str = "newest") -> Page:
    """One page, counted from 1; beyond the last it is empty. Raises BadRequest."""
    if page < 1 or not 1 <= size <= MOST_A_PAGE:
        raise BadRequest(f"page={page} size={size}: pages begin at 1, a page holds 1 to {MOST_A_PAGE}")
    rows = chosen(shot, wanted, order)
    items = [item_of(shot, row) for row in rows.slice((page - 1) * size, size).to_pylist()]
    return Page(shot.version, rows.num_rows, page, max(1, -(-rows.num_rows // size)), size, items)


def item_of(shot: Snapshot, row: Mapping[str, Any]) -> Item:
    """The card of a sample's row."""
    named = {name: row[name] for name in Item.__dataclass_fields__ if name in row}
    file = shot.sample_paths[row["_file"]].rpartition("part-")[2][:8]
    return Item(**named, file=file, written_ms=row["_written_ms"])


def place_of(shot: Snapshot, attempt_id: str) -> int:
    """Its place in `newest_first`. Raises NotThere, which says what became of the attempt if anything did."""
    at = pc.index(shot.newest_first["attempt_id"], attempt_id).as_py()
    if at >= 0:
        return int(at)
    other = shot.outcomes.filter(pc.equal(shot.outcomes["attempt_id"], attempt_id)).to_pylist()
    if other:
        row = other[0]
        why = row["error"] or f"{row['stage']}.{row['reason']} {row['detail']}".strip(". ")
        raise NotThere(f"{attempt_id} is no sample but a {row['kind']} attempt of {row['expert'] or 'a clip'}: {why}")
    raise NotThere(f"no sample {attempt_id}")


def whole(shot: Snapshot, attempt_id: str, row: Mapping[str, Any], candidates: KeyedTable) -> Whole:
    """One sample's page from its whole row. Raises NotThere."""
    at = place_of(shot, attempt_id)
    rows = shot.newest_first
    item = item_of(shot, rows.slice(at, 1).to_pylist()[0])

    def neighbour(place: int) -> str | None:
        return rows["attempt_id"][place].as_py() if 0 <= place < rows.num_rows else None

    scores = [
        Score(
            name,
            row[f"stage1_{name}"],
            row.get(f"stage1_{name}_fails_s"),
            row[f"stage2_{name}"],
            row.get(f"stage2_{name}_fails_s"),
        )
        for name in (*SUBSCORES, "score")
    ]
    images = [Image(i, image["camera"], float(image["time_s"])) for i, image in enumerate(row["images"] or ())]
    siblings = _siblings(shot, item, candidates)
    return Whole(item, _facts(row), scores, images, _lineage(row), siblings, neighbour(at - 1), neighbour(at + 1))


def _facts(row: Mapping[str, Any]) -> dict[str, str]:
    vx, vy, ax, ay = (float(v) for v in row["ego_status"])
    facts = {
        "ego at now": f"{(vx**2 + vy**2) ** 0.5:.1f} m/s, {ax:+.1f} m/s² along, {ay:+.1f} m/s² to the left",
        "command": row["command"],
    }
    if row["candidate_end"] is not None:
        x, y, heading, speed = (float(v) for v in row["candidate_end"])
        facts["perturbed by"] = f"{x:+.2f} m along, {to_the_side(y)}, {turned(heading)}, at {speed:.1f} m/s"
    x, y, heading = (float(v) for v in row["label_10hz"][-1])
    facts["label after 4 s"] = f"{x:.1f} m ahead, {to_the_side(y)}, turned {turned(heading)}"
    facts["around it"] = f"{len(row['agent_ids'])} agents, {len(row['lane_ids'])} lanes"
    facts["images"] = f"{len(row['images'] or ())} from {row['image_source']}"
    if row["psnr"] is not None:
        facts["block's PSNR"] = f"{row['psnr']:.2f} dB"
    facts["tags"] = ", ".join(row["tags"]) or "-"
    return facts


def _lineage(row: Mapping[str, Any]) -> dict[str, str]:
    names = (
        "attempt_id",
        "clip_id",
        "dataset",
        "log_id",
        "split",
        "licence",
        "expert",
        "expert_digest",
        "round",
        "candidate_index",
        "vocabulary_index",
        "vocabulary_digest",
        "settings_hash",
        "stage_versions",
        "content_digest",
        "asset_digest",
        "label_vocabulary",
    )
    found = {name: "-" if row[name] in (None, "") else str(row[name]) for name in names}
    return found | {"clip begins": f"{row['clip_start_s']:.1f} s into the log", "now": f"{row['now_s']:.1f} s later"}


def _siblings(shot: Snapshot, item: Item, candidates: KeyedTable) -> list[Sibling]:
    """All candidates of the clip in the order of the walk, with what this expert made of them."""

    def of_walk(rows: pa.Table) -> list[dict[str, Any]]:
        mine = pc.and_(pc.equal(rows["clip_id"], item.clip_id), pc.equal(rows["expert"], item.expert))
        return rows.filter(mine).to_pylist()

    known: dict[int, Sibling] = {}
    for row in of_walk(shot.outcomes):
        if row["kind"] != Kind.EXHAUSTED:
            failed = row["kind"] == Kind.FAILED
            reason = f"failed.{row['error_kind']}" if failed else f"{row['stage']}.{row['reason']}"
            words = REASON_WORDS.get(reason.rpartition(".")[2], "")
            detail = row["error"].strip().splitlines()[-1:] if failed else [row["detail"]]
            known[row["candidate_index"]] = Sibling(
                row["candidate_index"], row["attempt_id"], row["kind"], None, reason, words, "".join(detail), None, None
            )
    for row in of_walk(shot.samples):
        known[row["candidate_index"]] = Sibling(
            row["candidate_index"], row["attempt_id"], "accepted", row["round"], "", "", "", None, None
        )
    ends = _ends(shot, item.clip_id, candidates) if item.candidate_index >= 0 else {}
    everyone = sorted({*known, *ends})
    blank = Sibling(0, "", "untried", None, "", "", "", None, None)
    return [
        Sibling(**{**known.get(i, blank).__dict__, "candidate_index": i, "end_x_m": x, "end_y_m": y})
        for i in everyone
        for x, y in [ends.get(i, (None, None))]
    ]


def _ends(shot: Snapshot, clip_id: str, table: KeyedTable) -> dict[int, tuple[float, float]]:
    """Candidate -> where it ends, from the clip's own file."""
    at = shot.candidates.filter(pc.equal(shot.candidates["clip_id"], clip_id)).to_pylist()
    if not at:
        return {}
    path = shot.candidate_paths[at[0]["_file"]]
    (listed,) = table.read_file(path, {}, ["candidates"])["candidates"].slice(at[0]["_row"], 1).to_pylist()
    return {c["index"]: (c["end_x"], c["end_y"]) for c in listed}


def failures(shot: Snapshot, page: int = 1, size: int = 50) -> Failures:
    """Failed attempts with their errors, by log. Raises BadRequest."""
    if page < 1:
        raise BadRequest(f"page={page}: pages begin at 1")
    rows = shot.outcomes.filter(pc.equal(shot.outcomes["kind"], Kind.FAILED.value))
    rows = rows.sort_by([("log_id", "ascending"), ("clip_id", "ascending"), ("attempt_id", "ascending")])
    items = [
        Failure(
            row["attempt_id"],
            row["log_id"],
            row["clip_id"],
            row["expert"],
            row["candidate_index"],
            row["error_kind"],
            REASON_WORDS.get(row["error_kind"], ""),
            RETRY[row["error_kind"]],
            row["tries"],
            row["error"],
        )
        for row in rows.slice((page - 1) * size, size).to_pylist()
    ]
    return Failures(rows.num_rows, page, max(1, -(-rows.num_rows // size)), items)
