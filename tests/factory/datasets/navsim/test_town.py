"""The synthetic town as OpenScene and GeoPackage, read back: the same clips as the native reader's, and scores.

The native clip is thinned to 2 Hz and brought back by the slow twin; what thinning alone changes is tested too.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from factory.datasets.av2.reader import AV2Reader
from factory.datasets.navsim.log import read_frames
from factory.datasets.navsim.reader import LICENCE, NavsimReader
from factory.datasets.town.settings import TownSettings
from factory.datasets.town.town import write_logs
from factory.setup.bank import write_bank
from tasks.bank import SceneBank
from tasks.trajectories import score_trajectories
from tasks.world.clip import NOW, Clip
from tasks.world.road_map import CenterlineFinder, LightState, RoadMap, driving_command
from tasks.world.vocabulary import kinematic_trajectories
from tests.factory.datasets.navsim.geopackage_writer import CITIES, ORIGIN, stub_rows, write_root
from tests.factory.datasets.navsim.navsim_town import write_town
from tests.factory.datasets.navsim.twin import thinned

LOGS = (1, 2, 3, 5)  # of the town's kinds; three windows each. None drives a full circle: nuPlan's routes end there
FLAGS = ("nc", "dac", "ddc", "tlc", "ttc", "lk", "hc")


@dataclass(frozen=True)
class Towns:
    """The same logs twice."""

    native: AV2Reader
    navsim: NavsimReader

    def pairs(self) -> list[tuple[Clip, Clip]]:
        """Native clips, moved to where nuPlan has them, and NAVSIM's, window by window."""
        refs = {(ref.log_id, ref.start_ms): ref for ref in self.native.index().refs}
        return [
            (moved(self.native.read(refs[ref.log_id, ref.start_ms])), self.navsim.read(ref))
            for ref in self.navsim.index().refs
        ]


@pytest.fixture(scope="module")
def towns(tmp_path_factory: pytest.TempPathFactory) -> Towns:
    """Each log in a city of its own, since logs carry crops of their town's map."""
    root = tmp_path_factory.mktemp("towns")
    bare = TownSettings(cameras=(), lidar_beams=0)
    write_root(root / "maps", "sg-one-north", stub_rows())
    for location, folder in zip(CITIES, write_logs(root / "av2", LOGS, 0, bare)):
        write_town(root, "mini", folder, location)
    navsim = NavsimReader(root / "navsim_logs" / "mini", root / "maps", cache_dir=root / "kept")
    return Towns(AV2Reader(root / "av2"), navsim)


def moved(clip: Clip) -> Clip:
    """The clip at nuPlan's coordinates, on as much of its map as a GeoPackage holds."""
    shift = lambda points: points + np.append(ORIGIN, np.zeros(points.shape[-1] - 2))  # noqa: E731
    poses = clip.world_from_ego.copy()
    poses[:, :2, 3] += ORIGIN
    agents = replace(clip.agents, boxes=shift(clip.agents.boxes))
    states = shift(clip.ego_states)
    road_map = _moved_map(clip.road_map)
    line = CenterlineFinder(road_map, clip.route).centerline_from(states[NOW, :3])
    return replace(clip, ego_states=states, world_from_ego=poses, agents=agents, centerline=line, road_map=road_map)


def _moved_map(road_map: RoadMap) -> RoadMap:
    """Without the links from lane to lane and from connector to connector, which a GeoPackage cannot hold."""
    shift = lambda points: points + np.append(ORIGIN, np.zeros(points.shape[-1] - 2))  # noqa: E731
    lanes = {
        lane_id: replace(
            lane,
            ring=shift(lane.ring),
            centerline=shift(lane.centerline),
            successors=tuple(
                after
                for after in lane.successors
                if after in road_map.lanes and road_map.lanes[after].is_intersection != lane.is_intersection
            ),
        )
        for lane_id, lane in road_map.lanes.items()
    }
    areas = tuple(replace(area, ring=shift(area.ring)) for area in road_map.drivable_areas)
    return replace(road_map, lanes=lanes, drivable_areas=areas)


@pytest.mark.slow
def test_the_clips_are_the_native_reader_s_thinned_to_2_hz_and_back(towns: Towns) -> None:
    pairs = towns.pairs()
    assert len(pairs) == 12
    for native, read in pairs:
        twin = thinned(native)
        assert (read.log_id, read.start_s, read.licence) == (native.log_id, native.start_s, LICENCE)
        np.testing.assert_allclose(read.ego_states, twin.ego_states, atol=2e-8)
        np.testing.assert_allclose(read.world_from_ego[::5], native.world_from_ego[::5], atol=1e-8)
        assert len(read.agents) == len(twin.agents)
        kinds = list(zip(read.agents.kinds, read.agents.valid.sum(axis=0).tolist()))
        assert sorted(kinds) == sorted(zip(twin.agents.kinds, twin.agents.valid.sum(axis=0).tolist()))
        for mine, theirs in zip(_by_place(read), _by_place(twin)):
            np.testing.assert_allclose(mine, theirs, atol=1e-7)
        assert _red(read) == {lane: steps for lane, steps in _red(twin).items() if lane in read.road_map.lanes}


@pytest.mark.slow
def test_every_sub_score_is_the_native_reader_s(towns: Towns) -> None:
    """256 trajectories in 12 scenes, 0 differences."""
    plans, different, worst = kinematic_trajectories(256, 0), dict.fromkeys(FLAGS, 0), 0.0
    seen = {name: set[float]() for name in FLAGS}
    for native, read in towns.pairs():
        twin = thinned(native)
        mine, theirs = score_trajectories(read, plans), score_trajectories(twin, plans)
        for name in FLAGS:
            different[name] += int((getattr(mine, name) != getattr(theirs, name)).sum())
            seen[name].update(getattr(theirs, name).tolist())
        worst = max(
            worst, float(np.abs(mine.ep - theirs.ep).max()), float(np.abs(mine.pdm_score - theirs.pdm_score).max())
        )
    assert not any(different.values()) and worst < 1e-6, (different, worst)
    assert all(len(values) > 1 for name, values in seen.items() if name != "tlc"), seen


@pytest.mark.slow
def test_the_command_computed_from_the_route_is_the_log_s_own(towns: Towns) -> None:
    """But where the route ends at a lane that follows a lane directly, which a GeoPackage cannot hold."""
    seen, compared = set(), 0
    for _, read in towns.pairs():
        frames = {frame.token: frame for frame in read_frames(towns.navsim.logs()[read.log_id]).frames}
        command = frames[read.frame_tokens[0]].command
        computed = driving_command(read.centerline, read.ego_states[NOW, :3])
        if computed != "unknown":
            assert computed == command
            seen.add(command)
            compared += 1
    assert len(seen) > 1 and compared >= 6, (seen, compared)


def _by_place(clip: Clip) -> list[np.ndarray]:
    """Boxes (96, 5) and velocities of tracks, in an order that does not depend on their names."""
    agents = clip.agents
    columns = np.concatenate([agents.boxes, agents.velocities, agents.center_z[..., None]], axis=-1)
    columns[..., 2] = np.cos(columns[..., 2])
    key = [
        tuple(np.round(np.nan_to_num(np.nanmean(columns[:, i, [0, 1, 3, 4]], axis=0)), 3)) for i in range(len(agents))
    ]
    return [columns[:, i] for i in sorted(range(len(agents)), key=key.__getitem__)]


def _red(clip: Clip) -> dict[str, list[int]]:
    red = clip.lights.states == LightState.RED
    return {lane: np.flatnonzero(red[:, i]).tolist() for i, lane in enumerate(clip.lights.lane_ids) if red[:, i].any()}


def test_a_bank_of_navsim_s_logs_answers_by_token(towns: Towns, tmp_path: Path) -> None:
    """As NAVSIM's users name a scene: the frame at T."""
    refs = towns.navsim.index().refs[:2]
    assert write_bank(tmp_path, towns.navsim, refs) == {}
    clips, bank = [towns.navsim.read(ref) for ref in refs], SceneBank(tmp_path)
    tokens = [clip.frame_tokens[0] for clip in clips if clip.frame_tokens]
    assert bank.tokens == {token: ref.clip_id for token, ref in zip(tokens, refs, strict=True)}
    plans = np.zeros((2, 3, 8, 3))
    plans[..., 0] = np.arange(1, 9) * np.array([[[1.0], [2.0], [3.0]]])
    found = bank.score(tokens, plans)
    for clip, mine, scores in zip(clips, plans, found.score, strict=True):
        np.testing.assert_array_equal(scores, score_trajectories(clip, mine).pdm_score)
    np.testing.assert_array_equal(found.score, bank.score(bank.clip_ids, plans).score)
    with pytest.raises(KeyError, match="no scene 'another'"):
        bank.score(["another"], plans[:1])
