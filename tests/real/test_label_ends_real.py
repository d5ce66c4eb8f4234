"""What labels' ends lead to on the shared logs: no human is refused, and recovery's that leave the route are."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from factory.datasets.av2.reader import AV2Reader
from factory.datasets.scenarionet.reader import ScenarioNetReader
from factory.readers.base import ClipReader
from tasks.attempt import ExpertGate, Judged, ReadyScene, attempt, drive_under_log_replay, end_verdict, perturbed_scene
from tasks.experts.protocol import Human, Plan
from tasks.experts.recovery import RecoveryExpert, RecoverySettings, RecoveryTable, make_feasible
from tasks.perturb import Perturbation, PerturbSettings, perturb
from tasks.rollout.simulate import TrafficSettings, prepare_traffic
from tasks.stages import Rejected
from tasks.world.clip import Clip, Scene, random_stream, scene_of_clip
from tasks.world.frames import HEADING, to_local, to_world
from tasks.world.road_map import Rings
from tasks.world.vocabulary import Vocabulary

AV2 = ("data", "av2", "sensor", "val")
LOG, START_MS = "7fab2350-7eaf-3b7e-a39d-6937a4c1bede", 1000  # the route turns left at a junction
PUBLISHED = ExpertGate(off_route=False, after=False, near_log=False)
RNG = np.random.default_rng(0)  # who drives here draws nothing


@pytest.mark.slow
@pytest.mark.parametrize(
    ("reader", "folder"), [(AV2Reader, AV2), (ScenarioNetReader, ("data", "scenarionet", "nuscenes"))]
)
def test_no_human_drive_is_one_that_would_be_refused(
    shared_root: Path, reader: type[AV2Reader] | type[ScenarioNetReader], folder: tuple[str, ...]
) -> None:
    logs: ClipReader = reader(shared_root.joinpath(*folder))
    refs = logs.index().refs
    assert len(refs) in (14, 61)
    for ref in refs:
        judged = drive_under_log_replay(scene_of_clip(logs.read(ref)), Human(), RNG)
        replayed = prepare_traffic(judged.scene, TrafficSettings(mode="replay"))
        assert end_verdict(judged, replayed, ExpertGate()) is None, ref


@pytest.fixture(scope="module")
def clip(shared_root: Path) -> Clip:
    reader = AV2Reader(shared_root.joinpath(*AV2, LOG))
    return reader.read(next(ref for ref in reader.index().refs if ref.start_ms == START_MS))


class Smoothed(RecoveryExpert):
    """What the published equation retrieves, made drivable: where the log goes it looks at by the end pose alone."""

    def plan(self, scene: Scene, rng: np.random.Generator) -> Plan:
        return next(self.plans(scene, rng))

    def plans(self, scene: Scene, rng: np.random.Generator) -> Iterator[Plan]:
        (found,) = super().plans(scene, rng)
        assert isinstance(found, Plan)
        ego = scene.ego_state[: HEADING + 1]
        drivable = make_feasible(to_local(ego, found.poses), scene.ego_state)
        assert not isinstance(drivable, str)
        yield Plan(to_world(ego, drivable))


@pytest.fixture(scope="module")
def driven(clip: Clip, shared_root: Path) -> list[tuple[Judged, Rejected | None, Rejected | None]]:
    """Attempts of such a recovery: drive, the published gate's verdict, and that with the gates on ends."""
    human: NDArray[np.float64] = np.load(shared_root / "data" / "vocabulary" / "human_8192x40x3.npy")
    rng, traffic = random_stream(0, clip.clip_id, "perturb"), TrafficSettings()
    found = perturb(clip, Vocabulary(human), PerturbSettings(), traffic, rng)
    assert isinstance(found, Perturbation)
    expert, out = Smoothed(RecoveryTable(human), RecoverySettings(match="paper")), []
    for candidate in found.candidates:
        scene = perturbed_scene(clip, candidate.rollout)
        pair = [
            attempt(ReadyScene(scene, traffic), expert, gate, RNG) for gate in (PUBLISHED, ExpertGate(near_log=False))
        ]
        if not isinstance(pair[0], Rejected) and not isinstance(pair[1], Rejected):
            out.append((pair[0][0], pair[0][1], pair[1][1]))
    return out


def off_route_m(judged: Judged) -> float:
    """Of the rear axle at the end, to the nearest lane of the route."""
    clip = judged.scene.clip
    rings = Rings([clip.road_map.lanes[name].ring for name in clip.route.lane_ids if name in clip.road_map.lanes])
    return float(rings.distances(judged.rollout.ego_states[-1, :2]).min())


def test_full_marks_far_off_the_route_are_refused_and_what_is_kept_ends_on_it(
    driven: list[tuple[Judged, Rejected | None, Rejected | None]],
) -> None:
    full = [(judged, asked) for judged, published, asked in driven if published is None]
    assert max(off_route_m(judged) for judged, _ in full) > 5.0  # what the gate is for
    assert all(asked is not None and asked.reason == "off_route" for judged, asked in full if off_route_m(judged) > 0.5)
    kept = [off_route_m(judged) for judged, asked in full if asked is None]
    assert kept and max(kept) <= 0.5
    assert all(published is None or published == asked for _, published, asked in driven)  # sub-scores come first
