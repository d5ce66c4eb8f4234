"""Articulated vehicles on the real logs: the one truck and trailer that is there, and nobody else."""

import math
from pathlib import Path

import numpy as np
import pyarrow.feather as feather
import pytest
from numpy.typing import NDArray

from factory.datasets.av2.reader import AV2Reader
from factory.datasets.scenarionet.reader import ScenarioNetReader
from factory.readers.logs import LogReader, only_present
from tasks.rollout.simulate import TrafficSettings, next_scene, simulate
from tasks.world.clip import CLIP_STEPS, HORIZON_STEPS, Clip, scene_of_clip
from tasks.world.frames import wrap_angle
from tasks.world.repair.tracks import couplings

LOG = "7fab2350-7eaf-3b7e-a39d-6937a4c1bede"


@pytest.fixture(scope="module")
def val(shared_root: Path) -> Path:
    return shared_root / "data" / "av2" / "sensor" / "val"


@pytest.fixture(scope="module")
def truck(val: Path) -> tuple[str, str]:
    """Track ids of the cab and the trailer, by the annotators' categories."""
    rows = feather.read_table(val / LOG / "annotations.feather", ["category", "track_uuid"]).to_pydict()
    track = dict(zip(rows["category"], rows["track_uuid"]))
    return track["TRUCK_CAB"], track["VEHICULAR_TRAILER"]


@pytest.fixture(scope="module")
def clips(val: Path) -> list[Clip]:
    reader = AV2Reader(val)
    return [reader.read(ref) for ref in reader.index().refs if ref.log_id == LOG]


def test_every_window_says_what_is_towed(clips: list[Clip], truck: tuple[str, str]) -> None:
    cab, trailer = truck
    assert len(clips) == 7
    for clip in clips:
        (record,) = (repair for repair in clip.repairs if repair.what == "articulated")
        assert (record.thing, record.was, record.now) == (trailer, "an agent of its own", f"towed by {cab}")
        assert math.isnan(record.time_s)


def pairs_of(reader: LogReader) -> set[tuple[str, str, str]]:  # type: ignore[type-arg]
    """(log, front, towed) of whole logs and of a window from every fifth step on."""
    found = set()
    for log_id, path in reader.logs().items():
        agents = reader.load(path).agents
        starts = range(0, agents.n_steps - CLIP_STEPS + 1, 5)
        for part in (agents, *(only_present(agents.window(k, k + CLIP_STEPS)) for k in starts)):
            found |= {(log_id, part.track_ids[i], part.track_ids[j]) for i, j in couplings(part)}
    return found


@pytest.mark.slow
def test_nobody_else_is_coupled_in_the_logs_that_are_here(shared_root: Path, val: Path, truck: tuple[str, str]) -> None:
    """Ten logs: parked cars bumper to bumper, a parked truck before its trailer, queues that move up."""
    data = shared_root / "data"
    assert pairs_of(AV2Reader(val)) == {(LOG, *truck)}
    for folder in (data / "scenarionet" / "nuscenes", data / "nuscenes_front"):
        assert pairs_of(ScenarioNetReader(folder)) == set()


@pytest.mark.slow
@pytest.mark.parametrize("yields", [True, False])
def test_the_truck_keeps_its_trailer(clips: list[Clip], truck: tuple[str, str], yields: bool) -> None:
    """For two rollouts, 8 s; on their own they came from 6.6 to 12.3 m apart, and to 19.4 m where nobody yields."""
    for clip in clips:
        scene, settings = scene_of_clip(clip), TrafficSettings(yields=yields)
        pair = [clip.agents.track_ids.index(name) for name in truck]
        was = float(apart(scene.agents.boxes[scene.step, pair]))
        for _ in range(2):
            ahead = clip.ego_states[scene.step + 1 : scene.step + 1 + HORIZON_STEPS, :3]
            rollout = simulate(scene, ahead, settings)
            boxes = rollout.agents.boxes[:, pair]
            assert rollout.simulated[pair].all()
            assert apart(boxes) == pytest.approx(was, abs=0.3)
            assert np.hypot(*np.diff(boxes[:, 1, :2], axis=0).T).max() < 1.2, "12 m/s"
            assert np.abs(wrap_angle(np.diff(boxes[:, 1, 2]))).max() < math.radians(3.0)
            scene = next_scene(scene, rollout, clip.centerline)


def apart(boxes: NDArray[np.float64]) -> NDArray[np.float64]:
    """(...,) of boxes (..., 2, 5)."""
    between = boxes[..., 0, :2] - boxes[..., 1, :2]
    return np.asarray(np.hypot(between[..., 0], between[..., 1]))
