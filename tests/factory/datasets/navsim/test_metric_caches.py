"""NAVSIM's metric caches as a bank: the scores of the clip that each is of; what is no cache is refused by name."""

import lzma
import os
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely

from factory.datasets.navsim.metric_caches import MAX_PICKLE_BYTES, polygon_rings, read_metric_cache, write_cache_bank
from factory.readers.base import BadClip
from tasks.bank import SceneBank
from tasks.trajectories import score_trajectories
from tasks.world.clip import Clip
from tests.factory.datasets.navsim.cache_writer import cache_of, write_cache
from tests.factory.datasets.navsim.red_light import plans, write
from tests.factory.datasets.navsim.small import reader_of, write_city
from tests.tasks.test_bank import plans as swerving

SAME = 1e-9


@pytest.fixture(scope="module")
def clips(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Clip]:
    """By their tokens: one street, whose light is red in each at other times."""
    root = tmp_path_factory.mktemp("lights")
    write(root)
    write_city(root)
    reader = reader_of(root, sensors=None)
    read = [reader.read(ref) for ref in reader.index().refs]
    return {clip.frame_tokens[0]: clip for clip in read if clip.frame_tokens}


@pytest.fixture
def cache(clips: dict[str, Clip]) -> Any:
    return cache_of(next(iter(clips.values())))


def test_a_bank_of_caches_gives_the_scores_of_their_clips(clips: dict[str, Clip], tmp_path: Path) -> None:
    for token, clip in clips.items():
        write_cache(tmp_path / "caches", token, cache_of(clip))
    assert write_cache_bank(tmp_path / "bank", tmp_path / "caches") == {}
    bank = SceneBank(tmp_path / "bank")
    assert {*bank.clip_ids} == {*clips}
    poses, tlc = np.concatenate([plans(), swerving(0, 30)]), set[float]()
    for token, clip in clips.items():
        found, wanted = bank.score([token], poses[None]), score_trajectories(clip, poses)
        for i, name in enumerate(found.names):
            np.testing.assert_allclose(found.subscores[0, :, i], getattr(wanted, name), rtol=0.0, atol=SAME)
        np.testing.assert_allclose(found.score[0], wanted.pdm_score, rtol=0.0, atol=SAME)
        tlc |= {*wanted.tlc.tolist()}
    assert tlc == {0.0, 1.0}


def _without_past(cache: Any) -> None:
    del cache.past_human_trajectory, cache.log_name


def _wider(cache: Any) -> None:
    cache.ego_state._car_footprint._width = 1.9


def _ends_early(cache: Any) -> None:
    del cache.observation._detections_tracks[30:]


def _no_lights(cache: Any) -> None:
    del cache.observation._occupancy_maps_tl


def _ramp(cache: Any) -> None:
    cache.drivable_area_map.arguments[2][1] = shapely.LineString([(0.0, 0.0), (1.0, 0.0)])


def _backwards(cache: Any) -> None:
    cache.trajectory.arguments[0].reverse()


@pytest.mark.parametrize(
    ("harm", "said"),
    [
        (_without_past, "past_human_trajectory: missing: a cache of NAVSIM before v2"),
        (_wider, "ego_state._car_footprint._length: 5.176 x 1.9 m is not the car"),
        (_ends_early, "observation._detections_tracks: 30 instants, expected 41"),
        (_no_lights, "observation._occupancy_maps_tl: missing"),
        (_ramp, r"drivable_area_map[1]: a geometry of type 2, expected a polygon"),
        (_backwards, "trajectory: holds no states in the order of time"),
    ],
)
def test_what_a_cache_lacks_is_named(harm: Callable[[Any], None], said: str, cache: Any, tmp_path: Path) -> None:
    harm(cache)
    path = write_cache(tmp_path, "token", cache)
    with pytest.raises(BadClip) as error:
        read_metric_cache(path)
    assert said in str(error.value) and str(path) in str(error.value)
    assert [said in why for why in write_cache_bank(tmp_path / "bank", tmp_path).values()] == [True]


class _Harm:
    def __reduce__(self) -> tuple[Any, tuple[str]]:
        return os.system, ("true",)


class Foreign:
    """Of no class that a cache holds."""


def test_bytes_that_are_no_cache_are_refused_in_a_line(cache: Any, tmp_path: Path) -> None:
    path = write_cache(tmp_path, "token", cache)
    whole = path.read_bytes()
    pickled = lzma.decompress(whole)
    for data, said in (
        (lzma.compress(pickle.dumps({"a": _Harm()})), "refused global posix.system"),
        (lzma.compress(pickle.dumps(Foreign())), f"refused global {Foreign.__module__}.Foreign"),
        (lzma.compress(pickle.dumps({"a": 1})), "is a dict, expected MetricCache"),
        (lzma.compress(pickled[:-100]), "truncated or not a pickle"),
        (whole[: len(whole) // 2], "cut off"),
        (pickled, "no readable stream"),
        (lzma.compress(b"\0" * (4 * MAX_PICKLE_BYTES), preset=0), f"unpacks to more than {MAX_PICKLE_BYTES} bytes"),
        (lzma.compress(pickled, filters=[{"id": lzma.FILTER_LZMA2, "dict_size": 1 << 30}]), "no readable stream"),
    ):
        path.write_bytes(data)
        with pytest.raises(BadClip, match=said) as error:
            read_metric_cache(path)
        assert "\n" not in str(error.value) and str(path) in str(error.value)
    with pytest.raises(FileNotFoundError, match=r"no <log>/<scenario type>/<token>/metric_cache\.pkl"):
        write_cache_bank(tmp_path / "bank", tmp_path / "log")


def test_rings_are_those_that_shapely_wrote() -> None:
    square, hole = shapely.box(0.0, 0.0, 9.0, 9.0), shapely.box(2.0, 2.0, 3.0, 3.0)
    around = shapely.Polygon(square.exterior, [hole.exterior])
    beside = shapely.set_srid(shapely.force_3d(shapely.box(20.0, 0.0, 21.0, 1.0), 5.0), 32618)
    for shape in (around, beside, shapely.MultiPolygon([around, shapely.box(20.0, 0.0, 21.0, 1.0)])):
        parts = shapely.get_parts(shape)
        wanted = [np.array(ring.coords)[:, :2] for part in parts for ring in (part.exterior, *part.interiors)]
        for flavor in ({"flavor": "extended", "include_srid": True}, {"byte_order": 0}):
            found = polygon_rings(shapely.to_wkb(shape, **flavor))  # type: ignore[arg-type]
            assert len(found) == len(wanted) and all(np.array_equal(*pair) for pair in zip(found, wanted))
    data = shapely.to_wkb(around)
    for cut in range(len(data)):
        with pytest.raises(ValueError, match="cut off"):
            polygon_rings(data[:cut])
    with pytest.raises(ValueError, match="without an outline"):
        polygon_rings(shapely.to_wkb(shapely.Polygon()))
