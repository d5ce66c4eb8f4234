"""What 123D converted, read without it: the same clips as its source's own reader, whatever data set it was."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
import shapely

from factory.datasets.av2.reader import AV2Reader
from factory.datasets.py123d.arrow import KINDS_OF_LABELS
from factory.datasets.py123d.reader import Py123dReader
from tasks.world.clip import NOW, AgentKind, Clip
from tasks.world.road_map import LightState, MapLayer, polygons_near
from tests.factory.datasets.av2.test_av2 import SPEED, START_NS, road, write_log, write_table
from tests.factory.datasets.py123d.py123d_logs import (
    CARPARK,
    GENERIC_DRIVABLE,
    INTERSECTION,
    LANE_GROUP,
    Made,
    MapObject,
    convert,
    lane,
    rewrite,
    surface,
    write_camera,
    write_lights,
)

NUPLAN = Made("nuplan", "nuplan_val", location="us-ma-boston", map_is_per_log=False, labels="NuPlanBoxDetectionLabel")
NUPLAN = replace(NUPLAN, label_of={"REGULAR_VEHICLE": 0, "CONSTRUCTION_CONE": 3})
WAYMO = Made("wod-perception", "wod-perception_train", location=None, labels="WODPerceptionBoxDetectionLabel")
WAYMO = replace(WAYMO, label_of={"REGULAR_VEHICLE": 1, "CONSTRUCTION_CONE": 3})


@pytest.fixture(scope="module")
def street(small_town: Path) -> Path:
    """A signalised street of the town as an Argoverse 2 log."""
    return next(folder for folder in sorted(small_town.iterdir()) if folder.is_dir())


@pytest.fixture(scope="module")
def pair(street: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Clip, Clip]:
    """A clip of it as its own reader and as the reader of 123D's files has it."""
    return clips(street, tmp_path_factory.mktemp("123d"))


def clips(log: Path, root: Path, made: Made | None = None) -> tuple[Clip, Clip]:
    """The log's second window as its own reader and as the reader of 123D's files has it."""
    convert(log, root, made)
    native, through = AV2Reader(log), Py123dReader(root)
    assert [ref.start_ms for ref in native.index().refs] == [ref.start_ms for ref in through.index().refs]
    return native.read(native.index().refs[1]), through.read(through.index().refs[1])


def strip(x0: float, x1: float, y: float, n: int = 5) -> np.ndarray:
    """A line along the road of the small log, from x0 to x1."""
    return road(np.linspace(x0, x1, n), np.full(n, y))


def area(x0: float, x1: float, y0: float, y1: float, holes: Sequence[Any] = ()) -> shapely.Polygon:
    corners = road(np.array([x0, x1, x1, x0]), np.array([y0, y0, y1, y1]))
    return shapely.Polygon(corners, [hole.exterior.coords for hole in holes])


def only_clip(log: Path, root: Path, made: Made, objects: Sequence[MapObject]) -> Clip:
    """The first window of the small log on another data set's map."""
    convert(log, root, made, objects)
    reader = Py123dReader(root)
    return reader.read(reader.index().refs[0])


def test_a_converted_town_gives_the_native_reader_s_clips(pair: tuple[Clip, Clip]) -> None:
    native, through = pair
    assert np.array_equal(native.ego_states, through.ego_states)
    assert np.allclose(native.world_from_ego, through.world_from_ego, rtol=0, atol=1e-12)
    assert native.agents.track_ids == through.agents.track_ids
    assert native.agents.kinds == through.agents.kinds
    assert np.array_equal(native.agents.valid, through.agents.valid)
    for name in ("boxes", "velocities", "center_z", "heights"):
        here, there = getattr(native.agents, name), getattr(through.agents, name)
        assert np.allclose(here, there, rtol=0, atol=1e-12, equal_nan=True)
    assert native.lights.lane_ids == through.lights.lane_ids
    assert np.array_equal(native.lights.states, through.lights.states)
    assert LightState.RED in through.lights.states
    assert native.route == through.route
    assert np.array_equal(native.centerline, through.centerline)
    assert through.split == "train"
    assert through.licence == "CC BY-NC-SA 4.0 (Argoverse 2 via 123D)"


def test_a_converted_map_lacks_nothing_but_lanes_beyond_it(pair: tuple[Clip, Clip]) -> None:
    native, through = (clip.road_map for clip in pair)
    assert list(native.lanes) == list(through.lanes)
    beyond = 0
    for mine, other in zip(native.lanes.values(), through.lanes.values()):
        assert np.array_equal(mine.ring, other.ring)
        assert np.array_equal(mine.centerline, other.centerline)
        for name in ("is_intersection", "drives_cars", "left_boundary", "right_boundary"):
            assert np.array_equal(getattr(mine, name), getattr(other, name))
        for name in ("successors", "predecessors"):
            beyond += len(getattr(mine, name)) - len(getattr(other, name))
            assert tuple(one for one in getattr(mine, name) if one in native.lanes) == getattr(other, name)
        for name in ("left_neighbor", "right_neighbor"):
            one = getattr(mine, name)
            assert (one if one in native.lanes else None) == getattr(other, name)
    assert beyond > 0, "the town's map ends somewhere"
    assert native.roadblock_of == through.roadblock_of
    for mine, other in zip(native.drivable_areas, through.drivable_areas, strict=True):
        assert (mine.token, mine.layer) == (other.token, other.layer)
        assert np.array_equal(mine.ring, other.ring)
    assert all(np.array_equal(a, b) for a, b in zip(native.crossings, through.crossings, strict=True))


def test_keyframes_of_2_hz_become_10_hz(street: Path, tmp_path: Path) -> None:
    native, through = clips(street, tmp_path, Made(every=5))
    moved = np.hypot(*(native.ego_states - through.ego_states)[:, :2].T)
    assert moved.max() < 0.05
    assert np.abs(native.ego_states - through.ego_states)[:, 3:5].max() < 0.15  # m/s
    mine = {track: i for i, track in enumerate(native.agents.track_ids)}
    seen = 0
    for i, track in enumerate(through.agents.track_ids):
        both = through.agents.valid[:, i] & native.agents.valid[:, mine[track]]
        apart = through.agents.boxes[both, i, :2] - native.agents.boxes[both, mine[track], :2]
        assert np.hypot(*apart.T).max(initial=0.0) < 0.15
        seen += int(both.sum())
    assert seen > 0.9 * native.agents.valid.sum()


def test_a_track_that_misses_a_keyframe_is_away_until_it_is_seen_again(tmp_path: Path) -> None:
    log = write_log(tmp_path / "train" / "log-a")
    folder = convert(log, tmp_path, Made(every=5))
    boxes = pa.ipc.open_file(pa.OSFile(str(folder / "box_detections_se3.arrow"))).read_all()
    rows = boxes["box_detections_se3.track_token"].to_pylist()
    keep = [[not (frame == 6 and track == "car") for track in tracks] for frame, tracks in enumerate(rows)]
    columns = {}
    for name in ("bounding_box_se3", "track_token", "label", "velocity_3d", "num_lidar_points"):
        column = boxes[f"box_detections_se3.{name}"]
        kept = [[one for one, here in zip(items, used) if here] for items, used in zip(column.to_pylist(), keep)]
        columns[f"box_detections_se3.{name}"] = pa.array(kept, column.type)
    rewrite(folder / "box_detections_se3.arrow", columns)
    reader = Py123dReader(folder)
    agents = reader.read(reader.index().refs[0]).agents
    there = agents.valid[:, agents.track_ids.index("car")]
    assert np.flatnonzero(~there).tolist() == list(range(26, 35))  # between the frames at 2.5 and 3.5 s


def test_the_rear_axle_is_where_the_file_says_it_is_from_the_imu(tmp_path: Path) -> None:
    log = write_log(tmp_path / "train" / "log-a")
    turned = (-1.2, 0.3, -0.5, np.cos(0.1), 0.0, 0.0, np.sin(0.1))
    native, through = clips(log, tmp_path, Made(imu_to_rear=turned))
    assert np.allclose(native.ego_states, through.ego_states, rtol=0, atol=1e-6)
    assert np.allclose(native.world_from_ego, through.world_from_ego, rtol=0, atol=1e-9)


def test_a_drive_breaks_where_poses_are_missing(tmp_path: Path) -> None:
    log = write_log(tmp_path / "train" / "log-a", seconds=25.0)
    folder = convert(log, tmp_path)
    ego = pa.ipc.open_file(pa.OSFile(str(folder / "ego_state_se3.arrow"))).read_all()
    time_s = (np.asarray(ego["ego_state_se3.timestamp_us"]) - START_NS // 1000) / 1e6
    there = pa.array((time_s < 11.0) | (time_s > 12.5))
    rewrite(
        folder / "ego_state_se3.arrow", {name: ego[name].combine_chunks().filter(there) for name in ego.column_names}
    )
    index = Py123dReader(folder).index()
    assert [ref.start_ms for ref in index.refs] == [0, 1000, 13000, 14000, 15000]
    assert sum(index.dropped.values()) == 11


def test_nuplan_s_city_map_gives_roadblocks_junctions_and_car_parks_of_its_own(tmp_path: Path) -> None:
    log = write_log(tmp_path / "train" / "log-a")
    left, middle, right = ([strip(-20, 60, y), strip(60, 300, y)] for y in (6.0, 2.0, -2.0))
    far = np.array([5000.0, 5000.0])
    island = area(100, 110, 8, 12)
    objects = [
        lane(1, middle[0], right[0], lane_group_id=71, successor_ids=[2], left_lane_id=3, speed_limit_mps=11.2),
        lane(3, left[0], middle[0], lane_group_id=71, successor_ids=[2], right_lane_id=1),
        lane(2, middle[1], right[1], lane_group_id=72, predecessor_ids=[1, 3]),
        lane(9, middle[0] + far, right[0] + far, lane_group_id=79),
        surface(LANE_GROUP, 71, area(-20, 60, -2, 6), intersection_id=None, lane_ids=[1, 3]),
        surface(LANE_GROUP, 72, area(60, 300, -2, 6), intersection_id=5, lane_ids=[2]),
        surface(INTERSECTION, 5, area(60, 300, -4, 8), intersection_type=1, lane_group_ids=[72]),
        surface(CARPARK, 6, area(0, 20, 6, 12)),
        surface(GENERIC_DRIVABLE, 7, area(60, 300, 6, 20, [island])),
    ]
    clip = only_clip(log, tmp_path, NUPLAN, objects)
    road_map = clip.road_map
    assert list(road_map.lanes) == ["1", "3", "2"], "what is 7 km away is another drive's"
    assert road_map.roadblock_of == {"1": "71", "3": "71", "2": "72"}
    assert clip.route.roadblock_ids == ("71", "72")
    assert clip.route.lane_ids == {"1", "2", "3"}
    assert [one.is_intersection for one in road_map.lanes.values()] == [False, False, True]
    assert road_map.lanes["1"].left_neighbor == "3"
    assert road_map.lanes["1"].speed_limit_mps == 11.2
    assert road_map.location == "us-ma-boston"
    assert clip.split == "val"
    layers = [one.layer for one in polygons_near(road_map, clip.ego_states[NOW, :2], 1000.0)]
    assert sorted(layers) == sorted(
        [MapLayer.LANE] * 2
        + [MapLayer.LANE_CONNECTOR, MapLayer.INTERSECTION, MapLayer.DRIVABLE_AREA, MapLayer.CARPARK_AREA]
        + [MapLayer.ROADBLOCK]
    ), "of the two groups one is in the junction, whose surface is the intersection's"
    assert [len(one.holes) for one in road_map.drivable_areas] == [1, 0, 0]
    assert set(clip.agents.kinds) == {AgentKind.VEHICLE, AgentKind.TRAFFIC_CONE}


def test_waymo_s_connectors_and_surface_come_from_its_lanes(tmp_path: Path) -> None:
    log = write_log(tmp_path / "train" / "log-a")
    sides = [[strip(x0, x1, y) for x0, x1 in ((-20, 60), (60, 100), (100, 300))] for y in (2.0, -2.0)]
    fork = strip(60, 100, 2.0) + np.linspace(0, 8, 5)[:, None] * (road(np.array(0.0), np.array(1.0)) - road(0.0, 0.0))
    objects = [
        lane(1, sides[0][0], sides[1][0], successor_ids=[2, 4]),
        lane(2, sides[0][1], sides[1][1], predecessor_ids=[1], successor_ids=[3]),
        lane(3, sides[0][2], sides[1][2], predecessor_ids=[2]),
        lane(4, fork, fork - (sides[0][1] - sides[1][1]), predecessor_ids=[1]),
        lane(5, strip(-20, 300, 6.0), strip(-20, 300, 2.4), lane_type=3),
        lane(6, strip(-20, 60, -2.4), strip(-20, 60, -6.0)),
        surface(CARPARK, 8, area(20, 24, -20, -6)),
    ]
    road_map = only_clip(log, tmp_path, WAYMO, objects).road_map
    connectors = {lane_id for lane_id, one in road_map.lanes.items() if one.is_intersection}
    assert connectors == {"2", "4"}
    assert road_map.intersections is None
    assert road_map.lanes["1"].right_neighbor == "6", "found by geometry: the file names no lane beside another"
    assert road_map.roadblock_of["1"] == road_map.roadblock_of["6"]
    assert not road_map.lanes["5"].drives_cars
    surfaces = [shapely.Polygon(one.ring, one.holes) for one in road_map.drivable_areas]
    covered = shapely.union_all(surfaces)
    assert covered.contains(shapely.Point(road(np.array(30.0), np.array(-2.2)))), "the seam between two lanes"
    assert covered.contains(shapely.Point(road(np.array(22.0), np.array(-10.0)))), "a driveway"
    assert not covered.contains(shapely.Point(road(np.array(200.0), np.array(4.0)))), "a bicycle lane"


def test_a_phase_lasts_until_the_next_frame_and_the_stricter_of_two_counts(tmp_path: Path) -> None:
    folder = convert(write_log(tmp_path / "train" / "log-a"), tmp_path)
    green, yellow, red, off = 0, 1, 2, 3
    stamps = START_NS // 1000 + np.array([0, 500_000, 1_000_000])
    rows = np.array([0, 0, 0, 1, 2, 2])
    write_lights(folder, stamps, rows, [2, 2, 77, 2, 2, 2], [red, green, red, yellow, off, green])
    reader = Py123dReader(folder)
    lights = reader.read(reader.index().refs[0]).lights
    assert lights.lane_ids == ("2",), "77 is on no map"
    told = [LightState(state) for state in lights.states[:, 0]]
    assert told[:5] == [LightState.RED] * 5
    assert told[5:10] == [LightState.YELLOW] * 5
    assert told[10:16] == [LightState.GREEN] * 6, "0.55 s old at most"
    assert set(told[16:]) == {LightState.UNKNOWN}


def test_photos_lie_where_the_data_set_is(tmp_path: Path) -> None:
    log = write_log(tmp_path / "av2" / "train" / "log-a")
    (log / "calibration").mkdir()
    mount = dict(
        zip(("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m"), ([v] for v in (0.5, -0.5, 0.5, -0.5, 1.6, 0, 1)))
    )
    write_table(log / "calibration" / "egovehicle_SE3_sensor.feather", {"sensor_name": ["front"], **mount})
    names = ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "k3")
    numbers = {name: [value] for name, value in zip(names, (50.0, 50.0, 32.0, 18.0, 0.0, 0.0, 0.0))}
    sizes = {"height_px": pa.array([36], pa.uint16()), "width_px": pa.array([64], pa.uint16())}
    write_table(log / "calibration" / "intrinsics.feather", {"sensor_name": ["front"], **numbers, **sizes})
    (log / "sensors/cameras/front").mkdir(parents=True)
    for step in range(0, 117, 5):
        (log / f"sensors/cameras/front/{START_NS + step * 100_000_000}.jpg").touch()
    convert(log, tmp_path / "out")
    native, through = AV2Reader(log), Py123dReader(tmp_path / "out", sensor_root=tmp_path / "av2")
    ref, own = native.index().refs[1], through.index().refs[1]
    mine, other = native.read(ref), through.read(own)
    assert len(mine.images) == len(other.images) == 20
    for one, two in zip(mine.images, other.images):
        assert (one.sensor, one.uri, one.time_s) == (two.sensor, two.uri, two.time_s)
        assert np.allclose(one.world_from_ego, two.world_from_ego, rtol=0, atol=1e-9)
    assert mine.cameras[0].name == other.cameras[0].name
    assert np.allclose(mine.cameras[0].ego_from_camera, other.cameras[0].ego_from_camera)
    assert through.block(own) == native.block(ref) == "log-a@0s"
    assert other.block is not None and len(other.block.images) == 24
    without = Py123dReader(tmp_path / "out")
    assert without.block(own) is None
    assert without.read(own).images == ()
    assert [camera.name for camera in without.read(own).cameras] == ["front"]


def test_a_photo_s_own_pose_counts_and_a_fisheye_does_not(tmp_path: Path) -> None:
    folder = convert(write_log(tmp_path / "train" / "log-a"), tmp_path)
    x, y = road(np.array(SPEED * 0.5), np.array(0.0)) + 3.0  # of the log, whose own place there is 3 m off
    pose, lens = [x, y, 9.0, 0.5, -0.5, 0.5, -0.5], [0.1, 0.0, 0.01, 0.02, 0.0]
    for number, (model, flat) in enumerate((("pinhole", False), ("pinhole", True), ("fisheye_mei", True))):
        told = {"camera_model": model, "is_undistorted": flat, "camera_name": str(number), "distortion": lens}
        write_camera(folder, number, [START_NS // 1000 + 500_000], [f"{number}.jpg"], pose, **told)
    reader = Py123dReader(folder, sensor_root=tmp_path)
    clip = reader.read(reader.index().refs[0])
    assert [camera.distortion.tolist() for camera in clip.cameras] == [[0.1, 0.0, 0.01, 0.02, 0.0], [0.0] * 5]
    assert len(clip.images) == 2
    assert clip.images[0].world_from_ego[:3, 3] == pytest.approx([x - 1.6, y, 8.0])


def test_every_label_of_123d_has_a_kind() -> None:
    counts = {name: len(kinds) for name, kinds in KINDS_OF_LABELS.items()}
    assert counts == {  # members of the enumerations in py123d/parser/registry.py
        "AV2SensorBoxDetectionLabel": 30,
        "NuPlanBoxDetectionLabel": 7,
        "NuScenesBoxDetectionLabel": 23,
        "WODPerceptionBoxDetectionLabel": 5,
        "WODMotionBoxDetectionLabel": 5,
    }
    nuscenes = KINDS_OF_LABELS["NuScenesBoxDetectionLabel"]
    names = ["VEHICLE", "BICYCLE", "PEDESTRIAN", "TRAFFIC_CONE", "BARRIER", "GENERIC_OBJECT"]
    assert [nuscenes[k] for k in (0, 8, 10, 17, 18, 22)] == [AgentKind[name] for name in names]


def test_a_root_may_be_everything_the_logs_a_split_or_one_log(tmp_path: Path) -> None:
    convert(write_log(tmp_path / "source" / "train" / "log-a"), tmp_path / "out")
    for root in (".", "logs", "logs/av2-sensor_train", "logs/av2-sensor_train/log-a"):
        reader = Py123dReader(tmp_path / "out" / root)
        assert list(reader.logs()) == ["log-a"], root
    assert reader.read(reader.index().refs[0]).ego_states[NOW, 3] == pytest.approx(SPEED)
