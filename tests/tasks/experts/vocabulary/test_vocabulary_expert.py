"""The sampling expert: its plan is the best that passes, its modes end apart, and it judges as the attempt does."""

from dataclasses import fields, replace

import numpy as np
import pytest

from tasks.attempt import Judged, attempt, perturbed_scene
from tasks.experts.pdm_closed.planner import PdmSettings
from tasks.experts.protocol import Plan
from tasks.experts.smoothness import roughness
from tasks.experts.vocabulary.expert import VocabularyExpert, is_apart, spread
from tasks.experts.vocabulary.settings import VocabularySettings
from tasks.reward.epdms import Scores
from tasks.rollout.simulate import TrafficSettings, simulate
from tasks.settings import ExpertGate
from tasks.stages import Rejected
from tasks.world.clip import NOW, Clip, Scene, scene_of_clip
from tasks.world.frames import to_local, to_world
from tasks.world.kinematic_vocabulary import kinematic_trajectories
from tasks.world.vehicle import HEADING, VX
from tasks.world.vocabulary import Vocabulary
from tests.tasks.bad_ends import shift
from tests.tasks.streets import moved, street_clip

RNG = np.random.default_rng(0)  # not drawn from
RELATIVE = ("ep", "pdm_score")  # to PDM-Closed, which meets other traffic here and there
FEW = VocabularySettings(rollouts=24, mode_along_m=4.0)


def perturbed(clip: Clip) -> Scene:
    """Ends 0.7 m to the left of the log."""
    return perturbed_scene(
        clip, simulate(scene_of_clip(clip), to_world(clip.ego_states[NOW, :3], shift(8.0, 0.7)), TrafficSettings())
    )


@pytest.fixture(scope="module")
def scene() -> Scene:
    return perturbed(street_clip())


@pytest.fixture(scope="module")
def vocabulary() -> Vocabulary:
    """Drives of all kinds, and some that only move over."""
    shifts = [shift(speed, side) for speed in (5.0, 7.0, 8.0, 9.0) for side in (-1.5, -1.0, -0.7, -0.4, 0.4, 4.0)]
    return Vocabulary(np.concatenate([kinematic_trajectories(1500, seed=1), shifts]))


def tried(scene: Scene, expert: VocabularyExpert) -> tuple[Judged, Rejected | None]:
    result = attempt(scene, expert, expert.gate, expert.traffic, expert.pdm, RNG)
    assert not isinstance(result, Rejected), result
    return result


def test_the_attempt_drives_and_judges_the_plan_as_the_expert_did(scene: Scene, vocabulary: Vocabulary) -> None:
    expert = VocabularyExpert(vocabulary, FEW)
    found = expert.tried(scene)
    assert found is not None
    place = next(expert.modes(scene, found))
    judged, rejected = tried(scene, expert)
    assert rejected is None
    np.testing.assert_array_equal(judged.plan.poses, found.poses[place])
    np.testing.assert_array_equal(judged.rollout.ego_states, found.states[place])
    for field in fields(Scores):
        if field.name not in RELATIVE:
            here, there = getattr(found.scores, field.name)[place], getattr(judged.scores, field.name)[1]
            np.testing.assert_array_equal(here, there, field.name)


def test_the_plan_is_the_best_that_passes_and_the_smoothest_of_the_best(scene: Scene, vocabulary: Vocabulary) -> None:
    expert = VocabularyExpert(vocabulary, FEW, gate=ExpertGate(progress_above=0.9))
    found = expert.tried(scene)
    assert found is not None and 1 < np.count_nonzero(found.passes) < len(found.passes)
    place, score = next(expert.modes(scene, found)), found.scores.pdm_score
    step = np.floor((score.max() - score) / FEW.score_step)
    assert (np.diff(step) >= 0).all()
    rough = roughness(found.states)
    assert all(a <= b for a, b, same in zip(rough, rough[1:], np.diff(step) == 0) if same)
    named = [getattr(found.scores, name) == 1.0 for name in expert.gate.full]
    np.testing.assert_array_equal(found.passes, np.all(named, axis=0) & (found.scores.ep > 0.9))
    assert not found.passes[:place].any(), "the street's ends are all good: nothing better was passed over"


def test_modes_end_apart_from_each_other_and_each_is_accepted(scene: Scene, vocabulary: Vocabulary) -> None:
    ends = []
    for mode in (1, 2, 3):
        judged, rejected = tried(scene, VocabularyExpert(vocabulary, replace(FEW, mode=mode)))
        assert rejected is None
        end = judged.rollout.ego_states[-1, : HEADING + 1]
        assert is_apart(end, np.array(ends).reshape(-1, 3), (FEW.mode_along_m, FEW.mode_across_m))
        ends.append(end)


def test_a_mode_that_is_not_there_is_no_plan(scene: Scene, vocabulary: Vocabulary) -> None:
    result = VocabularyExpert(vocabulary, replace(FEW, mode=24)).plan(scene, RNG)
    assert isinstance(result, Rejected) and (result.stage, result.reason) == ("expert", "no_plan")
    assert "mode 24 of " in result.detail


def test_where_nothing_passes_the_best_is_planned_and_the_attempt_says_what_fails(
    scene: Scene, vocabulary: Vocabulary
) -> None:
    strict = VocabularyExpert(vocabulary, FEW, gate=ExpertGate(progress_above=1.0))
    judged, rejected = tried(scene, strict)
    assert rejected is not None and (rejected.stage, rejected.reason) == ("reward", "ep")
    assert judged.scores.pdm_score[1] > 0.9
    second = replace(strict, settings=replace(FEW, mode=2)).plan(scene, RNG)
    assert isinstance(second, Rejected) and "mode 2 of 0" in second.detail


def test_an_end_that_the_gate_refuses_is_passed_over(scene: Scene, vocabulary: Vocabulary) -> None:
    """The route's lanes end 18 m beyond where the best drive ends, and the route goes on elsewhere."""
    clip = scene.clip
    asked, open_gate = (ExpertGate(off_route=on, after=False, progress_above=0.0) for on in (True, False))
    best, _ = tried(scene, VocabularyExpert(vocabulary, FEW, gate=open_gate))
    reach = best.rollout.ego_states[-1, 0] + 18.0
    lanes = {}
    for name, lane in clip.road_map.lanes.items():
        line = lane.centerline
        lanes[name] = replace(lane, centerline=line[line[:, 0] <= reach]) if name.startswith("out") else lane
    route = replace(clip.route, roadblock_ids=(*clip.route.roadblock_ids, "rb_elsewhere"))
    ends = replace(scene, clip=replace(clip, road_map=replace(clip.road_map, lanes=lanes), route=route))
    refused = attempt(
        ends, VocabularyExpert(vocabulary, FEW, gate=open_gate), asked, TrafficSettings(), PdmSettings(), RNG
    )
    assert not isinstance(refused, Rejected) and refused[1] is not None and refused[1].reason == "off_route"
    judged, rejected = tried(ends, VocabularyExpert(vocabulary, FEW, gate=asked))
    assert rejected is None
    assert judged.rollout.ego_states[-1, 0] < reach - 19.0


def test_nothing_that_starts_like_the_ego_is_no_plan(scene: Scene, vocabulary: Vocabulary) -> None:
    history = scene.ego_history.copy()
    history[-1, VX] = 40.0
    result = VocabularyExpert(vocabulary, FEW).plan(replace(scene, ego_history=history), RNG)
    assert isinstance(result, Rejected) and "starts like the ego" in result.detail


def test_the_same_scene_gives_the_same_bits_and_a_scene_elsewhere_the_same_plan(vocabulary: Vocabulary) -> None:
    clip, origin = street_clip(), np.array([300.0, -120.0, 1.1])
    expert = VocabularyExpert(vocabulary, FEW)
    here, again = (expert.plan(perturbed(clip), RNG) for _ in range(2))
    there = expert.plan(perturbed(moved(clip, origin)), RNG)
    assert isinstance(here, Plan) and isinstance(again, Plan) and isinstance(there, Plan)
    np.testing.assert_array_equal(here.poses, again.poses, strict=True)
    np.testing.assert_allclose(to_local(origin, there.poses), here.poses, atol=1e-6)


def test_what_is_spread_is_apart_and_whatever_was_left_out_is_near_something_better() -> None:
    rng = np.random.default_rng(2)
    ends, order = rng.uniform([-20, -3, -0.3], [20, 3, 0.3], (300, 3)), rng.permutation(300)
    apart = (2.0, 0.5)
    taken, rank = spread(order, ends, apart, at_most=300).tolist(), np.argsort(order)
    assert taken == sorted(taken, key=lambda member: rank[member]) and taken[0] == order[0]
    for place, member in enumerate(taken):
        assert is_apart(ends[member], ends[taken[:place]], apart)
    for member in set(range(300)) - set(taken):
        better = [other for other in taken if rank[other] < rank[member]]
        off = np.abs(to_local(ends[member], ends[better])[:, :2])
        assert ((off[:, 0] <= 2.0) & (off[:, 1] <= 0.5)).any()
    assert spread(order, ends, apart, at_most=7).tolist() == taken[:7]


def test_the_digest_knows_vocabulary_settings_traffic_gate_and_planner(vocabulary: Vocabulary) -> None:
    expert = VocabularyExpert(vocabulary)
    others = [
        VocabularyExpert(Vocabulary(kinematic_trajectories(10, 0))),
        replace(expert, settings=VocabularySettings(mode=2)),
        replace(expert, traffic=TrafficSettings(mode="replay")),
        replace(expert, gate=ExpertGate(after=False)),
        replace(expert, pdm=PdmSettings(headway_s=2.0)),
    ]
    assert len({one.digest() for one in [expert, *others]}) == 6
    assert replace(expert, name="vocabulary_2").digest() == expert.digest(), "the name is in the attempt's own id"


@pytest.mark.parametrize(("name", "value"), [("mode", 0), ("rollouts", 0), ("score_step", 0.0), ("blend_s", -1.0)])
def test_settings_that_make_no_sense_are_refused(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=name):
        VocabularySettings(**{name: value})  # type: ignore[arg-type]
