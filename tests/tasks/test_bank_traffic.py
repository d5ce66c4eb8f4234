"""Plans scored among a bank's answering traffic get what the factory's own rollout and reward give them, to the bit."""

import json
import zlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from factory.datasets.town.reader import SyntheticReader
from factory.datasets.town.settings import TownSettings
from factory.setup.bank import write_bank, write_clips
from tasks.attempt import judge
from tasks.bank import SceneBank
from tasks.bank_traffic import pack_traffic, unpack_traffic
from tasks.caches import Damaged, json_with_checksum
from tasks.experts.pdm_closed import plan_for
from tasks.experts.protocol import Plan
from tasks.reward.epdms import Scores
from tasks.rollout.lqr import track
from tasks.rollout.simulate import prepare_traffic, roll_out
from tasks.settings import TrafficSettings
from tasks.trajectories import at_ten_hz
from tasks.world.clip import Clip, scene_of_clip
from tests.tasks.rollout import worlds
from tests.tasks.rollout.test_traffic_twin import train
from tests.tasks.test_bank import plans

IDM = TrafficSettings()


def driven_among_traffic(clip: Clip, poses: np.ndarray, settings: TrafficSettings) -> list[Scores]:
    """Of each plan (K, 40, 3) the pair of PDM-Closed and it, as an attempt drives and judges an expert's plan."""
    scene = scene_of_clip(clip)
    traffic, reference = prepare_traffic(scene, settings), plan_for(scene)
    states = track(scene.ego_state, poses, local=True)
    return [
        judge(scene, Plan(pose), roll_out(traffic, drive), reference).scores
        for pose, drive in zip(poses, states, strict=True)
    ]


def expect_the_factory_s(
    bank: SceneBank, clips: Sequence[Clip], poses: np.ndarray, settings: TrafficSettings = IDM
) -> None:
    """Plans (K, 40, 3), on each clip the same."""
    ids, many = [clip.clip_id for clip in clips], np.repeat(poses[None], len(clips), 0)
    got = bank.score(ids, many, traffic="idm", threads=3)
    alone = bank.score(ids, many, traffic="idm", threads=1)
    assert np.array_equal(got.score, alone.score) and np.array_equal(got.subscores, alone.subscores)
    beside = bank.score(ids, many, traffic="idm", reference="batch")
    for b, clip in enumerate(clips):
        want = driven_among_traffic(clip, poses, settings)
        for i, name in enumerate(got.names):
            assert got.subscores[b, :, i].tolist() == [getattr(scores, name)[1] for scores in want], name
        assert got.score[b].tolist() == [scores.pdm_score[1] for scores in want]
        metres, multiplier = np.array([(scores.ep_raw_m[1], scores.multiplier[1]) for scores in want]).T
        best = np.maximum((metres * multiplier).max(), metres * multiplier)
        ep = np.where(best > 5.0, np.clip(metres / np.maximum(best, 5.0), 0.0, 1.0), 1.0)
        assert beside.subscores[b, :, beside.names.index("ep")].tolist() == ep.tolist()


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> SyntheticReader:
    blind = TownSettings(cameras=(), lidar_beams=0, steps_per_photo=1)
    return SyntheticReader(tmp_path_factory.mktemp("town"), 4, settings=blind)


@pytest.mark.parametrize("settings", [IDM, TrafficSettings(yields=False, headway_s=2.0)])
def test_plans_among_the_town_s_traffic_get_the_factory_s_scores(
    town: SyntheticReader, settings: TrafficSettings, tmp_path: Path
) -> None:
    assert write_bank(tmp_path, town, traffic=settings) == {}
    bank, clips = SceneBank(tmp_path), [town.read(ref) for ref in town.index().refs]
    expect_the_factory_s(bank, clips, plans(1, 9), settings)
    coarse = plans(2, 5, 8)[None].astype(np.float32)
    got = bank.score(bank.clip_ids[:1], coarse, traffic="idm").score[0]
    want = driven_among_traffic(clips[0], at_ten_hz(coarse[0].astype(np.float64)), settings)
    assert got.tolist() == [scores.pdm_score[1] for scores in want]
    with pytest.raises(ValueError, match=r"poses\[0\] \(.*\): a plan or its drive is not finite"):
        bank.score(bank.clip_ids[:1], np.full((1, 1, 8, 3), np.nan), traffic="idm")


def crowd(seed: int) -> Clip:
    """A random world with a cab and its trailers in it, and a route along its road."""
    clip = worlds.with_members(worlds.random_scene(seed), *train(np.random.default_rng(seed))).clip
    road = np.linspace([-100.0, 0.0, 0.0], [300.0, 0.0, 0.0], 200)
    return replace(clip, clip_id=str(seed), centerline=road)


def test_crowds_and_trains_are_what_was_prepared_and_get_the_factory_s_scores(tmp_path: Path) -> None:
    clips = {clip.clip_id: clip for clip in map(crowd, range(8))}
    for clip in clips.values():
        ready, found = (
            prepare_traffic(scene_of_clip(clip), IDM),
            unpack_traffic(np.frombuffer(pack_traffic(clip, IDM), np.uint8)),
        )
        for got, want in ((found.roles, ready.roles), (found.paths, ready.paths), (found.yielding, ready.yielding)):
            assert got is not None and want is not None
            for name in {*got._fields} - {"height"}:
                np.testing.assert_array_equal(getattr(got, name), getattr(want, name), name, strict=True)
    assert write_clips(tmp_path, clips.__getitem__, {name: name for name in clips}, traffic=IDM) == {}
    expect_the_factory_s(SceneBank(tmp_path), [*clips.values()], plans(0, 6))


def test_a_bank_without_answering_traffic_says_how_to_get_it(town: SyntheticReader, tmp_path: Path) -> None:
    refs, poses = town.index().refs[:1], np.zeros((1, 1, 8, 3))
    write_bank(tmp_path / "without", town, refs)
    write_bank(tmp_path / "with", town, refs, traffic=IDM)
    without, bank = SceneBank(tmp_path / "without"), SceneBank(tmp_path / "with")
    with pytest.raises(ValueError, match=r"no traffic that answers: write it by write_bank\(traffic="):
        without.score(without.clip_ids, poses, traffic="idm")
    with pytest.raises(ValueError, match="traffic must be one of"):
        bank.score(bank.clip_ids, poses, traffic="navsim")  # type: ignore[arg-type]
    assert without.score(without.clip_ids, poses).score == bank.score(bank.clip_ids, poses).score
    assert (tmp_path / "with" / "scenes-00000.bank").read_bytes() == (
        tmp_path / "without" / "scenes-00000.bank"
    ).read_bytes()
    for other in (None, TrafficSettings(headway_s=2.0)):
        with pytest.raises(Damaged, match="a bank of other clips or traffic"):
            write_bank(tmp_path / "with", town, refs, traffic=other)
    with pytest.raises(ValueError, match="traffic is of mode navsim"):
        write_bank(tmp_path / "other", town, refs, traffic=TrafficSettings(mode="navsim"))


def test_traffic_of_somebody_else_is_refused_or_scored_and_never_read_beyond(tmp_path: Path) -> None:
    clip = crowd(3)
    assert write_clips(tmp_path, lambda _: clip, {clip.clip_id: 0}, traffic=IDM) == {}
    head, body = tmp_path / "scenes-00000.json", tmp_path / "scenes-00000.traffic"
    whole, poses = np.frombuffer(body.read_bytes(), np.uint8), plans(0, 2)[None]
    rng, refused = np.random.default_rng(0), 0
    for _ in range(60):
        changed = whole.copy()
        changed[rng.integers(0, len(whole), 3)] = rng.integers(0, 256, 3)
        body.write_bytes(changed.tobytes())
        with pytest.raises(Damaged, match="its checksum is another"):
            SceneBank(tmp_path).score([clip.clip_id], poses, traffic="idm")
        kept = json.loads(head.read_text())
        del kept["sha256"]
        kept["traffic"]["crc32"] = [zlib.crc32(changed.tobytes())]
        head.write_text(json_with_checksum(kept))
        try:
            SceneBank(tmp_path).score([clip.clip_id], poses, traffic="idm")
        except (Damaged, ValueError):
            refused += 1
    assert refused > 10
    body.write_bytes(whole.tobytes()[:-1])
    with pytest.raises(Damaged, match=r"scenes-00000\.traffic: not .* bytes"):
        SceneBank(tmp_path)
