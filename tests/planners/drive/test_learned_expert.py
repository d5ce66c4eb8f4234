"""A trained planner as an expert: it plans as the planner does from the row of the scene, and never sees the future."""

import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from factory.config.compose import ConfigError
from factory.config.run import load_config
from factory.setup.settings import RunContext, build_expert
from planners.drive.expert import LearnedExpert
from planners.evaluation.planner_names import planner_of
from tasks.attempt import perturbed_scene
from tasks.experts.protocol import Plan
from tasks.rollout.simulate import TrafficSettings, simulate
from tasks.stages import Rejected
from tasks.world.clip import NOW, Clip, Scene, scene_of_clip
from tasks.world.frames import to_local, to_world
from tasks.world.vehicle import HEADING, VX
from tests.planners.navsim.trained import made, saved
from tests.tasks.bad_ends import shift
from tests.tasks.streets import moved, street_clip

RNG = np.random.default_rng(0)  # not drawn from


def perturbed(clip: Clip) -> Scene:
    """Ends 0.7 m to the left of the log."""
    start = scene_of_clip(clip)
    return perturbed_scene(
        clip, simulate(start, to_world(clip.ego_states[NOW, :3], shift(8.0, 0.7)), TrafficSettings())
    )


@pytest.fixture(scope="module")
def scene() -> Scene:
    return perturbed(street_clip())


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """As a training leaves it, with random weights."""
    return Path(saved(made("ego_mlp_bev_small"), tmp_path_factory.mktemp("bev")))


def told(folder: str, *more: str) -> LearnedExpert:
    config = load_config(
        [
            "+expert.mine._target_=planners.drive.expert.learned",
            f"+expert.mine.planner={folder}",
            "experts=[mine]",
            *more,
        ]
    )
    no_clips: Any = None
    made = build_expert(RunContext(config, "mine", no_clips))
    assert isinstance(made, LearnedExpert)
    return made


def planned(expert: LearnedExpert, scene: Scene) -> np.ndarray:
    plan = expert.plan(scene, RNG)
    assert isinstance(plan, Plan)
    return plan.poses


def test_constant_velocity_as_an_expert_goes_straight_on_from_where_the_ego_is(scene: Scene) -> None:
    ego = scene.ego_state
    poses = planned(LearnedExpert(planner_of("constant_velocity"), smooth=False), scene)
    along = 0.1 * ego[3] * np.arange(1, 41)
    straight = to_world(ego[: HEADING + 1], np.column_stack([along, np.zeros((40, 2))]))
    np.testing.assert_allclose(poses, straight, atol=1e-4)


def test_a_smoothed_plan_starts_as_the_ego_moves_wherever_the_planner_wants_to_go(scene: Scene, trained: Path) -> None:
    """Its poses at 2 Hz are joined by straight lines: speed jumps at each of them."""
    jerks = []
    for smooth in ("false", "true"):
        poses = planned(told(str(trained), f"+expert.mine.smooth={smooth}"), scene)
        steps = np.diff(np.concatenate([scene.ego_state[None, : HEADING + 1], poses])[:, :2], axis=0)
        speeds = np.concatenate([[scene.ego_state[VX]], np.hypot(*steps.T) / 0.1])
        jerks.append(np.abs(np.diff(speeds, 2)).max() / 0.01)
    assert jerks[0] > 10.0 > 4.0 > jerks[1], jerks


def test_the_raster_is_looked_at_and_the_future_is_not(scene: Scene, trained: Path) -> None:
    expert, agents = told(str(trained), "+expert.mine.smooth=false"), scene.agents
    before = planned(expert, scene)
    boxes = agents.boxes.copy()
    boxes[scene.step + 1 :, :, 1] += 30.0
    np.testing.assert_array_equal(planned(expert, replace(scene, agents=replace(agents, boxes=boxes))), before)
    boxes[scene.step] = boxes[scene.step + 1]
    assert not np.array_equal(planned(expert, replace(scene, agents=replace(agents, boxes=boxes))), before)


def test_the_same_scene_elsewhere_is_planned_for_alike(trained: Path) -> None:
    clip, origin = street_clip(), np.array([40.0, -300.0, 2.0])
    expert = told(str(trained))
    here, there = planned(expert, perturbed(clip)), planned(expert, perturbed(moved(clip, origin)))
    np.testing.assert_allclose(
        to_local(origin, there), here, atol=0.1
    )  # cells at the edge of a shape may fall otherwise


def test_a_worker_that_gets_it_pickled_plans_the_same_bits(scene: Scene, trained: Path) -> None:
    expert = told(str(trained))
    poses = planned(expert, scene)
    sent = pickle.dumps(expert)
    assert len(sent) < 4000, "the weights are read where it is used"
    np.testing.assert_array_equal(planned(pickle.loads(sent), scene), poses, strict=True)
    assert pickle.loads(sent).digest() == expert.digest()


def test_the_digest_knows_the_weights_and_whether_plans_are_smoothed(trained: Path, tmp_path: Path) -> None:
    other = saved(made("ego_mlp_small"), tmp_path)
    made_of = told(str(trained)), told(str(trained), "+expert.mine.smooth=false"), told(other)
    assert len({expert.digest() for expert in made_of}) == 3


def test_what_cannot_be_an_expert_is_refused_by_name(tmp_path: Path) -> None:
    looks = saved(made("ltf_small"), tmp_path)
    for spec, said in ((looks, "it needs pictures"), ("human", "is an expert itself"), ("nobody", "neither")):
        with pytest.raises(ConfigError, match=said):
            told(spec)


def test_a_route_that_has_ended_is_no_plan(scene: Scene, trained: Path) -> None:
    ended = replace(scene, centerline=np.repeat(scene.centerline[-1:], 2, axis=0))
    result = told(str(trained)).plan(ended, RNG)
    assert isinstance(result, Rejected) and (result.stage, result.reason) == ("expert", "no_plan")
