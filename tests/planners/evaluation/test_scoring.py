"""Plans on frames: the public pair [PDM-Closed, plan], the traffic's answer, the human filter, extended comfort."""

from dataclasses import replace

import numpy as np
import pytest

from planners.evaluation.frames import FrameKey, Pair
from planners.evaluation.scoring import (
    ClipFrames,
    Rules,
    drive,
    human_plans,
    logged_poses,
    pdm_plans,
    prepare_clip,
    prepare_frame,
    prepare_lone,
    score_clip,
    score_lone,
    score_pair,
)
from tasks.attempt import drive_and_judge
from tasks.experts.protocol import Plan
from tasks.reward.aggregate import COLUMNS
from tasks.rollout.simulate import TrafficSettings
from tasks.world.clip import HORIZON_STEPS, NOW, STEP_S, Clip, scene_of_clip
from tasks.world.frames import AX, HEADING, X, to_world
from tasks.world.road_map import MapLayer, MapPolygon
from tests.planners.small_benchmark import clip_scenes, same_plan_everywhere, straight
from tests.tasks.streets import rectangle, street_clip

SCORE = COLUMNS.index("score")


@pytest.fixture(scope="module")
def clip() -> ClipFrames:
    return prepare_clip(clip_scenes(), Rules())


@pytest.mark.parametrize("mode", ["idm", "replay"])
@pytest.mark.parametrize("poses", [straight(8.0), straight(14.0), straight(6.0, -3.0)], ids=["log", "fast", "aside"])
def test_a_drive_scores_as_the_factory_scores_an_experts(mode: str, poses: np.ndarray) -> None:
    scene, traffic = clip_scenes().logged.now, TrafficSettings(mode=mode)
    judged = drive_and_judge(scene, Plan(to_world(scene.ego_state[: HEADING + 1], poses)), traffic)
    ours = drive(prepare_frame(scene, traffic, logged=True), poses)
    np.testing.assert_array_equal(ours.states, judged.rollout.ego_states)
    for name in ("nc", "dac", "ddc", "tlc", "ep", "ttc", "lk", "hc", "ep_raw_m", "pdm_score"):
        assert getattr(ours.scores, name)[0] == getattr(judged.scores, name)[1], name


def test_who_comes_from_behind_answers_to_the_plan_that_moves_over_in_front() -> None:
    """PDM-Closed, the reference, keeps its lane: for it nobody would have to brake."""
    scene, moves_over = clip_scenes().logged.now, straight(3.0, 2.0)
    answers, goes_on = (
        drive(prepare_frame(scene, TrafficSettings(mode=mode), logged=True), moves_over).scores
        for mode in ("idm", "replay")
    )
    assert (answers.nc[0], answers.ttc[0]) == (1.0, 1.0)
    assert (goes_on.nc[0], goes_on.ttc[0]) == (0.0, 0.0)


def test_the_human_is_known_every_half_second_and_driven_linearly_between() -> None:
    scene = clip_scenes().logged.now
    np.testing.assert_allclose(logged_poses(scene), straight(8.0), atol=1e-9)
    speeding = scene.clip.ego_states.copy()
    speeding[NOW + 2, 0] += 1.0  # between two poses that are looked at
    moved = scene_of_clip(replace(scene.clip, ego_states=speeding))
    np.testing.assert_allclose(logged_poses(moved), straight(8.0), atol=1e-9)


def test_rows_are_one_of_one_stage_two_of_stage_one_and_a_pair_a_follow_up(clip: ClipFrames) -> None:
    scenes = clip_scenes()
    rows = score_clip(clip, same_plan_everywhere(scenes, straight(8.0)))
    assert [(row.stage, row.key.kind, row.key.candidate_index) for row in rows] == [
        ("one_stage", "human", -1),
        ("stage_one", "human", -1),
        ("stage_one", "human_before", -1),
        ("stage_two", "follow_up", 0),
        ("stage_two", "follow_up_before", 0),
        ("stage_two", "follow_up", 1),
        ("stage_two", "follow_up_before", 1),
    ]
    for row in rows[1:3]:
        np.testing.assert_allclose(row.end - row.start, [32.0, 0.0, 0.0], atol=1e-9)
    # follow-up starts about 28 m and 32 m (0.5 m aside) ahead: the plan's end at 32 m prefers the second
    assert rows[5].weight > 0.99
    for side in (0, 1):
        assert sum(row.weight for row in rows[3 + side :: 2]) == pytest.approx(1.0)
    assert all(np.isnan(row.weight) for row in rows[:3])


def test_the_pair_shares_its_extended_comfort(clip: ClipFrames) -> None:
    scenes = clip_scenes()
    steady = score_clip(clip, same_plan_everywhere(scenes, straight(8.0)))
    plans = same_plan_everywhere(scenes, straight(8.0))
    plans[FrameKey.logged(clip.clip_id)[1]] = straight(2.0)  # 0.5 s ago it wanted to brake hard
    other = score_clip(clip, plans)
    ec = COLUMNS.index("ec")
    assert [row.scores.unfiltered[ec] for row in steady[:3]] == [1.0, 1.0, 1.0]
    assert [row.scores.unfiltered[ec] for row in other[:3]] == [0.0, 0.0, 0.0]
    for a, b in zip(steady[3:], other[3:]):
        np.testing.assert_array_equal(a.scores.unfiltered, b.scores.unfiltered)


def test_a_lone_frame_scores_as_the_logged_frame_among_the_one_stage_evaluation_s_traffic(clip: ClipFrames) -> None:
    scenes, rules = clip_scenes(), Rules()
    lone = prepare_lone(clip.clip_id, scenes.logged.now, rules)
    assert lone.frame.traffic.settings == rules.one_stage != rules.two_stage
    plans = same_plan_everywhere(scenes, straight(8.0))
    plans[FrameKey.logged(clip.clip_id)[1]] = straight(2.0)
    before = drive(clip.alone.before, straight(2.0)).states
    wanted, (row, _) = score_clip(clip, plans)[0], score_lone(lone, plans, before)
    np.testing.assert_array_equal(row.scores.filtered, wanted.scores.filtered)
    np.testing.assert_array_equal(row.end, wanted.end)
    alone, _ = score_lone(lone, plans, None)
    assert np.isnan(alone.scores.filtered[COLUMNS.index("ec")]) and row.scores.filtered[COLUMNS.index("ec")] == 0.0


def test_human_and_pdm_closed_bound_a_plan_that_stands_or_races(clip: ClipFrames) -> None:
    scenes = clip_scenes()
    human, pdm = score_clip(clip, human_plans(clip.frames)), score_clip(clip, pdm_plans(clip.frames))
    bad = [score_clip(clip, same_plan_everywhere(scenes, straight(v))) for v in (0.0, 25.0)]
    for i in range(3):
        assert human[i].scores.filtered[SCORE] > 0.9
        assert all(rows[i].scores.filtered[SCORE] < human[i].scores.filtered[SCORE] for rows in bad)
    assert all(row.scores.filtered[SCORE] > 0.5 for row in pdm)
    # nobody drove from a follow-up frame
    assert all(np.isnan(row.scores.filtered).all() and np.isnan(row.end).all() for row in human[3:])


def test_what_the_human_fails_is_forgiven_on_logged_frames_only() -> None:
    street = street_clip()
    narrow = MapPolygon("da_1", MapLayer.DRIVABLE_AREA, rectangle((-100.0, -0.5), (300.0, 7.0)))  # half a lane is gone
    scenes = clip_scenes(replace(street, road_map=replace(street.road_map, drivable_areas=(narrow,))))
    rows = score_clip(prepare_clip(scenes, Rules()), same_plan_everywhere(scenes, straight(8.0)))
    dac = COLUMNS.index("dac")
    assert [row.scores.unfiltered[dac] for row in rows] == [0.0] * 7
    assert [row.scores.filtered[dac] for row in rows] == [1.0] * 3 + [0.0] * 4
    assert all(row.scores.filtered[SCORE] > 0.9 and row.scores.unfiltered[SCORE] == 0.0 for row in rows[:3])


def test_the_human_is_not_excused_by_what_came_before_the_frame() -> None:
    """History is the ego's own: a plan that starts in rough motion fails, and nobody's roughness before excuses it."""
    street = street_clip()
    rough = street.ego_states.copy()
    rough[:NOW, AX] = 6.0  # the comfortable limit is 2.4
    scenes = clip_scenes(replace(street, ego_states=rough))
    rows = score_clip(prepare_clip(scenes, Rules()), same_plan_everywhere(scenes, straight(8.0)))[:3]
    hc = COLUMNS.index("hc")
    assert [row.scores.unfiltered[hc] for row in rows] == [0.0] * 3
    assert [row.scores.filtered[hc] for row in rows] == [0.0] * 3


def slow_start_ahead() -> Clip:
    """The car ahead is 15 m away at 2 m/s and by its log gone at once: IDM lets it pick up speed at its own pace."""
    street = street_clip()
    agents = street.agents
    boxes, velocities = agents.boxes.copy(), agents.velocities.copy()
    time = (np.arange(len(boxes)) - NOW) * STEP_S
    boxes[:, 0, X] = 15.0 + np.where(time > 0.0, 25.0 * time, 2.0 * time)
    velocities[:, 0] = 2.0, 0.0
    return replace(street, agents=replace(agents, boxes=boxes, velocities=velocities))


def test_what_the_human_fails_is_asked_among_the_traffic_of_the_same_evaluation() -> None:
    """Among reactive traffic the human runs into the car ahead, which is forgiven there; in the log the way is free,
    and who races through it into the next car is not."""
    scenes = clip_scenes(slow_start_ahead())
    prepared = prepare_clip(scenes, Rules())
    alone, logged = prepared.alone.now, prepared.logged.now
    assert alone.human is not None and logged.human is not None
    assert (alone.human.nc[0], logged.human.nc[0]) == (1.0, 0.0)
    one_stage, stage_one = score_clip(prepared, same_plan_everywhere(scenes, straight(30.0)))[:2]
    nc = COLUMNS.index("nc")
    assert stage_one.scores.unfiltered[nc] == 0.0 and stage_one.scores.filtered[nc] == 1.0
    assert one_stage.scores.unfiltered[nc] == one_stage.scores.filtered[nc]


def waving(after_s: float) -> np.ndarray:
    """(40, 3) 8 m/s, and from `after_s` on up to 2 m/s2 gained and lost in turn, a second each."""
    time = np.linspace(0.0, 4.0, 401)
    speed = 8.0 + np.where(time > after_s, 2.0 / np.pi * (1.0 - np.cos(np.pi * (time - after_s))), 0.0)
    way = np.concatenate([[0.0], np.cumsum(0.005 * (speed[1:] + speed[:-1]))])
    return np.column_stack([way[10::10], np.zeros(40), np.zeros(40)])


def test_a_plan_is_compared_with_what_the_one_before_wanted_at_the_same_time_of_day(clip: ClipFrames) -> None:
    """A wave in half a second was a second away half a second ago; the other way round it comes a second late."""
    now, before = clip.logged.now, clip.logged.before
    ec = COLUMNS.index("ec")
    found = {
        delays: score_pair(Pair(now, before), (waving(delays[0]), waving(delays[1])))[0][0].unfiltered[ec]
        for delays in ((0.5, 1.0), (1.0, 0.5), (0.5, 0.5))
    }
    assert found == {(0.5, 1.0): 1.0, (1.0, 0.5): 0.0, (0.5, 0.5): 0.0}


def test_the_rows_of_a_plan_do_not_depend_on_those_scored_before_it(clip: ClipFrames) -> None:
    plans = same_plan_everywhere(clip_scenes(), straight(8.0))
    first = score_clip(clip, plans)
    score_clip(clip, same_plan_everywhere(clip_scenes(), straight(20.0)))
    again = score_clip(prepare_clip(clip_scenes(), Rules()), dict(reversed(plans.items())))
    for a, b in zip(first, again):
        np.testing.assert_array_equal(a.scores.unfiltered, b.scores.unfiltered)
        assert (a.key, a.weight) == (b.key, b.weight) or np.isnan(a.weight)


def test_a_missing_or_broken_plan_is_named(clip: ClipFrames) -> None:
    plans = same_plan_everywhere(clip_scenes(), straight(8.0))
    key = FrameKey.follow_up(clip.clip_id, 1)[1]
    with pytest.raises(ValueError, match="clip street, frame follow_up_before 1: no plan"):
        score_clip(clip, {k: v for k, v in plans.items() if k != key})
    with pytest.raises(ValueError, match="follow_up_before 1: a plan must be"):
        score_clip(clip, plans | {key: np.full((HORIZON_STEPS, 3), np.nan)})
