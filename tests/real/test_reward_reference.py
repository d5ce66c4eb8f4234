"""The reward equals the public metric's recorded outputs (reference/, docs/reward.md 6), sub-score by sub-score."""

import json
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from reference_scenes import RECORDED_K, SCENES, loader, prepared_scene, tracks, world_poses

from factory.datasets.av2.reader import AV2Reader, log_folders
from factory.readers.base import ClipRef
from tasks.reward.centerline import MULTIPLE_LANES, NON_DRIVABLE, ONCOMING
from tasks.reward.comfort import extended_comfort
from tasks.reward.epdms import Scores, human_filtered, score, score_with_ec, select_rows
from tasks.rollout.lqr import track
from tasks.subscores import JUDGED, RECORDS
from tasks.trajectories import score_trajectories
from tasks.world.clip import NOW
from tasks.world.frames import HEADING, wrap_angle
from tests.tasks.reward.body_flags import flags_along

EXACT = {record.name: record.long_name for record in RECORDS if record.name in JUDGED}  # ours: recorded
CLOSE = {"ep": "ego_progress", "ep_raw_m": "ego_progress_raw_m", "pdm_score": "pdm_score"}


@pytest.fixture(scope="module")
def reader(shared_root: Path) -> AV2Reader:
    return AV2Reader(shared_root / "data/av2/sensor/val")


def assert_equal_scores(ours: Scores, recorded: dict) -> None:
    for name, column in EXACT.items():
        wrong = np.nonzero(getattr(ours, name) != recorded[column])[0]
        assert wrong.size == 0, f"{name} differs in rows {wrong}"
    for name, column in CLOSE.items():
        np.testing.assert_allclose(getattr(ours, name), recorded[column], rtol=0, atol=1e-9, err_msg=name)


@pytest.mark.parametrize("name", SCENES)
def test_tracked_states_equal_the_reference_in_all_columns(shared_root: Path, name: str) -> None:
    module = loader(shared_root)
    inputs = module.inputs(name)
    states = track(inputs["ego_state0"], world_poses(module, inputs, module.proposals(name, 256)))
    difference = states - module.simulated(name, 256)
    difference[..., HEADING] = wrap_angle(difference[..., HEADING])
    assert np.abs(difference).max() < 1e-9


@pytest.mark.parametrize(("name", "k"), [(name, k) for name in SCENES for k in (256, *RECORDED_K.get(name, ()))])
def test_every_score_index_area_and_flag_equals_the_reference(shared_root: Path, name: str, k: int) -> None:
    module = loader(shared_root)
    inputs, recorded = module.inputs(name), module.metrics(name, k)
    states = track(inputs["ego_state0"], world_poses(module, inputs, module.proposals(name, k)))
    prepared = prepared_scene(inputs)
    assert prepared.history is not None
    np.testing.assert_allclose(prepared.history, recorded["history_states"], rtol=0, atol=1e-9)

    ours = score(prepared, states)
    assert len(ours) == k
    assert_equal_scores(ours, recorded)
    assert np.array_equal(ours.collision_index, recorded["collision_time_idx"])
    assert np.array_equal(ours.ttc_index, recorded["ttc_time_idx"])
    flags = flags_along(prepared.map_index, states)
    for area, bit in enumerate((MULTIPLE_LANES, NON_DRIVABLE, ONCOMING)):
        assert np.array_equal(flags & bit != 0, recorded["ego_areas"][..., area])
    assert np.array_equal(ours.comfort, recorded["comfort_flags"])
    np.testing.assert_allclose(ours.multiplier, recorded["multiplicative_metrics_prod"], rtol=0, atol=1e-9)

    extended = extended_comfort(states, recorded["prev_human_simulated_states"][None], interval_s=0.5)
    assert np.array_equal(extended.ec, recorded["two_frame_extended_comfort"])
    # Filtered values are rounded to 1e-8: one tie of rounding moves the RMS of 36 rows by 1e-8 / 6 or less.
    np.testing.assert_allclose(extended.rms, recorded["two_frame_rms"], rtol=0, atol=2e-9)
    np.testing.assert_allclose(score_with_ec(ours, extended.ec), recorded["score_with_ec"], rtol=0, atol=1e-9)


def test_what_is_recorded_holds_every_kind_of_outcome(shared_root: Path) -> None:
    module = loader(shared_root)
    recorded = [module.metrics(name, k) for name in SCENES for k in (256, *RECORDED_K.get(name, ()))]
    seen = {column: set(np.concatenate([metrics[column] for metrics in recorded])) for column in EXACT.values()}
    assert seen.pop("traffic_light_compliance") == {1.0}  # no light is red there
    three = ("no_at_fault_collisions", "driving_direction_compliance")
    for column, values in seen.items():
        assert values == ({0.0, 0.5, 1.0} if column in three else {0.0, 1.0}), column


def test_a_red_lane_connector_changes_exactly_what_the_reference_says(shared_root: Path) -> None:
    module = loader(shared_root)
    name = "7fab2350_44"
    inputs = module.inputs(name)
    with np.load(shared_root / "reference" / name / "metrics_K256_redlight.npz") as arrays:
        recorded = dict(arrays)
    states = track(inputs["ego_state0"], world_poses(module, inputs, module.proposals(name, 256)))
    red = tuple(str(lane) for lane in np.atleast_1d(recorded["red_lane_connector"]))
    assert_equal_scores(score(prepared_scene(inputs, red_lanes=red), states), recorded)


@pytest.mark.parametrize("name", SCENES)
def test_official_rows_against_pdm_closed_with_the_human_filter(shared_root: Path, name: str) -> None:
    module = loader(shared_root)
    inputs = module.inputs(name)
    folder = shared_root / "reference" / name
    with np.load(folder / "pdm_closed.npz") as planner:
        pdm_closed = planner["chosen_trajectory_states"][:, :3]
    with np.load(folder / "idm_agents.npz") as traffic:
        idm = dict(traffic)
    proposals = module.proposals(name, 256)
    human_poses = world_poses(module, inputs, two_hz_resampled(module, inputs))
    for row in json.loads((folder / "official_pdm_score_rows.json").read_text())["rows"]:
        k = row["proposal"]
        plan = world_poses(module, inputs, proposals[k : k + 1])
        states = track(
            inputs["ego_state0"],
            np.concatenate([pdm_closed[None, 1:], plan]),
            planned_pose0=np.stack([pdm_closed[0], inputs["ego_state0"][:3]]),
        )
        if row["policy"] == "idm":
            objects = tracks(
                inputs,
                idm[f"box_ego{k}"],
                idm[f"vel_ego{k}"],
                idm[f"valid_ego{k}"],
                [str(token) for token in idm["tokens"]],
            )
            prepared = prepared_scene(inputs, objects)
        else:
            prepared = prepared_scene(inputs)
        ours = select_rows(score(prepared, states), slice(1, 2))
        human = score(prepared_scene(inputs), track(inputs["ego_state0"], human_poses), with_history=False)
        ours_filtered = human_filtered(ours, human)
        recorded = {key: np.array([value]) for key, value in row.items() if isinstance(value, float)}
        for column, theirs in EXACT.items():
            assert getattr(ours_filtered, column)[0] == recorded[theirs][0], (name, k, row["policy"], column)
        np.testing.assert_allclose(ours_filtered.ep, recorded["ego_progress"], rtol=0, atol=1e-9)
        np.testing.assert_allclose(ours_filtered.multiplier, recorded["multiplicative_metrics_prod"], rtol=0, atol=1e-9)
        # The public filter rewrites the columns, not pdm_score.
        np.testing.assert_allclose(ours.pdm_score, recorded["pdm_score"], rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", ["7fab2350_20", "7fab2350_44", "adcf7d18_64"])  # the log holds a whole clip there
def test_score_trajectories_equals_the_official_scores_from_the_raw_log(
    shared_root: Path, reader: AV2Reader, name: str
) -> None:
    """Poses and a clip in, PDM-Closed as the reference by default: the public pdm_score().

    To 1e-6: the public code reads PDM-Closed's plan back at times truncated to microseconds, up to 7e-6 m away.
    """
    log, frame = name.split("_")
    log_id = next(log_id for log_id in log_folders(reader.root) if log_id.startswith(log))
    clip = reader.read(ClipRef("av2", log_id, (int(frame) - NOW) * 100))
    recorded = json.loads((shared_root / "reference" / name / "official_pdm_score_rows.json").read_text())["rows"]
    replayed = [row for row in recorded if row["policy"] == "log_replay"]
    assert len(replayed) == 8
    proposals = loader(shared_root).proposals(name, 256)[[row["proposal"] for row in replayed]]
    ours = score_trajectories(clip, proposals)
    for ours_name, theirs in (("ep", "ego_progress"), ("pdm_score", "pdm_score")):
        expected = [row[theirs] for row in replayed]
        np.testing.assert_allclose(getattr(ours, ours_name), expected, rtol=0, atol=1e-6, err_msg=theirs)
    assert len(set(np.round(ours.pdm_score, 6))) > 2


def two_hz_resampled(module: ModuleType, inputs: dict) -> np.ndarray:
    """The logged human future in the ego frame, (1, 40, 3), linear between its 0.5 s poses."""
    poses = np.concatenate([np.zeros((1, 3)), inputs["human_poses_2hz"]])
    poses[:, 2] = np.unwrap(poses[:, 2])
    times = 0.1 * np.arange(1, 41)
    return np.stack([np.interp(times, 0.5 * np.arange(9), poses[:, i]) for i in range(3)], axis=-1)[None]
