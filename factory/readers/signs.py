"""What gives away that a log's calibration, poses or stamps mean something else: numbers that pass every other check.

Each function says what it saw, with its number, and what helps; None: nothing gives it away. Numbers beside the limits
are those of 26 real cameras and ten real logs (Argoverse 2, nuPlan, nuScenes).
"""

import numpy as np

from tasks.world.arrays import Array, Ints
from tasks.world.clip import STEP_S, Camera
from tasks.world.frames import HEADING, PACIFICA, X, Y, wrap_angle
from tasks.world.road_map import RoadMap

# Cameras

MOST_TILT_RAD = np.radians(60.0)  # between the image's top and the vertical; 3 deg
BESIDE_VEHICLE_M = 2.0  # around the Pacifica's box, which leaves room for a truck; all cameras are within it
LOW_M, HIGH_M = -0.5, 4.5  # above the rear axle; 1.2 to 1.5
LEAST_M = 0.4  # from the rear axle, of one that is thought to be in another unit; 1.4
NARROW, WIDE = 0.1, 20.0  # focal length in image widths; 0.8 to 1.2. 0.1 is 157 deg, 20 is 3 deg
OFF_CENTRE = 0.2  # of width and height, the principal point in both; 0.02


def camera_sign(camera: Camera) -> str | None:
    """Of a camera that looks at the sky or the ground, lies on its side, stands beside the car, or has another K."""
    pose = camera.ego_from_camera
    if not _is_upright(pose):
        elevation = float(np.degrees(np.arcsin(np.clip(pose[2, 2], -1.0, 1.0))))
        tilt = float(np.degrees(np.arccos(np.clip(-pose[2, 1], -1.0, 1.0))))
        looks = f"looks at the {'sky' if elevation > 0.0 else 'ground'}, {elevation:.0f} deg above the horizon"
        said = looks if abs(elevation) > np.degrees(MOST_TILT_RAD) else f"its image's top is {tilt:.0f} deg off upright"
    elif not _is_on_vehicle(pose[:3, 3]):
        said = _place_sign(pose[:3, 3])
    else:
        return _intrinsics_sign(camera)
    inverse = np.asarray(np.linalg.inv(pose), np.float64)
    if _is_upright(inverse) and _is_on_vehicle(inverse[:3, 3]):
        said += ", its inverse would be right"
    return f"{said}: expected ego from camera, in metres, camera x right, y down, z forward"


def _is_upright(pose: Array) -> bool:
    return bool(-pose[2, 1] >= np.cos(MOST_TILT_RAD))


def mount_sign(mount: Array) -> str | None:
    """Of a lidar (4, 4) on the ego that stands beside the car; its axes may be any."""
    if _is_on_vehicle(mount[:3, 3]):
        return None
    return f"{_place_sign(mount[:3, 3])}: expected ego from lidar, in metres"


def _is_on_vehicle(place: Array) -> bool:
    x, y, z = place
    along = abs(x - PACIFICA.rear_axle_to_center) <= PACIFICA.half_length + BESIDE_VEHICLE_M
    return bool(along and abs(y) <= PACIFICA.half_width + BESIDE_VEHICLE_M and LOW_M <= z <= HIGH_M)


def _place_sign(place: Array) -> str:
    x, y, z = place
    said = f"stands {x:,.1f} m ahead, {y:,.1f} m left and {z:,.1f} m above the rear axle, not on the vehicle"
    for unit, metres in (("centimetres", 0.01), ("millimetres", 0.001)):
        if np.linalg.norm(place * metres) > LEAST_M and _is_on_vehicle(place * metres):
            return f"{said}, which it were in {unit}"
    return said


def _intrinsics_sign(camera: Camera) -> str | None:
    k = camera.intrinsics
    focal = k[0, 0] / camera.width
    if not NARROW <= focal <= WIDE:
        fov = 2.0 * np.degrees(np.arctan(0.5 / focal))
        said = f"a focal length of {k[0, 0]:,.3g} px in an image {camera.width} px wide sees {fov:.0f} deg"
        return f"{said}: expected pixels of this image"
    off = np.abs([k[0, 2] / camera.width - 0.5, k[1, 2] / camera.height - 0.5])
    if off.min() > OFF_CENTRE:
        said = f"the principal point ({k[0, 2]:,.0f}, {k[1, 2]:,.0f}) px is far off the centre of the image"
        return f"{said}, {camera.width} x {camera.height} px: expected the intrinsics of images of this size"
    return None


# Poses

FAR_M = 100.0  # of a whole drive from any lane, and of two poses at one instant
MOVING_MPS, MOVING_STEPS = 1.0, 10
OFF_MOTION_RAD = 0.35  # of headings, the median of the steps that move; 0.003 to 0.016
REVERSING_MPS = 5.0  # faster, nobody drives backwards
FASTEST_MPS = 80.0


def motion_sign(ego_states: Array) -> str | None:
    """Of an ego (S, 11), every 0.1 s, whose headings are not along its motion, or whose places are in another unit."""
    moved, headings = np.diff(ego_states[:, [X, Y]], axis=0), ego_states[:, HEADING]
    speeds = np.hypot(*moved.T) / STEP_S
    moving = speeds > MOVING_MPS  # false next to absent steps
    if moving.sum() < MOVING_STEPS:
        return None
    if (usual := float(np.median(speeds[moving]))) > FASTEST_MPS:
        return f"the ego drives at {usual:,.0f} m/s (median): expected places in metres and stamps of the right unit"
    between = headings[:-1] + wrap_angle(np.diff(headings)) / 2.0
    off = float(np.median(np.abs(wrap_angle(np.arctan2(moved[:, 1], moved[:, 0]) - between))[moving]))
    if off <= OFF_MOTION_RAD or (off >= np.pi - OFF_MOTION_RAD and speeds[moving].max() <= REVERSING_MPS):
        return None
    said = f"headings are {np.degrees(off):.0f} deg off the direction of motion (median of {moving.sum()} steps)"
    expected = "expected radians from x, counter-clockwise, of the ego's axis that points forward"
    return f"{said}: {expected}; are they degrees, clockwise, or of a quaternion in another order?"


def place_sign(world_from_ego: Array, ego_states: Array) -> str | None:
    """Of poses in space (S, 4, 4) that are elsewhere than the ego (S, >= 2) at the same instants."""
    apart = float(np.hypot(*(world_from_ego[:, :2, 3] - ego_states[:, :2]).T).max())
    if apart <= FAR_M:
        return None
    return f"up to {apart:,.0f} m from where ego_states have the ego: expected its poses in the same world frame"


def map_sign(poses: Array, road_map: RoadMap) -> str | None:
    """Of a drive (S, >= 2) [m] that lies nowhere near a lane of its map."""
    if not len(poses) or not road_map.lanes:
        return None
    places, lanes = poses[::10, :2], np.concatenate([lane.centerline[:, :2] for lane in road_map.lanes.values()])
    away = min(float(np.hypot(*(lanes - place).T).min()) for place in places)
    if away <= FAR_M:
        return None
    return (
        f"the drive ({_extent(poses)}) is nowhere nearer than {away:,.0f} m to a lane of the map ({_extent(lanes)}): "
        "its poses are in another frame or unit than the map"
    )


def _extent(points: Array) -> str:
    (x0, y0), (x1, y1) = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    return f"x {x0:,.0f} to {x1:,.0f}, y {y0:,.0f} to {y1:,.0f} m"


# Stamps

UNITS_S = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
LEAST_APART_S, MOST_APART_S = 2e-3, 5.0  # of poses, frames and photos; 6e-3 to 0.6
USUAL_APART_S = 0.1


def stamps_sign(stamps: Array | Ints, unit: str) -> str | None:
    """Of stamps (n,) that come at an impossible rate in their unit, "s" to "ns", and at a usual one in another."""
    apart = np.diff(np.unique(stamps))
    if not len(apart):
        return None
    usual = float(np.median(apart))
    if LEAST_APART_S <= usual * UNITS_S[unit] <= MOST_APART_S:
        return None
    others = [name for name, unit_s in UNITS_S.items() if LEAST_APART_S <= usual * unit_s <= MOST_APART_S]
    if not others:
        return None
    other = min(others, key=lambda name: abs(np.log(usual * UNITS_S[name] / USUAL_APART_S)))
    said = f"stamps are {usual * UNITS_S[unit]:.3g} s apart, and {usual * UNITS_S[other]:.3g} s if they were in {other}"
    return f"{said}: expected {unit}"
