"""Traffic that a policy drives: what the policy is asked, what becomes of its answer, what it cannot know."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tasks.rollout.simulate import (
    SEEN_ROWS,
    BadPolicy,
    SeenTraffic,
    TrafficSettings,
    check_same_policy,
    next_scene,
    prepare_traffic,
    roll_out,
    roll_out_longer,
    traffic_record,
)
from tasks.world.clip import CLIP_STEPS, NOW, PER_STEP, STEP_S, AgentKind, AgentTracks, Scene
from tasks.world.frames import X
from tests.tasks.rollout import worlds
from tests.tasks.rollout.worlds import Track

Array = NDArray[np.float64]
CALLS: list[SeenTraffic] = []


class StraightOn:
    """Keeps speed and heading, and what it was asked."""

    def digest(self) -> str:
        return "straight on"

    def speeds(self, seen: SeenTraffic) -> Array:
        heading, velocity = seen.boxes[-1, :-1, 2], seen.velocities[-1, :-1]
        return velocity[:, 0] * np.cos(heading) + velocity[:, 1] * np.sin(heading)

    def next_states(self, seen: SeenTraffic) -> Array:
        CALLS.append(seen)
        (x, y, heading), speed = seen.boxes[-1, :-1, :3].T, self.speeds(seen)
        gone = STEP_S * speed
        return np.stack([x + gone * np.cos(heading), y + gone * np.sin(heading), heading, speed], axis=1)


class Nervous(StraightOn):
    """Its speed follows what everybody did in the second before."""

    def speeds(self, seen: SeenTraffic) -> Array:
        return 4.0 + 3.0 * np.sin(np.nansum(seen.boxes[..., :2] * seen.valid[..., None]) + np.arange(len(seen.asked)))


class Echo(StraightOn):
    """Has driven vehicles where another rollout had them."""

    of: AgentTracks

    def next_states(self, seen: SeenTraffic) -> Array:
        now = seen.boxes[-1, :-1]
        (t, *_) = np.flatnonzero([np.array_equal(boxes, now, equal_nan=True) for boxes in self.of.boxes])
        return np.column_stack([self.of.boxes[t + 1, :, :3], np.hypot(*self.of.velocities[t + 1].T)])


def by(policy: type) -> TrafficSettings:
    return TrafficSettings(mode="custom", policy=f"{__name__}:{policy.__name__}")


def asked_in(scene: Scene, ego: Array) -> list[SeenTraffic]:
    CALLS.clear()
    roll_out(prepare_traffic(scene, by(StraightOn)), ego)
    return list(CALLS)


def parked_ego() -> Array:
    scene = worlds.scene(worlds.straight_road())
    return np.repeat(scene.ego_state[None], 41, axis=0)


@pytest.mark.parametrize("seed", range(8))
def test_a_policy_that_answers_as_idm_gives_idm_s_world(seed: int) -> None:
    """All that is not its answer goes by the same rules: who is driven, waits, enters, parks, and from when."""
    scene = worlds.random_scene(seed)
    (ego,) = worlds.random_egos(scene, seed, 1)
    idm = roll_out(prepare_traffic(scene, TrafficSettings(yields=False)), ego)
    Echo.of = idm.agents
    echoed = roll_out(prepare_traffic(scene, by(Echo)), ego)
    np.testing.assert_array_equal(echoed.agents.boxes, idm.agents.boxes)
    np.testing.assert_array_equal(echoed.agents.valid, idm.agents.valid)
    np.testing.assert_allclose(echoed.agents.velocities, idm.agents.velocities, atol=1e-12)
    np.testing.assert_array_equal(echoed.simulated, idm.simulated)


@pytest.mark.parametrize("seed", range(4))
def test_a_rollout_goes_on_and_leads_to_a_scene_that_does(seed: int) -> None:
    scene = worlds.random_scene(seed)
    traffic, egos = prepare_traffic(scene, by(Nervous)), worlds.random_egos(scene, seed, 3)
    for ego in egos:
        alone = roll_out(traffic, ego)
        on = roll_out_longer(traffic, np.concatenate([ego, np.repeat(ego[-1:], 10, axis=0)]))
        for name in PER_STEP:
            np.testing.assert_array_equal(getattr(on, name)[:41], getattr(alone.agents, name))
        second = next_scene(scene, alone, scene.centerline)
        after = roll_out(prepare_traffic(second, by(Nervous)), np.repeat(ego[-1:], 41, axis=0))
        np.testing.assert_array_equal(after.agents.boxes[0], alone.agents.boxes[-1])
        assert np.isfinite(after.agents.boxes[after.agents.valid]).all()


def test_what_the_ego_does_later_changes_nothing_before() -> None:
    scene = worlds.scene(worlds.straight_road(), Track(0.0, speed=5.0), ego=(25.0, 0.0, 0.0), ego_speed=3.0)
    (first,) = worlds.random_egos(scene, 1, 1)
    other = first.copy()
    other[21:, X] += 3.0
    traffic = prepare_traffic(scene, by(Nervous))
    a, b = (roll_out(traffic, ego).agents.boxes for ego in (first, other))
    np.testing.assert_array_equal(a[:22], b[:22])
    assert not np.array_equal(a, b, equal_nan=True)


def test_a_policy_is_shown_the_second_before_and_nothing_of_what_comes() -> None:
    scene = worlds.scene(worlds.straight_road(), Track(0.0, speed=5.0), ego=(40.0, 0.0, 0.0), ego_speed=3.0)
    ego = np.repeat(scene.ego_state[None], 41, axis=0)
    ego[:, X] = 40.0 + 0.3 * np.arange(41)
    calls = asked_in(scene, ego)
    assert len(calls) == 40
    for t, seen in enumerate(calls):
        assert seen.boxes.shape == (SEEN_ROWS, 2, 5) and seen.asked.tolist() == [True] and seen.valid.all()
        ego_center = ego[0, X] + 0.3 * (np.arange(t - 10, t + 1)) + 1.461
        assert seen.boxes[:, 1, 0] == pytest.approx(ego_center, abs=0.01)
        assert seen.boxes[:, 0, 0] == pytest.approx(0.5 * np.arange(t - 10, t + 1))
        assert seen.velocities[:, 1, 0] == pytest.approx(3.0)
        assert seen.ways.line_state.shape == (1, 0) and seen.way.tolist() == [0]
        assert seen.kinds == (AgentKind.VEHICLE,) * 2 and seen.road_map is scene.clip.road_map


def test_a_car_that_its_log_holds_is_not_asked_before_its_log_starts() -> None:
    """It stands for 1.5 s, as at a light that is in no map; then the policy's first answer moves it."""
    way = np.maximum(0.0, STEP_S * (np.arange(CLIP_STEPS) - NOW - 15) * 6.0)
    scene = worlds.scene(worlds.straight_road(), Track(0.0, poses=np.column_stack([way, 0.0 * way, 0.0 * way])))
    calls = asked_in(scene, parked_ego())  # there is none while nobody is to be asked
    assert len(calls) == 40 - 16 and all(seen.asked[0] for seen in calls)
    assert (calls[0].boxes[:, 0, 0] == 0.0).all()


class AnswersNan(StraightOn):
    def next_states(self, seen: SeenTraffic) -> Array:
        return np.full((len(seen.asked), 4), np.nan)


class AnswersThree(StraightOn):
    def next_states(self, seen: SeenTraffic) -> Array:
        return np.zeros((len(seen.asked), 3))


@pytest.mark.parametrize(
    ("policy", "said"),
    [
        ("nothing_of_that_name:It", "traffic.policy=nothing_of_that_name:It: name one as"),
        ("tasks.rollout.idm:NoSuchPolicy", "name one as"),
        ("builtins:dict", "is no traffic policy: it has no digest, next_states"),
        (f"{__name__}:AnswersNan", "AnswersNan.next_states gave a state that is not finite"),
        (f"{__name__}:AnswersThree", r"AnswersThree.next_states gave \(1, 3\), not \(1, 4\)"),
    ],
)
def test_what_is_no_policy_is_told(policy: str, said: str) -> None:
    scene = worlds.scene(worlds.straight_road(), Track(0.0, speed=5.0))
    with pytest.raises(BadPolicy, match=said):
        roll_out(prepare_traffic(scene, TrafficSettings(mode="custom", policy=policy)), parked_ego())


def test_records_tell_policies_apart_and_hold_nothing_of_one_elsewhere(monkeypatch: pytest.MonkeyPatch) -> None:
    assert "policy" not in traffic_record(TrafficSettings())
    one, other = (traffic_record(by(policy))["policy"] for policy in (StraightOn, Nervous))
    assert one == f"{__name__}:StraightOn straight on" != other
    check_same_policy(by(StraightOn), one)
    monkeypatch.setattr(StraightOn, "digest", lambda self: "changed")
    with pytest.raises(OSError, match="another digest than when the run began"):
        check_same_policy(by(StraightOn), one)


@pytest.mark.parametrize("words", [{"mode": "custom"}, {"policy": "my:Policy"}, {"mode": "navsim", "policy": "my:P"}])
def test_a_policy_and_its_mode_are_given_together(words: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"traffic=custom takes one, alone"):
        TrafficSettings(**words)
