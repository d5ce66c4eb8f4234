"""A user's trajectories on a clip get the scores of the public metric's path: interpolate, track, score."""

from dataclasses import replace

import numpy as np
import pytest

from tasks.experts.pdm_closed import plan_for
from tasks.trajectories import at_ten_hz, score_trajectories
from tasks.world.clip import CLIP_STEPS, HISTORY_STEPS, AgentTracks, Clip, scene_of_clip
from tasks.world.frames import VX, X, to_local
from tasks.world.road_map import NO_LIGHTS, Lane, LightState, MapPolygon, RoadMap, Route, TrafficLights
from tests.tasks.reward.straight_street import STREET, Thing, drive, tracks


def clip_on_the_street(speed: float, things: list[Thing], red_from_step: int | None = None) -> Clip:
    ego = np.tile(drive(speed)[0, 0], (CLIP_STEPS, 1))
    ego[:, X] = speed * 0.1 * (np.arange(CLIP_STEPS) - HISTORY_STEPS)
    short = tracks(things)
    where = np.clip(np.arange(CLIP_STEPS) - HISTORY_STEPS, 0, 40)
    agents = AgentTracks(
        short.track_ids,
        short.kinds,
        short.boxes[where],
        short.velocities[where],
        short.valid[where],
        short.center_z[where],
        short.heights,
    )
    centerline = np.column_stack([np.linspace(-50, 130, 181), np.zeros((181, 2))])
    turn = np.array([[20, -2], [30, -2], [30, 2], [20, 2], [20, -2]], dtype=float)
    lanes = {
        "own": Lane("own", STREET[0].ring, centerline, is_intersection=False, drives_cars=True),
        "turn": Lane("turn", turn, centerline[70:81], is_intersection=True, drives_cars=True),
    }
    states = np.full((CLIP_STEPS, 1), LightState.GREEN, dtype=np.int8)
    if red_from_step is not None:
        states[red_from_step:] = LightState.RED
    return Clip(
        clip_id="c",
        dataset="test",
        log_id="l",
        split="val",
        start_s=0.0,
        ego_states=ego,
        world_from_ego=np.tile(np.eye(4), (CLIP_STEPS, 1, 1)),
        agents=agents,
        road_map=RoadMap(lanes, (MapPolygon("da_1", STREET[2].layer, STREET[2].ring),)),
        route=Route(("own", "turn"), ("rb", "rbc"), frozenset({"own", "turn"})),
        centerline=centerline,
        lights=TrafficLights(("turn",), states),
    )


def straight(speed: float, steps: int) -> np.ndarray:
    t = 4.0 / steps * np.arange(1, steps + 1)
    return np.stack([speed * t, np.zeros(steps), np.zeros(steps)], axis=-1)


def test_plans_at_2_hz_are_joined_linearly_also_across_the_heading_jump():
    np.testing.assert_allclose(at_ten_hz(straight(7.0, 8)[None]), straight(7.0, 40)[None], atol=1e-12)
    turning = straight(7.0, 8)
    turning[:, 2] = np.linspace(0.5, 4.0, 8)
    wrapped = turning.copy()
    wrapped[:, 2] = (turning[:, 2] + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(at_ten_hz(wrapped[None]), at_ten_hz(turning[None]), atol=1e-12)
    with pytest.raises(ValueError, match="poses must be"):
        at_ten_hz(np.zeros((3, 10, 3)))


def test_going_on_in_the_lane_is_perfect_and_ramming_the_car_ahead_is_not():
    clip = clip_on_the_street(6.0, [Thing(30.0, 0.0, 0.0, (2.0, 0.0))])
    assert clip.ego_states[HISTORY_STEPS, VX] == 6.0
    got = score_trajectories(clip, np.stack([straight(6.0, 40), straight(9.0, 40)]), reference="batch")
    assert got.pdm_score[0] == 1.0 and got.nc.tolist() == [1.0, 0.0]


def test_progress_against_a_reference_is_that_of_a_two_row_batch():
    clip = clip_on_the_street(6.0, [])
    plans = np.stack([straight(6.0, 8), straight(5.0, 8)])
    got = score_trajectories(clip, plans, reference=straight(6.5, 8))
    for k in range(2):
        pair = score_trajectories(clip, np.stack([straight(6.5, 8), plans[k]]), reference="batch")
        assert got.ep[k] == pair.ep[1] < 1.0
    assert len(got) == 2


def test_a_car_that_stands_alone_is_perfect_in_its_own_batch_and_makes_no_progress_against_pdm_closed():
    clip = clip_on_the_street(0.0, [])
    standing = np.zeros((1, 40, 3))
    alone = score_trajectories(clip, standing, reference="batch")
    assert alone.pdm_score[0] == 1.0 and alone.ep_raw_m[0] == 0.0
    judged = score_trajectories(clip, standing)
    assert judged.ep[0] == 0.0
    np.testing.assert_allclose(judged.pdm_score, 9.0 / 14.0, rtol=0, atol=1e-12)  # all but EP's 5 of 14
    np.testing.assert_array_equal(score_trajectories(clip, standing, reference="pdm_closed").ep, judged.ep)


def test_the_default_reference_is_pdm_closed_s_plan_and_a_row_depends_on_no_other():
    clip = clip_on_the_street(6.0, [])
    scene = scene_of_clip(clip)
    of_pdm = to_local(scene.ego_state[:3], plan_for(scene).poses)
    plans = np.stack([straight(6.0, 40), straight(5.0, 40), straight(0.5, 40)])
    got = score_trajectories(clip, plans)
    np.testing.assert_allclose(got.ep, score_trajectories(clip, plans, reference=of_pdm).ep, rtol=0, atol=1e-9)
    for k in range(3):
        assert got.pdm_score[k] == score_trajectories(clip, plans[k : k + 1]).pdm_score[0]


def test_an_unknown_reference_and_a_route_without_length_are_refused_by_name():
    clip = clip_on_the_street(6.0, [])
    with pytest.raises(ValueError, match="'idm'"):
        score_trajectories(clip, straight(6.0, 40)[None], reference="idm")
    nowhere = replace(clip, centerline=np.zeros((2, 3)))
    with pytest.raises(ValueError, match="centerline must have a length"):
        score_trajectories(nowhere, straight(6.0, 40)[None])


def test_a_clip_without_lights_has_no_red_ones():
    clip = replace(clip_on_the_street(6.0, []), lights=NO_LIGHTS)
    assert score_trajectories(clip, straight(6.0, 40)[None]).tlc[0] == 1.0


def test_lights_count_from_the_clips_own_time():
    plan = straight(6.0, 40)[None]  # reaches the connector at 16 m, 2.7 s after T
    assert score_trajectories(clip_on_the_street(6.0, []), plan).tlc[0] == 1.0
    red = score_trajectories(clip_on_the_street(6.0, [], red_from_step=0), plan)
    late = score_trajectories(clip_on_the_street(6.0, [], red_from_step=HISTORY_STEPS + 35), plan)
    assert red.tlc_index[0] == 27 and late.tlc_index[0] == 35
    never = score_trajectories(clip_on_the_street(6.0, [], red_from_step=HISTORY_STEPS + 41), plan)
    assert never.tlc[0] == 1.0
