"""AlpaSim's columns: as its own scorers have them, by closed forms, and in its summary's form."""

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from planners.drive.alpasim_score import (
    AlpasimColumns,
    LoggedRollout,
    SummaryEntry,
    bodies,
    counted,
    logged_rollout,
    results_summary,
    scene_score,
    score_drive,
)
from planners.drive.loop import LoopSettings, drive
from tasks.world.frames import PACIFICA
from tests.planners.drive.alpasim_judge import SIZES, STAMPS_US
from tests.planners.drive.streets import Steady, car, nobody, start_on, street_with
from tests.tasks.streets import street_clip

JUDGED = json.loads((Path(__file__).parent / "alpasim_judged.json").read_text())
TRACK = LoopSettings(seconds=5.5)


def rollout(given: dict[str, Any]) -> LoggedRollout:
    ego, others = np.array(given["ego"]), np.array(given["others"])
    return LoggedRollout(
        stamps_us=np.array(STAMPS_US),
        ego=np.column_stack([ego, np.tile(SIZES[0], (len(ego), 1))]),
        others=np.concatenate([others, np.broadcast_to(SIZES[1:], (*others.shape[:2], 2))], axis=-1),
        present=np.ones(others.shape[:2], bool),
        recorded_us=np.array(given["recorded_us"]),
        recorded=np.array(given["recorded"])[:, :2],
        road_map=street_clip().road_map,
    )


@pytest.mark.parametrize("given", JUDGED["scored"])
def test_the_columns_and_scores_are_alpasim_s_own(given: dict[str, Any]) -> None:
    """To what float32 leaves of positions there."""
    found = asdict(score_drive(rollout(given)))
    expected = given["columns"] | {"score": given["score"], "score_july": given["score_july"]}
    assert {name: found[name] for name in expected} == pytest.approx(expected, abs=1e-5)
    assert found.keys() == expected.keys()


def test_the_judged_rollouts_have_every_end() -> None:
    columns = [given["columns"] for given in JUDGED["scored"]]
    for name in ("collision_front", "collision_rear", "collision_lateral", "offroad", "left_corridor_laterally"):
        assert {one[name] for one in columns} == {0.0, 1.0}, name


def straight(speed: float, recorded_mps: float, side_m: float = 0.0) -> LoggedRollout:
    """5 s along the street, nobody else; the recording goes at another speed, and 0.4 s further."""
    stamps = np.array([0, *(17_000 + 500_000 * np.arange(11))])
    recorded_us = np.append(stamps, stamps[-1] + 400_000)
    ego = np.zeros((12, 5))
    ego[:, 0], ego[:, 1], ego[:, 3:] = speed * stamps / 1e6, side_m, SIZES[0]
    recorded = np.column_stack([recorded_mps * recorded_us / 1e6, np.zeros(13)])
    nobody_else = np.zeros((12, 0, 5)), np.zeros((12, 0), bool)
    return LoggedRollout(stamps, ego, *nobody_else, recorded_us, recorded, street_clip().road_map)


def test_half_as_fast_as_the_log_is_half_its_progress() -> None:
    """July by the whole recording, 5.417 s of it; October by the 5.017 s that were driven."""
    found = score_drive(straight(4.0, 8.0))
    assert found.progress == pytest.approx(0.5 * 5.017 / 5.417)
    assert found.progress_rel_to_total == pytest.approx(0.5)
    assert (found.score_july, found.score) == pytest.approx((0.5 * 5.017 / 5.417 / 0.8, 0.625))
    assert (found.dist_traveled_m, found.gt_dist_traveled_m) == pytest.approx((4.0 * 5.017, 8.0 * 5.417))
    assert found.dist_to_gt_location == pytest.approx(4.0 * 5.017)


def test_beyond_the_recording_only_what_is_across_is_lateral() -> None:
    """At 8 m/s past a recording of 5 m/s the way ahead cuts off, and fails nothing; 1 m to the side stays 1 m."""
    found = score_drive(straight(8.0, 5.0, side_m=1.0))
    assert found.dist_to_gt_trajectory >= 4.0
    assert (found.lateral_dist_to_gt_trajectory, found.left_corridor_laterally) == (pytest.approx(1.0), 0.0)
    assert found.score == found.score_july == 1.0


def test_four_metres_to_the_side_fail_since_october() -> None:
    found = score_drive(straight(8.0, 8.0, side_m=4.0))
    assert (found.left_corridor_laterally, found.score, found.offroad) == (1.0, 0.0, 0.0)
    assert found.progress == pytest.approx(8.0 * 1.017 / (8.0 * 5.417))  # cut off at its first instant


def test_a_recording_of_less_than_five_metres_is_driven_whole_by_standing() -> None:
    found = score_drive(straight(0.0, 0.9))
    assert (found.score, found.progress) == (1.0, 0.0)


def test_what_counts_begins_after_a_second_and_ends_with_an_incident_or_four_metres() -> None:
    stamps, none, near = np.array([0, *(17_000 + 500_000 * np.arange(5))]), np.zeros(6, bool), np.zeros(6)
    assert counted(stamps, none, near).tolist() == [False, False, False, True, True, True]
    early, late, far = np.eye(6, dtype=bool)[1], np.eye(6, dtype=bool)[4], np.array([0, 0, 0, 4.0, 5.0, 0])
    assert counted(stamps, early, near).sum() == 3, "an incident before counts for nothing"
    assert counted(stamps, late, near).tolist() == [False, False, False, True, True, False]
    assert counted(stamps, late, far).tolist() == [False, False, False, True, False, False]
    assert counted(stamps[:3], none[:3], near[:3]).all(), "of a single step everything counts, as for AlpaSim"


def test_against_its_lane_s_direction_a_car_is_on_the_wrong_lane() -> None:
    ahead = straight(8.0, 8.0)
    turned = replace(ahead, ego=ahead.ego + np.array([0.0, 0.0, 3.0, 0.0, 0.0]))
    assert (score_drive(ahead).wrong_lane, score_drive(turned).wrong_lane) == (0.0, 1.0)
    assert np.isnan(score_drive(ahead).min_distance_to_obstacle_m)


def test_a_body_is_shrunk_by_two_percent_and_its_corners_are_rounded() -> None:
    """Its area lacks four corners of (1 - pi / 4) r^2."""
    whole, front, _ = bodies(np.array([10.0, 5.0, 0.3, 5.0, 2.0]))
    radius = 0.5 * 0.98 * 2.0 / 2.0
    assert whole.area == pytest.approx(4.9 * 1.96 - (4.0 - np.pi) * radius**2, abs=2e-3)
    assert front.area == pytest.approx(1.96 * radius - 2.0 * (1.0 - np.pi / 4.0) * radius**2, abs=2e-3)
    assert (whole.centroid.x, whole.centroid.y) == pytest.approx((10.0, 5.0))


def test_a_failure_is_zero_and_progress_saturates() -> None:
    columns = {"gt_dist_traveled_m": 50.0, "progress": 0.9, "progress_rel_to_total": 0.4}
    columns |= dict.fromkeys(("collision_at_fault", "offroad", "left_corridor_laterally"), 0.0)
    assert (scene_score(columns, october=False), scene_score(columns, october=True)) == (1.0, 0.5)
    for name in ("collision_at_fault", "offroad"):
        assert scene_score(columns | {name: 1.0}, october=False) == 0.0
    assert scene_score(columns | {"left_corridor_laterally": 1.0}, october=False) == 1.0


def test_a_drive_is_judged_at_its_plans_and_by_the_log_that_fits_its_seconds() -> None:
    """5.5 s hold ten steps, and 0.483 s more of the log; the first pose is 17 ms before the start."""
    made = drive(start_on(street_with(car(30.0)), TRACK), Steady(8.0), TRACK)
    assert made.n_steps == 50 and len(made.plans) == 10
    found = logged_rollout(made, TRACK.seconds)
    assert found.stamps_us.tolist() == [0, *(17_000 + 500_000 * np.arange(11)).tolist()]
    assert found.recorded_us[-1] == 5_500_000
    begin = PACIFICA.rear_axle_to_center - 8.0 * 0.017
    np.testing.assert_allclose(found.recorded[[0, -1], 0], [begin, begin + 8.0 * 5.5], atol=1e-9)
    assert found.ego[0, 0] == pytest.approx(begin) and found.others.shape == (12, 1, 5)
    columns = score_drive(found)
    assert (columns.collision_front, columns.collision_at_fault, columns.score) == (1.0, 1.0, 0.0)


def test_a_drive_of_a_step_or_two_is_scored_and_of_none_refused() -> None:
    settings = replace(TRACK, seconds=1.1)
    assert score_drive(logged_rollout(drive(start_on(street_with(nobody()), settings), Steady(8.0), settings), 1.1))
    short = straight(8.0, 8.0)
    with pytest.raises(ValueError, match="2 instants"):
        score_drive(replace(short, stamps_us=short.stamps_us[:2]))


def test_the_summary_has_alpasim_s_form() -> None:
    """What its readers ask of it: src/eval/src/eval/aggregation/processing.py and failed_rollouts.py of 6f1029c."""
    good, hit = score_drive(straight(8.0, 8.0)), score_drive(rollout(JUDGED["scored"][3]))
    drives = [SummaryEntry("a", "1", "x", good), SummaryEntry("a", "2", "y", hit)]
    told = json.loads(
        results_summary([*drives, SummaryEntry("a", "3", "z", None, "broken"), SummaryEntry("b", "1", "x", hit)])
    )
    assert (told["schema_version"], told["scene_score_enabled"]) == (1, True)
    first, second, third, _ = told["rollouts"]
    assert (first["status"], first["passed"], first["score"], first["failure_reason"]) == ("pass", True, 1.0, None)
    assert (second["status"], second["score"], second["failure_reason"]) == ("fail", 0.0, "collision_at_fault")
    assert (third["status"], third["score"], third["failure_reason"]) == ("fail", 0.0, "broken")
    for entry in told["rollouts"]:
        assert {"run_uuid", "run_name", "clipgt_id", "rollout_id", "metrics", "score_metrics"} <= entry.keys()
        assert {"progress_score", "progress_clipped_rel", "offroad"} <= entry["score_metrics"].keys()
    of_a, of_b = told["metrics_results"]
    assert (of_a["n_clips"], of_a["collision_at_fault"], of_b["n_clips"]) == (2, 0.5, 1)
    km = (good.dist_traveled_m + hit.dist_traveled_m) / 1000.0
    assert of_a["avg_dist_between_incidents"] == pytest.approx(km)
    assert {field for field in AlpasimColumns.__dataclass_fields__ if not field.startswith("score")} <= of_a.keys()
