"""2 Hz frames at 10 Hz: the fast path is the slow twin's, and each rule by a case of its own."""

from typing import Any

import numpy as np
import pytest

from factory.datasets.navsim.log import Frame, parse_frame
from factory.datasets.navsim.window import ego_states, stretch_agents, traffic_lights, window_agents, world_from_ego
from tasks.world.clip import NOW, AgentKind, AgentTracks
from tasks.world.road_map import LightState
from tests.factory.datasets.navsim.logs import frame
from tests.factory.datasets.navsim.twin import Shown, brought_to_10_hz

KINDS = ("vehicle", "pedestrian", "barrier", "generic_object")


def _frame(k: int, rows: dict[str, list[float]], kinds: dict[str, str], **other: Any) -> Frame:
    """Frame k with these boxes: x, y, z, length, width, height, yaw, vx, vy in the ego frame."""
    table = np.array(list(rows.values()), np.float64).reshape(len(rows), 9)
    anns = {
        "gt_boxes": table[:, :7],
        "gt_names": np.array([kinds[name] for name in rows]),
        "gt_velocity_3d": np.column_stack([table[:, 7:], np.zeros(len(rows))]),
        "instance_tokens": list(rows),
        "track_tokens": list(rows),
    }
    return parse_frame(frame(k, anns=anns, **other), "f", "")


def _random_frames(seed: int) -> list[Frame]:
    """20 frames of a turning ego and 30 objects that come and go as they like."""
    rng = np.random.default_rng(seed)
    kinds = {f"t{i}": KINDS[i % len(KINDS)] for i in range(30)}
    shown = rng.random((20, 30)) < rng.choice([0.05, 0.15, 0.6, 1.0], 30)
    frames = []
    for k in range(20):
        rows = {
            f"t{i}": [*rng.uniform(-40, 40, 2), 0.5, *rng.uniform(0.3, 5, 3), rng.uniform(-9, 9), *rng.normal(0, 5, 2)]
            for i in np.flatnonzero(shown[k])
        }
        heading = 3.0 + 0.2 * k
        quaternion = [np.cos(heading / 2), 0.0, 0.0, np.sin(heading / 2)]
        frames.append(_frame(k, rows, kinds, ego2global_rotation=quaternion))
    return frames


def _shown(frame: Frame) -> dict[str, Shown]:
    """Placed by hand: turned by the ego's heading, moved to its rear axle."""
    out, (x, y, heading) = {}, frame.pose
    assert frame.boxes is not None
    c, s = np.cos(heading), np.sin(heading)
    for i, track_id in enumerate(frame.boxes.track_tokens):
        bx, by, bz, *size, yaw = frame.boxes.boxes[i]
        vx, vy, _ = frame.boxes.velocities[i]
        kind = frame.boxes.kinds[i]
        if kind not in (AgentKind.VEHICLE, AgentKind.PEDESTRIAN):
            vx = vy = 0.0
        turned = np.arctan2(np.sin(yaw + heading), np.cos(yaw + heading))
        place = (x + c * bx - s * by, y + s * bx + c * by, float(turned), *size, c * vx - s * vy, s * vx + c * vy)
        out[track_id] = Shown(kind, *place, bz + frame.world_from_ego[2, 3])
    return out


@pytest.mark.parametrize("seed", range(4))
def test_the_fast_path_is_the_slow_twin_s(seed: int) -> None:
    frames = _random_frames(seed)
    fast = window_agents(frames)
    slow = brought_to_10_hz([_shown(frame) for frame in frames], frames[3].pose)
    assert set(fast.track_ids) == set(slow.track_ids)
    order = [fast.track_ids.index(name) for name in slow.track_ids]
    assert tuple(fast.kinds[i] for i in order) == slow.kinds
    assert (fast.valid[:, order] == slow.valid).all() and 0.1 < slow.valid.mean() < 0.9
    turn = fast.boxes[:, order, 2] - slow.boxes[..., 2]
    assert np.nanmax(np.abs((turn + np.pi) % (2 * np.pi) - np.pi)) < 1e-9
    for name in ("velocities", "center_z"):
        assert np.nanmax(np.abs(getattr(fast, name)[:, order] - getattr(slow, name))) < 1e-8
    rest = [0, 1, 3, 4]
    assert np.nanmax(np.abs(fast.boxes[:, order][..., rest] - slow.boxes[..., rest])) < 5e-9  # a UTM metre's last bits


def _only_in(*numbers: int, x: float = 30.0) -> AgentTracks:
    """A standing car at x metres ahead of the first frame's ego, seen in these frames alone."""
    rows = {
        k: {"car": [x - 4.0 * k, 0.0, 0.8, 4.0, 2.0, 1.5, 0.0, 0.0, 0.0]} if k in numbers else {} for k in range(20)
    }
    return window_agents([_frame(k, rows[k], {"car": "vehicle"}) for k in range(20)])


def _steps(agents: AgentTracks) -> list[int]:
    return [int(step) for step in np.flatnonzero(agents.valid.any(axis=1))]


def test_a_track_is_there_from_its_first_to_its_last_frame_of_the_horizon_gaps_and_all() -> None:
    assert _steps(_only_in(4, 9)) == list(range(20, 46))


def test_a_track_seen_once_in_the_horizon_is_there_at_all_its_steps_but_t_itself() -> None:
    assert _steps(_only_in(6)) == list(range(NOW + 1, 56))
    assert _steps(_only_in(3)) == list(range(NOW, 56))
    assert _steps(_only_in(14)) == list(range(56, 96))


def test_a_track_seen_once_that_would_touch_the_ego_at_t_is_left_out() -> None:
    assert _steps(_only_in(6, x=12.0)) == []  # the ego's rear axle is at 12 m at T


def test_history_and_horizons_know_nothing_of_each_other() -> None:
    assert _steps(_only_in(1)) == [5]
    assert _steps(_only_in(1, 5, 6)) == [5, *range(25, 31)]
    assert _steps(_only_in(2, 3, 4)) == list(range(10, 21))


def test_a_stretch_shows_each_track_from_its_first_to_its_last_frame() -> None:
    frames = [
        _frame(k, {"car": [9.0, 0, 0, 4, 2, 1, 0, 0, 0]} if k in (2, 5) else {}, {"car": "vehicle"}) for k in range(8)
    ]
    agents = stretch_agents(frames)
    assert agents.n_steps == 36 and _steps(agents) == list(range(10, 26))


def test_the_ego_is_linear_between_frames_in_pose_velocity_and_acceleration() -> None:
    frames = [parse_frame(frame(k, ego_dynamic_state=[8.0 + k, 0.5, 0.25 * k, 0.0]), "f", "") for k in range(20)]
    states, poses = ego_states(frames), world_from_ego(frames)
    at = np.arange(96) / 5
    assert np.allclose(states[:, 0], 331_000.0 + 4.0 * at, atol=1e-9) and (states[:, 1] == 4_690_000.0).all()
    assert np.allclose(states[:, 3], 8.0 + at) and np.allclose(states[:, 5], 0.25 * at)
    assert (states[:, 7:] == 0.0).all()
    assert np.allclose(poses[:, :3, 3], np.column_stack([states[:, :2], np.full(96, 12.0)]), atol=1e-9)


def test_an_ego_that_turns_through_pi_takes_the_short_way() -> None:
    frames = []
    for k, heading in enumerate((3.1, -3.1)):
        quaternion = [np.cos(heading / 2), 0.0, 0.0, np.sin(heading / 2)]
        frames.append(parse_frame(frame(k, ego2global_rotation=quaternion), "f", ""))
    turned = ego_states(frames)[:, 2]
    assert (np.abs(turned) > 3.09).all() and turned[0] > 0 > turned[-1]
    forward = world_from_ego(frames)[:, :2, 0]
    assert np.allclose(np.arctan2(forward[:, 1], forward[:, 0]), np.arctan2(np.sin(turned), np.cos(turned)), atol=1e-9)


def test_a_light_holds_until_the_next_frame_and_red_wins_where_it_is_named_twice() -> None:
    named = [[("21", False)], [("21", True), ("21", False), ("77", True)], []]
    frames = [parse_frame(frame(k, traffic_lights=lights_), "f", "") for k, lights_ in enumerate(named)]
    read = traffic_lights(frames, ["21", "22"])
    assert read.lane_ids == ("21",)
    green, red, unknown = LightState.GREEN, LightState.RED, LightState.UNKNOWN
    assert read.states[:, 0].tolist() == [green] * 5 + [red] * 5 + [unknown]
