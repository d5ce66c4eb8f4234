"""The same street told in the dialects of three converters reads as the same clip."""

import numpy as np
import pytest
import shapely
from scipy.signal import savgol_filter
from shapely.geometry import Point, Polygon

from factory.datasets.scenarionet.map import pieces
from factory.datasets.scenarionet.reader import (
    FIT_STEPS,
    SLOPE_STEPS,
    FrameClock,
    LoggedTrack,
    ScenarioNetReader,
    fitted_derivative,
    fitted_velocities,
    read_log,
    resampled,
)
from factory.readers.base import ClipRef
from tasks.world.clip import CLIP_STEPS, NOW, STEP_S, AgentKind
from tasks.world.frames import AX, AY, HEADING, VX, VY, X, Y
from tasks.world.road_map import LightState
from tests.factory.datasets.scenarionet import scenarionet_scenarios as town

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


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("n", [FIT_STEPS, FIT_STEPS + 1, 300])
def test_derivatives_are_scipy_s_to_the_bit(n, order):
    xy = np.cumsum(np.random.default_rng(n).normal(size=(n, 2)), axis=0) + np.array([4e5, 3e6])
    wanted = savgol_filter(xy, FIT_STEPS, 2, deriv=order, delta=STEP_S, axis=0)
    np.testing.assert_array_equal(fitted_derivative(xy, order), wanted)


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


@pytest.mark.parametrize(("invalid", "windows"), [(3, 6), (4, 6), (5, 1)])
def test_frames_where_the_ego_is_invalid_are_filled_up_to_half_a_second_and_else_break_their_windows(
    tmp_path, invalid, windows
):
    scenario = town.waymo(150)
    for name, values in scenario["tracks"]["17"]["state"].items():
        values[100 : 100 + invalid] = False if name == "valid" else 0.0  # as the converters do
    path = town.save(scenario, tmp_path)
    reader = ScenarioNetReader(path)
    index = reader.index()
    assert len(index.refs) == windows and index.dropped == ({"broken_tracks": 6 - windows} if windows < 6 else {})
    repairs = reader.read(index.refs[-1]).repairs
    assert [(r.what, r.thing, r.time_s) for r in repairs] == [("gap", "ego", pytest.approx(9.9))] * (windows == 6)
    whole = read_log(town.save(town.waymo(150), tmp_path / "whole")).ego_states
    told = read_log(path).ego_states
    here = np.isfinite(told).all(axis=1)
    assert here.all() == (windows == 6)
    np.testing.assert_allclose(told[here], whole[here], atol=1e-3)


def test_a_gap_in_a_log_costs_the_windows_across_it_and_no_others(tmp_path):
    """FrameClock 120 to 139 of 300 are gone: 2.1 s without any, with 12 s before and 16 s behind them."""
    left = np.setdiff1d(np.arange(300), np.arange(120, 140))
    scenario = town.waymo(300)
    scenario["length"], scenario["metadata"]["ts"] = len(left), scenario["metadata"]["ts"][left]
    for track in scenario["tracks"].values():
        track["state"] = {name: values[left] for name, values in track["state"].items()}
    for light in scenario["dynamic_map_states"].values():
        light["state"]["object_state"] = [light["state"]["object_state"][k] for k in left]
    broken, whole = (
        ScenarioNetReader(town.save(s, tmp_path / name))
        for s, name in ((scenario, "broken"), (town.waymo(300), "whole"))
    )
    index = broken.index()
    apart = [ref for ref in whole.index().refs if ref.start_ms + 9500 < 12000 or ref.start_ms >= 14000]
    assert index.refs == tuple(apart) and len(apart) == 10 and index.dropped == {"broken_tracks": 11}
    for ref in apart:
        clip, same = broken.read(ref), whole.read(ref)
        np.testing.assert_allclose(clip.ego_states, same.ego_states, atol=1e-3)
        np.testing.assert_allclose(clip.agents.boxes, same.agents.boxes, atol=1e-9)
        assert (clip.lights.states == same.lights.states).all()


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


def test_between_two_frames_a_track_turns_the_short_way_round() -> None:
    """From 0.1 rad before the half turn to 0.1 rad behind it: half way it is the half turn, not straight ahead."""
    positions = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    headings = np.array([np.pi - 0.1, -np.pi + 0.1])
    track = LoggedTrack(positions, headings, np.ones(2, bool), np.ones(3))
    frames = FrameClock(np.arange(2), np.array([0.0, 0.4]), np.array([0.0, 0.25, 0.5]), np.ones(3, bool), ())
    position, heading, valid = resampled(track, frames)
    np.testing.assert_allclose(position[:, 0], [0.0, 0.5, 1.0])
    np.testing.assert_allclose(heading, [np.pi - 0.1, np.pi - 0.05, -np.pi], atol=1e-12)
    assert valid.all()


def test_slope_velocities_ignore_absent_frames_and_far_origins():
    t = 0.1 * np.arange(30)
    xy = np.stack([1e6 + 3.0 * t, 2e6 - 4.0 * t], axis=1)[:, None]
    valid = np.ones((30, 1), bool)
    valid[[4, 5, 20]] = False
    velocity = fitted_velocities(np.where(valid[..., None], xy, 0.0), valid)
    np.testing.assert_allclose(velocity[valid], np.tile([3.0, -4.0], (27, 1)), atol=1e-6)
    assert np.isnan(velocity[~valid]).all()
    alone = np.zeros((30, 1), bool)
    alone[15] = True
    assert (fitted_velocities(xy, alone)[15] == 0.0).all() and SLOPE_STEPS == 5
