"""Pictures of maps, agents, trajectories and stored samples, drawn with OpenCV in some milliseconds; films."""

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from factory.store.reader import decode_stored_image, labels_of
from factory.store.schema import AGENT_STEPS, NOW_INDEX
from tasks.attempt import Judged
from tasks.perturb import Candidate, ConsideredTrajectories
from tasks.world.arrays import Array, Bytes, Image, ShortInts
from tasks.world.clip import NOW, AgentKind, Clip
from tasks.world.frames import HEADING, PACIFICA, box_corners, ego_boxes, points_to_local, to_local
from tasks.world.road_map import LightState

Colour = tuple[int, int, int]  # RGB

BACKGROUND: Colour = (246, 246, 243)
ROAD: Colour = (218, 220, 222)
ROUTE: Colour = (205, 222, 205)
LANE_EDGE: Colour = (250, 250, 250)
CROSSING: Colour = (236, 230, 205)
EGO: Colour = (30, 30, 30)
LOGGED: Colour = (110, 110, 110)
PERTURBED: Colour = (224, 122, 32)
EXPERT: Colour = (32, 120, 200)
RED_LIGHT: Colour = (214, 58, 50)
AGENT_COLOURS: dict[str, Colour] = {
    AgentKind.VEHICLE: (96, 133, 168),
    AgentKind.PEDESTRIAN: (190, 80, 120),
    AgentKind.BICYCLE: (120, 90, 180),
}
OBJECT: Colour = (150, 150, 130)
BEV_LEGEND: Mapping[str, Colour] = (  # of a sample from above: everything that is drawn
    {"logged": LOGGED, "perturbed": PERTURBED, "expert": EXPERT, "ego": EGO}
    | {kind.lower(): colour for kind, colour in AGENT_COLOURS.items()}
    | {"object": OBJECT, "red light": RED_LIGHT, "road": ROAD, "lane edge": LANE_EDGE}
    | {"route": ROUTE, "crossing": CROSSING}
)
_SHIFT = 4  # OpenCV draws at 1/16 pixel with this many fractional bits


@dataclass(frozen=True)
class DrawnPath:
    """One trajectory to draw, world frame."""

    poses: Array  # (M, >=2)
    colour: Colour
    label: str
    dashed: bool = False
    width_px: int = 2


@dataclass(frozen=True)
class MapShapes:
    """What lies underneath, world frame: rings (M, 2)."""

    roads: Sequence[Array] = ()
    route: Sequence[Array] = ()
    crossings: Sequence[Array] = ()
    lanes: Sequence[Array] = ()
    red: Sequence[Array] = ()


@dataclass(frozen=True)
class Boxes:
    """Agents at one instant, world frame."""

    boxes: Array  # (N, 5) centre x, y, heading, length, width; rows with NaN are left out
    kinds: Sequence[str]


def draw_bev(
    centre: Array,
    shapes: MapShapes,
    agents: Boxes,
    ego: Array,
    paths: Sequence[DrawnPath] = (),
    title: str = "",
    size_px: tuple[int, int] = (480, 480),
    metres: float = 80.0,
) -> Bytes:
    """An RGB picture (height, width, 3), x of `centre` (3,) pointing up.

    `ego` (3,) is the rear-axle pose of the box to draw; `metres` is the extent along the picture's height.
    """
    width, height = size_px
    scale = height / metres
    image = np.full((height, width, 3), BACKGROUND, np.uint8)

    def pixels(points: Array) -> ShortInts:
        local = points_to_local(centre, np.asarray(points, dtype=float)[..., :2])
        u = width / 2.0 - local[..., 1] * scale
        v = height * 0.6 - local[..., 0] * scale
        fixed = np.stack([u, v], axis=-1) * (1 << _SHIFT)
        return np.clip(fixed, -(2**24), 2**24).astype(np.int32)

    def fill(rings: Sequence[Array], colour: Colour) -> None:
        for ring in rings:
            cv2.fillPoly(image, [pixels(ring)], colour, cv2.LINE_AA, _SHIFT)

    fill(shapes.roads, ROAD)
    fill(shapes.route, ROUTE)
    fill(shapes.crossings, CROSSING)
    fill(shapes.red, RED_LIGHT)
    for ring in shapes.lanes:
        cv2.polylines(image, [pixels(ring)], True, LANE_EDGE, 1, cv2.LINE_AA, _SHIFT)
    for path in paths:
        _polyline(image, pixels(path.poses), path)
    for box, kind in zip(agents.boxes, agents.kinds):
        if np.isfinite(box).all():
            corners = box_corners(box)
            cv2.fillPoly(image, [pixels(corners)], AGENT_COLOURS.get(kind, OBJECT), cv2.LINE_AA, _SHIFT)
            nose = np.stack([(corners[0] + corners[3]) / 2.0, box[:2]])
            cv2.polylines(image, [pixels(nose)], False, BACKGROUND, 1, cv2.LINE_AA, _SHIFT)
    cv2.fillPoly(image, [pixels(box_corners(ego_boxes(ego, PACIFICA)))], EGO, cv2.LINE_AA, _SHIFT)
    write_text(image, title, (8, 18), 0.42)
    for row, path in enumerate(path for path in paths if path.label):
        y = height - 10 - 16 * row
        cv2.line(image, (8, y - 4), (26, y - 4), path.colour, 3, cv2.LINE_AA)
        write_text(image, path.label, (32, y))
    return image


def _polyline(image: Bytes, points: ShortInts, path: DrawnPath) -> None:
    every, length = (4, 3) if path.dashed else (len(points), len(points))
    for start in range(0, len(points) - 1, every):
        piece = points[start : start + length]
        cv2.polylines(image, [piece], False, path.colour, path.width_px, cv2.LINE_AA, _SHIFT)


def write_text(image: Bytes, text: str, at: tuple[int, int], size: float = 0.4, colour: Colour = (20, 20, 20)) -> None:
    """A line of text into the picture."""
    cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, colour, 1, cv2.LINE_AA)


def write_mp4(path: "os.PathLike[str]", frames: Iterable[Bytes], frames_per_s: int = 10) -> None:
    """RGB frames (height, width, 3), even sizes, as H.264 that browsers play; makes the folder.

    Raises ValueError without frames.
    """
    import av

    Path(path).parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = None
        for frame in frames:
            if stream is None:
                stream = container.add_stream("libx264", rate=frames_per_s)
                stream.height, stream.width = frame.shape[:2]
                stream.pix_fmt = "yuv420p"
                stream.options = {"crf": "20", "movflags": "+faststart"}
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")))
        if stream is None:
            raise ValueError(f"{path}: a film needs at least one frame")
        container.mux(stream.encode())


# Pictures of clips and attempts: who was where, what was tried, what the expert drove.

FATE_COLOURS = {  # what became of a gated vocabulary trajectory
    "reached_gate": (200, 200, 200),
    "white_cell": (190, 205, 220),
    "not_needed": (150, 180, 150),
    "score": (214, 90, 80),
    "reactive": (240, 150, 40),
    "kept": (20, 130, 60),
}


def map_shapes(clip: Clip, step: int) -> MapShapes:
    """The clip's map with the lights of one step."""
    lanes = clip.road_map.lanes
    red = {
        lane_id
        for lane_id, state in zip(clip.lights.lane_ids, clip.lights.states[step] if clip.lights.lane_ids else ())
        if state == LightState.RED
    }
    return MapShapes(
        roads=clip.road_map.road_rings,
        route=[lanes[i].ring for i in sorted(clip.route.lane_ids) if i in lanes],
        crossings=clip.road_map.crossings,
        lanes=[lane.ring for lane in lanes.values() if lane.drives_cars],
        red=[lanes[i].ring for i in sorted(red) if i in lanes],
    )


def attempt_picture(
    clip: Clip, candidate: Candidate | None, judged: Judged | None, title: str, size_px: tuple[int, int] = (480, 480)
) -> Image:
    """Logged, perturbed, planned and driven way of one attempt, with the agents at the scene's instant."""
    if judged is not None:
        step, ego, boxes = judged.scene.step, judged.scene.ego_state, judged.rollout.agents.boxes[0]
        kinds: Sequence[str] = judged.rollout.agents.kinds
    elif candidate is not None:
        rollout, kinds = candidate.rollout, clip.agents.kinds
        step, ego, boxes = rollout.start_step + 40, rollout.ego_states[-1], rollout.agents.boxes[-1]
    else:
        step, ego, boxes, kinds = NOW, clip.ego_states[NOW], clip.agents.boxes[NOW], clip.agents.kinds
    pose = ego[: HEADING + 1]
    ways = _paths_of_attempt(clip, candidate, judged, "expert (simulated)")
    return draw_bev(pose, map_shapes(clip, step), Boxes(boxes, kinds), pose, ways, title, size_px)


def _paths_of_attempt(clip: Clip, candidate: Candidate | None, judged: Judged | None, expert: str) -> list[DrawnPath]:
    ways = [DrawnPath(clip.ego_states[NOW:, : HEADING + 1], LOGGED, "logged", dashed=True)]
    if candidate is not None:
        ways.append(DrawnPath(candidate.rollout.ego_states, PERTURBED, "perturbed"))
    if judged is not None:
        ways.append(DrawnPath(judged.rollout.ego_states, EXPERT, expert))
    return ways


def candidates_picture(clip: Clip, considered: ConsideredTrajectories, size_px: tuple[int, int] = (720, 720)) -> Image:
    """End poses of all gated trajectories around the logged pose at T+H, coloured by what became of them."""
    step = NOW + 40
    target = clip.ego_states[step, : HEADING + 1]
    image = draw_bev(
        target,
        map_shapes(clip, step),
        Boxes(clip.agents.boxes[step], clip.agents.kinds),
        target,
        [DrawnPath(clip.ego_states[NOW:, : HEADING + 1], LOGGED, "", dashed=True)],
        f"{len(considered.fate)} gated end poses at T+H",
        size_px,
        metres=60.0,
    )
    height, width = image.shape[:2]
    scale = height / 60.0
    for fate, colour in FATE_COLOURS.items():
        for pose in considered.end_pose[[f == fate for f in considered.fate]]:
            centre = (int(width / 2 - pose[1] * scale), int(height * 0.6 - pose[0] * scale))
            cv2.circle(image, centre, 3 if fate == "kept" else 2, colour, -1, cv2.LINE_AA)
    for row, (fate, colour) in enumerate(FATE_COLOURS.items()):
        count = sum(f == fate for f in considered.fate)
        cv2.circle(image, (14, height - 14 - 16 * row), 4, colour, -1, cv2.LINE_AA)
        write_text(image, f"{fate} {count}", (24, height - 10 - 16 * row))
    return image


def rollout_film(
    clip: Clip, candidate: Candidate, judged: Judged, size_px: tuple[int, int] = (480, 480)
) -> Iterator[Image]:
    """Both rollouts at 10 Hz, T .. T+2H, one picture a step."""
    ways = _paths_of_attempt(clip, candidate, judged, "expert")
    for stage, rollout in enumerate((candidate.rollout, judged.rollout)):
        for row in range(stage, len(rollout.ego_states)):
            step = rollout.start_step + row
            pose = rollout.ego_states[row, : HEADING + 1]
            boxes = Boxes(rollout.agents.boxes[row], rollout.agents.kinds)
            shapes = map_shapes(clip, min(step, clip.agents.n_steps - 1))
            yield draw_bev(pose, shapes, boxes, pose, ways, f"stage {stage + 1}  t = {step * 0.1 - 1.5:.1f} s", size_px)


# Pictures of stored samples, from the row alone: the world from above, and what the cameras saw.

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
    boxes = np.asarray(row["agent_boxes"], dtype=float).reshape(-1, AGENT_STEPS, 5)
    here = ego_poses(row)[step]
    paths = [*(_scored_paths(row, vocabulary) if vocabulary is not None else ()), *_paths_of_sample(row, logged)]
    if not legend:
        paths = [replace(path, label="") for path in paths]
    return draw_bev(here, shapes, Boxes(boxes[:, step], row["agent_kinds"]), here, paths, "", size_px)


def crop_to_60_m(image: Image) -> Image:
    """Of a square top-down picture the inner 60 m of 80 m, the ego staying at 6/10 of the height; the legend goes."""
    size = image.shape[0]
    top, side = round(0.6 * size / 4), size // 8
    return np.ascontiguousarray(image[top : top + 3 * size // 4, side : side + 3 * size // 4])


def ego_poses(row: Row) -> Array:
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


def _paths_of_sample(row: Row, logged: Array | None) -> list[DrawnPath]:
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


def front_camera(row: Row) -> str | None:
    """The camera with images that looks ahead; the first of the rig among those within 1 % of the straightest."""
    seen = {image["camera"] for image in row["images"] or ()}
    rig = [camera for camera in row["cameras"] or () if camera["name"] in seen]
    if not rig:
        return None
    return str(
        max(rig, key=lambda camera: round(float(np.reshape(camera["ego_from_camera"], (4, 4))[0, 2]), 2))["name"]
    )


def letterboxed(image: Image, width: int, height: int) -> Image:
    """The image scaled into width x height pixels, its aspect kept, padded with the background."""
    scale = min(width / image.shape[1], height / image.shape[0])
    size = (max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale)))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    sheet = np.full((height, width, 3), BACKGROUND, np.uint8)
    top, left = (height - size[1]) // 2, (width - size[0]) // 2
    sheet[top : top + size[1], left : left + size[0]] = small
    return sheet


def encode_image(image: Image, suffix: str = ".jpg") -> bytes:
    """RGB as the bytes of a JPEG (quality 85) or PNG file."""
    options = [cv2.IMWRITE_JPEG_QUALITY, 85] if suffix == ".jpg" else []
    done, data = cv2.imencode(suffix, cv2.cvtColor(image, cv2.COLOR_RGB2BGR), options)
    assert done, f"OpenCV cannot write {suffix}"
    return bytes(data)


def small_jpeg(image: Image, width: int) -> bytes:
    """RGB scaled to a width, as the bytes of a JPEG."""
    return encode_image(letterboxed(image, width, max(1, round(width * image.shape[0] / image.shape[1]))))


def sample_sheet(row: Row, logged: Array | None = None, bev_px: int = 720, vocabulary: Array | None = None) -> Image:
    """Top-down view and all cameras at now, side by side; up to three cameras in one column, more in two."""
    tiles = [_stored_image_tile(image) for image in images_at_now(row)] or [
        text_tile(f"no images: image_source is {row['image_source']}")
    ]
    return side_by_side(sample_bev(row, logged, (bev_px, bev_px), vocabulary), tiles)


def side_by_side(bev: Image, tiles: Sequence[Image]) -> Image:
    """A top-down view and tiles to the right of it, in one column up to three, else in two."""
    strip = tile_grid(tiles, 1 if len(tiles) <= 3 else 2)
    height = max(bev.shape[0], strip.shape[0])
    return np.concatenate([padded_to(part, height, part.shape[1]) for part in (bev, strip)], axis=1)


def tile_grid(tiles: Sequence[Image], columns: int) -> Image:
    """Tiles of one size, row by row, the last row filled up with background."""
    whole = [*tiles, *([np.full_like(tiles[0], BACKGROUND)] * (-len(tiles) % columns))]
    return np.concatenate([np.concatenate(whole[i : i + columns], axis=1) for i in range(0, len(whole), columns)])


def _stored_image_tile(image: Mapping[str, Any]) -> Image:
    try:
        return captioned_tile(decode_stored_image(image), f"{image['camera']}  {image['time_s']:+.1f} s")
    except ValueError as error:
        return text_tile(str(error))


def captioned_tile(pixels: Image, caption: str, size_px: tuple[int, int] = TILE_PX) -> Image:
    """A picture over its caption, with a margin; `size_px` width, height."""
    framed = np.full((size_px[1], size_px[0], 3), BACKGROUND, np.uint8)
    framed[4:-CAPTION_PX, 4:-4] = letterboxed(pixels, size_px[0] - 8, size_px[1] - CAPTION_PX - 4)
    return _written(framed, caption, size_px[1] - 7)


def text_tile(text: str) -> Image:
    """A tile of words."""
    return _written(np.full((TILE_PX[1], TILE_PX[0], 3), BACKGROUND, np.uint8), text[:60], TILE_PX[1] // 2)


def _written(picture: Image, text: str, baseline: int) -> Image:
    write_text(picture, text, (8, baseline), 0.42, INK)
    return picture


def padded_to(image: Image, height: int, width: int) -> Image:
    """The image with background below and to the right of it."""
    below, right = height - image.shape[0], width - image.shape[1]
    return np.asarray(cv2.copyMakeBorder(image, 0, below, 0, right, cv2.BORDER_CONSTANT, value=BACKGROUND))
