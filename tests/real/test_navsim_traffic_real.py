"""`traffic=navsim` on the reference scenes: the public code's recorded rollouts, each against three egos."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from reference_scenes import SCENES, loader, logged_tracks

from factory.datasets.av2.reader import read_log
from tasks.rollout.simulate import TrafficSettings, prepare_traffic, roll_out
from tasks.world.clip import HISTORY_STEPS, Clip, Scene
from tasks.world.road_map import RoadMap, Route

EGOS = 3


@cache
def road_map_of(root: Path, log: str) -> RoadMap:
    """The whole log's: the recordings' own map ends 100 m from the ego, the public traffic's did not."""
    (folder,) = (root / "data/av2/sensor/val").glob(f"{log}*")
    return read_log(folder).road_map


def scene_of(root: Path, name: str) -> Scene:
    """The recorded scene: its objects over their 51 steps, of which step 0 is now."""
    inputs = loader(root).inputs(name)
    objects, ego = logged_tracks(inputs), inputs["ego_state0"]
    clip = Clip(
        clip_id=name,
        dataset="reference",
        log_id=name,
        split="val",
        start_s=0.0,
        ego_states=np.tile(ego, (objects.n_steps, 1)),
        world_from_ego=np.tile(np.eye(4), (objects.n_steps, 1, 1)),
        agents=objects,
        road_map=road_map_of(root, name.split("_")[0]),
        route=Route((), (), frozenset()),
        centerline=inputs["centerline"],
    )
    return Scene(clip, 0, np.tile(ego, (HISTORY_STEPS + 1, 1)), objects, inputs["centerline"])


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_the_traffic_answers_as_the_public_code_was_recorded_to(shared_root: Path, name: str) -> None:
    scene = scene_of(shared_root, name)
    traffic = prepare_traffic(scene, TrafficSettings(mode="navsim"))
    with np.load(shared_root / "reference" / name / "idm_agents.npz") as file:
        recorded = dict(file)
    rows = [scene.agents.track_ids.index(str(token)) for token in recorded["tokens"]]
    gone = np.setdiff1d(np.arange(len(scene.agents)), rows)
    egos = loader(shared_root).simulated(name, 256)[:EGOS]
    for k, states in enumerate(egos):
        ours = roll_out(traffic, states)
        assert not ours.agents.valid[:, gone].any()
        assert np.array_equal(ours.agents.valid[:, rows], recorded[f"valid_ego{k}"])
        for field, column in (("boxes", "box"), ("velocities", "vel")):
            theirs = recorded[f"{column}_ego{k}"]
            there = recorded[f"valid_ego{k}"] & np.isfinite(theirs).all(axis=-1)  # things that stand have no velocity
            found = getattr(ours.agents, field)[:, rows]
            np.testing.assert_allclose(found[there], theirs[there], rtol=0, atol=1e-9)
        assert ours.simulated.sum() > 10
