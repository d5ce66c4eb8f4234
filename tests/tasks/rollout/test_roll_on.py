"""Traffic for longer than a rollout: what was scored stays as it was, and everybody goes on from there."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from tasks.rollout.simulate import TrafficSettings, next_scene, prepare_traffic, roll_out, roll_out_longer
from tasks.world.clip import CLIP_STEPS, HORIZON_STEPS, NOW, PER_STEP, STEP_S, AgentKind, Scene
from tasks.world.frames import EGO_STATE_SIZE, VX, X
from tasks.world.road_map import LightState, TrafficLights
from tests.tasks.rollout import worlds
from tests.tasks.rollout.worlds import Track

IDM = TrafficSettings()
LONG = HORIZON_STEPS + 1 + 10
AT_THE_END = HORIZON_STEPS + NOW  # the step from which a label is driven: it ends with the log


def longer(states: NDArray[np.float64]) -> NDArray[np.float64]:
    """(51, 11) states of an ego that drives on at its last speed and heading."""
    way = STEP_S * np.arange(1, 11)[:, None] * states[-1, VX] * [np.cos(states[-1, 2]), np.sin(states[-1, 2])]
    after = np.repeat(states[-1:], 10, axis=0)
    after[:, :2] += way
    return np.concatenate([states, after])


def at_the_end(scene: Scene) -> Scene:
    """The same world at the step from which its log lasts for one rollout more."""
    return replace(scene, step=AT_THE_END)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("mode", ["idm", "replay"])
def test_the_rows_of_a_rollout_do_not_change_by_a_bit_where_it_goes_on(seed: int, mode: str) -> None:
    scene, settings = worlds.random_scene(seed), TrafficSettings(mode=mode)  # type: ignore[arg-type]
    first = prepare_traffic(scene, settings)
    (ego,) = worlds.random_egos(scene, seed, 1)
    rollout = roll_out(first, ego)
    second = prepare_traffic(next_scene(scene, rollout, scene.centerline), settings)
    (ego_after,) = worlds.random_egos(second.scene, seed + 100, 1)
    for traffic, states, other in ((first, ego, ego_after), (second, ego_after, ego)):
        whole = roll_out_longer(prepare_traffic(traffic.scene, settings), longer(states))
        roll_out(traffic, other)
        after_another = roll_out_longer(traffic, longer(states))
        shorter, on = roll_out(traffic, states).agents, roll_out_longer(traffic, longer(states))
        assert on.n_steps == LONG and on.track_ids == shorter.track_ids
        for name in PER_STEP:
            kept = getattr(whole, name)[: HORIZON_STEPS + 1]
            np.testing.assert_array_equal(kept, getattr(shorter, name), strict=True)
            for same in (on, after_another):  # one goes on from the rollout, one must not
                np.testing.assert_array_equal(getattr(same, name), getattr(whole, name), strict=True)


def test_the_public_traffic_goes_on_as_well() -> None:
    """Its vehicles drive on, what is none goes on along its log and then straight on; the first 41 rows stay."""
    walker = Track(20.0, -6.0, np.pi / 2, 1.2, AgentKind.PEDESTRIAN, (0.6, 0.6))
    scene = at_the_end(worlds.scene(worlds.straight_road(), walker, Track(0.0, speed=5.0), ego=(60.0, -50.0, 0.0)))
    traffic = prepare_traffic(scene, TrafficSettings(mode="navsim"))
    ego = np.repeat(scene.ego_state[None], LONG, axis=0)
    on, shorter = roll_out_longer(traffic, ego), roll_out(traffic, ego[: HORIZON_STEPS + 1]).agents
    for name in PER_STEP:
        np.testing.assert_array_equal(getattr(on, name)[: HORIZON_STEPS + 1], getattr(shorter, name), strict=True)
    assert on.valid.all() and (np.diff(on.boxes[:, 1, 0])[1:] > 0.4).all()
    assert np.diff(on.boxes[:, 0, 1]) == pytest.approx(0.12)


def parked_ego() -> NDArray[np.float64]:
    """(51, 11) far away."""
    return np.tile(np.array([*worlds.FAR_EGO, *np.zeros(EGO_STATE_SIZE - 3)]), (LONG, 1))


def test_after_the_log_s_end_who_replays_it_goes_straight_on_and_who_is_driven_is_driven_on() -> None:
    walker = Track(20.0, -6.0, np.pi / 2, 1.2, AgentKind.PEDESTRIAN, (0.6, 0.6))
    car, parked = Track(0.0, speed=5.0), Track(-30.0, 6.0)
    gone = Track(60.0, -9.0, 0.0, 1.0, AgentKind.PEDESTRIAN, (0.6, 0.6), last=CLIP_STEPS - 3)
    scene = at_the_end(worlds.scene(worlds.straight_road(), walker, car, parked, gone))
    for yields in (False, True):
        on = roll_out_longer(prepare_traffic(scene, TrafficSettings(yields=yields)), parked_ego())
        assert np.diff(on.boxes[:, 0, 1]) == pytest.approx(0.12) and on.boxes[:, 0, 0] == pytest.approx(20.0)
        speed = on.velocities[:, 1, 0]  # a free road: it accelerates through all 51 rows, or keeps its log's speed
        assert speed == pytest.approx(5.0) if yields else (np.diff(speed) > 0.0).all()
        assert (on.boxes[:, 2] == on.boxes[0, 2]).all() and on.valid[:, :3].all()
        assert on.valid[:-12, 3].all() and not on.valid[-12:, 3].any()  # who left its log does not come back


def test_a_light_is_after_the_log_s_end_what_it_was_at_it() -> None:
    """Red to the end, and a car that waits at the line goes on waiting; green at the end, and it has gone."""
    lanes = worlds.fork()
    lanes = {"in": replace(lanes["in"], successors=("ahead",)), "ahead": lanes["ahead"], "east": lanes["east"]}
    for last, waits in ((LightState.RED, True), (LightState.GREEN, False)):
        states = np.full((CLIP_STEPS, 1), LightState.RED, np.int8)
        states[-1] = last
        lights = TrafficLights(("ahead",), states)
        scene = at_the_end(worlds.scene(lanes, Track(-6.0, speed=1.0), lights=lights))
        agents = scene.agents
        here = agents.boxes.copy()
        here[AT_THE_END, 0, 0] = 56.0
        slow = np.where(np.arange(CLIP_STEPS)[:, None, None] == AT_THE_END, 0.01, agents.velocities)
        scene = replace(scene, agents=replace(agents, boxes=here, velocities=slow), ever_simulated=np.array([True]))
        x = roll_out_longer(prepare_traffic(scene, IDM), parked_ego()).boxes[:, 0, 0]
        assert x[HORIZON_STEPS] + worlds.CAR[0] / 2.0 < 60.0
        assert (x[-1] - x[HORIZON_STEPS] < 0.3) == waits


def test_the_log_s_own_second_is_replayed_where_there_is_one() -> None:
    way = np.where(np.arange(CLIP_STEPS) < NOW + HORIZON_STEPS, 0.0, 1.0).cumsum()
    scene = worlds.scene(worlds.straight_road(), Track(0.0, poses=np.column_stack([way, 0.0 * way, 0.0 * way])))
    on = roll_out_longer(prepare_traffic(scene, TrafficSettings(mode="replay")), parked_ego())
    np.testing.assert_array_equal(on.boxes[:, 0, 0], way[NOW : NOW + LONG])


def test_the_traffic_of_the_second_after_answers_to_where_the_ego_is_then() -> None:
    """An ego 20 m ahead stops on the lane after the rollout's end: the car behind brakes harder than if it goes on."""
    scene = worlds.scene(worlds.straight_road(), Track(0.0, speed=8.0), ego=(20.0, 0.0, 0.0), ego_speed=8.0)
    traffic = prepare_traffic(scene, IDM)
    (goes_on,) = worlds.random_egos(scene, 0, 1)
    goes_on[:, VX], goes_on[:, 2] = 8.0, 0.0
    goes_on[:, X], goes_on[:, 1] = 20.0 + 0.8 * np.arange(HORIZON_STEPS + 1), 0.0
    stops = longer(goes_on)
    stops[HORIZON_STEPS + 1 :, VX], stops[HORIZON_STEPS + 1 :, X] = 0.0, goes_on[-1, X]
    behind = {
        name: roll_out_longer(traffic, ego).velocities[-1, 0, 0]
        for name, ego in (("on", longer(goes_on)), ("no", stops))
    }
    assert behind["no"] < behind["on"] - 0.5


def test_states_that_are_none_are_refused() -> None:
    traffic = prepare_traffic(worlds.scene(worlds.straight_road(), Track(0.0)), IDM)
    broken = parked_ego()
    broken[45, X] = np.nan
    with pytest.raises(ValueError, match="not finite"):
        roll_out_longer(traffic, broken)
    with pytest.raises(ValueError, match="ego_states must be"):
        roll_out(traffic, parked_ego())
