"""Map polygons laid out so that the regions that hold a point are found at once (docs/reward.md 2a).

A grid covers every polygon. A cell that no edge touches lies in the same regions everywhere, so it names one set of
regions. A crossed cell names the set of its middle and lists its edges: on the way from the middle to a point of the
cell, every edge that is passed leads into or out of the regions it bounds. Polygons share many edges, so that nearly
all crossed cells know just two sets or four.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from tasks.kernels.compiled import hidden_kernel, inlined, kernel
from tasks.world.arrays import Array, Bools, Bytes, Ints, ShortInts
from tasks.world.frames import LARGEST, all_within
from tasks.world.road_map import MapLayer, MapPolygon

Bits = NDArray[np.uint64]

# Map polygons as edges, and what is refused of them.

MIN_WIDTH = 1e-12  # area of a ring over its squared perimeter; what is below is rounding


class Outlines(NamedTuple):
    """E edges of the R rings of some polygons, in order."""

    edges: Array  # (E, 4) x, y of the start, x, y of the end [m]; none of length zero
    first: Ints  # (R + 1,) where the edges of a ring begin
    owner: Ints  # (R,) the polygon of a ring


def outlines(polygons: Sequence[MapPolygon]) -> Outlines:
    """The edges of polygons, holes included; an open ring is closed, repeated points are left out.

    Raises ValueError naming the polygon when a ring is no (M, 2) array, is not finite, has fewer than three distinct
    points or, unless it crosses itself, bounds no area.
    """
    rings, owner = [], []
    for i, polygon in enumerate(polygons):
        for ring in (polygon.ring, *polygon.holes):
            if ring.ndim != 2 or ring.shape[1] != 2:
                raise polygon_error(polygon, f"a ring must be (M, 2), got {ring.shape}")
            rings.append(ring)
            owner.append(i)
    points = np.concatenate([np.empty((0, 2)), *rings])
    edges, first = _edges(points, np.cumsum([0, *map(len, rings)]))
    if not all_within(points):
        bad = next(i for i, ring in zip(owner, rings) if not all_within(ring))
        raise polygon_error(polygons[bad], f"its ring is not finite or farther than {LARGEST:g} m")
    few = np.flatnonzero(np.diff(first) < 3)
    if few.size:
        raise polygon_error(polygons[owner[few[0]]], "its ring has fewer than three distinct points")
    return Outlines(edges, first, np.array(owner, dtype=np.int64))


def polygon_error(polygon: MapPolygon, problem: str) -> ValueError:
    """The error that names a polygon, what is wrong with it and how to fix it."""
    return ValueError(
        f"polygons: {polygon.layer} {polygon.token!r}: {problem} (tasks.world.road_map.valid_ring repairs)"
    )


@kernel
def _edges(points: Array, ends: Ints) -> tuple[Array, Ints]:
    """Edges (E, 4) between successive distinct points of rings ends[i] .. ends[i + 1], and where each ring's begin."""
    edges = np.empty((points.shape[0], 4))
    first = np.zeros(ends.size, np.int64)
    n = 0
    for i in range(ends.size - 1):
        last = ends[i + 1] - 1
        for k in range(ends[i], ends[i + 1]):
            if points[k, 0] != points[last, 0] or points[k, 1] != points[last, 1]:
                edges[n, 0], edges[n, 1] = points[last, 0], points[last, 1]
                edges[n, 2], edges[n, 3] = points[k, 0], points[k, 1]
                n += 1
                last = k
        first[i + 1] = n
    return edges[:n], first


@kernel
def first_ring_without_area(edges: Array, first: Ints) -> int:
    """The first ring without an area, -1: every ring has one."""
    for i in range(first.size - 1):
        x, y = edges[first[i], 0], edges[first[i], 1]
        doubled_area = perimeter = 0.0
        for ax, ay, bx, by in edges[first[i] : first[i + 1]]:
            doubled_area += (ax - x) * (by - y) - (ay - y) * (bx - x)
            perimeter += np.hypot(bx - ax, by - ay)
        if abs(doubled_area) <= 2.0 * MIN_WIDTH * perimeter**2:
            return i
    return -1


# A grid of square cells over edges: the cells that an edge touches, and those between whose middles it passes.

CELL_M = 0.5
MAX_CELLS = 1_000_000  # larger maps get larger cells
SLACK_CELLS = 1e-6  # an edge this close to a cell touches it: far above rounding, far below a cell
CLEAR_CELLS = 1e-9  # the line of an edge keeps this far from the middles of the edge's cells
LEFT, WAY, THROUGH, EDGE = 1, 1, 8, 4  # of an entry: two flags; where a way of two bits and the edge begin
SHIFTS = (math.sqrt(5.0), math.sqrt(2.0))  # in x, y: no line of rational slope holds on to cells moved by these


class Grid(NamedTuple):
    """Cells over all edges with free ones around them, or a window of these; they are numbered row by row."""

    low_x: float  # corner of the whole [m]
    low_y: float
    cell_m: float
    first_row: int  # of the window
    first_column: int
    n_rows: int
    n_columns: int


def cover_with_grid(edges: Array) -> tuple[Grid, Ints]:
    """A grid over edges (E, 4), and the pairs cell << 32 | entry of its cells and the edges that touch them.

    An entry is edge << EDGE, with LEFT where the cell's middle is on the left of the edge, and THROUGH where neither
    end of the edge is in the cell. No middle is on the line of an edge of its cell. Pairs are in the order of edges.
    """
    is_clear, attempt = False, 0
    while not is_clear:  # nearly always once
        attempt += 1
        grid = _grid(edges, attempt)
        touched, is_clear = touched_cells(edges, grid)
    return grid, touched


def _grid(edges: Array, attempt: int) -> Grid:
    """One of many grids, each with its corner at another place in the cells."""
    if not len(edges):
        return Grid(0.0, 0.0, CELL_M, 0, 0, 1, 1)
    low_x, low_y = edges[:, ::2].min(), edges[:, 1::2].min()
    width, height = edges[:, ::2].max() - low_x, edges[:, 1::2].max() - low_y
    cell_m = max(CELL_M, math.sqrt((width + 4.0 * CELL_M) * (height + 4.0 * CELL_M) / MAX_CELLS))
    margin_x, margin_y = ((1.0 + math.fmod(attempt * shift, 1.0)) * cell_m for shift in SHIFTS)
    return Grid(
        low_x=float(low_x - margin_x),
        low_y=float(low_y - margin_y),
        cell_m=float(cell_m),
        first_row=0,
        first_column=0,
        n_rows=int((height + margin_y) / cell_m) + 3,
        n_columns=int((width + margin_x) / cell_m) + 3,
    )


@inlined
def cell_middle(low: float, cell_m: float, index: int) -> float:
    """Where the middle of a row or column of cells is."""
    return low + (index + 0.5) * cell_m


@inlined
def side_of_edge(ax: float, ay: float, bx: float, by: float, x: float, y: float) -> float:
    """Where a point is as seen from a to b: > 0 on the left, < 0 on the right; twice an area [m2]."""
    return (bx - ax) * (y - ay) - (by - ay) * (x - ax)


@inlined
def line_splits_edge(
    ax: float, ay: float, bx: float, by: float, from_x: float, from_y: float, x: float, y: float
) -> bool:
    """Whether the line through two points has the ends of an edge on either side; an end on it counts as right."""
    return (side_of_edge(from_x, from_y, x, y, ax, ay) > 0.0) != (side_of_edge(from_x, from_y, x, y, bx, by) > 0.0)


@kernel
def window_around(grid: Grid, low_x: float, low_y: float, high_x: float, high_y: float) -> Grid:
    """The part of a whole grid that covers a rectangle [m]; where that reaches beyond, the outermost cells stand."""
    cell_m, last_row, last_column = grid.cell_m, grid.n_rows - 1.0, grid.n_columns - 1.0
    first_row = int(min(max((low_y - grid.low_y) / cell_m - 1.0, 0.0), last_row))
    first_column = int(min(max((low_x - grid.low_x) / cell_m - 1.0, 0.0), last_column))
    n_rows = int(min(max((high_y - grid.low_y) / cell_m + 1.0, 0.0), last_row)) + 1 - first_row
    n_columns = int(min(max((high_x - grid.low_x) / cell_m + 1.0, 0.0), last_column)) + 1 - first_column
    return Grid(grid.low_x, grid.low_y, cell_m, first_row, first_column, n_rows, n_columns)


@kernel
def changes_along_rows(edges: Array, bounded: Bits, grid: Grid) -> tuple[Ints, Bits]:
    """cell << 32 | edge wherever an edge passes between the middles of a cell and of the one on its left.

    And the set of regions (rows, W) at the middle of each row's first cell.
    """
    found = np.empty(_most_cells(edges, grid.cell_m), np.int64)
    at_start = np.zeros((grid.n_rows, bounded.shape[1]), np.uint64)
    n = 0
    for e in range(edges.shape[0]):
        ax, ay, bx, by = edges[e]
        row = max(int((min(ay, by) - grid.low_y) / grid.cell_m - 1.0) - grid.first_row, 0)
        y = cell_middle(grid.low_y, grid.cell_m, row + grid.first_row)
        while y < max(ay, by) and row < grid.n_rows:
            if (ay > y) != (by > y):
                column = _first_right_of(ax, ay, bx, by, y, grid) - grid.first_column
                if column <= 0:
                    for w in range(bounded.shape[1]):
                        at_start[row, w] ^= bounded[e, w]
                elif column < grid.n_columns:
                    found[n] = (row * grid.n_columns + column) << 32 | e
                    n += 1
            row += 1
            y = cell_middle(grid.low_y, grid.cell_m, row + grid.first_row)
    return found[:n], at_start


@hidden_kernel
def _first_right_of(ax: float, ay: float, bx: float, by: float, y: float, grid: Grid) -> int:
    """The first column whose middle at height y is on the right of an edge that passes that height."""
    rises = by > ay
    x = ax + (y - ay) / (by - ay) * (bx - ax)
    column = int((x - grid.low_x) / grid.cell_m)
    while (side_of_edge(ax, ay, bx, by, cell_middle(grid.low_x, grid.cell_m, column), y) < 0.0) != rises:
        column += 1
    while (side_of_edge(ax, ay, bx, by, cell_middle(grid.low_x, grid.cell_m, column - 1), y) < 0.0) == rises:
        column -= 1
    return column


@kernel
def touched_cells(edges: Array, grid: Grid) -> tuple[Ints, bool]:
    """The pairs of `cover_with_grid`, and whether no middle is on the line of an edge."""
    found = np.empty(_most_cells(edges, grid.cell_m), np.int64)
    n = 0
    is_clear = True
    for e in range(edges.shape[0]):
        ax, ay, bx, by = edges[e]
        u, v = (ax - grid.low_x) / grid.cell_m, (ay - grid.low_y) / grid.cell_m
        du, dv = (bx - ax) / grid.cell_m, (by - ay) / grid.cell_m
        near = CLEAR_CELLS * grid.cell_m * math.hypot(bx - ax, by - ay)
        low, high = int(min(v, v + dv) - SLACK_CELLS), int(max(v, v + dv) + SLACK_CELLS) + 1
        for row in range(max(low, grid.first_row), min(high, grid.first_row + grid.n_rows)):
            y = cell_middle(grid.low_y, grid.cell_m, row)
            start, stop = _columns(u, v, du, dv, row)
            for column in range(max(start, grid.first_column), min(stop, grid.first_column + grid.n_columns)):
                side = side_of_edge(ax, ay, bx, by, cell_middle(grid.low_x, grid.cell_m, column), y)
                is_clear &= abs(side) > near
                inside = _is_near_cell(u, v, row, column) or _is_near_cell(u + du, v + dv, row, column)
                entry = e << EDGE | (0 if inside else THROUGH) | (LEFT if side > 0.0 else 0)
                cell = (row - grid.first_row) * grid.n_columns + column - grid.first_column
                found[n] = cell << 32 | entry
                n += 1
    return found[:n], is_clear


@inlined
def _is_near_cell(u: float, v: float, row: int, column: int) -> bool:
    """Whether a point is in a cell or touches it; all in cells."""
    return max(abs(u - (column + 0.5)), abs(v - (row + 0.5))) <= 0.5 + SLACK_CELLS


@kernel
def _columns(u: float, v: float, du: float, dv: float, row: int) -> tuple[int, int]:
    """The columns (first, past the last) that an edge from (u, v) over (du, dv) touches in a row; all in cells."""
    enter, leave = 0.0, 1.0
    if dv != 0.0:
        one, other = (row - SLACK_CELLS - v) / dv, (row + 1.0 + SLACK_CELLS - v) / dv
        enter = min(max(min(one, other), 0.0), 1.0)
        leave = min(max(max(one, other), 0.0), 1.0)
    one, other = u + enter * du, u + leave * du
    return int(min(one, other) - SLACK_CELLS), int(max(one, other) + SLACK_CELLS) + 1


@hidden_kernel
def _most_cells(edges: Array, cell_m: float) -> int:
    """A bound on the cells that edges touch: a flat edge between two rows touches both all along."""
    n = 0
    for e in range(edges.shape[0]):
        du, dv = abs(edges[e, 2] - edges[e, 0]) / cell_m, abs(edges[e, 3] - edges[e, 1]) / cell_m
        n += 4 * (int(du) + int(dv)) + 24
    return n


# The index.

ROUNDING = 1e-15  # above the error of a difference of two products, relative to their sum

# Parts a region plays: rows of MapIndex.playing; 1 << part are the bits of MapIndex.parts
LANE, ON_ROUTE, DRIVABLE, INTERSECTION = range(4)
PARTS_OF_LAYER = {  # lane, drivable, intersection; lanes themselves are not drivable
    MapLayer.LANE: (True, False, False),
    MapLayer.LANE_CONNECTOR: (True, False, False),
    MapLayer.INTERSECTION: (False, True, True),
    MapLayer.DRIVABLE_AREA: (False, True, False),
    MapLayer.ROADBLOCK: (False, True, False),
    MapLayer.CARPARK_AREA: (False, True, False),
}

# Columns of MapIndex.crossed
NEAR = 0  # set of the cell's middle; columns 0 .. 3 are the sets that ways lead to from there, or column 1 is -1
FIRST, LAST = 4, 5  # the cell's entries; the last one is not included


class MapIndex(NamedTuple):
    """R regions, lanes first. A set of regions is W words; region r is bit r % 64 of word r // 64."""

    low_x: float  # corner of the grid [m]
    low_y: float
    cell_m: float
    first_row: int  # of the cells
    first_column: int
    cells: ShortInts  # (rows, columns) set of a cell without edges; -1 - q for crossed cell q
    crossed: ShortInts  # (Q, 6) sets, FIRST, LAST
    entry: ShortInts  # (N,) see cover_with_grid; with the way that passing the edge is a part of
    edges: Array  # (E, 4) x, y of the start, x, y of the end [m]
    bounded: Bits  # (E, W) the regions an edge bounds
    sets: Bits  # (S, W); set 0 is empty
    parts: Bytes  # (S,) bits of the parts that some region of the set plays
    playing: Bits  # (4, W) the regions that play each part
    n_lane_words: int  # the first words, which hold all lanes
    clear: Bytes  # (rows * columns,) see with_clearance; empty without


def index_map(polygons: Sequence[MapPolygon], route_lane_ids: frozenset[str]) -> MapIndex:
    """The index of a map's polygons; those with the same rings are one region that plays all their parts.

    A region holds the points that an odd number of its rings enclose. A ring may touch itself.
    Raises ValueError naming the polygon when a ring is not finite, has fewer than three distinct points, bounds no
    area, or crosses itself or another ring of its polygon.
    """
    regions, plays = _regions(polygons, route_lane_ids)
    n_words = max(1, -(-len(regions) // 64))
    lines = outlines(regions)
    edges, bounded = _merged(lines.edges.view(np.uint64), lines.first, lines.owner, n_words)
    grid, touched = cover_with_grid(edges)
    n_lane_words = -(-int(plays[:, LANE].sum()) // 64)
    index = assembled(grid, touched, edges, bounded, _packed(plays, n_words), n_lane_words)
    _check_rings(regions, lines, edges, bounded, index.crossed, index.entry)
    return index


@register_jitable
def assembled(grid: Grid, touched: Ints, edges: Array, bounded: Bits, playing: Bits, n_lane_words: int) -> MapIndex:
    """The index of the edges within a grid or a window of it, which all points that are looked up lie in."""
    changes, at_start = changes_along_rows(edges, bounded, grid)
    cells, crossed, entry, sets = _arranged(np.sort(changes), at_start, touched, bounded, grid.n_columns)
    parts = _parts_of(sets, playing)
    return MapIndex(
        grid.low_x,
        grid.low_y,
        grid.cell_m,
        grid.first_row,
        grid.first_column,
        cells.reshape(grid.n_rows, grid.n_columns),
        crossed,
        entry,
        edges,
        bounded,
        sets,
        parts,
        playing,
        n_lane_words,
        np.empty(0, np.uint8),
    )


def with_clearance(index: MapIndex, reach_m: float) -> MapIndex:
    """The same index, with a 1 in `clear` for cells around which all is drivable as far as `reach_m` goes."""
    return index._replace(clear=_clear_cells(index, int(reach_m / index.cell_m) + 1))


@kernel
def _clear_cells(index: MapIndex, reach: int) -> Bytes:
    """Cells whose square of 2 `reach` + 1 cells each way lies in drivable regions, boundaries in it included."""
    cells, crossed, wide = index.cells, index.crossed, 2 * reach + 1
    is_road, crossed_is_road = index.parts & 1 << DRIVABLE != 0, np.zeros(len(crossed), np.bool_)
    for q in range(len(crossed)):
        for w in range(index.sets.shape[1]):
            kept = index.sets[crossed[q, NEAR], w]  # in all of the cell, on the edges themselves too
            for i in range(crossed[q, FIRST], crossed[q, LAST]):
                kept &= ~index.bounded[index.entry[i] >> EDGE, w]
            crossed_is_road[q] |= kept & index.playing[DRIVABLE, w] != 0
    clear, tall = np.zeros(cells.shape, np.uint8), np.zeros((2, cells.shape[1]), np.int32)  # rows so far, all road
    for row in range(cells.shape[0]):
        above, here, first, last = tall[row % 2], tall[1 - row % 2], 0, wide - 1
        here[:] = 0
        while last < cells.shape[1]:  # the cells from `first` to `last`: most are not all road, as any of them tells
            at = last
            while at >= first:
                cell = cells[row, at]
                if not (is_road[cell] if cell >= 0 else crossed_is_road[-1 - cell]):
                    break
                at -= 1
            if at >= first:
                first, last = at + 1, at + wide
                continue
            middle = last - reach
            here[middle] = above[middle] + 1
            if here[middle] >= wide:
                clear[row - reach, middle] = 1
            first, last = last + 1, last + 1
    return clear.reshape(-1)


@kernel
def _parts_of(sets: Bits, playing: Bits) -> Bytes:
    """(S,) bits of the parts that some region of each set plays."""
    parts = np.zeros(sets.shape[0], np.uint8)
    for s in range(sets.shape[0]):
        for part in range(playing.shape[0]):
            for w in range(sets.shape[1]):
                parts[s] |= (sets[s, w] & playing[part, w] != 0) << part
    return parts


def _regions(polygons: Sequence[MapPolygon], route_lane_ids: frozenset[str]) -> tuple[list[MapPolygon], Bools]:
    """The first polygon of every region, lanes first, and the parts (R, 4) that the regions play."""
    found: dict[tuple[bytes, ...], tuple[MapPolygon, list[bool]]] = {}
    for polygon in polygons:
        key = (polygon.ring.tobytes(), *[hole.tobytes() for hole in polygon.holes])
        plays = found.setdefault(key, (polygon, [False] * 4))[1]
        is_lane, is_drivable, is_intersection = PARTS_OF_LAYER[polygon.layer]
        plays[LANE] |= is_lane
        plays[ON_ROUTE] |= is_lane and polygon.token in route_lane_ids
        plays[DRIVABLE] |= is_drivable
        plays[INTERSECTION] |= is_intersection
    regions = sorted(found.values(), key=lambda region: not region[1][LANE])
    return [polygon for polygon, _ in regions], np.array([plays for _, plays in regions], bool).reshape(-1, 4)


def _packed(plays: Bools, n_words: int) -> Bits:
    """Columns (R, 4) as sets of regions (4, W)."""
    padded = np.zeros((4, n_words * 64), dtype=bool)
    padded[:, : len(plays)] = plays.T
    return np.packbits(padded, axis=1, bitorder="little").view(np.uint64)


def _check_rings(
    regions: list[MapPolygon], lines: Outlines, edges: Array, bounded: Bits, crossed: ShortInts, entry: ShortInts
) -> None:
    """Raises ValueError for rings that cross, else for rings without area: a figure of eight may be both."""
    edge, region = _first_crossing(edges, bounded, crossed, entry)
    if edge >= 0:
        x, y = edges[edge, :2]
        raise polygon_error(regions[region], f"its outline crosses itself near ({x:.2f}, {y:.2f})")
    flat = first_ring_without_area(lines.edges, lines.first)
    if flat >= 0:
        raise polygon_error(regions[lines.owner[flat]], "its ring bounds no area")


@kernel
def _merged(ends: Bits, first: Ints, owner: Ints, n_words: int) -> tuple[Array, Bits]:
    """The distinct edges (E, 4) of rings, either way round, and the regions they bound (E, W); ends as raw bits."""
    points = ends.view(np.float64)
    edges = np.empty(ends.shape, np.uint64)
    bounded = np.zeros((ends.shape[0], n_words), np.uint64)
    slots = _no_slots(ends.shape[0])
    n = 0
    for i in range(owner.size):
        for k in range(first[i], first[i + 1]):
            ax, ay, bx, by = points[k]
            swap = ax > bx or (ax == bx and ay > by)
            for c in range(4):
                edges[n, c] = ends[k, c ^ 2 if swap else c]
            edge = _row_of(edges, n, slots)
            n = max(n, edge + 1)
            bounded[edge, owner[i] >> 6] ^= np.uint64(1) << np.uint64(owner[i] & 63)
    return edges[:n].copy().view(np.float64), bounded[:n].copy()


@kernel
def _arranged(
    changes: Ints, at_start: Bits, touched: Ints, bounded: Bits, n_columns: int
) -> tuple[ShortInts, ShortInts, ShortInts, Bits]:
    """`cells`, flat, `crossed`, `entry` and `sets` of the index; see `changes_along_rows`."""
    sides = np.full((bounded.shape[0], 2), -1, np.int32)  # sets last met on the two sides of each edge
    sets = np.empty((len(at_start) + changes.size + 2 * touched.size + 2, bounded.shape[1]), np.uint64)
    sets[0] = 0
    slots = _no_slots(sets.shape[0])
    n_sets = 1 + _row_of(sets, 0, slots)
    cells = np.zeros(len(at_start) * n_columns, np.int32)
    n_sets = _fill_cells(changes, at_start, cells, bounded, sides, sets, slots, n_sets)
    crossed, entry = _crossed(touched, cells)
    n_sets = _find_ways(crossed, entry, bounded, sides, sets, slots, n_sets)
    return cells, crossed, entry, sets[:n_sets].copy()


@hidden_kernel
def _fill_cells(
    changes: Ints,
    at_start: Bits,
    cells: ShortInts,
    bounded: Bits,
    sides: ShortInts,
    sets: Bits,
    slots: ShortInts,
    n_sets: int,
) -> int:
    """Fill in the set at every cell's middle where it is not 0; returns how many sets there are."""
    k, n_columns = 0, cells.size // len(at_start)
    for row in range(len(at_start)):
        for w in range(sets.shape[1]):
            sets[n_sets, w] = at_start[row, w]
        current = _row_of(sets, n_sets, slots)
        n_sets = max(n_sets, current + 1)
        begin, end = row * n_columns, (row + 1) * n_columns
        while begin < end:
            stop = min(changes[k] >> 32, end) if k < changes.size else end
            if current != 0:
                cells[begin:stop] = current
            if stop < end:
                current = _across(bounded, sides, sets, slots, n_sets, current, changes[k] & 0xFFFFFFFF)
                n_sets = max(n_sets, current + 1)
                k += 1
            begin = stop
    return n_sets


@kernel
def _crossed(touched: Ints, cells: ShortInts) -> tuple[ShortInts, ShortInts]:
    """The crossed cells (Q, 6), not yet knowing any ways, and their entries; `cells` then name them."""
    crossed = np.empty((touched.size, 6), np.int32)
    n = 0
    for pair in touched:
        cell = pair >> 32
        if cells[cell] >= 0:
            crossed[n, NEAR] = cells[cell]
            crossed[n, LAST] = 0
            cells[cell] = -1 - n
            n += 1
        crossed[-1 - cells[cell], LAST] += 1
    total = 0
    for q in range(n):
        crossed[q, FIRST] = total
        total += crossed[q, LAST]
        crossed[q, LAST] = crossed[q, FIRST]
    entry = np.empty(total, np.int32)
    for pair in touched:
        q = -1 - cells[pair >> 32]
        entry[crossed[q, LAST]] = pair & 0xFFFFFFFF
        crossed[q, LAST] += 1
    return crossed[:n].copy(), entry


@hidden_kernel
def _find_ways(
    crossed: ShortInts, entry: ShortInts, bounded: Bits, sides: ShortInts, sets: Bits, slots: ShortInts, n_sets: int
) -> int:
    """Fill in the sets of crossed cells and the ways of their entries; returns how many sets there are.

    Way 1 is to pass the first edge, way 2 one that bounds other regions; who bounds what just one of the two does is
    both. An edge that is none of these, in one cell of twenty, leaves the cell without ways.
    """
    for q in range(crossed.shape[0]):
        one, other, has_ways = entry[crossed[q, FIRST]] >> EDGE, -1, True
        for i in range(crossed[q, FIRST], crossed[q, LAST]):
            way = 1 if entry[i] >> EDGE == one else _way(bounded, entry[i] >> EDGE, one, other)
            if way == 0 and other < 0:
                other, way = entry[i] >> EDGE, 2
            has_ways &= way > 0
            entry[i] |= way << WAY
        for way in range(1, 4 if other >= 0 else 2):
            edge, start = (one, crossed[q, way - 1]) if way != 2 else (other, crossed[q, NEAR])
            crossed[q, way] = _across(bounded, sides, sets, slots, n_sets, start, edge)
            n_sets = max(n_sets, crossed[q, way] + 1)
        if not has_ways:
            crossed[q, 1] = -1
    return n_sets


@inlined
def _way(bounded: Bits, edge: int, one: int, other: int) -> int:
    """1 where an edge bounds what one edge does, 2 what another does, 3 what just one of them does, else 0."""
    as_one, as_other, as_both = True, other >= 0, other >= 0
    for w in range(bounded.shape[1]):
        as_one &= bounded[edge, w] == bounded[one, w]
        as_other &= bounded[edge, w] == bounded[other, w]
        as_both &= bounded[edge, w] == bounded[one, w] ^ bounded[other, w]
    return 1 if as_one else 2 if as_other else 3 if as_both else 0


@inlined
def _across(bounded: Bits, sides: ShortInts, sets: Bits, slots: ShortInts, n_sets: int, start: int, edge: int) -> int:
    """The number of the set on the other side of an edge, n_sets if it is a new one."""
    for side in range(2):
        if start == sides[edge, side]:
            return int(sides[edge, 1 - side])
    for w in range(sets.shape[1]):
        sets[n_sets, w] = sets[start, w] ^ bounded[edge, w]
    found = _row_of(sets, n_sets, slots)
    sides[edge, 0], sides[edge, 1] = start, found
    return found


@kernel
def _no_slots(n_rows: int) -> ShortInts:
    """An empty hash table for that many rows: a power of two, at most half of it in use."""
    size = 2
    while size < 2 * n_rows:
        size *= 2
    return np.full(size, -1, np.int32)


@hidden_kernel
def _row_of(rows: Bits, new: int, slots: ShortInts) -> int:
    """The earlier row that equals row `new`, else `new`, which the hash table then knows."""
    key = np.uint64(0)
    for w in range(rows.shape[1]):
        key = (key ^ rows[new, w]) * np.uint64(0x9E3779B97F4A7C15)
        key ^= key >> np.uint64(29)
    slot = np.int64(key & np.uint64(slots.size - 1))
    while slots[slot] >= 0:
        same = True
        for w in range(rows.shape[1]):
            same &= rows[slots[slot], w] == rows[new, w]
        if same:
            return int(slots[slot])
        slot = (slot + 1) & (slots.size - 1)
    slots[slot] = new
    return new


@kernel
def _first_crossing(edges: Array, bounded: Bits, crossed: ShortInts, entry: ShortInts) -> tuple[int, int]:
    """An edge that crosses another one of its region beyond doubt, and that region; -1: there is none."""
    for q in range(crossed.shape[0]):
        for i in range(crossed[q, FIRST], crossed[q, LAST]):
            for k in range(crossed[q, FIRST], i):
                one, other = entry[i] >> EDGE, entry[k] >> EDGE
                for w in range(bounded.shape[1]):
                    both = bounded[one, w] & bounded[other, w]
                    if both and _splits_clearly(edges, one, other) and _splits_clearly(edges, other, one):
                        return one, 64 * w + int(math.log2(both & (~both + np.uint64(1))))
    return -1, -1


@hidden_kernel
def _splits_clearly(edges: Array, line: int, edge: int) -> bool:
    """Whether a line has the ends of an edge on either side, neither of them within rounding."""
    ax, ay, bx, by = edges[line]
    n_left = 0
    for k in (0, 2):
        left, right = (bx - ax) * (edges[edge, k + 1] - ay), (by - ay) * (edges[edge, k] - ax)
        if abs(left - right) <= ROUNDING * (abs(left) + abs(right)):
            return False
        n_left += left > right
    return n_left == 1
