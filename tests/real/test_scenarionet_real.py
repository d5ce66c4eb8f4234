"""Seven nuScenes scenes through the ScenarioNet reader: what the format promises, and what a clip must be like."""

from pathlib import Path

import numpy as np
import pytest

from factory.datasets.scenarionet.reader import ScenarioNetReader, read_log, read_scenario, scenario_files
from factory.readers.base import ClipIndex
from tasks.world.clip import CLIP_STEPS, NOW, AgentKind, Clip
from tasks.world.frames import AX, AY, HEADING, VX, VY, X, Y
from tasks.world.road_map import Rings


@pytest.fixture(scope="module")
def root(shared_root: Path) -> Path:
    return shared_root / "data" / "scenarionet" / "nuscenes"


@pytest.fixture(scope="module")
def logs(root: Path):
    return {log_id: read_log(path) for log_id, path in scenario_files(root).items()}


@pytest.fixture(scope="module")
def index(root: Path) -> ClipIndex:
    return ScenarioNetReader(root).index()


@pytest.fixture(scope="module")
def clips(root: Path, index: ClipIndex) -> list[Clip]:
    reader = ScenarioNetReader(root)
    return [reader.read(ref) for ref in index.refs]


def test_the_seven_scenes_give_61_windows_and_15_that_stand(index):
    counts = {}
    for ref in index.refs:
        counts[ref.log_id[-4:]] = counts.get(ref.log_id[-4:], 0) + 1
    assert counts == {"0061": 10, "0655": 11, "0757": 9, "0796": 11, "1077": 11, "1100": 9}
    assert index.dropped == {"ego_standing": 15}  # all of 0553, and where 0757 and 1100 only wait
    assert not index.broken and not index.skipped_logs


def test_joined_lanes_meet_and_point_the_same_way(logs):
    gaps, turns = [], []
    for log in logs.values():
        lanes = log.road_map.lanes
        for lane in lanes.values():
            for successor in lane.successors:
                end, start = lane.centerline[-1], lanes[successor].centerline[0]
                gaps.append(np.hypot(*(start - end)[:2]))
                turns.append(abs(np.angle(np.exp(1j * (start[2] - end[2])))))
    assert len(gaps) > 2000 and max(gaps) < 0.5
    assert np.quantile(turns, 0.99) < np.radians(30)


def test_the_ego_drives_like_a_car(clips):
    for clip in clips:
        states = clip.ego_states
        assert np.hypot(states[:, AX], states[:, AY]).max() < 4.0
        assert np.abs(np.diff(states[:, AX])).max() / 0.1 < 4.0
        assert np.abs(states[:, VY]).max() < 0.3 and states[:, VX].min() > -0.1
        assert np.abs(np.diff(np.unwrap(states[:, HEADING]))).max() / 0.1 < 0.6
        travelled = np.cumsum(states[:-1, VX]) * 0.1
        assert travelled[-1] == pytest.approx(np.hypot(*np.diff(states[:, [X, Y]], axis=0).T).sum(), abs=0.6)


def test_the_ego_on_the_log_s_clock_meets_the_keyframes_that_follow_the_can_bus(logs, root):
    """The last 2-4 poses of three scenes are keyframes on the agents' clock: as stored the ego falls back up to 3 m."""
    compared = 0
    for log_id, tail in (("0061", 188), ("0655", 197), ("1077", 199)):
        (path,) = (path for stem, path in scenario_files(root).items() if stem.endswith(log_id))
        scenario, _ = read_scenario(path)
        stored = np.asarray(scenario["tracks"]["ego"]["state"]["position"])[:, :2]
        motion = logs[path.stem].motion
        on = np.flatnonzero(motion.segment >= 0)
        off = np.hypot(*(motion.ego_states[:, [X, Y]] - stored).T)
        assert off[tail - 1] > 0.5
        assert off[on[on >= tail]].max() < 0.05
        compared += int((on >= tail).sum())
    assert compared >= 5


def test_every_window_is_on_its_route_and_has_road_ahead(clips):
    for clip in clips:
        rings = Rings([clip.road_map.lanes[lane_id].ring for lane_id in clip.route.lane_ids])
        assert np.mean([rings.contains(state[:2]).any() for state in clip.ego_states]) > 0.9
        line = clip.centerline
        assert np.hypot(*(line[:, :2] - clip.ego_states[NOW, :2]).T).min() < 2.0
        driven = np.hypot(*np.diff(clip.ego_states[NOW:, [X, Y]], axis=0).T).sum()
        nearest = int(np.hypot(*(line[:, :2] - clip.ego_states[NOW, :2]).T).argmin())
        assert np.hypot(*np.diff(line[nearest:, :2], axis=0).T).sum() > driven


def test_nothing_valid_is_missing_and_agents_move_as_they_are_seen_to(clips):
    for clip in clips:
        agents = clip.agents
        assert agents.valid.any(axis=0).all() and agents.n_steps == CLIP_STEPS
        assert np.isfinite(agents.boxes[agents.valid]).all() and np.isfinite(agents.velocities[agents.valid]).all()
        for k, kind in enumerate(agents.kinds):
            seen = agents.valid[:, k]
            speed = np.hypot(*agents.velocities[seen, k].T)
            limit = {AgentKind.VEHICLE: 35.0, AgentKind.BICYCLE: 15.0, AgentKind.PEDESTRIAN: 4.0}.get(kind, 1.5)
            assert speed.max() < limit
        moved = np.diff(agents.boxes[..., :2], axis=0)
        both = agents.valid[1:] & agents.valid[:-1]
        assert np.abs(moved[both] - 0.1 * agents.velocities[1:][both]).max() < 1.0


def test_the_ego_never_overlaps_the_box_of_an_agent_s_first_sight(clips):
    """No track is the ego's own: none stays on its rear axle."""
    for clip in clips:
        distance = np.hypot(*np.moveaxis(clip.agents.boxes[..., :2] - clip.ego_states[:, None, [X, Y]], -1, 0))
        assert np.nanmax(distance, axis=0).min() > 1.0
