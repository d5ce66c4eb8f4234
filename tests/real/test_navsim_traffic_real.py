"""`traffic=navsim` on the reference scenes: the public code's recorded rollouts, each against three egos."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
import shapely
from reference_scenes import SCENES, loader, logged_tracks

from factory.datasets.av2.reader import AV2Reader, log_folders, read_log
from factory.readers.base import ClipRef
from tasks.rollout.navsim import box_polygons
from tasks.rollout.simulate import TrafficSettings, prepare_traffic, roll_out
from tasks.world.clip import HISTORY_STEPS, NOW, AgentKind, AgentTracks, Clip, Scene, scene_of_clip
from tasks.world.road_map import RoadMap, Route

EGOS = 3
WHOLE = SCENES[:3]  # the log holds a whole clip there
SHARED_M2 = 0.01


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


@pytest.mark.slow
def test_cars_that_were_apart_run_into_each_other_more_often_than_in_our_own_traffic(shared_root: Path) -> None:
    """The numbers of docs/reward.md: three scenes, the logged human as ego."""
    reader = AV2Reader(shared_root / "data/av2/sensor/val")
    found = dict.fromkeys(("replay", "idm", "navsim"), 0)
    for name in WHOLE:
        log, frame = name.split("_")
        log_id = next(log_id for log_id in log_folders(reader.root) if log_id.startswith(log))
        scene = scene_of_clip(reader.read(ClipRef("av2", log_id, (int(frame) - NOW) * 100)))
        human = loader(shared_root).simulated(name, 256)[0]
        for mode in found:
            agents = roll_out(prepare_traffic(scene, TrafficSettings(mode=mode)), human).agents  # type: ignore[arg-type]
            found[mode] += len(_meeting(agents))
    assert found == {"replay": 6, "idm": 1, "navsim": 8}


def _meeting(agents: AgentTracks) -> set[tuple[int, int]]:
    """Pairs with a vehicle in them that share more than SHARED_M2 at a later step, but not at the first."""
    vehicle = np.array([kind == AgentKind.VEHICLE for kind in agents.kinds])
    pairs = []
    for boxes, valid in zip(agents.boxes, agents.valid):
        here = np.flatnonzero(valid)
        shapes = box_polygons(boxes[here])
        shared = shapely.area(shapely.intersection(shapes[:, None], shapes[None])) > SHARED_M2
        shared &= vehicle[here][:, None] | vehicle[here][None]
        pairs.append({(int(here[i]), int(here[j])) for i, j in np.argwhere(np.triu(shared, 1))})
    return set().union(*pairs[1:]) - pairs[0]
