"""Top-down pictures: map, agents and trajectories, drawn with OpenCV in a couple of milliseconds; films of pictures."""

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from tasks.world.agents import AgentKind
from tasks.world.arrays import Array, Bytes, ShortInts
from tasks.world.frames import box_corners, points_to_local
from tasks.world.geometry import ego_boxes
from tasks.world.vehicle import PACIFICA

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
    _captions(image, title, paths)
    return image


def _polyline(image: Bytes, points: ShortInts, path: DrawnPath) -> None:
    every, length = (4, 3) if path.dashed else (len(points), len(points))
    for start in range(0, len(points) - 1, every):
        piece = points[start : start + length]
        cv2.polylines(image, [piece], False, path.colour, path.width_px, cv2.LINE_AA, _SHIFT)


def _captions(image: Bytes, title: str, paths: Sequence[DrawnPath]) -> None:
    height = image.shape[0]
    write(image, title, (8, 18), 0.42)
    for row, path in enumerate(path for path in paths if path.label):
        y = height - 10 - 16 * row
        cv2.line(image, (8, y - 4), (26, y - 4), path.colour, 3, cv2.LINE_AA)
        write(image, path.label, (32, y))


def write(image: Bytes, text: str, at: tuple[int, int], size: float = 0.4, colour: Colour = (20, 20, 20)) -> None:
    """A line of text into the picture."""
    cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, colour, 1, cv2.LINE_AA)


def write_mp4(path: "os.PathLike[str]", frames: Iterable[Bytes], frames_per_s: int = 10) -> None:
    """RGB frames (height, width, 3), even sizes, as H.264 that browsers play. Raises ValueError without frames."""
    import av

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
