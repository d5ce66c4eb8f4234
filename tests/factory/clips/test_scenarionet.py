"""The same street told in the dialects of three converters reads as the same clip; broken files say what is broken."""

import os
import pickle

import numpy as np
import pytest
import scenarionet_scenarios as town
import shapely
from shapely.geometry import Point, Polygon

from factory.clips.reader import BadClip, ClipRef
from factory.clips.scenarionet import ScenarioNetReader, read_log
from factory.clips.scenarionet_map import pieces
from factory.clips.scenarionet_tracks import SLOPE_STEPS, slope_velocities
from tasks.world.agents import AgentKind
from tasks.world.clip import CLIP_STEPS, NOW
from tasks.world.lanes import LightState
from tasks.world.vehicle import AX, AY, HEADING, VX, VY, X, Y

DIALECTS = {
    "nuscenes": town.nuscenes,
    "nuscenes_newer": lambda **k: town.nuscenes(newer=True, **k),
    "waymo": town.waymo,
    "nuplan": town.nuplan,
    "nuplan_older": lambda **k: town.nuplan(newer=False, **k),
}


def lane_ids(dialect, *names):
    return [str(town.INT_ID[name]) if dialect == "waymo" else name for name in names]


@pytest.fixture(scope="module", params=list(DIALECTS))
def dialect(request):
    return request.param


@pytest.fixture(scope="module")
def clip(dialect, tmp_path_factory):
    folder = tmp_path_factory.mktemp(dialect)
    town.save(DIALECTS[dialect](), folder)
    reader = ScenarioNetReader(folder)
    index = reader.index()
    assert not index.broken and not index.dropped
    assert [ref.start_ms for ref in index.refs] == [0, 1000, 2000]
    return reader.read(index.refs[1])


def test_the_ego_is_at_its_rear_axle_and_keeps_its_speed(clip):
    states = clip.ego_states
    truth = town.EGO_START + town.EGO_SPEED * (1.0 + 0.1 * np.arange(CLIP_STEPS))
    np.testing.assert_allclose(states[:, X], truth, atol=1e-4)
    np.testing.assert_allclose(states[:, Y], town.EGO_Y, atol=1e-4)
    np.testing.assert_allclose(states[:, VX], town.EGO_SPEED, atol=1e-3)
    np.testing.assert_allclose(states[:, [HEADING, VY, AX, AY]], 0.0, atol=5e-3)
    np.testing.assert_allclose(clip.world_from_ego[:, :2, 3], states[:, [X, Y]])
    assert clip.start_s == 1.0


def test_the_lane_graph_is_the_street_s(clip, dialect):
    for before, after in [("E1", ("C1", "CR")), ("E2", ("C2", "CL")), ("C2", ("E2b",)), ("W1b", ("CW",)), ("N", ())]:
        (lane_id,) = lane_ids(dialect, before)
        lane = clip.road_map.lanes[lane_id]
        assert set(lane.successors) == set(lane_ids(dialect, *after))
        for successor in lane.successors:
            assert lane_id in clip.road_map.lanes[successor].predecessors


def test_exactly_the_junction_s_lanes_are_connectors(clip, dialect):
    found = {lane_id for lane_id, lane in clip.road_map.lanes.items() if lane.is_intersection}
    assert found == set(lane_ids(dialect, *town.CONNECTORS))


def test_lanes_of_one_direction_share_a_roadblock_and_the_other_direction_is_off_route(clip, dialect):
    e1, e2, w1, e1b, e2b = lane_ids(dialect, "E1", "E2", "W1", "E1b", "E2b")
    block = clip.road_map.roadblock_of
    assert block[e1] == block[e2] != block[w1]
    assert {e1, e2, e1b, e2b} <= clip.route.lane_ids
    assert w1 not in clip.route.lane_ids
    assert clip.route.lane_path[0] == e2
    assert clip.road_map.lanes[e1].left_neighbor == e2 and clip.road_map.lanes[e2].right_neighbor == e1


def test_the_centreline_runs_under_the_ego_and_on(clip):
    line = clip.centerline
    for step in (NOW, NOW + 40, CLIP_STEPS - 1):
        assert np.hypot(*(line[:, :2] - clip.ego_states[step, :2]).T).min() < 0.4
    assert line[-1, 0] == pytest.approx(320.0)


def test_the_drivable_area_holds_every_lane_s_centre(clip):
    surfaces = [Polygon(area.ring, area.holes) for area in clip.road_map.drivable_areas]
    for lane in clip.road_map.lanes.values():
        middle = Point(lane.centerline[len(lane.centerline) // 2, :2])
        assert not lane.drives_cars or any(surface.contains(middle) for surface in surfaces)


def test_agents_have_their_kind_box_and_velocity(clip):
    agents = clip.agents
    of = {track_id: k for k, track_id in enumerate(agents.track_ids)}
    assert {track_id: agents.kinds[k] for track_id, k in of.items()} == {
        "lead": AgentKind.VEHICLE,
        "oncoming": AgentKind.VEHICLE,
        "walker": AgentKind.PEDESTRIAN,
        "rider": AgentKind.BICYCLE,
        "cone": AgentKind.TRAFFIC_CONE,
        "fence": AgentKind.BARRIER,
    }
    np.testing.assert_allclose(agents.velocities[:, of["lead"]], np.tile([9.0, 0.0], (CLIP_STEPS, 1)), atol=1e-3)
    np.testing.assert_allclose(agents.velocities[:, of["walker"]], np.tile([0.0, 1.2], (CLIP_STEPS, 1)), atol=1e-3)
    assert (agents.velocities[:, of["cone"]] == 0.0).all()
    np.testing.assert_allclose(agents.boxes[0, of["lead"]], [69.0, -5.25, 0.0, 4.5, 1.9], atol=1e-4)
    seen = agents.valid[:, of["oncoming"]]
    assert np.flatnonzero(seen).tolist() == list(range(10, 51))  # frames 20..60 of a window that starts at frame 10
    np.testing.assert_allclose(agents.velocities[seen, of["oncoming"]], np.tile([-7.0, 0.0], (41, 1)), atol=1e-3)
    assert np.isnan(agents.boxes[~seen, of["oncoming"]]).all()
    assert agents.center_z[0, of["walker"]] == pytest.approx(0.9)


def test_the_licence_and_digest_are_the_source_s(clip, dialect):
    name = {"nuscenes": "nuScenes", "waymo": "Waymo", "nuplan": "nuPlan"}[dialect.split("_")[0]]
    assert name in clip.licence and len(clip.content_digest) == 64


def test_waymo_lights_govern_their_connector_step_by_step(tmp_path):
    path = town.save(town.waymo(), tmp_path)
    lights = read_log(path).lights
    assert lights.lane_ids == (str(town.INT_ID["C2"]),)
    states = lights.states[:, 0]
    assert (states[:50] == LightState.RED).all() and (states[50:-1] == LightState.GREEN).all()
    assert states[-1] == LightState.UNKNOWN
    reader = ScenarioNetReader(path)
    window = reader.read(ClipRef("scenarionet", path.stem, 2000)).lights.states[:, 0]
    np.testing.assert_array_equal(window, states[20 : 20 + CLIP_STEPS])


def test_speed_limits_are_read_but_not_nuscenes_placeholder(tmp_path):
    waymo = read_log(town.save(town.waymo(), tmp_path / "w")).road_map.lanes
    assert waymo[str(town.INT_ID["E1"])].speed_limit_mps == pytest.approx(30 * 0.44704)
    nuscenes = read_log(town.save(town.nuscenes(), tmp_path / "n")).road_map.lanes
    assert all(lane.speed_limit_mps is None for lane in nuscenes.values())


def test_lanes_without_a_polygon_are_as_wide_as_measured_or_three_and_a_half_metres(tmp_path):
    scenario = town.waymo()
    scenario["map_features"][str(town.INT_ID["W1"])]["width"][:] = 1.5
    lanes = read_log(town.save(scenario, tmp_path)).road_map.lanes
    for name, width in (("E1", 3.5), ("W1", 3.0)):
        assert np.ptp(lanes[str(town.INT_ID[name])].ring[:, 1]) == pytest.approx(width, abs=1e-5)
    assert not lanes["7"].drives_cars


def test_islands_of_the_drivable_surface_stay_holes(tmp_path):
    log = read_log(town.save(town.nuscenes(), tmp_path))
    surface = max((Polygon(a.ring, a.holes) for a in log.road_map.drivable_areas), key=lambda p: p.area)
    assert surface.contains(Point(150.0, 5.0)) and not surface.contains(Point(155.0, 7.0))
    assert len(log.road_map.crossings) == 1


def test_a_surface_of_many_points_is_cut_into_overlapping_pieces_of_the_same_union():
    angle = np.linspace(0, 2 * np.pi, 3001)[:-1]
    radius = 200 + 10 * np.sin(40 * angle)
    disc = Point(0, 0).buffer(30, quad_segs=200)
    blob = Polygon(np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])).difference(disc)
    cut = pieces(blob)
    assert max(shapely.get_num_coordinates(cut)) <= 256
    assert shapely.union_all(cut).symmetric_difference(blob).area < 1e-6 * blob.area
    assert sum(piece.area for piece in cut) > blob.area  # they overlap: no point is lost on a seam


def test_a_neighbour_of_the_other_direction_is_found_by_geometry(tmp_path):
    lanes = read_log(town.save(town.nuscenes(), tmp_path)).road_map.lanes
    assert lanes["E2"].left_neighbor == "W1" and lanes["W1"].left_neighbor == "E2"
    assert lanes["E1"].right_neighbor is None and lanes["W1"].right_neighbor is None


def test_a_constant_acceleration_is_a_fixed_point_of_the_smoothing(tmp_path):
    t = 0.1 * np.arange(town.N_FRAMES)
    ego = np.column_stack([10.0 + 2.0 * t + 0.6 * t**2, np.full(len(t), town.EGO_Y)])
    states = read_log(town.save(town.nuscenes(ego=ego), tmp_path)).motion.ego_states
    np.testing.assert_allclose(states[:, X], ego[:, 0], atol=1e-6)
    np.testing.assert_allclose(states[:, VX], 2.0 + 1.2 * t, atol=1e-6)
    np.testing.assert_allclose(states[:, AX], 1.2, atol=1e-5)


def test_a_lost_can_message_is_time_that_passed_and_no_acceleration(tmp_path):
    ego = town.ego_xy()
    ego[50:, 0] += 0.04 * town.EGO_SPEED  # two lost messages of 50 Hz
    states = read_log(town.save(town.nuscenes(ego=ego), tmp_path)).motion.ego_states
    assert np.abs(np.diff(ego[:, 0], n=2)).max() / 0.01 > 30.0  # what the log says
    np.testing.assert_allclose(states[:, X], town.ego_xy()[:, 0], atol=1e-6)
    assert np.abs(states[:, AX]).max() < 1e-4


def test_a_can_bus_that_runs_ahead_is_set_by_the_keyframes_that_follow_it(tmp_path):
    true = town.ego_xy()
    ego = true.copy()
    ego[:116, 0] += 0.25 * town.EGO_SPEED
    motion = read_log(town.save(town.nuscenes(ego=ego), tmp_path)).motion
    told = motion.segment >= 0
    assert np.flatnonzero(told).tolist() == list(range(3, 118))  # the bus tells of 0.25 s .. 11.75 s
    np.testing.assert_allclose(motion.ego_states[told, X], true[told, 0], atol=1e-6)


def test_keyframe_jitter_of_an_interpolated_ego_is_smoothed_away(tmp_path):
    rng = np.random.default_rng(3)
    key_times = 0.5 * np.arange(25) + rng.choice([-0.05, 0.0, 0.05], 25)
    x = np.interp(np.arange(town.N_FRAMES) / 5.0, np.arange(25), town.EGO_START + town.EGO_SPEED * key_times)
    ego = np.column_stack([x, np.full(len(x), town.EGO_Y)])
    states = read_log(town.save(town.nuscenes(ego=ego), tmp_path)).motion.ego_states
    assert np.abs(np.diff(x, n=2)).max() / 0.01 > 10.0
    assert np.abs(states[:, AX]).max() < 4.0
    assert np.abs(states[10:-10, VX] - town.EGO_SPEED).max() < 1.0


def test_a_jump_of_the_ego_breaks_every_window_across_it(tmp_path):
    ego = town.ego_xy(200)
    ego[105:, 0] += 3.0
    town.save(town.nuscenes(200, ego), tmp_path)
    reader = ScenarioNetReader(tmp_path)
    index = reader.index()
    assert index.dropped == {"broken_tracks": 10} and [ref.start_ms for ref in index.refs] == [0]
    assert np.abs(reader.read(index.refs[0]).ego_states[:, AX]).max() < 0.1


def test_frames_where_the_ego_is_invalid_break_their_windows(tmp_path):
    scenario = town.waymo(150)
    scenario["tracks"]["17"]["state"]["valid"][100:103] = False
    town.save(scenario, tmp_path)
    index = ScenarioNetReader(tmp_path).index()
    assert len(index.refs) == 1 and index.dropped == {"broken_tracks": 5}


def test_an_ego_that_stands_and_a_log_too_short_are_counted(tmp_path):
    ego = np.tile([30.0, town.EGO_Y], (town.N_FRAMES, 1))
    town.save(town.nuscenes(ego=ego), tmp_path, "sd_a.pkl")
    town.save(town.waymo(91), tmp_path, "sd_b.pkl")
    index = ScenarioNetReader(tmp_path).index()
    assert not index.refs and index.dropped == {"ego_standing": 3}
    assert index.skipped_logs == {"sd_b": "9.1 s of driving, a clip needs 9.6 s"}


@pytest.mark.parametrize("step_s", [0.05, 0.2, 0.5])
def test_other_sample_rates_read_as_the_same_drive_at_ten_hertz(tmp_path, step_s):
    n = round(12.0 / step_s) + 1
    times = step_s * np.arange(n)
    ego = np.column_stack([town.EGO_START + town.EGO_SPEED * times, np.full(n, town.EGO_Y)])
    scenario = town.nuplan(n, ego)
    scenario["metadata"]["ts"] = times + 5.0
    motion = read_log(town.save(scenario, tmp_path)).motion
    assert len(motion.segment) == 121
    np.testing.assert_allclose(motion.ego_states[:, X], town.ego_xy(121)[:, 0], atol=1e-6)


def test_slope_velocities_ignore_absent_frames_and_far_origins():
    t = 0.1 * np.arange(30)
    xy = np.stack([1e6 + 3.0 * t, 2e6 - 4.0 * t], axis=1)[:, None]
    valid = np.ones((30, 1), bool)
    valid[[4, 5, 20]] = False
    velocity = slope_velocities(np.where(valid[..., None], xy, 0.0), valid)
    np.testing.assert_allclose(velocity[valid], np.tile([3.0, -4.0], (27, 1)), atol=1e-6)
    assert np.isnan(velocity[~valid]).all()
    alone = np.zeros((30, 1), bool)
    alone[15] = True
    assert (slope_velocities(xy, alone)[15] == 0.0).all() and SLOPE_STEPS == 5


def without(*path):
    def change(scenario):
        part = scenario
        for key in path[:-1]:
            part = part[key]
        del part[path[-1]]

    return change


def with_value(value, *path):
    def change(scenario):
        part = scenario
        for key in path[:-1]:
            part = part[key]
        part[path[-1]] = value

    return change


def nan_pose(scenario):
    scenario["tracks"]["ego"]["state"]["position"][40, 0] = np.nan


def backwards(scenario):
    scenario["metadata"]["ts"][50] = 0.0


BREAKS = {
    "tracks: missing": without("tracks"),
    "map_features: missing": without("map_features"),
    "dynamic_map_states: missing": without("dynamic_map_states"),
    "length: missing": without("length"),
    "metadata.ts: missing": without("metadata", "ts"),
    "metadata.sdc_id: missing": without("metadata", "sdc_id"),
    "metadata.dataset: 'pg' is not supported": with_value("pg", "metadata", "dataset"),
    "metadata.ts: time is not finite and strictly increasing": backwards,
    "metadata.ts: frames further apart": with_value(np.arange(121.0), "metadata", "ts"),
    r"tracks\[ego\].state.position: missing": without("tracks", "ego", "state", "position"),
    r"tracks\[ego\].state.position: NaN pose": nan_pose,
    r"tracks\[lead\].state.heading: shape": with_value(np.zeros(7), "tracks", "lead", "state", "heading"),
    r"tracks\[lead\].type: unknown class 'TRAM'": with_value("TRAM", "tracks", "lead", "type"),
    r"tracks\[lead\].state: length, width, height": without("tracks", "lead", "state", "length"),
}
MAP_BREAKS = {
    "map_features: the map is empty": with_value({}, "map_features"),
    r"map_features\[E1\].type: unknown lane class": with_value("LANE_HOVER", "map_features", "E1", "type"),
    r"map_features\[E1\].polyline: missing": without("map_features", "E1", "polyline"),
    r"map_features\[E1\].polyline: a lane of 1000000 m": with_value(
        [(0.0, 0.0), (1e6, 0.0)], "map_features", "E1", "polyline"
    ),
    r"map_features\[E1\].polyline: NaN": with_value(np.full((5, 2), np.nan), "map_features", "E1", "polyline"),
    "unknown light states": with_value(
        {"C2": {"lane": "C2", "state": {"object_state": ["PURPLE"] * 121}}}, "dynamic_map_states"
    ),
    "120 steps, the log has 121": with_value(
        {"C2": {"lane": "C2", "state": {"object_state": [None] * 120}}}, "dynamic_map_states"
    ),
    "no lane or no state": with_value({"C2": {"lane": "C2"}}, "dynamic_map_states"),
    "map_features: the ego is never within": lambda s: [
        s["map_features"].pop(k) for k in list(s["map_features"]) if k not in ("N", "S")
    ],
}


@pytest.mark.parametrize("message", list(BREAKS))
def test_a_broken_file_is_named_with_its_field_and_hurts_no_other(tmp_path, message):
    scenario = town.nuscenes()
    BREAKS[message](scenario)
    path = town.save(scenario, tmp_path, "sd_broken.pkl")
    town.save(town.nuscenes(), tmp_path, "sd_good.pkl")
    reader = ScenarioNetReader(tmp_path)
    index = reader.index()
    assert {ref.log_id for ref in index.refs} == {"sd_good"} and list(index.broken) == [
        ClipRef("scenarionet", "sd_broken", 0)
    ]
    with pytest.raises(BadClip, match=message) as error:
        reader.read(next(iter(index.broken)))
    assert error.value.file == str(path)


@pytest.mark.parametrize("message", list(MAP_BREAKS))
def test_a_broken_map_or_light_is_named_when_the_clip_is_read(tmp_path, message):
    scenario = town.nuscenes()
    MAP_BREAKS[message](scenario)
    reader = ScenarioNetReader(town.save(scenario, tmp_path))
    with pytest.raises(BadClip, match=message):
        reader.read(reader.index().refs[0])


JUNK = [None, 3, float("nan"), "x", [], {}, [{}], np.zeros((2, 2)), np.full(121, np.nan), b"x", [None] * 121]


@pytest.mark.parametrize("dialect", ["nuscenes", "waymo", "nuplan"])
def test_junk_in_any_field_is_a_bad_clip_or_harmless(tmp_path, dialect):
    def fields(part, path=()):
        for key, value in part.items():
            yield (*path, key)
            if isinstance(value, dict):
                yield from fields(value, (*path, key))

    data = pickle.dumps(DIALECTS[dialect]())
    paths = list(fields(pickle.loads(data)))
    rng = np.random.default_rng(0)
    for k in range(60):
        scenario = pickle.loads(data)
        with_value(JUNK[k % len(JUNK)], *paths[rng.integers(len(paths))])(scenario)
        path = town.save(scenario, tmp_path)
        reader = ScenarioNetReader(path)
        reader.index()
        try:
            reader.read(ClipRef("scenarionet", path.stem, 0))
        except BadClip as error:
            assert error.file == str(path)


class Evil:
    def __reduce__(self):
        return os.system, ("touch ran",)


def test_truncated_hostile_and_foreign_pickles_are_broken_logs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    data = pickle.dumps(town.nuscenes())
    (tmp_path / "sd_cut.pkl").write_bytes(data[: len(data) // 2])
    (tmp_path / "sd_evil.pkl").write_bytes(pickle.dumps({**town.nuscenes(), "id": Evil()}))
    (tmp_path / "sd_list.pkl").write_bytes(pickle.dumps([1, 2]))
    (tmp_path / "sd_empty.pkl").write_bytes(b"")
    broken = {ref.log_id: message for ref, message in ScenarioNetReader(tmp_path).index().broken.items()}
    assert set(broken) == {"sd_cut", "sd_evil", "sd_list", "sd_empty"}
    assert "truncated" in broken["sd_cut"] and "system" in broken["sd_evil"] and "not a dict" in broken["sd_list"]
    assert not (tmp_path / "ran").exists()


def test_a_database_is_read_by_its_summary_and_mapping(tmp_path):
    town.save(town.nuscenes(), tmp_path / "db_0", "sd_one.pkl")
    town.save(town.waymo(), tmp_path / "db_1", "sd_two.pkl")
    summary = {"sd_one.pkl": {"id": "one"}, "sd_two.pkl": {"id": "two"}, "sd_gone.pkl": {}}
    mapping = {"sd_one.pkl": "db_0", "sd_two.pkl": "db_1", "sd_gone.pkl": ""}
    (tmp_path / "dataset_summary.pkl").write_bytes(pickle.dumps(summary))
    (tmp_path / "dataset_mapping.pkl").write_bytes(pickle.dumps(mapping))
    index = ScenarioNetReader(tmp_path).index()
    assert [ref.log_id for ref in index.refs] == ["sd_one"] * 3 + ["sd_two"] * 3
    assert [ref.log_id for ref in index.broken] == ["sd_gone"]


@pytest.mark.parametrize("name, folder", [("../sd_x.pkl", ""), ("sd_x.pkl", "/etc"), ("passwd", ""), ("sd_x.pkl", 3)])
def test_a_database_that_names_impossible_files_is_refused(tmp_path, name, folder):
    (tmp_path / "dataset_summary.pkl").write_bytes(pickle.dumps({name: {}}))
    (tmp_path / "dataset_mapping.pkl").write_bytes(pickle.dumps({name: folder}))
    with pytest.raises(ValueError, match="impossible file"):
        ScenarioNetReader(tmp_path).index()


def test_a_root_without_scenarios_or_with_one_twice_is_refused(tmp_path):
    with pytest.raises(ValueError, match="no such folder"):
        ScenarioNetReader(tmp_path / "nowhere").index()
    with pytest.raises(ValueError, match="no scenario here"):
        ScenarioNetReader(tmp_path).index()
    town.save(town.nuscenes(), tmp_path / "a")
    town.save(town.nuscenes(), tmp_path / "b")
    with pytest.raises(ValueError, match="stands in two folders"):
        ScenarioNetReader(tmp_path).index()


def test_a_reader_travels_light_keeps_two_logs_and_reads_the_same_twice(tmp_path):
    for k in range(3):
        town.save(town.nuscenes(), tmp_path, f"sd_{k}.pkl")
    reader = ScenarioNetReader(tmp_path, stride_s=2.0)
    index = reader.index()
    assert index == reader.index() and [ref.start_ms for ref in index.refs] == [0, 2000] * 3
    clips = [reader.read(ref) for ref in index.refs]
    assert len(reader._logs) == 2
    traveller = pickle.loads(pickle.dumps(reader))
    assert not traveller._logs
    again = traveller.read(index.refs[0])
    np.testing.assert_array_equal(again.ego_states, clips[0].ego_states)
    np.testing.assert_array_equal(again.agents.velocities, clips[0].agents.velocities)
    assert again.clip_id == index.refs[0].clip_id and again.route == clips[0].route


def test_a_window_that_is_not_there_is_a_bad_clip(tmp_path):
    path = town.save(town.nuscenes(), tmp_path)
    reader = ScenarioNetReader(path)
    for ref in (ClipRef("scenarionet", path.stem, 9000), ClipRef("scenarionet", path.stem, 55)):
        with pytest.raises(BadClip, match="start_ms"):
            reader.read(ref)
    with pytest.raises(BadClip, match="no log sd_other"):
        reader.read(ClipRef("scenarionet", "sd_other", 0))
