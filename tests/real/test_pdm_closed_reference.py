"""PDM-Closed equals the public planner's recorded proposals, states, scores and choice (docs/reward.md 4 and 6)."""

import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from tasks.experts.pdm_closed import PdmPlan, plan_pdm_closed
from tasks.world.clip import AgentKind, AgentTracks
from tasks.world.frames import wrap_angle
from tasks.world.road_map import MapLayer, MapPolygon

SCENES = ("7fab2350_20", "7fab2350_44", "7fab2350_104", "adcf7d18_64", "adcf7d18_80")
STEPS = 41  # the recorded arrays hold the 5 s extension as zeros


def plan_of(folder: Path) -> PdmPlan:
    arrays = np.load(folder / "inputs.npz")
    names = json.loads((folder / "inputs.json").read_text())
    n = len(names["object_tokens"])
    agents = AgentTracks(
        track_ids=tuple(names["object_tokens"]),
        kinds=tuple(AgentKind(kind) for kind in names["object_type"]),
        boxes=arrays["object_box"][:1],
        velocities=arrays["object_velocity"][:1],
        valid=arrays["object_valid"][:1],
        center_z=np.zeros((1, n)),
        heights=np.ones(n),
    )
    ends = arrays["map_ring_offset"]
    rings = [arrays["map_ring_xy"][a:b] for a, b in pairwise(ends)]
    return plan_pdm_closed(
        ego_state=arrays["ego_state0"],
        centerline=arrays["centerline"],
        agents=agents,
        polygons=[
            MapPolygon(token, MapLayer(layer), ring)
            for token, layer, ring in zip(names["map_tokens"], names["map_layers"], rings)
        ],
        route_lane_ids=frozenset(names["route_lane_ids"]),
    )


@pytest.mark.parametrize("scene", SCENES)
def test_proposals_states_scores_and_choice_equal_the_recorded_ones(shared_root: Path, scene: str) -> None:
    folder = shared_root / "reference" / scene
    recorded, plan = np.load(folder / "pdm_closed.npz"), plan_of(folder)

    poses = plan.proposals.poses[:, :STEPS] - recorded["proposals"][:, :STEPS, :3]
    np.testing.assert_allclose(poses[..., :2], 0.0, rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(wrap_angle(poses[..., 2]), 0.0, rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(
        plan.proposals.progress_velocity[:, :STEPS], recorded["idm_progress_velocity"][:, :STEPS], rtol=0.0, atol=1e-6
    )
    np.testing.assert_allclose(
        plan.proposals.leads[:, :STEPS], recorded["leading_agent"][:, :STEPS], rtol=0.0, atol=1e-6
    )
    np.testing.assert_allclose(plan.simulated, recorded["simulated"], rtol=0.0, atol=1e-6)

    scores = plan.scores
    multipliers = np.stack([scores.nc, scores.dac, scores.ddc, scores.tlc])
    np.testing.assert_array_equal(multipliers, recorded["multi_metrics"])
    weighted = np.stack([scores.ep, scores.ttc, scores.lk, scores.hc])
    np.testing.assert_allclose(weighted, recorded["weighted_metrics"][:4], rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(scores.ep_raw_m, recorded["progress_raw"], rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(scores.pdm_score, recorded["pdm_score"], rtol=0.0, atol=1e-9)

    assert plan.chosen == int(recorded["chosen_index"])
    # The public one reads its own chosen proposal back at times truncated to microseconds: up to 7e-6 m away from it.
    np.testing.assert_allclose(plan.poses, recorded["proposals"][plan.chosen, 1:STEPS, :3], rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(plan.poses, recorded["chosen_poses_40"], rtol=0.0, atol=1e-5)
