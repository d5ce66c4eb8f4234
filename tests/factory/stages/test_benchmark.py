"""A benchmark out of the factory: pairs complete, scenes beside the tables, the same after any interruption."""

import json
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from factory.config.run import BenchmarkSettings, load_config
from factory.datasets.town.settings import TownSettings
from factory.exits import COMPLETE
from factory.graph.steps import PreparedClip, RejectedAttempt, SampleColumns, run_attempt
from factory.pipeline import BenchmarkWork, FactoryWork
from factory.readers.base import ClipRef
from factory.setup.settings import assemble, run_identity
from factory.stages.benchmark import describe_benchmark, write_benchmark
from factory.store.location import BadCacheFile, Location, SceneFiles
from factory.store.samples import Store
from tasks.stages import Rejected
from tasks.world.clip import HORIZON_STEPS, NOW
from tests.factory.stages.test_pipeline import VOCABULARY
from tests.factory.toy import executed

SMALL = TownSettings(cameras=("ring_front_center",), lidar_beams=32)
EXPERTS = ("human", "human_before", "follow_up", "follow_up_before")
Rows = dict[tuple[str, str], dict[int, dict[str, Any]]]


def overrides(folder: Path, *more: str, settings: TownSettings | None = None) -> list[str]:
    cameras = ",".join(settings.cameras) if settings else ""
    beams = settings.lidar_beams if settings else 0
    return [
        "preset=hard_benchmark",
        "clips=synthetic_towns",
        f"clips.cache_dir={folder / 'towns'}",
        "clips.seeds=[0]",
        "clips.logs_per_town=1",
        "clips.split=test",
        f"clips.settings.cameras=[{cameras}]",
        f"clips.settings.lidar_beams={beams}",
        "render=none",
        "vocabulary.k=2000",
        f"out={folder / 'out'}",
        *more,
    ]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("benchmark")


@pytest.fixture(scope="module")
def work(folder: Path) -> FactoryWork:
    return assemble(load_config(overrides(folder))).work


@pytest.fixture(scope="module")
def refs(work: FactoryWork) -> Sequence[ClipRef]:
    found = work.reader.index().refs
    assert [ref.start_ms for ref in found] == [0, 1000, 2000]
    return found


def made(work: FactoryWork, refs: Sequence[ClipRef], out: Path, rounds: int) -> Store:
    store = Store(str(out))
    assert executed(work, refs, EXPERTS, rounds, store).exit_code == COMPLETE
    return Store(str(out))


@pytest.fixture(scope="module")
def store(work: FactoryWork, refs: Sequence[ClipRef], folder: Path) -> Store:
    return made(work, refs, folder / "whole", 3)


def rows_of(store: Store) -> Rows:
    rows: Rows = defaultdict(dict)
    for row in store.samples.read().to_pylist():
        rows[row["clip_id"], row["expert"]][row["candidate_index"]] = row
    return rows


@pytest.mark.slow
def test_every_clip_has_its_logged_frames_and_complete_pairs(store: Store, refs: Sequence[ClipRef]) -> None:
    rows = rows_of(store)
    for ref in refs[1:]:
        now, before = (rows[ref.clip_id, expert] for expert in ("follow_up", "follow_up_before"))
        assert list(now) == list(before) and len(now) == 3
        human, earlier = (rows[ref.clip_id, expert][-1] for expert in ("human", "human_before"))
        assert earlier["now_s"] == human["now_s"] - 0.5 == 1.0
        assert earlier["clip_start_s"] == human["clip_start_s"] and earlier["split"] == "test"
        assert earlier["parent_states"] == human["parent_states"]
        assert earlier["attempt_id"] != human["attempt_id"]
        for index, row in now.items():
            assert before[index]["now_s"] == pytest.approx(row["now_s"] - 0.5)
            assert before[index]["perturbed_states"] == row["perturbed_states"]
            pose = np.array(row["perturbed_states"])[HORIZON_STEPS - 5, :3]
            assert np.allclose(before[index]["now_pose"], pose)


def test_the_earlier_logged_frame_is_the_same_log(store: Store, refs: Sequence[ClipRef]) -> None:
    rows, scenes = rows_of(store), SceneFiles(store.location.child("scenes"))
    for ref in refs[1:]:
        kept = scenes.load(ref.clip_id)
        assert np.allclose(kept.before.ego_states[NOW], kept.clip.ego_states[NOW - 5])
        now_pose = rows[ref.clip_id, "human_before"][-1]["now_pose"]
        assert np.allclose(now_pose, kept.clip.ego_states[NOW - 5, :3])


def test_scenes_rebuild_what_the_rows_were_made_from(store: Store, refs: Sequence[ClipRef]) -> None:
    rows, scenes = rows_of(store), SceneFiles(store.location.child("scenes"))
    assert scenes.clip_ids() == sorted(ref.clip_id for ref in refs[1:])
    kept = scenes.load(refs[1].clip_id)
    assert kept.clip.clip_id == refs[1].clip_id and not kept.clip.images
    for expert, before in (("follow_up", False), ("follow_up_before", True)):
        for index, row in rows[refs[1].clip_id, expert].items():
            scene = kept.stage_two(index, before)
            assert np.allclose(scene.ego_state[:3], row["now_pose"])
            assert scene.step * 0.1 == pytest.approx(row["now_s"])
            assert np.allclose(row["ego_status"], scene.ego_state[[3, 4, 5, 6]], atol=1e-5)


def test_the_document_names_what_counts_and_what_does_not(
    store: Store, work: FactoryWork, refs: Sequence[ClipRef]
) -> None:
    few = describe_benchmark(store, refs, work.identity, 3, BenchmarkSettings(min_follow_ups=8))
    assert [(clip["start_ms"], clip["why"], clip["follow_ups"]) for clip in few["left_out"]] == [
        (0, "clip.no_earlier_frame", 0),
        (1000, "few_follow_ups", 3),
        (2000, "few_follow_ups", 3),
    ]
    said = write_benchmark(store, refs, work.identity, 3, BenchmarkSettings(min_follow_ups=3))
    assert "2 clips, 6 follow-ups; left out 1 clips (clip.no_earlier_frame 1)" in said
    document = json.loads((Path(store.location.uri) / "benchmark.json").read_text())
    assert [clip["clip_id"] for clip in document["clips"]] == [ref.clip_id for ref in refs[1:]]
    rows = rows_of(store)
    for clip in document["clips"]:
        assert clip["follow_ups"] == sorted(rows[clip["clip_id"], "follow_up"])
    assert document["settings_hash"] == work.identity.settings_hash
    other = replace(work.identity, settings={"seed": 1})
    assert {clip["why"] for clip in describe_benchmark(store, refs, other, 3, BenchmarkSettings(3))["left_out"]} == {
        "clip.no_earlier_frame",
        "no_logged_frames",
    }


@pytest.mark.slow
def test_a_resumed_benchmark_is_the_same_and_its_scenes_come_back(
    store: Store, work: FactoryWork, refs: Sequence[ClipRef], tmp_path: Path
) -> None:
    made(work, refs[1:2], tmp_path, 1)
    scene_file = tmp_path / "scenes" / f"{refs[1].clip_id}.clip"
    first = scene_file.read_bytes()
    scene_file.unlink()
    resumed = made(work, refs[1:2], tmp_path, 3)
    assert scene_file.read_bytes() == first == (Path(store.location.uri) / "scenes" / scene_file.name).read_bytes()
    again, whole = (
        {place: repr(sorted(rows.items())) for place, rows in rows_of(made_by).items() if place[0] == refs[1].clip_id}
        for made_by in (resumed, store)
    )
    assert again == whole and len(again) == len(EXPERTS)


def test_scenes_are_there_before_any_row_is(
    work: FactoryWork, refs: Sequence[ClipRef], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def killed(*_arguments: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(BenchmarkWork, "drive", killed)
    executed(work, refs[1:2], EXPERTS, 1, Store(str(tmp_path)))
    assert SceneFiles(Location(str(tmp_path / "scenes"))).clip_ids() == [refs[1].clip_id]
    assert not len(Store(str(tmp_path)).samples)


def test_missing_and_foreign_scenes_are_named(tmp_path: Path) -> None:
    files = SceneFiles(Location(str(tmp_path)))
    with pytest.raises(FileNotFoundError, match="abc"):
        files.load("abc")
    (tmp_path / "abc.clip").write_bytes(b"no zip")
    with pytest.raises(BadCacheFile):
        files.load("abc")


def test_a_log_that_begins_too_late_is_left_out_with_its_reason(work: FactoryWork, refs: Sequence[ClipRef]) -> None:
    result = work.prepare(refs[0])
    assert isinstance(result, Rejected)
    assert (result.stage, result.reason) == ("clip", "no_earlier_frame")


@pytest.mark.slow
def test_a_pair_falls_together_at_the_pictures(tmp_path: Path) -> None:
    small = ["clips.settings.width=64", "clips.settings.height=36", "clips.settings.lidar_azimuths=300"]
    small += ["clips.settings.steps_per_photo=5"]
    render = ["render=auto", "render.frames=now", "render.width=64", "render.height=36", "render.scene=discs"]
    lenient = [
        *small,
        *render,
        "render.psnr_min=0",
        "render.gate.vehicle_min=0",
        "render.gate.guessed_max=1",
        "vocabulary.k=300",
    ]
    drawn = assemble(load_config(overrides(tmp_path, *lenient, settings=SMALL))).work
    strict = replace(drawn, render=replace(drawn.render, gate=replace(drawn.render.gate, contrast_min=1.0)))
    prepared = strict.prepare(strict.reader.index().refs[1])
    assert isinstance(prepared, PreparedClip) and prepared.candidates
    pair = [run_attempt(strict, prepared, 0, expert) for expert in ("follow_up", "follow_up_before")]
    assert all(isinstance(result, RejectedAttempt) and result.rejected.reason == "blank" for result in pair)
    assert pair[0].rejected == pair[1].rejected  # type: ignore[union-attr]
    assert "at step 50" in pair[0].rejected.detail  # type: ignore[union-attr]
    for expert, at in (("human_before", -1), ("follow_up", 0), ("follow_up_before", 0)):
        result = run_attempt(drawn, prepared, at, expert)
        assert isinstance(result, SampleColumns)
        assert result.row["image_source"] == ("photo" if at < 0 else "render")
        assert [image["time_s"] for image in result.row["images"]] == [pytest.approx(0.0, abs=1e-6)]  # type: ignore[attr-defined]


def test_a_run_of_pairs_of_frames_prepares_anew() -> None:
    dense = run_identity(load_config(["perturb=dense"]), VOCABULARY, None).settings
    assert dense["perturb.order"] == "spread" and dense["perturb.at_most"] == 32
    benchmark = run_identity(load_config([f"experts=[{','.join(EXPERTS)}]"]), VOCABULARY, None)
    assert benchmark.prepare_digest != run_identity(load_config([]), VOCABULARY, None).prepare_digest
