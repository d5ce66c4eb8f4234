"""Real photos of nuPlan's eight cameras as an OpenScene log: through `clips=navsim` they come out as they went in.

The log is ours: 16 instants with photos, two frames without before and after them, and a straight road under it all.
"""

import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest

from factory.datasets.navsim.log import CAMERA_NAMES
from factory.datasets.navsim.maps import open_city
from factory.datasets.navsim.reader import NavsimReader
from factory.readers.logs import WholeLog
from factory.stages.sensors import load_photos
from tasks.render.scene.sensed import Photo
from tasks.world.clip import CLIP_STEPS, NOW, AgentTracks, Camera, Clip
from tasks.world.road_map import TrafficLights
from tasks.world.roadblocks import route_of_roadblocks
from tests.factory.datasets.navsim.geopackage_writer import CITIES, ORIGIN, stub_rows, write_geopackage
from tests.factory.datasets.navsim.openscene_writer import FRAME_STEPS, Place, Sensed, write_openscene

pytestmark = pytest.mark.slow

CITY = "us-nv-las-vegas-strip"
START = np.array([ORIGIN[0] + 20.0, ORIGIN[1], 600.0])  # [m] of the first photo, on the road's first lane
BARE = 2  # frames without photos at either end
FIRST = 16  # the first instant's number
LOG = "2021.05.12.22.00.38_veh-35_01008_01518"


@dataclass(frozen=True)
class PhotoDrive:
    """What the folder of photos says of them."""

    folder: Path
    cameras: dict[str, Camera]
    poses: np.ndarray  # (16, 4, 4) ego in the world of the log

    def photo(self, camera: str, instant: int) -> bytes:
        return (self.folder / f"frame_{FIRST + instant}" / f"{camera}.jpg").read_bytes()


@pytest.fixture(scope="module")
def drive(shared_root: Path) -> PhotoDrive:
    folder = shared_root / "data" / "openscene_0101"
    told = json.loads((folder / "cameras.json").read_text())
    poses = np.array([frame["ego_to_world"] for frame in told["frames"]])
    poses[:, :3, 3] += START
    cameras = {}
    for name, row in told["cameras"].items():
        mount = np.eye(4)
        mount[:3, :3], mount[:3, 3] = row["cam_to_ego"]["R"], row["cam_to_ego"]["t"]
        arrays = np.array(row["K"], np.float64), np.array(row["dist_k1k2p1p2k3"], np.float64), mount
        cameras[name] = Camera(name, told["width"], told["height"], *arrays)
    return PhotoDrive(folder, cameras, poses)


@pytest.fixture(scope="module")
def clip(drive: PhotoDrive, tmp_path_factory: pytest.TempPathFactory) -> Clip:
    root = tmp_path_factory.mktemp("openscene")
    version, zone = CITIES[CITY]
    write_geopackage(root / "maps" / CITY / version / "map.gpkg", stub_rows(), zone)
    steps = [pose for pose in _with_bare_ends(drive.poses) for _ in range(FRAME_STEPS)][:CLIP_STEPS]
    images = {(name, BARE + k): drive.photo(name, k) for name in CAMERA_NAMES for k in range(len(drive.poses))}
    sensed = Sensed(tuple(drive.cameras[name] for name in CAMERA_NAMES), images)
    log = _log_on_the_road(root / "maps", np.stack(steps))
    write_openscene(root, "mini", LOG, log, Place(CITY, np.zeros(3)), sensed, np.stack(steps))
    blobs = root / "sensor_blobs" / "mini"
    reader = NavsimReader(root / "navsim_logs" / "mini", root / "maps", sensors=str(blobs), cache_dir=root / "kept")
    (ref,) = reader.index().refs
    return reader.read(ref)


def _with_bare_ends(poses: np.ndarray) -> np.ndarray:
    """Two more at either end, as far apart as the first two and the last two."""
    before = np.repeat(poses[:1], BARE, axis=0)
    after = np.repeat(poses[-1:], BARE, axis=0)
    for k in range(BARE):
        before[k, :3, 3] -= (BARE - k) * (poses[1] - poses[0])[:3, 3]
        after[k, :3, 3] += (k + 1) * (poses[-1] - poses[-2])[:3, 3]
    return np.concatenate([before, poses, after])


def _log_on_the_road(maps: Path, poses: np.ndarray) -> WholeLog:
    """An ego alone, at these poses."""
    states = np.zeros((len(poses), 11))
    states[:, :2], states[:, 2], states[:, 3] = poses[:, :2, 3], np.arctan2(poses[:, 1, 0], poses[:, 0, 0]), 6.0
    nobody = np.zeros((len(poses), 0))
    boxes, velocities = np.zeros((len(poses), 0, 5)), np.zeros((len(poses), 0, 2))
    agents = AgentTracks((), (), boxes, velocities, nobody.astype(bool), nobody, np.zeros(0))
    road_map = open_city(maps, CITY).road_map(states[:, :2], 100.0)[0]
    route = route_of_roadblocks(road_map, ["31", "33", "32"], states[NOW, :3])
    return WholeLog("photos", states, agents, road_map, route, TrafficLights((), nobody.astype(np.int8)), "", "")


def _opened(clip: Clip, name: str, instant: int) -> tuple[Photo, np.ndarray]:
    """The photo as the scene engine gets it, and as it lies on disk (H, W, 3)."""
    (image,) = (i for i in clip.images if i.sensor == name and round(i.time_s / 0.5) == BARE + instant)
    (photo,) = load_photos([image], clip.cameras, 1920, 1080)
    return photo, cv2.imread(image.uri)[..., ::-1]


@pytest.mark.parametrize("name", ["CAM_F0", "CAM_R2"])
def test_an_opened_photo_is_opencv_s_undistorted_one(clip: Clip, drive: PhotoDrive, name: str) -> None:
    camera = drive.cameras[name]
    photo, raw = _opened(clip, name, 5)
    centres_at_0 = camera.intrinsics - np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]])
    theirs = cv2.undistort(raw, centres_at_0, camera.distortion)
    apart = np.abs(photo.rgb.astype(int) - theirs)
    assert apart.max() <= 2 and apart.mean() < 0.1
    assert np.abs(raw.astype(int) - theirs).mean() > 3.0, "the lens bends the picture"
    assert (photo.intrinsics == camera.intrinsics).all()


def test_a_point_of_the_street_is_where_the_pinhole_sees_it(clip: Clip, drive: PhotoDrive) -> None:
    """Through the lens on disk and through the pinhole in the opened photo: the same colour."""
    points = np.load(drive.folder / "sfm_points.npz")["xyz"] + START
    for name in ("CAM_F0", "CAM_L2", "CAM_B0"):
        photo, raw = _opened(clip, name, 6)
        camera = drive.cameras[name]
        world_from_camera = drive.poses[6] @ camera.ego_from_camera
        local = (points - world_from_camera[:3, 3]) @ world_from_camera[:3, :3]
        seen = (local[:, 2] > 3.0) & (np.abs(local[:, :2]) < local[:, 2:] * [0.55, 0.3]).all(axis=1)
        local = local[seen]
        lens, _ = cv2.projectPoints(local, np.zeros(3), np.zeros(3), camera.intrinsics, camera.distortion)
        flat = local / local[:, 2:] @ camera.intrinsics.T
        a, b = _at(raw, lens[:, 0]), _at(photo.rgb, flat[:, :2])
        assert len(a) > 500 and np.median(np.abs(a - b)) < 0.5 and np.percentile(np.abs(a - b), 95) < 4.0, name
        assert np.median(np.abs(a - _at(raw, flat[:, :2]))) > 5.0, "the lens bends the picture"


def _at(image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Colours (N, 3) at pixels (N, 2), the centre of the first at (0.5, 0.5)."""
    x, y = (pixels - 0.5).astype(np.float32).T
    return np.asarray(cv2.remap(image.astype(np.float32), x, y, cv2.INTER_LINEAR).reshape(-1, 3))
