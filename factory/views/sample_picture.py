"""Pictures of stored samples, from the row alone: the world from above, and what the cameras saw."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np

from factory.store.reader import decode_stored_image, labels_of
from factory.store.schema import NOW_INDEX
from factory.views.bev import (
    BACKGROUND,
    EXPERT,
    LOGGED,
    PERTURBED,
    Boxes,
    Colour,
    DrawnPath,
    MapShapes,
    draw_bev,
    write,
)
from tasks.world.arrays import Array, Image
from tasks.world.frames import to_local
from tasks.world.road_map import LightState

Row = Mapping[str, Any]

BEV_COLUMNS = (
    "now_pose",
    "ego_history_10hz",
    "parent_states",
    "label_10hz",
    "perturbed_states",
    "agent_kinds",
    "agent_boxes",
    "lane_ids",
    "lane_polygons",
    "drivable_rings",
    "crossing_rings",
    "light_lane_ids",
    "light_states",
    "route_lane_ids",
)
TILE_PX = (400, 240)  # width, height of a camera in the sheet, its caption included
CAPTION_PX = 22
INK = (30, 30, 30)
SCORE_COLOURS = ((228, 190, 184), (235, 190, 80), (50, 150, 90))  # at 0, 0.5, 1
MOST_LINES = 800  # of a vocabulary: more would hide the map


def sample_bev(
    row: Row,
    logged: Array | None = None,
    size_px: tuple[int, int] = (480, 480),
    vocabulary: Array | None = None,
    step: int = NOW_INDEX,
    legend: bool = True,
) -> Image:
    """A sample (BEV_COLUMNS) from above, at its now or another 10 Hz step -1.5 .. 4.0 s around it, the ego pointing up.

    logged: (M, >=3) the log's drive from T on, world frame; None: the row's own two logged poses are joined.
    vocabulary: (K, 40, 3) that the row's labels are of, to be drawn in the colour of their score.
    """
    lanes = dict(zip(row["lane_ids"], row["lane_polygons"]))
    red = {
        lane_id for lane_id, states in zip(row["light_lane_ids"], row["light_states"]) if states[step] == LightState.RED
    }
    shapes = MapShapes(
        roads=row["drivable_rings"],
        route=[lanes[i] for i in row["route_lane_ids"] if i in lanes],
        crossings=row["crossing_rings"],
        lanes=list(lanes.values()),
        red=[lanes[i] for i in sorted(red) if i in lanes],
    )
    boxes = np.asarray(row["agent_boxes"], dtype=float).reshape(len(row["agent_kinds"]), -1, 5)
    here = ego_way(row)[step]
    paths = [*(_scored_paths(row, vocabulary) if vocabulary is not None else ()), *_paths(row, logged)]
    if not legend:
        paths = [replace(path, label="") for path in paths]
    return draw_bev(here, shapes, Boxes(boxes[:, step], row["agent_kinds"]), here, paths, "", size_px)


def nearer(image: Image) -> Image:
    """Of a square top-down picture the inner 60 m of 80 m, the ego staying at 6/10 of the height; the legend goes."""
    size = image.shape[0]
    top, side = round(0.6 * size / 4), size // 8
    return np.ascontiguousarray(image[top : top + 3 * size // 4, side : side + 3 * size // 4])


def ego_way(row: Row) -> Array:
    """(56, 3) poses at 10 Hz, -1.5 .. 4.0 s around now, in the ego frame at now: what led here, then the label."""
    return np.concatenate([row["ego_history_10hz"], row["label_10hz"]]).astype(np.float64)


def _scored_paths(row: Row, vocabulary: Array) -> list[DrawnPath]:
    """Thin lines from the ego for every n-th trajectory, the best on top; the worst and the best have a caption."""
    shown = slice(None, None, -(-len(vocabulary) // MOST_LINES))
    scores = labels_of(row).pdm_score()[shown]
    lines = np.concatenate([np.zeros((len(scores), 1, 3)), vocabulary[shown]], axis=1)
    order = np.argsort(scores, kind="stable")
    captions = {i: f"vocabulary: EPDMS {scores[i]:.2f}" for i in (order[0], order[-1])}
    return [DrawnPath(lines[i], _score_colour(scores[i]), captions.get(i, ""), width_px=1) for i in order]


def _score_colour(score: float) -> Colour:
    """Red at 0, yellow at a half, green at 1."""
    red, green, blue = (np.interp(score, (0.0, 0.5, 1.0), channel) for channel in zip(*SCORE_COLOURS))
    return round(red), round(green), round(blue)


def _paths(row: Row, logged: Array | None) -> list[DrawnPath]:
    pose = np.asarray(row["now_pose"], dtype=float)
    label = np.concatenate([np.zeros((1, 3)), row["label_10hz"]])
    if row["perturbed_states"] is None:
        return [DrawnPath(label, LOGGED, "logged drive = label")]
    known, name = (logged, "logged") if logged is not None else (row["parent_states"], "logged at T and T+H, joined")
    return [
        DrawnPath(to_local(pose, np.asarray(known, dtype=float)[:, :3]), LOGGED, name, dashed=logged is not None),
        DrawnPath(to_local(pose, np.asarray(row["perturbed_states"])[:, :3]), PERTURBED, "perturbed"),
        DrawnPath(label, EXPERT, "expert (simulated) = label"),
    ]


def images_at_now(row: Row) -> list[dict[str, Any]]:
    """Each camera's image nearest to now, in the order of the row."""
    nearest: dict[str, dict[str, Any]] = {}
    for image in row["images"] or ():
        known = nearest.get(image["camera"])
        if known is None or abs(image["time_s"]) < abs(known["time_s"]):
            nearest[image["camera"]] = image
    return list(nearest.values())


def earlier_images(row: Row, camera: str) -> list[dict[str, Any]]:
    """What one camera saw up to now, in order of time."""
    taken = [image for image in row["images"] or () if image["camera"] == camera and image["time_s"] < 0.1]
    return sorted(taken, key=lambda image: float(image["time_s"]))


def front_camera(row: Row) -> str | None:
    """The camera with images that looks ahead; the first of the rig among those within 1 % of the straightest."""
    seen = {image["camera"] for image in row["images"] or ()}
    rig = [camera for camera in row["cameras"] or () if camera["name"] in seen]
    if not rig:
        return None
    return str(
        max(rig, key=lambda camera: round(float(np.reshape(camera["ego_from_camera"], (4, 4))[0, 2]), 2))["name"]
    )


def fitted(image: Image, width: int, height: int) -> Image:
    """The image scaled into width x height pixels, its aspect kept, padded with the background."""
    scale = min(width / image.shape[1], height / image.shape[0])
    size = (max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale)))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    sheet = np.full((height, width, 3), BACKGROUND, np.uint8)
    top, left = (height - size[1]) // 2, (width - size[0]) // 2
    sheet[top : top + size[1], left : left + size[0]] = small
    return sheet


def encoded(image: Image, suffix: str = ".jpg") -> bytes:
    """RGB as the bytes of a JPEG (quality 85) or PNG file."""
    options = [cv2.IMWRITE_JPEG_QUALITY, 85] if suffix == ".jpg" else []
    done, data = cv2.imencode(suffix, cv2.cvtColor(image, cv2.COLOR_RGB2BGR), options)
    assert done, f"OpenCV cannot write {suffix}"
    return bytes(data)


def small_jpeg(image: Image, width: int) -> bytes:
    """RGB scaled to a width, as the bytes of a JPEG."""
    return encoded(fitted(image, width, max(1, round(width * image.shape[0] / image.shape[1]))))


def sample_sheet(row: Row, logged: Array | None = None, bev_px: int = 720, vocabulary: Array | None = None) -> Image:
    """Top-down view and all cameras at now, side by side; up to three cameras in one column, more in two."""
    tiles = [_stored(image) for image in images_at_now(row)] or [
        note(f"no images: image_source is {row['image_source']}")
    ]
    return beside(sample_bev(row, logged, (bev_px, bev_px), vocabulary), tiles)


def beside(bev: Image, tiles: Sequence[Image]) -> Image:
    """A top-down view and tiles to the right of it, in one column up to three, else in two."""
    strip = in_rows(tiles, 1 if len(tiles) <= 3 else 2)
    height = max(bev.shape[0], strip.shape[0])
    return np.concatenate([padded(bev, height), padded(strip, height)], axis=1)


def in_rows(tiles: Sequence[Image], columns: int) -> Image:
    """Tiles of one size, row by row, the last row filled up with background."""
    whole = [*tiles, *([np.full_like(tiles[0], BACKGROUND)] * (-len(tiles) % columns))]
    return np.concatenate([np.concatenate(whole[i : i + columns], axis=1) for i in range(0, len(whole), columns)])


def _stored(image: Mapping[str, Any]) -> Image:
    try:
        return tile(decode_stored_image(image), f"{image['camera']}  {image['time_s']:+.1f} s")
    except ValueError as error:
        return note(str(error))


def tile(pixels: Image, caption: str, size_px: tuple[int, int] = TILE_PX) -> Image:
    """A picture over its caption, with a margin; `size_px` width, height."""
    framed = np.full((size_px[1], size_px[0], 3), BACKGROUND, np.uint8)
    framed[4:-CAPTION_PX, 4:-4] = fitted(pixels, size_px[0] - 8, size_px[1] - CAPTION_PX - 4)
    return _written(framed, caption, size_px[1] - 7)


def note(text: str) -> Image:
    """A tile of words."""
    return _written(np.full((TILE_PX[1], TILE_PX[0], 3), BACKGROUND, np.uint8), text[:60], TILE_PX[1] // 2)


def _written(tile: Image, text: str, baseline: int) -> Image:
    write(tile, text, (8, baseline), 0.42, INK)
    return tile


def padded(image: Image, height: int) -> Image:
    """The image with background below."""
    below = np.full((height - image.shape[0], image.shape[1], 3), BACKGROUND, np.uint8)
    return np.concatenate([image, below], axis=0)
