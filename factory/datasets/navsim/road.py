"""The road around a drive in NAVSIM's frames, from nuPlan's maps."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from factory.datasets.navsim.log import Frame
from factory.datasets.navsim.maps import open_city
from factory.readers.base import BadClip
from factory.readers.pictures import BadPicture, Size, jpeg_size
from tasks.world.arrays import Array
from tasks.world.clip import Camera, SensorFile
from tasks.world.road_map import NoRoute, RoadMap, Route, RouteFinder
from tasks.world.roadblocks import corrected_roadblocks, route_of_roadblocks

MAP_RADIUS_M = 150.0  # around the drive: the reward's 100 m, and room for one that strays


@dataclass(frozen=True)
class RoadAhead:
    """The map around a drive and the way through it."""

    road_map: RoadMap
    route: Route
    centerline: Array  # (P, 3) from the lane of the pose at T along the route


def road_around(maps: Path, frame: Frame, along_xy: Array, pose: Array, file: str, number: int) -> RoadAhead:
    """The map around the drive (S, 2) and along its route; the route and its centre line from `pose` (3,) at `frame`.

    Lights count on the lanes of the log's own roadblocks, before the route is mended: the public metric cache
    gathers the one and the other so (metric_cache_processor.py, `_load_route_dicts` and `_build_pdm_observation`).
    file, number: of the frame there. Raises BadClip, which names both.
    """
    city = open_city(maps, frame.map_location)
    blocks = city.roadblocks
    try:
        passed = corrected_roadblocks(blocks, frame.roadblock_ids, pose)
        own = [block for block in frame.roadblock_ids if block in blocks.lanes_of]
        lit = frozenset(lane_id for block in own for lane_id in blocks.lanes_of[block])
        along = [lane_id for block in passed for lane_id in blocks.lanes_of.get(block, ())]
        road_map = city.road_map(along_xy, MAP_RADIUS_M, along)
        route = replace(route_of_roadblocks(road_map, frame.roadblock_ids, pose, blocks), lit_lane_ids=lit)
        return RoadAhead(road_map, route, RouteFinder(road_map, route).centerline_from(pose))
    except NoRoute as error:
        raise BadClip(file, f"frames[{number}].roadblock_ids", str(error)) from error


# The eight cameras of a frame as a clip's rig, and the blobs of frames as sensor files.
#
# NAVSIM's pictures are distorted and its K is that of the distorted picture. The factory keeps both in `Camera`, and
# whoever opens a photo takes the distortion out (`tasks.render.views.undistorted`), so scenes are built of pinholes.
#
# A download may hold the pictures of a few frames only: navtrain's current and history archives have none of the
# future. So a frame none of whose blobs is there has no pictures. A frame that has some and lacks others was damaged.

LIDAR = "lidar"
FRAME_S = 0.5


@dataclass(frozen=True)
class Blobs:
    """What the sensors of a run of frames recorded and is on disk."""

    images: tuple[SensorFile, ...]
    sweeps: tuple[SensorFile, ...]


def blobs_of(frames: Sequence[Frame], folder: Path) -> Blobs:
    """The pictures and sweeps below `folder` of frames 0.5 s apart, times from the first. Raises BadClip."""
    images: list[SensorFile] = []
    sweeps: list[SensorFile] = []
    for k, frame in enumerate(frames):
        files = {camera.name: _below(folder, camera.path) for camera in frame.cameras}
        there = {name: path for name, path in files.items() if path.is_file()}
        if there and (missing := [path for name, path in files.items() if name not in there]):
            problem = f"missing, though {len(there)} of the frame's {len(files)} pictures are there"
            raise BadClip(str(missing[0]), "image", f"{problem}: restore it, or remove them all")
        images += [SensorFile(name, str(path), FRAME_S * k, frame.world_from_ego) for name, path in there.items()]
        if frame.lidar_path is not None and (sweep := _below(folder, frame.lidar_path)).is_file():
            sweeps.append(SensorFile(LIDAR, str(sweep), FRAME_S * k, frame.world_from_ego))
    return Blobs(tuple(images), tuple(sweeps))


def rig_of(frame: Frame, images: Sequence[SensorFile], file: str) -> tuple[Camera, ...]:
    """The cameras of a frame that took any of the `images`, whose first tells their size. Raises BadClip."""
    first: dict[str, str] = {}
    for image in images:
        first.setdefault(image.sensor, image.uri)
    cameras = []
    for camera in frame.cameras:
        if camera.name in first:
            width, height = _jpeg_size(Path(first[camera.name]))
            try:
                cameras.append(
                    Camera(camera.name, width, height, camera.intrinsics, camera.distortion, camera.ego_from_camera)
                )
            except ValueError as error:
                raise BadClip(file, f"cams.{camera.name}", str(error)) from error
    return tuple(cameras)


def _jpeg_size(path: Path) -> Size:
    """Raises BadClip."""
    try:
        return jpeg_size(path.read_bytes())
    except OSError as error:
        raise BadClip(str(path), "image", f"cannot be read: {error.strerror}") from error
    except BadPicture as error:
        raise BadClip(str(path), error.field, str(error)) from error


def _below(folder: Path, path: str) -> Path:
    """A path of the log, which may not lead out of the folder of blobs. Raises BadClip."""
    if Path(path).is_absolute() or ".." in Path(path).parts:
        raise BadClip(str(folder), path, "a log's sensor paths lie below the folder of sensor blobs")
    return folder / path
