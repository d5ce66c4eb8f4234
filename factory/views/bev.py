"""Top-down pictures: map, agents and trajectories, drawn with OpenCV in a couple of milliseconds; films of pictures."""

import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from tasks.attempt import Judged
from tasks.perturb import Candidate, Considered
from tasks.world.arrays import Array, Bytes, Image, ShortInts
from tasks.world.clip import NOW, AgentKind, Clip
from tasks.world.frames import HEADING, PACIFICA, box_corners, points_to_local
from tasks.world.geometry import ego_boxes
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
    ways = _ways(clip, candidate, judged, "expert (simulated)")
    return draw_bev(pose, map_shapes(clip, step), Boxes(boxes, kinds), pose, ways, title, size_px)


def _ways(clip: Clip, candidate: Candidate | None, judged: Judged | None, expert: str) -> list[DrawnPath]:
    ways = [DrawnPath(clip.ego_states[NOW:, : HEADING + 1], LOGGED, "logged", dashed=True)]
    if candidate is not None:
        ways.append(DrawnPath(candidate.rollout.ego_states, PERTURBED, "perturbed"))
    if judged is not None:
        ways.append(DrawnPath(judged.rollout.ego_states, EXPERT, expert))
    return ways


def candidates_picture(clip: Clip, considered: Considered, size_px: tuple[int, int] = (720, 720)) -> Image:
    """End poses of all gated trajectories around the logged pose at T+H, coloured by what became of them."""
    import cv2

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
        write(image, f"{fate} {count}", (24, height - 10 - 16 * row))
    return image


def film(clip: Clip, candidate: Candidate, judged: Judged, size_px: tuple[int, int] = (480, 480)) -> Iterator[Image]:
    """Both rollouts at 10 Hz, T .. T+2H, one picture a step."""
    ways = _ways(clip, candidate, judged, "expert")
    for stage, rollout in enumerate((candidate.rollout, judged.rollout)):
        for row in range(stage, len(rollout.ego_states)):
            step = rollout.start_step + row
            pose = rollout.ego_states[row, : HEADING + 1]
            boxes = Boxes(rollout.agents.boxes[row], rollout.agents.kinds)
            shapes = map_shapes(clip, min(step, clip.agents.n_steps - 1))
            yield draw_bev(pose, shapes, boxes, pose, ways, f"stage {stage + 1}  t = {step * 0.1 - 1.5:.1f} s", size_px)
