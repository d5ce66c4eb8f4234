"""Passes on maps and lights: points, lanes' boundaries, outlines, lights of no lane.

Each gives what it was given, put right, and a record of everything that is not as the file has it. A second time it
finds nothing to do. Points are in the world frame, metres; a map's records have no time.
"""

import math
from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from tasks.world.arrays import Array
from tasks.world.frames import LARGEST
from tasks.world.repair.records import LEFT_OUT, Repair
from tasks.world.road_map import MAX_LANE_M, TrafficLights, arc_lengths, valid_ring

MIN_LANE_M: Final = 0.01  # a shorter lane leads nowhere
MOST_CROSSED: Final = 16  # pairs of sides; no order is looked for where an outline crosses itself more often
SIDES: Final = ("left", "right")


@dataclass(frozen=True)
class LaneSides:
    """What of a lane its boundaries are judged by."""

    left: Array  # (B, 3) x, y, z
    right: Array  # (B, 3)
    predecessors: tuple[str, ...] = ()
    successors: tuple[str, ...] = ()
    centerline: Array | None = None  # (P, 2+) in driving direction; None where the source has none of its own
    turned: bool = False  # whether a boundary was listed the other way round


def map_repair(what: str, thing: str, was: str, now: str = LEFT_OUT) -> Repair:
    """A record of a map, which holds at all times."""
    return Repair(what, thing, math.nan, was, now)


def left_out_lanes(repairs: Iterable[Repair]) -> str:
    """Ends a sentence that says that a map has no lanes: which of them were left out, and why; "" where none was."""
    lanes = [f"{repair.thing} ({repair.was})" for repair in repairs if (repair.what, repair.now) == ("lane", LEFT_OUT)]
    more = f" and {len(lanes) - 3} more" if len(lanes) > 3 else ""
    return f"; left out: {', '.join(lanes[:3])}{more}" if lanes else ""


def finite_points(points: Array, what: str, thing: str, part: str = "") -> tuple[Array, tuple[Repair, ...]]:
    """Points (N, C) without those that are NaN, infinite or beyond LARGEST."""
    kept = points[(np.abs(points) <= LARGEST).all(axis=1)]
    return _kept(points, kept, what, thing, part, f"not finite or beyond {LARGEST:g} m")


def distinct_points(points: Array, what: str, thing: str, part: str = "") -> tuple[Array, tuple[Repair, ...]]:
    """Points (N, 2+) without those that are not finite, and those in the place (x, y) of the one before."""
    finite, lost = finite_points(points, what, thing, part)
    moved = np.concatenate([[True], (np.diff(finite[:, :2], axis=0) != 0.0).any(axis=1)])[: len(finite)]
    kept, doubled = _kept(finite, finite[moved], what, thing, part, "doubled")
    return kept, (*lost, *doubled)


def _kept(points: Array, kept: Array, what: str, thing: str, part: str, fault: str) -> tuple[Array, tuple[Repair, ...]]:
    if len(kept) == len(points):
        return points, ()
    was = f"{part} {len(points) - len(kept)} of {len(points)} points {fault}".strip()
    return kept, (map_repair(what, thing, was, f"{part} {len(kept)} points".strip()),)


def line_fault(line: Array) -> str:
    """Why a line (P, 2+) of distinct finite points is no lane's; "" where it may be one's.

    It has fewer than two points, or is shorter than a centimetre or longer than MAX_LANE_M.
    """
    if len(line) < 2:
        return "1 distinct point" if len(line) == 1 else "no point"
    return _length_fault(arc_lengths(line)[-1])


def _length_fault(length_m: float) -> str:
    return "" if MIN_LANE_M <= length_m <= MAX_LANE_M else f"{length_m:.3g} m long"


def sound_lanes(lanes: Mapping[str, LaneSides]) -> tuple[dict[str, LaneSides], tuple[Repair, ...]]:
    """The lanes that lie between two lines, both in driving direction, without odd points; by id, in the same order.

    A lane is left out where a boundary has fewer than two places, where it is shorter than a centimetre or longer than
    MAX_LANE_M, and where its boundaries enclose no area. Other lanes may still name it.
    """
    lines: dict[str, LaneSides] = {}
    found: list[Repair] = []
    for lane_id, lane in lanes.items():
        left, of_left = distinct_points(lane.left, "boundary", lane_id, "left")
        right, of_right = distinct_points(lane.right, "boundary", lane_id, "right")
        if fault := _fault_of_lines(left, right):
            found.append(map_repair("lane", lane_id, fault))
        else:
            found += (*of_left, *of_right)
            lines[lane_id] = replace(lane, left=left, right=right)
    facing, turned = facing_boundaries(lines)
    flat = {lane_id for lane_id, lane in facing.items() if not _bounds_area(_ring_between(lane.left, lane.right))}
    found += turned
    found += (map_repair("lane", lane_id, "no area between its boundaries") for lane_id in lines if lane_id in flat)
    return {lane_id: lane for lane_id, lane in facing.items() if lane_id not in flat}, tuple(found)


def facing_boundaries(lanes: Mapping[str, LaneSides]) -> tuple[dict[str, LaneSides], tuple[Repair, ...]]:
    """The lanes with both boundaries in driving direction; lines of two points or more.

    Where the source has a centreline of its own, each boundary is laid along it. Elsewhere two boundaries run against
    each other where their ends lie closer crosswise: of two lines side by side the diagonals are longer together than
    the ends. One is turned: that with which the lane begins where the lanes before it end, and ends where those after
    it begin; lanes that are put right count as well. Where no lane tells, that with which left is left of the way.
    """
    turned = {lane_id: _against_centerline(lane) for lane_id, lane in lanes.items()}
    facing = {lane_id: _turn(lane, turned[lane_id]) for lane_id, lane in lanes.items()}
    apart = {
        lane_id: None for lane_id, lane in lanes.items() if lane.centerline is None and _apart(lane.left, lane.right)
    }
    before, after = _links(lanes)
    while apart:
        telling = {
            lane_id: (
                [_middle(facing[other], -1) for other in before[lane_id] if other not in apart],
                [_middle(facing[other], 0) for other in after[lane_id] if other not in apart],
            )
            for lane_id in apart
        }
        sides = {lane_id: _side_by_links(lanes[lane_id], *places) for lane_id, places in telling.items()}
        told = {lane_id: side for lane_id, side in sides.items() if side}
        for lane_id, side in (told or {lane_id: _side_by_name(lanes[lane_id]) for lane_id in apart}).items():
            turned[lane_id] = (side,)
            facing[lane_id] = _turn(lanes[lane_id], turned[lane_id])
            del apart[lane_id]
    return facing, tuple(
        map_repair("boundary", lane_id, f"{' and '.join(sides)} against the way", f"{' and '.join(sides)} turned")
        for lane_id, sides in turned.items()
        if sides
    )


def simple_crossing(outline: Array, crossing_id: str) -> tuple[Array | None, tuple[Repair, ...]]:
    """The closed ring (M, 2) of a crossing's outline (N, 2); None where it encloses no area.

    Where it crosses itself, one run of its points is turned between two sides that cross, as of an edge that is listed
    the other way round; of several runs that give a simple ring that of the largest area. Where no run does, its
    largest part is kept.
    """
    return _outline(outline, "crossing", crossing_id, turn=True)


def crossing_between(edge1: Array, edge2: Array, crossing_id: str) -> tuple[Array | None, tuple[Repair, ...]]:
    """The same of a crossing between two edges (E, 2), which run the same way; None where one of them is no line."""
    lines = [distinct_points(edge, "crossing", crossing_id, f"edge{i}") for i, edge in enumerate((edge1, edge2), 1)]
    if short := [i for i, (line, _) in enumerate(lines, 1) if len(line) < 2]:
        return None, (map_repair("crossing", crossing_id, f"edge{short[0]} of fewer than two distinct finite points"),)
    ring, found = simple_crossing(np.concatenate([lines[0][0], lines[1][0][::-1]]), crossing_id)
    return ring, found if ring is None else (*lines[0][1], *lines[1][1], *found)


def simple_area(outline: Array, area_id: str, what: str = "area") -> tuple[Array | None, tuple[Repair, ...]]:
    """The closed ring (M, 2) of an area's outline (N, 2), its largest part where it crosses itself; None: no area."""
    return _outline(outline, what, area_id, turn=False)


def lights_on_map(
    lights: TrafficLights, lane_ids: Collection[str], elsewhere: Collection[str] = ()
) -> tuple[TrafficLights, tuple[Repair, ...]]:
    """The lights of these lanes.

    elsewhere: lanes that the source knows and this part of its map does not hold: their lights are in order.
    """
    kept = [column for column, lane_id in enumerate(lights.lane_ids) if lane_id in lane_ids]
    known = {*lane_ids, *elsewhere}
    found = tuple(map_repair("light", name, "on no lane of the map") for name in lights.lane_ids if name not in known)
    if len(kept) == len(lights.lane_ids):
        return lights, ()
    return TrafficLights(tuple(lights.lane_ids[column] for column in kept), lights.states[:, kept]), found


def _fault_of_lines(left: Array, right: Array) -> str:
    """Why there is no lane between two boundaries; "" where there may be one."""
    for side, line in zip(SIDES, (left, right), strict=True):
        if len(line) < 2:
            return f"{line_fault(line)} in its {side} boundary"
    return _length_fault((arc_lengths(left)[-1] + arc_lengths(right)[-1]) / 2.0)


def _ring_between(left: Array, right: Array) -> Array:
    return np.concatenate([left[:, :2], right[::-1, :2], left[:1, :2]])


def _bounds_area(ring: Array) -> bool:
    try:
        valid_ring(ring)
    except ValueError:
        return False
    return True


def _apart(one: Array, other: Array) -> bool:
    """Whether two lines (B, 2+) run against each other."""
    ends, others = one[[0, -1], :2], other[[0, -1], :2]
    return bool(np.hypot(*(ends - others[::-1]).T).sum() < np.hypot(*(ends - others).T).sum())


def _against_centerline(lane: LaneSides) -> tuple[str, ...]:
    if lane.centerline is None:
        return ()
    return tuple(side for side in SIDES if _apart(getattr(lane, side), lane.centerline))


def _turn(lane: LaneSides, sides: tuple[str, ...]) -> LaneSides:
    lines = {side: getattr(lane, side)[::-1] for side in sides}
    return replace(lane, turned=True, **lines) if sides else lane


def _links(lanes: Mapping[str, LaneSides]) -> tuple[Mapping[str, set[str]], Mapping[str, set[str]]]:
    """Of each lane those before and those after it, by its own word or theirs."""
    before: dict[str, set[str]] = defaultdict(set)
    after: dict[str, set[str]] = defaultdict(set)
    pairs = [(one, other) for one, lane in lanes.items() for other in lane.successors]
    pairs += [(other, one) for one, lane in lanes.items() for other in lane.predecessors]
    for first, second in pairs:
        if first in lanes and second in lanes:
            before[second].add(first)
            after[first].add(second)
    return before, after


def _middle(lane: LaneSides, end: int) -> Array:
    """(2,) between the boundaries at the lane's first (0) or last (-1) points."""
    return np.asarray((lane.left[end, :2] + lane.right[end, :2]) / 2.0, np.float64)


def _side_by_links(lane: LaneSides, ends_before: list[Array], starts_after: list[Array]) -> str | None:
    """Which of two boundaries that run apart is turned so that the lane joins those before and after it."""
    as_left = _turn(lane, ("right",))
    first, last = _middle(as_left, 0), _middle(as_left, -1)
    # how much farther the lane is from the others if it runs as its left boundary than if it runs as its right one
    farther = math.fsum(math.dist(first, place) - math.dist(last, place) for place in ends_before)
    farther += math.fsum(math.dist(last, place) - math.dist(first, place) for place in starts_after)
    return None if farther == 0.0 else "left" if farther > 0.0 else "right"


def _side_by_name(lane: LaneSides) -> str:
    """Which of two boundaries that run apart is turned so that the left one is left of the way.

    Up the left and back down the right boundary is clockwise; one of the two is listed the other way round already.
    """
    x, y = (np.concatenate([lane.left, lane.right])[:, :2] - lane.left[0, :2]).T
    return "right" if float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum()) < 0.0 else "left"


def _outline(outline: Array, what: str, thing: str, turn: bool) -> tuple[Array | None, tuple[Repair, ...]]:
    import shapely  # here alone, as in valid_ring

    points, found = distinct_points(outline, what, thing)
    if (corners := len(np.unique(points, axis=0))) < 3:
        return None, (map_repair(what, thing, f"an outline of {corners} distinct finite points"),)
    ring = points if np.array_equal(points[0], points[-1]) else np.concatenate([points, points[:1]])
    if shapely.Polygon(ring).is_valid:
        return ring, found
    was = f"crosses itself, {shapely.make_valid(shapely.Polygon(ring)).area:.1f} m2"
    simple, now = _simple_order(ring) if turn else None, "a run of its points turned"
    if simple is None:
        try:
            simple, now = valid_ring(ring), "its largest part"
        except ValueError:
            return None, (map_repair(what, thing, "an outline of no area"),)
    return simple, (*found, map_repair(what, thing, was, f"{now}, {shapely.Polygon(simple).area:.1f} m2"))


def _simple_order(ring: Array) -> Array | None:
    """The largest simple ring that is this one with the points between two crossing sides turned; None: there is none.

    ring: (M, 2) closed. Where side i crosses side j, points i + 1 to j are passed the other way round.
    """
    import shapely

    sides = shapely.linestrings(np.stack([ring[:-1], ring[1:]], axis=1))
    pairs = [(i, j) for i, j in shapely.STRtree(sides).query(sides, predicate="crosses").T.tolist() if i < j]
    if len(pairs) > MOST_CROSSED:
        return None
    orders = [np.concatenate([ring[: i + 1], ring[i + 1 : j + 1][::-1], ring[j + 1 :]]) for i, j in sorted(pairs)]
    simple = [order for order in orders if shapely.Polygon(order).is_valid]
    return max(simple, key=lambda order: float(shapely.Polygon(order).area), default=None)
