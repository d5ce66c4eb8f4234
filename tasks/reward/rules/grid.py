"""A grid of square cells over edges: the cells that an edge touches, and those between whose middles it passes."""

import math
from typing import NamedTuple

import numpy as np

from tasks.kernels.compiled import kernel
from tasks.world.arrays import Array, Ints

CELL_M = 0.5
MAX_CELLS = 1_000_000  # larger maps get larger cells
SLACK_CELLS = 1e-6  # an edge this close to a cell touches it: far above rounding, far below a cell
CLEAR_CELLS = 1e-9  # the line of an edge keeps this far from the middles of the edge's cells
SHIFTS = (math.sqrt(5.0), math.sqrt(2.0))  # in x, y: no line of rational slope holds on to cells moved by these


class Grid(NamedTuple):
    """Cells over all edges with free ones around them; a cell's number is row * n_columns + column."""

    low_x: float  # corner [m]
    low_y: float
    cell_m: float
    n_rows: int
    n_columns: int


def grid_over(edges: Array) -> tuple[Grid, Ints]:
    """A grid over edges (E, 4), and the pairs cell << 32 | entry of its cells and the edges that touch them.

    An entry is 2 * edge, plus 1 where the cell's middle is on the left of the edge. No middle is on the line of an
    edge of its cell. Pairs are in the order of the edges.
    """
    is_clear, attempt = False, 0
    while not is_clear:  # nearly always once
        attempt += 1
        grid = _grid(edges, attempt)
        touched, is_clear = _touched_cells(edges, grid)
    return grid, touched


def _grid(edges: Array, attempt: int) -> Grid:
    """One of many grids, each with its corner at another place in the cells."""
    if not len(edges):
        return Grid(0.0, 0.0, CELL_M, 1, 1)
    low_x, low_y = edges[:, ::2].min(), edges[:, 1::2].min()
    width, height = edges[:, ::2].max() - low_x, edges[:, 1::2].max() - low_y
    cell_m = max(CELL_M, math.sqrt((width + 4.0 * CELL_M) * (height + 4.0 * CELL_M) / MAX_CELLS))
    margin_x, margin_y = ((1.0 + math.fmod(attempt * shift, 1.0)) * cell_m for shift in SHIFTS)
    return Grid(
        low_x=float(low_x - margin_x),
        low_y=float(low_y - margin_y),
        cell_m=float(cell_m),
        n_rows=int((height + margin_y) / cell_m) + 3,
        n_columns=int((width + margin_x) / cell_m) + 3,
    )


@kernel
def middle(low: float, cell_m: float, index: int) -> float:
    """Where the middle of a row or column of cells is."""
    return low + (index + 0.5) * cell_m


@kernel
def beside(ax: float, ay: float, bx: float, by: float, x: float, y: float) -> float:
    """Where a point is as seen from a to b: > 0 on the left, < 0 on the right; twice an area [m2]."""
    return (bx - ax) * (y - ay) - (by - ay) * (x - ax)


@kernel
def passes_between(
    ax: float, ay: float, bx: float, by: float, from_x: float, from_y: float, x: float, y: float
) -> bool:
    """Whether the line through two points has the ends of an edge on either side; an end on it counts as right."""
    return (beside(from_x, from_y, x, y, ax, ay) > 0.0) != (beside(from_x, from_y, x, y, bx, by) > 0.0)


@kernel
def changes_along_rows(edges: Array, grid: Grid) -> Ints:
    """cell << 32 | edge wherever an edge passes between the middles of a cell and of the one on its left."""
    found = np.empty(_most_cells(edges, grid.cell_m), np.int64)
    n = 0
    for e in range(edges.shape[0]):
        ax, ay, bx, by = edges[e]
        row = int((min(ay, by) - grid.low_y) / grid.cell_m - 1.0)
        y = middle(grid.low_y, grid.cell_m, row)
        while y < max(ay, by):
            if (ay > y) != (by > y):
                found[n] = (row * grid.n_columns + _first_right_of(ax, ay, bx, by, y, grid)) << 32 | e
                n += 1
            row += 1
            y = middle(grid.low_y, grid.cell_m, row)
    return found[:n]


@kernel
def _first_right_of(ax: float, ay: float, bx: float, by: float, y: float, grid: Grid) -> int:
    """The first column whose middle at height y is on the right of an edge that passes that height."""
    rises = by > ay
    x = ax + (y - ay) / (by - ay) * (bx - ax)
    column = int((x - grid.low_x) / grid.cell_m)
    while (beside(ax, ay, bx, by, middle(grid.low_x, grid.cell_m, column), y) < 0.0) != rises:
        column += 1
    while (beside(ax, ay, bx, by, middle(grid.low_x, grid.cell_m, column - 1), y) < 0.0) == rises:
        column -= 1
    return column


@kernel
def _touched_cells(edges: Array, grid: Grid) -> tuple[Ints, bool]:
    """The pairs of `grid_over`, and whether no middle is on the line of an edge."""
    found = np.empty(_most_cells(edges, grid.cell_m), np.int64)
    n = 0
    is_clear = True
    for e in range(edges.shape[0]):
        ax, ay, bx, by = edges[e]
        u, v = (ax - grid.low_x) / grid.cell_m, (ay - grid.low_y) / grid.cell_m
        du, dv = (bx - ax) / grid.cell_m, (by - ay) / grid.cell_m
        near = CLEAR_CELLS * grid.cell_m * math.hypot(bx - ax, by - ay)
        for row in range(int(min(v, v + dv) - SLACK_CELLS), int(max(v, v + dv) + SLACK_CELLS) + 1):
            y = middle(grid.low_y, grid.cell_m, row)
            start, stop = _columns(u, v, du, dv, row)
            for column in range(start, stop):
                side = beside(ax, ay, bx, by, middle(grid.low_x, grid.cell_m, column), y)
                is_clear &= abs(side) > near
                found[n] = (row * grid.n_columns + column) << 32 | 2 * e + (side > 0.0)
                n += 1
    return found[:n], is_clear


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


@kernel
def _most_cells(edges: Array, cell_m: float) -> int:
    """A bound on the cells that edges touch: a flat edge between two rows touches both all along."""
    n = 0
    for e in range(edges.shape[0]):
        du, dv = abs(edges[e, 2] - edges[e, 0]) / cell_m, abs(edges[e, 3] - edges[e, 1]) / cell_m
        n += 4 * (int(du) + int(dv)) + 24
    return n
