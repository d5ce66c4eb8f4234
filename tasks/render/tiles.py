"""Which ellipses touch which tile of the picture, nearest first."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tasks.kernels import kernel
from tasks.render.gaussians import F32
from tasks.render.project import DEPTH, HALF_U, HALF_V, U, V
from tasks.render.threads import in_chunks

TILE_WIDTH, TILE_HEIGHT = 16, 16  # pixels; a row is two vector registers (measured: 8 wide is slower)
CHUNK = 8192  # ellipses a thread deals out at a time


def deal(projected: F32, width: int, height: int, threads: int) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Start of each tile (tiles + 1,), row by row, in the list (pairs,) of the ellipses that touch it, nearest first.

    `projected` (M, 9) as from tasks.render.project.
    """
    tiles_x, tiles_y = tiles_of(width, height)
    order = _nearest_first(projected)
    chunks = -(-len(order) // CHUNK)
    counts = np.zeros((chunks, tiles_x * tiles_y), np.int64)

    def count(first: int, last: int) -> None:
        _count(projected, order[first:last], tiles_x, tiles_y, counts[first // CHUNK])

    def fill(first: int, last: int) -> None:
        _fill(projected, order[first:last], tiles_x, tiles_y, places[first // CHUNK], pairs)

    in_chunks(count, len(order), CHUNK, threads)
    ends = np.cumsum(counts.T).reshape(-1, chunks) if chunks else np.zeros((tiles_x * tiles_y, 0), np.int64)
    places = np.ascontiguousarray((ends - counts.T).T)  # a tile's ellipses of the nearer chunks come first
    start = np.concatenate([[0], np.cumsum(counts.sum(axis=0))])
    pairs = np.empty(start[-1], np.int32)
    in_chunks(fill, len(order), CHUNK, threads)
    return start, pairs


def tiles_of(width: int, height: int) -> tuple[int, int]:
    """Columns and rows of tiles that cover a picture."""
    return -(-width // TILE_WIDTH), -(-height // TILE_HEIGHT)


@kernel
def tile_range(row: Any, tiles_x: int, tiles_y: int) -> Any:
    """Tiles x0 <= x < x1, y0 <= y < y1 that the box of a projected row touches."""
    x0 = max(0, int(np.floor((row[U] - row[HALF_U]) / TILE_WIDTH)))
    x1 = min(tiles_x, int(np.floor((row[U] + row[HALF_U]) / TILE_WIDTH)) + 1)
    y0 = max(0, int(np.floor((row[V] - row[HALF_V]) / TILE_HEIGHT)))
    y1 = min(tiles_y, int(np.floor((row[V] + row[HALF_V]) / TILE_HEIGHT)) + 1)
    return x0, x1, y0, y1


@kernel
def tile_counts(projected: Any, tiles_x: int, tiles_y: int) -> Any:
    """Where each ellipse's pairs start (M + 1,) when they are numbered ellipse by ellipse, tiles row by row."""
    out = np.zeros(projected.shape[0] + 1, np.int64)
    for i in range(projected.shape[0]):
        x0, x1, y0, y1 = tile_range(projected[i], tiles_x, tiles_y)
        out[i + 1] = out[i] + max(0, x1 - x0) * max(0, y1 - y0)
    return out


@kernel
def _nearest_first(projected: Any) -> Any:
    """Rows (M,) by depth, equal depths in the order they have: radix sort of the bits, which for positive numbers are
    in the order of the numbers."""
    n = projected.shape[0]
    keys = np.ascontiguousarray(projected[:, DEPTH]).view(np.uint32)
    rows, spare = np.arange(n).astype(np.int32), np.empty(n, np.int32)
    for shift in (0, 11, 22):
        start = np.zeros(2049, np.int64)
        for i in range(n):
            start[((keys[i] >> np.uint32(shift)) & np.uint32(2047)) + 1] += 1
        for digit in range(2048):
            start[digit + 1] += start[digit]
        for j in range(n):
            digit = (keys[rows[j]] >> np.uint32(shift)) & np.uint32(2047)
            spare[start[digit]] = rows[j]
            start[digit] += 1
        rows, spare = spare, rows
    return rows


@kernel
def _count(projected: Any, rows: Any, tiles_x: int, tiles_y: int, counts: Any) -> None:
    for i in rows:
        x0, x1, y0, y1 = tile_range(projected[i], tiles_x, tiles_y)
        for ty in range(y0, y1):
            for tx in range(x0, x1):
                counts[ty * tiles_x + tx] += 1


@kernel
def _fill(projected: Any, rows: Any, tiles_x: int, tiles_y: int, places: Any, pairs: Any) -> None:
    for i in rows:
        x0, x1, y0, y1 = tile_range(projected[i], tiles_x, tiles_y)
        for ty in range(y0, y1):
            for tx in range(x0, x1):
                t = ty * tiles_x + tx
                pairs[places[t]] = i
                places[t] += 1
