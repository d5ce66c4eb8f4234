"""Which ellipses touch which tile of the picture, nearest first."""

from typing import Any

import numpy as np

from tasks.kernels.compiled import kernel
from tasks.kernels.threads import in_chunks
from tasks.render.splatting.project import TILE
from tasks.world.arrays import F32, Ints, ShortInts

CHUNK = 8192  # ellipses a thread deals out at a time


def deal(depths: F32, tiles: ShortInts, width: int, height: int, threads: int) -> tuple[Ints, ShortInts]:
    """Start of each tile (tiles + 1,), row by row, in the list (pairs,) of the ellipses that touch it, nearest first.

    `depths` (M,) positive, `tiles` (M, 4) as from tasks.render.splatting.project.
    """
    tiles_x, tiles_y = -(-width // TILE), -(-height // TILE)
    order = _nearest_first(np.ascontiguousarray(depths))
    corners = np.zeros((-(-len(order) // CHUNK), tiles_y + 1, tiles_x + 1), np.int64)

    def mark(first: int, last: int) -> None:
        _mark_corners(tiles, order, first, last, corners[first // CHUNK])

    in_chunks(mark, len(order), CHUNK, threads)
    counts = corners.cumsum(axis=1).cumsum(axis=2)[:, :-1, :-1].reshape(len(corners), tiles_x * tiles_y)
    start = np.concatenate([[0], np.cumsum(counts.sum(axis=0))])
    before = np.cumsum(counts, axis=0) - counts  # a tile's ellipses of the nearer chunks come first
    places = start[:-1] + before
    pairs = np.empty(start[-1], np.int32)

    def fill(first: int, last: int) -> None:
        _fill(tiles, order, tiles_x, first, last, places[first // CHUNK], pairs)

    in_chunks(fill, len(order), CHUNK, threads)
    return start, pairs


def pair_starts(tiles: ShortInts) -> Ints:
    """Where each ellipse's pairs start (M + 1,) when they are numbered ellipse by ellipse, its tiles row by row."""
    counts = (tiles[:, 1] - tiles[:, 0]) * (tiles[:, 3] - tiles[:, 2])
    return np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])


@kernel
def _nearest_first(depths: Any) -> Any:
    """Rows (M,) by depth, equal depths in the order they have: radix sort of the bits, which for positive numbers are
    in the order of the numbers."""
    n = depths.shape[0]
    keys = depths.view(np.uint32)
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
def _mark_corners(tiles: Any, order: Any, first: int, last: int, corners: Any) -> None:
    """Summed along both axes, `corners` (tiles_y + 1, tiles_x + 1) counts the ellipses on each tile."""
    for at in range(first, last):
        i = order[at]
        x0, x1, y0, y1 = tiles[i, 0], tiles[i, 1], tiles[i, 2], tiles[i, 3]
        corners[y0, x0] += 1
        corners[y0, x1] -= 1
        corners[y1, x0] -= 1
        corners[y1, x1] += 1


@kernel
def _fill(tiles: Any, order: Any, tiles_x: int, first: int, last: int, places: Any, pairs: Any) -> None:
    for at in range(first, last):
        i = order[at]
        for ty in range(tiles[i, 2], tiles[i, 3]):
            for tx in range(tiles[i, 0], tiles[i, 1]):
                t = ty * tiles_x + tx
                pairs[places[t]] = i
                places[t] += 1
