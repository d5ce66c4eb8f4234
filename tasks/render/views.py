"""What the rig sees from poses nobody drove, with the agents where the simulation put them."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np

from tasks.render.scene.asset import Instant, OwnBody, Reach, RenderAsset
from tasks.render.scene.engine import render_pictures
from tasks.render.scene.movers import agents_at_time
from tasks.render.settings import Backend
from tasks.world.arrays import Array, Bytes
from tasks.world.clip import STEP_S, AgentKind, AgentTracks, Camera, Fisheye, Pinhole
from tasks.world.frames import box_corners
from tasks.world.road_map import RoadMap

VISIBLE_M = 150.0  # agents further away are not drawn


def render_views(
    asset: RenderAsset,
    cameras: Sequence[Camera],
    world_from_ego: Array,
    agents: AgentTracks,
    steps: Sequence[float],
    width: int,
    height: int,
    backend: Backend = Backend.CPU,
) -> Iterator[Bytes]:
    """Images (C, height, width, 3) rgb of one instant after the other; a GPU draws the next ones meanwhile.

    `world_from_ego` (F, 4, 4) in 3-D (`pose_on_ground`), `steps` (F,) rows of `agents` at these instants, or between
    two. The images are those of ideal pinholes, `camera.resized(width, height)` with distortion zero: photos are
    undistorted before they enter the scene. Each camera shows the scene in its own colours at that time, step 0 being
    the scene's 0 (`RenderAsset.since`), and before it what it sees of the car that carries it.
    Raises BackendMissing where the backend cannot work on this machine.
    """
    asked = instants_of_views(asset, cameras, world_from_ego, agents, steps, width, height)
    return render_pictures(asset, *asked, backend)


def instants_of_views(
    asset: RenderAsset,
    cameras: Sequence[Camera],
    world_from_ego: Array,
    agents: AgentTracks,
    steps: Sequence[float],
    width: int,
    height: int,
    reach_m: float | None = None,
) -> tuple[list[Instant], list[OwnBody | None]]:
    """What `render_views` draws: one instant a pose, and what each camera sees of its own car.

    reach_m: of the background and of agents what is nearer to the ego; None: all, and agents as far as VISIBLE_M.
    """
    rig, instants = [camera.resized(width, height) for camera in cameras], []
    for pose, step in zip(world_from_ego, steps, strict=True):
        affines = [asset.affine_of(camera.name, step * STEP_S) for camera in cameras]
        there = agents_at_time(agents, step * STEP_S, pose[:2, 3], VISIBLE_M if reach_m is None else reach_m)
        eyes = [Pinhole(c.intrinsics, pose @ c.ego_from_camera, width, height) for c in rig]
        instants.append(Instant(eyes, there, affines, None if reach_m is None else Reach(pose[:3, 3], reach_m)))
    return instants, [asset.own_body(camera.name) for camera in cameras]


def undistorted(image: Bytes, camera: Camera) -> Bytes:
    """The photo (H, W, 3), or a mask of it (H, W), that an ideal pinhole of the same intrinsics would have taken.

    Outside of the photo: edge colours.

    `Camera.distortion` is Brown's model as OpenCV has it. Where an ideal pinhole sees x, y over depth, the lens shows
    x s + 2 p1 x y + p2 (r2 + 2 x^2), y s + p1 (r2 + 2 y^2) + 2 p2 x y with s = 1 + k1 r2 + k2 r2^2 + k3 r2^3.
    """
    if not np.any(camera.distortion):
        return image
    height, width = image.shape[:2]
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    fx, fy, cx, cy = (camera.intrinsics[i, j] for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    x, y = (u - cx) / fx, (v - cy) / fy
    r2 = x * x + y * y
    k1, k2, p1, p2, k3 = camera.distortion
    stretch = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    seen_x = x * stretch + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    seen_y = y * stretch + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    map_x, map_y = (fx * seen_x + cx - 0.5).astype(np.float32), (fy * seen_y + cy - 0.5).astype(np.float32)
    return np.asarray(cv2.remap(image, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.uint8)


def straightened(image: Bytes, lens: Fisheye) -> Bytes:
    """A fisheye's photo (H, W, 3), or a mask of it (H, W), as a pinhole of the same intrinsics takes it."""
    to_first_centre = np.array([[1.0, 0.0, -0.5], [0.0, 1.0, -0.5], [0.0, 0.0, 1.0]])  # OpenCV's pixels begin there
    k, size = to_first_centre @ lens.intrinsics, (image.shape[1], image.shape[0])
    maps = cv2.fisheye.initUndistortRectifyMap(k, lens.terms, np.eye(3), k, size, cv2.CV_32FC1)
    return np.asarray(cv2.remap(image, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.uint8)


# render=map: lanes, paint, crossings and boxes in perspective on plain ground. A drawing, not a photo, and marked so.
#
# The ground is a plane parallel to the ego's own, at the height of the lane boundaries around it; where the map has
# no heights, the plane through the ego's origin.

NEAR_M = 0.3
DRAWN_M = 90.0
NEAR_GROUND_M = 15.0
SHIFT = 4  # cv2 draws with 1/16 pixel
PAINT_WIDTH_M = 0.15
DASH_M, GAP_M = 3.0, 6.0
SKY, GROUND, ROAD, CROSSING = (176, 196, 216), (122, 130, 112), (84, 84, 88), (150, 150, 152)
WHITE, YELLOW, EDGE = (232, 232, 228), (214, 176, 60), (108, 108, 110)
BOX = {AgentKind.VEHICLE: (70, 100, 150), AgentKind.PEDESTRIAN: (190, 80, 70), AgentKind.BICYCLE: (200, 140, 60)}
OTHER_BOX = (150, 110, 150)


def draw_map_views(
    road_map: RoadMap,
    cameras: Sequence[Camera],
    world_from_ego: Array,
    agents: AgentTracks,
    steps: Sequence[int],
    width: int,
    height: int,
) -> Bytes:
    """Images (F, C, height, width, 3) rgb; arguments as `tasks.render.views.render_views`."""
    out = np.empty((len(steps), len(cameras), height, width, 3), np.uint8)
    for f, step in enumerate(steps):
        pose = world_from_ego[f].copy()
        pose[:3, 3] += ground_height(road_map, pose) * pose[:3, 2]
        ground, faces = _ground_shapes(road_map, pose), _box_faces(agents, step, pose)
        for c, camera in enumerate(cameras):
            mount = camera.resized(width, height)
            lifted = np.linalg.inv(pose) @ world_from_ego[f] @ mount.ego_from_camera
            out[f, c] = _draw(ground, faces, replace(mount, ego_from_camera=lifted))
    return out


def ground_height(road_map: RoadMap, world_from_ego: Array) -> float:
    """Height [m] of the road over the ego's origin, along the ego's up axis: Argoverse 2 counts from the rear axle.

    Median over the lane boundaries within NEAR_GROUND_M; 0 where none has heights (all z are the same 0) or none is
    near.
    """
    lines = [line for lane in road_map.lanes.values() for line in (lane.left_boundary, lane.right_boundary)]
    points = np.concatenate([np.zeros((0, 3)), *(line for line in lines if line is not None and line.shape[1] == 3)])
    if not points[:, 2].any():
        return 0.0
    offsets = points - world_from_ego[:3, 3]
    near = np.hypot(offsets[:, 0], offsets[:, 1]) < NEAR_GROUND_M
    return float(np.median(offsets[near] @ world_from_ego[:3, 2])) if near.any() else 0.0


Shape = tuple[Array, tuple[int, int, int]]  # polygon (M, 3) in the ego frame, colour


def _ground_shapes(road_map: RoadMap, pose: Array) -> list[Shape]:
    """Everything painted on the ground, bottom first."""
    shapes: list[Shape] = []
    for ring in road_map.road_rings:
        shapes.append((_on_ground(ring, pose), ROAD))
    lanes = [lane for lane in road_map.lanes.values() if _near(lane.centerline[:, :2], pose)]
    shapes.extend((_on_ground(lane.ring, pose), ROAD) for lane in lanes)
    shapes.extend((_on_ground(ring, pose), CROSSING) for ring in road_map.crossings if _near(ring, pose))
    for lane in lanes:
        for boundary, mark in ((lane.left_boundary, lane.left_mark), (lane.right_boundary, lane.right_mark)):
            if boundary is None or lane.is_intersection:
                continue
            colour = YELLOW if "YELLOW" in mark else (WHITE if "WHITE" in mark else EDGE)
            line = _on_ground(boundary[:, :2], pose)
            shapes.extend((piece, colour) for piece in _paint(line, dashed="DASH" in mark))
        if lane.left_boundary is None:
            shapes.extend((piece, EDGE) for piece in _paint(_on_ground(lane.ring, pose), dashed=False))
    return shapes


def _near(points: Array, pose: Array) -> bool:
    return bool((np.linalg.norm(points[:, :2] - pose[:2, 3], axis=1) < DRAWN_M).any())


def _on_ground(points: Array, pose: Array) -> Array:
    """World points (M, 2) on the ego's own ground plane, ego frame (M, 3)."""
    up = pose[:3, 2]
    offset = points[:, :2] - pose[:2, 3]
    rise = -(offset * up[:2]).sum(axis=1) / up[2]
    return np.asarray(np.column_stack([offset, rise]) @ pose[:3, :3])


def _paint(line: Array, dashed: bool) -> list[Array]:
    """Quads (4, 3) along a polyline (M, 3); dashes of 3 m every 9 m."""
    pieces = []
    travelled = 0.0
    for a, b in pairwise(line):
        length = float(np.linalg.norm(b - a))
        if length < 1e-6:
            continue
        along = (b - a) / length
        side = np.array([-along[1], along[0], 0.0]) * PAINT_WIDTH_M / 2.0
        start = 0.0
        while start < length:
            if dashed:
                phase = (travelled + start) % (DASH_M + GAP_M)
                stop = min(length, start + (DASH_M - phase if phase < DASH_M else DASH_M + GAP_M - phase))
                painted = phase < DASH_M - 1e-9
            else:
                stop, painted = length, True
            if painted:
                p, q = a + along * start, a + along * stop
                pieces.append(np.stack([p + side, q + side, q - side, p - side]))
            start = max(stop, start + 1e-6)
        travelled += length
    return pieces


def _box_faces(agents: AgentTracks, step: int, pose: Array) -> list[Shape]:
    """Shaded faces of the boxes that are there, ego frame."""
    faces: list[Shape] = []
    valid = agents.valid[step]
    corners = box_corners(agents.boxes[step])
    for j in np.flatnonzero(valid):
        if not _near(agents.boxes[step, j : j + 1, :2], pose):
            continue
        bottom = _on_ground(corners[j], pose)
        top = bottom + np.array([0.0, 0.0, agents.heights[j]])
        colour = BOX.get(agents.kinds[j], OTHER_BOX)
        for k, light in enumerate((0.75, 0.6, 0.75, 0.9)):  # left, rear, right, front as corners run FL, RL, RR, FR
            n = (k + 1) % 4
            shaded = (int(colour[0] * light), int(colour[1] * light), int(colour[2] * light))
            faces.append((np.stack([bottom[k], bottom[n], top[n], top[k]]), shaded))
        faces.append((top, colour))
    return faces


def _draw(ground: list[Shape], faces: list[Shape], camera: Camera) -> Bytes:
    image = np.empty((camera.height, camera.width, 3), np.uint8)
    image[:] = SKY
    camera_from_ego: Array = np.linalg.inv(camera.ego_from_camera).astype(np.float64)
    far = 2000.0
    plane = np.array([[far, far, 0.0], [-far, far, 0.0], [-far, -far, 0.0], [far, -far, 0.0]])
    for polygon, colour in [(plane, GROUND), *ground]:
        _fill(image, polygon, colour, camera, camera_from_ego)
    position = camera.ego_from_camera[:3, 3]
    for polygon, colour in sorted(faces, key=lambda face: -float(np.linalg.norm(face[0].mean(axis=0) - position))):
        _fill(image, polygon, colour, camera, camera_from_ego)
    return image


def _fill(image: Bytes, polygon: Array, colour: tuple[int, int, int], camera: Camera, camera_from_ego: Array) -> None:
    seen = clip_near(polygon @ camera_from_ego[:3, :3].T + camera_from_ego[:3, 3])
    if len(seen) < 3:
        return
    k = camera.intrinsics
    u = k[0, 0] * seen[:, 0] / seen[:, 2] + k[0, 2]
    v = k[1, 1] * seen[:, 1] / seen[:, 2] + k[1, 2]
    # cv2 counts pixel centres from 0 and overflows far outside the picture.
    pixels = np.clip(np.stack([u, v], axis=1) - 0.5, -30000.0, 30000.0)
    points = np.rint(pixels * (1 << SHIFT)).astype(np.int32)
    cv2.fillPoly(image, [points], colour, lineType=cv2.LINE_AA, shift=SHIFT)


def clip_near(polygon: Array) -> Array:
    """The part of a polygon (M, 3), camera frame, beyond the near plane (Sutherland and Hodgman 1974)."""
    z = polygon[:, 2]
    if (z >= NEAR_M).all():
        return polygon
    out = []
    for i in range(len(polygon)):
        a, b = polygon[i - 1], polygon[i]
        if (a[2] >= NEAR_M) != (b[2] >= NEAR_M):
            out.append(a + (b - a) * (NEAR_M - a[2]) / (b[2] - a[2]))
        if b[2] >= NEAR_M:
            out.append(b)
    return np.array(out).reshape(-1, 3)


# Named camera rigs, for clips that have no calibrated cameras of their own (render=map).

HEIGHT_M = 1.6  # of every camera above the ground; all sit above the rear axle's x + 1.5 m


def pinhole(name: str, yaw_deg: float, field_of_view_deg: float, width: int = 640, height: int = 360) -> Camera:
    """A level camera that looks `yaw_deg` to the left of the ego's heading."""
    yaw = np.radians(yaw_deg)
    focal = width / 2.0 / np.tan(np.radians(field_of_view_deg) / 2.0)
    ego_from_camera = np.eye(4)
    forward = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    down = np.array([0.0, 0.0, -1.0])
    ego_from_camera[:3, :3] = np.stack([np.cross(down, forward), down, forward], axis=1)
    ego_from_camera[:3, 3] = [1.5, 0.0, HEIGHT_M]
    intrinsics = np.array([[focal, 0.0, width / 2.0], [0.0, focal, height / 2.0], [0.0, 0.0, 1.0]])
    return Camera(name, width, height, intrinsics, np.zeros(5), ego_from_camera)


MAP_RIG = (pinhole("front_left", 55.0, 70.0), pinhole("front", 0.0, 70.0), pinhole("front_right", -55.0, 70.0))
