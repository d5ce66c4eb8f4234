"""What others' bug reports say of real logs, as inputs: each reads as what the undamaged log says."""

import pickle
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute
import pyarrow.feather
import pytest

from factory.datasets.av2.reader import AV2Reader, read_log, read_motion
from factory.datasets.scenarionet.reader import ScenarioNetReader
from factory.datasets.scenarionet.reader import read_log as read_scenario_log
from tasks.world.clip import AgentKind
from tasks.world.frames import HEADING, PACIFICA, X, Y
from tasks.world.repair.records import LEFT_OUT, RepairCount, repair_counts
from tests.writable import load_writable

STEP_S = 0.1


def mutate(trial: Path, *words: object) -> None:
    subprocess.run([sys.executable, trial / "mutate.py", *map(str, words)], check=True)


@pytest.fixture(scope="module")
def argoverse(shared_root: Path) -> Path:
    """A log of 156 frames in 15.6 s, in which a car is listed twice."""
    (folder,) = (shared_root / "data/av2/sensor/val").glob("7fab2350*")
    return folder


@pytest.fixture
def copy(argoverse: Path, tmp_path: Path) -> Path:
    """Of what its clips are made of, writable."""
    to = tmp_path / argoverse.name
    (to / "map").mkdir(parents=True)
    for path in (*argoverse.glob("*.feather"), *argoverse.glob("map/log_map_archive_*")):
        shutil.copyfile(path, to / path.relative_to(argoverse))
    return to


@pytest.fixture
def scene(shared_root: Path) -> Path:
    """A scene with ten clips."""
    (path,) = (shared_root / "data/scenarionet/nuscenes").rglob("*scene-0061.pkl")
    return path


def keep_frames(log: Path, kept: Callable[[int], bool]) -> None:
    """Rewrite the annotations with the frames of these numbers."""
    path = log / "annotations.feather"
    table = pyarrow.feather.read_table(path)
    stamps = np.unique(table["timestamp_ns"].to_numpy())
    wanted = pa.array([stamp for k, stamp in enumerate(stamps.tolist()) if kept(k)])
    pyarrow.feather.write_feather(table.filter(pa.compute.is_in(table["timestamp_ns"], wanted)), str(path))


def assert_agents_are_on_the_lines_between_frames(
    found: Path, sound: Path, slower: float, kept: Callable[[int], bool]
) -> None:
    """The tracks of the undamaged log at its frames, by the other log's clock; sparse: gaps between all frames."""
    log, motion = read_log(found), read_motion(sound)
    frames = [k for k in range(len(motion.frame_times_s)) if kept(k)]
    number = {t: k for k, t in enumerate(motion.frame_times_s.tolist())}
    zero = motion.frame_times_s[frames[0]]
    for track in motion.tracks:
        shown = [i for i, t in enumerate(track.times_s.tolist()) if number[t] in frames]
        if not shown:
            continue
        n = log.agents.track_ids.index(track.track_id)
        times_s = (track.times_s[shown] - zero) * slower
        at = STEP_S * np.flatnonzero(log.agents.valid[:, n])
        xy = np.column_stack([np.interp(at, times_s, track.centers[shown, axis]) for axis in (0, 1)])
        assert np.abs(log.agents.boxes[log.agents.valid[:, n], n, :2] - xy).max(initial=0.0) < 1e-6
        steps = np.arange(len(log.agents.valid)) * STEP_S
        inside = (steps >= times_s[0]) & (steps <= times_s[-1])
        assert log.agents.valid[inside, n].all()


@pytest.mark.slow
@pytest.mark.parametrize(("hz", "windows"), [(9.9, 7), (9.7, 7), (10.3, 6)])
def test_a_clock_that_is_slow_or_fast_loses_no_window(
    shared_root: Path, argoverse: Path, copy: Path, hz: float, windows: int
) -> None:
    """At 10.3 Hz the log is 15.05 s long, where six fit."""
    mutate(shared_root / "trials/03-slow-clock", copy, hz)
    reader = AV2Reader(copy)
    index = reader.index()
    assert len(index.refs) == windows and not index.dropped and not index.broken
    clip = reader.read(index.refs[-1])
    assert [r.now for r in clip.repairs if r.what == "clock"] == ["every 0.1 s"]
    assert_agents_are_on_the_lines_between_frames(copy, argoverse, 10.0 / hz, lambda k: True)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kept", "windows", "told"),
    [
        (lambda k: k != 77, 7, ("gap", "")),  # one of 156 is missing
        (lambda k: not 77 <= k < 81, 7, ("gap", "")),
        (lambda k: k % 2 == 0, 6, ("clock", "")),  # the last of these is 15.4 s behind the first
        (lambda k: k % 5 == 0, 7, ("clock", "")),
    ],
)
def test_frames_that_are_missing_are_filled_in(
    argoverse: Path, copy: Path, kept: Callable[[int], bool], windows: int, told: tuple[str, str]
) -> None:
    keep_frames(copy, kept)
    index = AV2Reader(copy).index()
    assert len(index.refs) == windows and not index.dropped and not index.broken
    assert told in [(r.what, r.thing) for r in read_log(copy).repairs]
    assert_agents_are_on_the_lines_between_frames(copy, argoverse, 1.0, kept)


def both(scene: Path, spoiled: Path) -> tuple[ScenarioNetReader, ScenarioNetReader]:
    """Readers of the spoiled scene and of the sound one, which have the same windows."""
    found, sound = ScenarioNetReader(spoiled), ScenarioNetReader(scene)
    index = found.index()
    assert [ref.start_ms for ref in index.refs] == [ref.start_ms for ref in sound.index().refs]
    assert not index.broken and index.dropped == sound.index().dropped
    return found, sound


def assert_same_but_for(found: ScenarioNetReader, sound: ScenarioNetReader, gone: str | None) -> None:
    for one, other in zip(found.index().refs, sound.index().refs):
        clip, whole = found.read(one), sound.read(other)
        kept = [n for n, name in enumerate(whole.agents.track_ids) if name != gone]
        assert clip.agents.track_ids == tuple(whole.agents.track_ids[n] for n in kept)
        for name in ("boxes", "velocities", "valid", "center_z"):
            expected = getattr(whole.agents, name)[:, kept]
            assert np.array_equal(getattr(clip.agents, name), expected, equal_nan=expected.dtype.kind == "f")
        assert np.array_equal(clip.ego_states, whole.ego_states)


@pytest.mark.slow
def test_one_object_of_an_impossible_length_is_left_out_and_counted_and_costs_no_clip(
    shared_root: Path, scene: Path, tmp_path: Path
) -> None:
    mutate(shared_root / "trials/05-one-bad-box", scene, tmp_path / scene.name)
    tracks = load_writable(scene)["tracks"]
    vehicles = [name for name, track in tracks.items() if name != "ego" and track["type"] == "VEHICLE"]
    longest = max(vehicles, key=lambda name: tracks[name]["state"]["valid"].sum())
    found, sound = both(scene, tmp_path / scene.name)
    assert len(found.index().refs) == 10
    assert_same_but_for(found, sound, longest)
    sound_repairs, repairs = read_scenario_log(scene).repairs, read_scenario_log(tmp_path / scene.name).repairs
    (told,) = set(repairs) - set(sound_repairs)
    assert (told.what, told.thing, told.was, told.now) == ("impossible", longest, "length -1.2959", LEFT_OUT)
    assert RepairCount("impossible", 0, 1) in repair_counts(repairs)


@pytest.mark.slow
def test_the_ego_listed_among_the_agents_is_no_agent(shared_root: Path, scene: Path, tmp_path: Path) -> None:
    mutate(shared_root / "trials/10-ego-listed-as-agent", scene, tmp_path / scene.name)
    found, sound = both(scene, tmp_path / scene.name)
    assert_same_but_for(found, sound, None)
    for ref in found.index().refs:
        clip = found.read(ref)
        assert ("ego", "ego_again", LEFT_OUT) in [(r.what, r.thing, r.now) for r in clip.repairs]
        ego = clip.ego_states
        c, s = np.cos(ego[:, None, HEADING]), np.sin(ego[:, None, HEADING])
        dx, dy = (clip.agents.boxes[..., i] - ego[:, None, at] for i, at in enumerate((X, Y)))
        ahead, aside = c * dx + s * dy - PACIFICA.rear_axle_to_center, c * dy - s * dx
        assert not ((np.abs(ahead) < PACIFICA.half_length) & (np.abs(aside) < PACIFICA.half_width)).any()


@pytest.mark.slow
def test_an_identity_that_jumps_is_two_people_who_walk(scene: Path, tmp_path: Path) -> None:
    scenario = load_writable(scene)
    walkers = [name for name, track in scenario["tracks"].items() if track["type"] == "PEDESTRIAN"]
    longest = max(walkers, key=lambda name: scenario["tracks"][name]["state"]["valid"].sum())
    scenario["tracks"][longest]["state"]["position"][60:, 0] += 8.0
    (tmp_path / scene.name).write_bytes(pickle.dumps(scenario))
    found, sound = read_scenario_log(tmp_path / scene.name), read_scenario_log(scene)
    one, other = (found.agents.track_ids.index(name) for name in (longest, f"{longest}#2"))
    was = sound.agents.track_ids.index(longest)
    assert found.agents.kinds[one] is found.agents.kinds[other] is AgentKind.PEDESTRIAN
    assert np.flatnonzero(found.agents.valid[:, one]).max() < np.flatnonzero(found.agents.valid[:, other]).min()
    assert np.array_equal(found.agents.valid[:, one] | found.agents.valid[:, other], sound.agents.valid[:, was])
    speeds = np.hypot(*np.moveaxis(found.agents.velocities[:, [one, other]], -1, 0))
    assert np.nanmax(speeds) < 3.0
    told = [(r.what, r.was, r.now) for r in found.repairs if r.thing == longest]
    assert told == [("jump", longest, f"{longest}#2")]
