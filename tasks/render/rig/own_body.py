"""What a camera sees of the car that carries it, told by its photos alone: what keeps its place while the ego drives.

An edge of the street moves through a camera's photos, one of the own body stays. At each pixel the grey gradient along
the way on which the street moves there is asked: where its median over the photos is most of what it is in each, the
pixel shows the body; where gradients come and go, the street. Only along that way, for a kerb or a painted line that
runs with it stays, too. Plain paint and smooth asphalt tell nothing: a minimum cut gives each pixel to one or the
other so that it parts them where the median picture has an edge.

What a body mirrors comes and goes on it, so of a car that shines much is left out.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import breadth_first_order, maximum_flow

from tasks.render.scene.sky import may_be_sky
from tasks.world.arrays import F32, Array, Bools, Bytes, Ints
from tasks.world.clip import Camera

WIDTH_PX = 240  # of the pictures that are looked at
STEP_M = 2.0  # that the ego drives at least from one photo to the next
LEAST_PHOTOS, MOST_PHOTOS = 8, 24  # fewer tell nothing, more tell no more
STREET_M = 20.0  # how far off the street is taken to be where it is no nearer
LEAST_HEIGHT_M = 0.8  # of a camera above the road, where its mount says less
MOVES_PX = 9.0  # what the street must move from photo to photo to be told from what stays
ONE_WAY = 0.5  # how much alike the ways are on which it moves, 1: the same in all
LEANS = 0.05  # share of what runs with the way that may lean on it: a mount is some degrees off
STAYS = 0.375  # share of a gradient's mean square that its median must have
FAINT, FAINT_STREET = 0.001, 0.05  # gradients [grey/px] that tell little: of what stays, and of what comes and goes
BODY, STREET, NEITHER = 2.5, 0.75, 0.015  # what either, and what tells nothing, weighs in the cut
FAR_ROAD_M, FAR_ROAD = 6.0, 0.15  # what looks at road farther than that is body the less
PART, PART_AT = 2.5, 0.006  # cost of parting two pixels, and the difference of colour at which it is free
LEAST_SHARE, LEAST_TOLD = 0.001, 0.03  # of a picture, and of the mean evidence, that a part of the body has
EDGE_PX, EDGE_AT = 3, 0.035  # within which its outline goes to the strongest edge
SURE = 50.0


def choose_photos(world_from_ego: Array) -> Ints:
    """Rows of a camera's photos, in the order in which they were taken, that are looked at; none where too few tell.

    world_from_ego: (N, 4, 4) poses of the ego.
    """
    rows, last = [], None
    for row, place in enumerate(world_from_ego[:, :3, 3]):
        if last is None or np.linalg.norm(place - last) >= STEP_M:
            rows.append(row)
            last = place
    if len(rows) < LEAST_PHOTOS:
        return np.zeros(0, np.int64)
    return np.array(rows)[np.linspace(0, len(rows) - 1, min(len(rows), MOST_PHOTOS)).astype(np.int64)]


def shrink(photo: Bytes) -> Bytes:
    """A photo (H, W, 3) as it is looked at, WIDTH_PX wide."""
    size = (WIDTH_PX, round(WIDTH_PX * photo.shape[0] / photo.shape[1]))
    return np.asarray(cv2.resize(photo, size, interpolation=cv2.INTER_AREA))


def find_own_body(small: Sequence[Bytes], camera: Camera, world_from_ego: Array) -> Bools | None:
    """(H, W) pixels of a camera's photos, as its lens shows them, that are the car itself; None: there is nothing.

    small: (N, h, w, 3) photos that `choose_photos` chose, shrunk; world_from_ego: (N, 4, 4) poses of the ego then.
    """
    pictures = np.stack(small).astype(np.float32) / np.float32(255.0)
    median = _median(pictures)
    stays, comes_and_goes, road_m = _evidence(pictures, median, camera, world_from_ego)
    far_road = (road_m > FAR_ROAD_M) & np.isfinite(road_m)
    for_body = BODY * stays - STREET * comes_and_goes - NEITHER - FAR_ROAD * far_road
    found = np.zeros(median.shape[:2], bool)
    for part in _parts(_minimum_cut(for_body, median, PART, PART_AT)):
        at_edge = part[0].any() or part[-1].any() or part[:, 0].any() or part[:, -1].any()
        if at_edge and part.mean() >= LEAST_SHARE and stays[part].mean() > LEAST_TOLD:
            found |= part
    if not found.any():
        return None
    outlined, size = _to_strongest_edge(found, median), (camera.width, camera.height)
    return np.asarray(cv2.resize(outlined.astype(np.float32), size, interpolation=cv2.INTER_LINEAR) > 0.5)


def _evidence(pictures: F32, median: F32, camera: Camera, world_from_ego: Array) -> tuple[Array, Array, Array]:
    """(h, w) each: how surely a pixel stays, how surely it comes and goes, 0 to 1, and how far [m] the road is there,
    infinite where it is not seen."""
    along, across, road_m, tells = _street_ways(pictures.shape[1:3], camera, world_from_ego)
    tells &= np.isfinite(road_m) | ~may_be_sky(median)  # clouds stay, too
    grey = (pictures[..., 0] + pictures[..., 1] + pictures[..., 2]) / np.float32(3.0)
    x, y = (np.stack([cv2.Sobel(one, cv2.CV_32F, *way, scale=1.0 / 8.0) for one in grey]) for way in ((1, 0), (0, 1)))
    on_way, aside = x * along + y * across, y * along - x * across
    median_square, mean_square = _around(_median(on_way) ** 2), _around((on_way**2).mean(axis=0))
    median_square -= LEANS * _around(_median(aside) ** 2)
    stays = np.maximum(median_square - STAYS * mean_square, 0.0) / (mean_square + FAINT**2) / (1.0 - STAYS)
    median_square = _around(_median(x) ** 2 + _median(y) ** 2)
    mean_square = _around((x**2 + y**2).mean(axis=0))
    goes = np.maximum(STAYS * mean_square - median_square, 0.0) / (mean_square + FAINT_STREET**2) / STAYS
    return stays * tells, goes, road_m


def _median(pictures: Any) -> Any:
    """Over the first axis, in the kind of numbers it is given; numpy's takes three times as long."""
    ordered, n = np.sort(pictures, axis=0), len(pictures)
    return 0.5 * (ordered[(n - 1) // 2] + ordered[n // 2])


def _around(values: F32 | Array) -> F32:
    return np.asarray(cv2.blur(values.astype(np.float32), (3, 3)))


def _street_ways(shape: Sequence[int], camera: Camera, world_from_ego: Array) -> tuple[Array, Array, Array, Bools]:
    """The way (x and y, (h, w) each) on which the street moves through a picture of this shape, how far [m] the road is
    there, and where the street moves enough, and on one way."""
    height, width = shape
    lens = np.diag([width / camera.width, height / camera.height, 1.0]) @ camera.intrinsics
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    pixels = np.column_stack([u.ravel(), v.ravel()])
    flat = cv2.undistortPoints(pixels[:, None], lens, camera.distortion)[:, 0]
    rays = np.column_stack([flat, np.ones(len(flat))])
    rise = rays @ camera.ego_from_camera[2, :3]
    with np.errstate(divide="ignore"):
        road_m = np.where(rise < -1e-3, max(camera.ego_from_camera[2, 3], LEAST_HEIGHT_M) / -rise, np.inf)
    points = rays * np.minimum(road_m, STREET_M)[:, None]
    twice_x, twice_y, moved = np.zeros((3, len(rays)))  # by the way's double angle: a way and its opposite are one
    poses = world_from_ego @ camera.ego_from_camera
    for here, there in pairwise(poses):
        seen = points @ (there[:3, :3].T @ here[:3, :3]).T + there[:3, :3].T @ (here[:3, 3] - there[:3, 3])
        seen[:, 2] = np.maximum(seen[:, 2], 0.2)
        x, y = np.ascontiguousarray((_in_picture(seen, lens, camera.distortion) - pixels).T)
        square = x * x + y * y
        length = np.sqrt(square)
        told = (length > MOVES_PX / 3.0) / np.maximum(square, 1e-12)
        twice_x += (x * x - y * y) * told
        twice_y += 2.0 * x * y * told
        moved += length
    n = len(poses) - 1
    way = 0.5 * np.arctan2(twice_y, twice_x)
    tells = (np.hypot(twice_x, twice_y) > ONE_WAY * n) & (moved > MOVES_PX * n)
    along_x, along_y = (np.asarray(part(way).reshape(shape), np.float64) for part in (np.cos, np.sin))
    return along_x, along_y, road_m.reshape(shape), tells.reshape(shape)


def _in_picture(points: Array, lens: Array, distortion: Array) -> Array:
    """Where points (M, 3) before a camera are in its picture, (M, 2) [px]."""
    if distortion.any():
        return np.asarray(cv2.projectPoints(points[:, None], np.zeros(3), np.zeros(3), lens, distortion)[0][:, 0])
    return points[:, :2] * (1.0 / points[:, 2:]) * lens.diagonal()[:2] + lens[:2, 2]  # the same bits, ten times as fast


def _minimum_cut(for_first: Array, picture: F32, cost: float, free_at: float) -> Bools:
    """(h, w) pixels of the first of two kinds: the split that loses least of `for_first` (h, w), above 0 for the first
    and below for the second, and of the costs of parting neighbours in a picture (h, w, 3).

    Exact (Ford and Fulkerson 1956; for pictures Greig, Porteous and Seheult 1989).
    """
    n, cells = for_first.size, np.arange(for_first.size).reshape(for_first.shape)
    first, second = n, n + 1
    wants = for_first.ravel()
    likes = wants > 0.0
    ends = [(np.full(likes.sum(), first), cells.ravel()[likes], wants[likes])]
    ends.append((cells.ravel()[~likes], np.full((~likes).sum(), second), -wants[~likes]))
    for a, b in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        differs = ((picture[a] - picture[b]) ** 2).sum(axis=-1)
        parting = (cost * np.exp(-differs / (2.0 * free_at**2)) + 0.02).ravel()
        ends += [(cells[a].ravel(), cells[b].ravel(), parting), (cells[b].ravel(), cells[a].ravel(), parting)]
    rows, columns, costs = (np.concatenate(part) for part in zip(*ends))
    graph = coo_matrix((np.rint(1000.0 * costs).astype(np.int32), (rows, columns)), (n + 2, n + 2)).tocsr()
    left = graph - maximum_flow(graph, first, second).flow
    left.data = np.maximum(left.data, 0)
    left.eliminate_zeros()
    out = np.zeros(n + 2, bool)
    out[breadth_first_order(left, first, return_predecessors=False)] = True
    return out[:n].reshape(for_first.shape)


def _parts(mask: Bools) -> list[Bools]:
    n, labels = cv2.connectedComponents(mask.astype(np.uint8), connectivity=4)
    return [labels == k for k in range(1, n)]


def _to_strongest_edge(mask: Bools, median: F32) -> Bools:
    """The mask with its outline moved by EDGE_PX at most; parts that are thinner stay as they are."""
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * EDGE_PX + 1, 2 * EDGE_PX + 1))
    padded = np.pad(mask, EDGE_PX, mode="edge").astype(np.uint8)  # the body goes on beyond the picture
    core = cv2.erode(padded, disc)[EDGE_PX:-EDGE_PX, EDGE_PX:-EDGE_PX].astype(bool)
    beyond = cv2.dilate(mask.astype(np.uint8), disc) == 0
    moved = _minimum_cut(np.where(core, SURE, np.where(beyond, -SURE, -1e-3)), median, 1.0, EDGE_AT)
    for part in _parts(mask):
        if not core[part].any():
            moved |= part
    return moved
