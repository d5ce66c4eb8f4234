"""Sample rows: the world seen from the ego at now, in closed form and wherever the world lies."""

from dataclasses import replace

import numpy as np
import pytest

from factory.stages.rows import sample_row
from factory.store.schema import BOOKKEEPING, COLUMNS, MAP_RADIUS_M, sample_rows_to_table
from tasks.attempt import Judged, drive_under_log_replay, perturbed_scene
from tasks.attempt import drive_and_judge as judge
from tasks.experts.pdm_closed import PdmClosed
from tasks.experts.protocol import Human
from tasks.perturb import Candidate
from tasks.rollout.simulate import TrafficSettings
from tasks.world.clip import HORIZON_STEPS, NOW, Clip, scene_of_clip
from tasks.world.frames import to_world
from tasks.world.road_map import LightState, MapLayer, MapPolygon, TrafficLights
from tests.tasks.streets import EGO_HEIGHT_M, SPEED_MPS, moved, perturbed, rectangle, same_poses, street_clip

RNG = np.random.default_rng(0)  # nothing here draws from it
END = NOW + HORIZON_STEPS
WORLD_COLUMNS = {"parent_states", "now_pose", "world_from_ego", "perturbed_states"}
POSE_COLUMNS = {name for name, column in COLUMNS.items() if column.shape and column.shape[-1] in (3, 5)}
POSE_COLUMNS -= {"off_log_end", "off_log_most"}  # distances


def human(clip: Clip) -> dict[str, object]:
    return sample_row(clip, None, drive_under_log_replay(scene_of_clip(clip), Human(), RNG))


def simulated(clip: Clip) -> tuple[Candidate, Judged]:
    candidate = perturbed(clip).candidates[0]
    scene = perturbed_scene(clip, candidate.rollout)
    plan = PdmClosed().plan(scene, RNG)
    return candidate, judge(scene, plan, TrafficSettings(yields=False))  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def candidate_and_judged() -> tuple[Candidate, Judged]:
    return simulated(street_clip())


@pytest.fixture(scope="module")
def row(candidate_and_judged: tuple[Candidate, Judged]) -> dict[str, object]:
    return sample_row(street_clip(), *candidate_and_judged)


def test_both_kinds_of_row_fit_the_schema(row: dict[str, object]) -> None:
    no_images = {"image_source": "none"}
    books = {"round": 0, "candidate_index": 0} | {
        name: "x" for name in BOOKKEEPING if name not in ("round", "candidate_index")
    }
    table = sample_rows_to_table([row | no_images | books, human(street_clip()) | no_images | books])
    assert table.num_rows == 2
    of_simulated = ("vocabulary_index", "proposal_10hz", "perturbed_states", "candidate_end", "off_log_end")
    for name in (*of_simulated, "off_log_most", "stage1_score"):
        assert table[name].is_null().to_pylist() == [False, True], f"{name} is null for the human alone"
    for name in ("stage1_ec", "stage2_ec"):
        assert table[name].null_count == 2, "there is no earlier plan to compare comfort with"


def test_a_simulated_row_says_how_far_off_the_log_it_ends_and_gets_at_most(
    candidate_and_judged: tuple[Candidate, Judged], row: dict[str, object]
) -> None:
    """The log keeps its lane and speed along x: what is off is y, heading and speed themselves, and x less its way."""
    judged = candidate_and_judged[1]
    states = judged.rollout.ego_states[1:]
    logged_x = judged.scene.clip.ego_states[END, 0] + 0.1 * SPEED_MPS * np.arange(1, 41)
    logged_y = judged.scene.clip.ego_states[END, 1]
    metres = np.sqrt((states[:, 0] - logged_x) ** 2 + (states[:, 1] - logged_y) ** 2)
    off = np.column_stack([metres, abs(states[:, 2]), abs(states[:, 3] - SPEED_MPS)])
    np.testing.assert_allclose(row["off_log_end"], off[-1], atol=1e-9)  # type: ignore[arg-type]
    np.testing.assert_allclose(row["off_log_most"], off.max(axis=0), atol=1e-9)  # type: ignore[arg-type]
    assert off.max(axis=0).min() > 1e-3, "something is to be seen in each"


def test_the_human_s_label_is_the_log() -> None:
    row = human(street_clip())
    straight = np.column_stack([0.1 * SPEED_MPS * np.arange(1, 41), np.zeros((40, 2))])
    np.testing.assert_allclose(row["label_10hz"], straight, atol=1e-12)  # type: ignore[arg-type]
    np.testing.assert_allclose(row["label_2hz"], straight[4::5], atol=1e-12)  # type: ignore[arg-type]
    assert row["now_s"] == pytest.approx(1.5)


def test_a_turning_human_is_labelled_by_the_log_too_not_by_what_a_tracker_makes_of_it() -> None:
    clip = street_clip()
    states = clip.ego_states.copy()
    states[:, 1] += 0.3 * np.sin(np.arange(len(states)))  # nobody could steer this
    row = human(replace(clip, ego_states=states))
    world = to_world(np.asarray(row["now_pose"]), np.asarray(row["label_10hz"]))
    assert same_poses(world, states[NOW + 1 : NOW + 41, :3], 1e-9)


def test_a_simulated_label_is_the_driven_states_beside_the_expert_s_proposal(
    row: dict[str, object], candidate_and_judged: tuple[Candidate, Judged]
) -> None:
    candidate, judged = candidate_and_judged
    pose = judged.scene.ego_state[:3]
    np.testing.assert_array_equal(row["now_pose"], candidate.rollout.ego_states[-1, :3])  # type: ignore[arg-type]
    driven = to_world(pose, np.asarray(row["label_10hz"]))
    assert same_poses(driven, judged.rollout.ego_states[1:, :3], 1e-9)
    assert same_poses(to_world(pose, np.asarray(row["proposal_10hz"])), judged.plan.poses, 1e-9)
    np.testing.assert_array_equal(np.asarray(row["label_2hz"]), np.asarray(row["label_10hz"])[4::5])
    history = to_world(pose, np.asarray(row["ego_history_10hz"]))
    assert same_poses(history, candidate.rollout.ego_states[-16:, :3], 1e-9)
    np.testing.assert_allclose(np.asarray(row["ego_history_10hz"])[-1], 0.0, atol=1e-12)
    np.testing.assert_array_equal(np.asarray(row["ego_history_2hz"]), np.asarray(row["ego_history_10hz"])[::5])
    np.testing.assert_array_equal(row["parent_states"], street_clip().ego_states[[NOW, END]])  # type: ignore[arg-type]
    np.testing.assert_array_equal(row["perturbed_states"], candidate.rollout.ego_states)  # type: ignore[arg-type]
    assert row["now_s"] == pytest.approx(5.5)
    assert row["stage1_score"] == candidate.reactive_score
    assert row["stage2_score"] == judged.scores.pdm_score[1]


def test_the_agents_of_a_simulated_row_are_those_of_its_drives_before_and_after_now(
    row: dict[str, object], candidate_and_judged: tuple[Candidate, Judged]
) -> None:
    candidate, judged = candidate_and_judged
    seen = [judged.scene.agents.track_ids.index(name) for name in row["agent_ids"]]  # type: ignore[attr-defined]
    boxes = to_world(judged.scene.ego_state[:3], np.asarray(row["agent_boxes"], float)[..., :3]).transpose(1, 0, 2)
    assert same_poses(boxes[:16], candidate.rollout.agents.boxes[-16:, seen, :3], 1e-6)
    assert same_poses(boxes[15:], judged.rollout.agents.boxes[:, seen, :3], 1e-6)
    log = street_clip().agents.boxes[END + 1 : END + 41, seen, :2]
    assert np.nanmax(np.abs(boxes[16:, :, :2] - log)) > 0.5, "the log would tell of another world"


def test_history_agents_and_map_of_the_human_in_closed_form() -> None:
    row = human(street_clip())
    back = np.column_stack([0.1 * SPEED_MPS * np.arange(-15, 1), np.zeros((16, 2))])
    np.testing.assert_allclose(np.asarray(row["ego_history_10hz"]), back, atol=1e-12)
    np.testing.assert_allclose(np.asarray(row["ego_status"]), [SPEED_MPS, 0.0, 0.0, 0.0])
    assert row["agent_ids"] == ["ahead", "left", "walker", "cone"]
    ahead, cone = np.asarray(row["agent_boxes"])[[0, 3]]
    np.testing.assert_allclose(ahead[:, 0], 30.0 + 0.8 * np.arange(-15, 41), atol=1e-9)
    np.testing.assert_allclose(ahead[:, 3:], [[4.6, 1.9]] * 56)
    assert np.isnan(cone[:30]).all(), "the cone is not seen before step 30"
    np.testing.assert_allclose(cone[30:, :3], [[70.0, 7.5, 0.0]] * 26, atol=1e-9)
    np.testing.assert_array_equal(np.asarray(row["agent_valid"])[3], np.arange(56) >= 30)
    assert row["lane_ids"] == ["in", "in_left", "cross", "cross_left"]  # "out" begins 80 m ahead
    assert row["lane_is_intersection"] == [False, False, True, True]
    assert row["light_lane_ids"] == ["cross"]
    np.testing.assert_array_equal(np.asarray(row["light_states"]), np.full((1, 56), LightState.GREEN))
    pose = np.asarray(row["world_from_ego"])
    np.testing.assert_allclose(pose[:3, 3], [0.0, 0.0, EGO_HEIGHT_M], atol=1e-12)
    np.testing.assert_allclose(pose[:3, :3], np.eye(3), atol=1e-12)


def test_what_is_near_the_map_s_long_edges_is_in_the_row_and_what_is_far_is_not() -> None:
    """An area 30 m beside the ego with corners 500 m away, one that starts just within and one just beyond 64 m."""
    clip = street_clip()
    rings = {
        "long": rectangle((-500.0, 30.0), (500.0, 40.0)),
        "within": rectangle((-500.0, -90.0), (500.0, -MAP_RADIUS_M + 0.1)),
        "beyond": rectangle((-500.0, MAP_RADIUS_M + 0.1), (500.0, 90.0)),
        "around": rectangle((-500.0, -500.0), (500.0, 500.0)),
    }
    areas = tuple(MapPolygon(name, MapLayer.DRIVABLE_AREA, ring) for name, ring in rings.items())
    row = human(replace(clip, road_map=replace(clip.road_map, drivable_areas=areas)))
    found = [next(name for name, ring in rings.items() if np.array_equal(ring, got)) for got in row["drivable_rings"]]  # type: ignore[attr-defined]
    assert found == ["long", "within", "around"]


def test_lights_run_from_the_history_to_the_end_of_the_label(candidate_and_judged: tuple[Candidate, Judged]) -> None:
    clip = street_clip()
    states = np.full((96, 1), LightState.GREEN, np.int8)
    states[END] = LightState.RED  # at the simulated row's now
    lit = replace(clip, lights=TrafficLights(("cross",), states))
    candidate, judged = candidate_and_judged
    row = sample_row(lit, candidate, replace(judged, scene=replace(judged.scene, clip=lit)))
    assert np.flatnonzero(np.asarray(row["light_states"])[0] == LightState.RED).tolist() == [15]


@pytest.mark.parametrize("origin", [(500.0, -300.0, 0.0), (-70.0, 40.0, 2.7)])
def test_moving_the_world_changes_only_the_columns_in_the_world_frame(
    row: dict[str, object], origin: tuple[float, float, float]
) -> None:
    clip = moved(street_clip(), np.array(origin))
    candidate, judged = simulated(clip)
    there = sample_row(clip, candidate, judged)
    assert row.keys() == there.keys()
    for name in row.keys() - WORLD_COLUMNS:
        here_value, there_value = row[name], there[name]
        if isinstance(here_value, np.ndarray) or (isinstance(here_value, list) and name in POSE_COLUMNS):
            for a, b in zip(here_value, there_value, strict=True):  # type: ignore[call-overload]
                close = same_poses(a, b, 1e-5) if name in POSE_COLUMNS else np.allclose(a, b, atol=1e-5, equal_nan=True)
                assert close, name
        elif isinstance(here_value, float):
            assert there_value == pytest.approx(here_value, abs=1e-6), name
        elif isinstance(here_value, list) and here_value and isinstance(here_value[0], np.ndarray):
            for a, b in zip(here_value, there_value, strict=True):  # type: ignore[call-overload]
                np.testing.assert_allclose(a, b, atol=1e-5, err_msg=name)
        else:
            assert here_value == there_value, name
    assert same_poses(
        to_world(np.array(origin), np.asarray(row["now_pose"])[None]), np.asarray(there["now_pose"])[None], 1e-5
    )


def test_tags_say_what_is_near_now() -> None:
    clip = street_clip()
    assert human(clip)["tags"] == ["command_straight", "near_pedestrian"]
    far = clip.agents.boxes.copy()
    far[:, 2, 1] -= 40.0
    slow = clip.ego_states.copy()
    slow[:, 3] = 1.0
    quiet = replace(clip, agents=replace(clip.agents, boxes=far), ego_states=slow)
    assert human(quiet)["tags"] == ["command_straight", "slow"]
