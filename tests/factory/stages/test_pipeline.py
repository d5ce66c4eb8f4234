"""The work behind the machine: what its digests cover, what a block's verdict drops, and data that moves."""

import copy
import dataclasses
import shutil
from pathlib import Path

import numpy as np
import pytest

from factory.config.run import load_config
from factory.datasets.town.reader import SyntheticReader
from factory.datasets.town.settings import TownSettings
from factory.graph.steps import HUMAN_CANDIDATE, PreparedClip, RejectedAttempt, SampleColumns, run_attempt
from factory.pipeline import FactoryWork, WholeClip
from factory.readers.base import BadClip, read_clip
from factory.setup.settings import assemble, run_identity
from factory.stages.assets import load_or_build_scene
from factory.store.schema import COLUMNS, UNLISTED
from tasks import stages
from tasks.perturb import Perturbation, perturb
from tasks.render.scene.asset import camera_psnr_db
from tasks.stages import HUMAN, HUMAN_BEFORE
from tasks.world.clip import HORIZON_STEPS, NOW, random_stream
from tasks.world.frames import to_local
from tasks.world.vocabulary import Vocabulary, kinematic_trajectories

VOCABULARY = Vocabulary(kinematic_trajectories(3, 0))
SIZE = ["render.width=64", "render.height=36", "render.scene=discs", "vocabulary.k=300"]
SIZE += ["render.psnr_min=0", "render.gate.vehicle_min=0", "render.gate.guessed_max=1", "experts=[pdm_closed,human]"]
OPEN = ["reward.full=[]", "reward.progress_above=-1", "reward.off_route=false", "reward.after=false"]
OPEN += ["reward.near_log=false"]


def work_on(root: Path, out: Path, *overrides: str) -> FactoryWork:
    return assemble(load_config(["clips=av2", f"clips.root={root}", f"out={out}", *SIZE, *overrides])).work


def strict_on(root: Path, out: Path, *overrides: str, **gate: float) -> FactoryWork:
    """With measures of the pictures' gate that no configuration offers."""
    work = work_on(root, out, *overrides)
    return dataclasses.replace(
        work, render=dataclasses.replace(work.render, gate=dataclasses.replace(work.render.gate, **gate))
    )


def prepared_by(work: FactoryWork) -> PreparedClip:
    prepared = work.prepare(work.reader.index().refs[0])
    assert isinstance(prepared, PreparedClip)
    return prepared


def first_sample(work: FactoryWork, prepared: PreparedClip) -> SampleColumns:
    results = (run_attempt(work, prepared, row.index, "pdm_closed") for row in prepared.candidates)
    return next(result for result in results if isinstance(result, SampleColumns))


def test_a_block_below_the_gate_drops_the_experts_and_keeps_the_human(small_town: Path, tmp_path: Path) -> None:
    work = work_on(small_town, tmp_path, "render.psnr_min=60")
    prepared = prepared_by(work)
    assert prepared.dropped is not None and (prepared.dropped.stage, prepared.dropped.reason) == ("render", "psnr")
    assert prepared.candidates == ()
    human = run_attempt(work, prepared, HUMAN_CANDIDATE, HUMAN)
    assert isinstance(human, SampleColumns) and human.row["image_source"] == "photo"


@pytest.mark.slow
def test_a_camera_too_poor_is_left_out_of_what_is_drawn_and_the_human_s_photos_are_all_there(tmp_path: Path) -> None:
    cameras = ("ring_front_center", "ring_front_left")
    town = SyntheticReader(tmp_path / "town", 1, 0, TownSettings(cameras, 64, 36, lidar_beams=32, lidar_azimuths=300))
    town.index()
    work = work_on(town.root, tmp_path)
    clip = read_clip(work.reader, work.reader.index().refs[0])
    asset = load_or_build_scene(clip, work.render, tmp_path / "cache")
    assert asset is not None
    front, left = (camera_psnr_db(asset)[name] for name in cameras)
    assert left < front, "a street whose side is the harder"
    between = (front + left) / 2.0
    work = work_on(town.root, tmp_path, "render.psnr_min=1", f"render.camera_psnr_min={between}")
    prepared = prepared_by(work)
    assert prepared.gate_counts["camera ring_front_left"] == 1 and prepared.dropped is None
    drawn, human = first_sample(work, prepared).row, run_attempt(work, prepared, HUMAN_CANDIDATE, HUMAN)
    assert isinstance(human, SampleColumns)
    assert drawn["cameras_left_out"] == [{"camera": "ring_front_left", "why": f"{left:.2f} dB, below {between:g}"}]
    assert drawn["psnr"] == pytest.approx(front)
    for row, seen in ((drawn, {"ring_front_center"}), (human.row, set(cameras))):
        assert {camera["name"] for camera in row["cameras"]} == set(cameras)  # type: ignore[attr-defined]
        assert {image["camera"] for image in row["images"]} == seen  # type: ignore[attr-defined]


@pytest.mark.slow
def test_a_drive_that_cannot_be_shown_is_dropped_and_the_human_s_is_not(small_town: Path, tmp_path: Path) -> None:
    strict = strict_on(small_town, tmp_path, contrast_min=1.0)
    prepared = prepared_by(strict)
    results = [run_attempt(strict, prepared, row.index, "pdm_closed") for row in prepared.candidates]
    dropped = [
        result for result in results if isinstance(result, RejectedAttempt) and result.rejected.stage == "render"
    ]
    assert dropped and {result.rejected.reason for result in dropped} == {"blank"}
    assert not any(isinstance(result, SampleColumns) for result in results)
    assert dropped[0].subscores["nc"] == 1.0  # the reward had accepted it
    assert isinstance(run_attempt(strict, prepared, HUMAN_CANDIDATE, HUMAN), SampleColumns)
    for override in ("render.gate.enabled=false", "render=none", "render=map"):
        lenient = strict_on(small_town, tmp_path, override, contrast_min=1.0)
        assert isinstance(first_sample(lenient, prepared), SampleColumns)


@pytest.mark.slow
def test_a_drive_past_a_vehicle_unlike_its_photos_is_dropped_and_at_zero_it_is_not(
    small_town: Path, tmp_path: Path
) -> None:
    stored = {f"ring_front_center at step {step}" for step in (40, 45, 50, 55)}  # 1.5 s before T+H to T+H
    strict = strict_on(small_town, tmp_path, vehicle_min=1.0, vehicle_share=0.001)
    prepared = prepared_by(strict)
    found = [run_attempt(strict, prepared, row.index, "pdm_closed") for row in prepared.candidates]
    dropped = [result.rejected for result in found if isinstance(result, RejectedAttempt)]
    details = [rejected.detail for rejected in dropped if rejected.reason == "unlike_photos"]
    assert details and {detail.split(":")[0] for detail in details} <= stored
    lenient = strict_on(small_town, tmp_path, vehicle_min=0.0, vehicle_share=0.001)
    assert isinstance(first_sample(lenient, prepared), SampleColumns)


@pytest.mark.slow
def test_a_prepared_clip_is_rendered_also_where_its_data_has_moved(small_town: Path, tmp_path: Path) -> None:
    prepared = prepared_by(work_on(small_town, tmp_path / "a"))
    here = first_sample(work_on(small_town, tmp_path / "a"), prepared)
    moved = tmp_path / "elsewhere"
    shutil.copytree(small_town, moved)
    there = first_sample(work_on(moved, tmp_path / "b"), prepared)
    assert here.row["image_source"] == there.row["image_source"] == "render"
    assert here.row["images"][0]["jpeg"] == there.row["images"][0]["jpeg"]  # type: ignore[index]


def test_the_earlier_frame_of_a_pair_shows_its_own_instants_from_where_the_ego_was(
    small_town: Path, tmp_path: Path
) -> None:
    """The photo at -0.5 s of the later frame is the one at now of the earlier, with its pose, and so on."""
    work = work_on(small_town, tmp_path, "experts=[human,human_before]")
    ref = work.reader.index().refs[1]
    prepared = work.prepare(ref)
    assert isinstance(prepared, PreparedClip)
    log, shown = work.reader.read(ref), []
    for expert, step in ((HUMAN, NOW), (HUMAN_BEFORE, NOW - 5)):
        accepted = run_attempt(work, prepared, HUMAN_CANDIDATE, expert)
        assert isinstance(accepted, SampleColumns)
        np.testing.assert_allclose(accepted.row["now_pose"], log.ego_states[step, :3], atol=1e-6)  # type: ignore[arg-type]
        shown.append({round(image["time_s"], 3): image for image in accepted.row["images"]})  # type: ignore[attr-defined]
    later, earlier = shown
    assert sorted(later) == sorted(earlier) == [-1.5, -1.0, -0.5, 0.0]
    for time_s in (-1.0, -0.5, 0.0):
        same = later[time_s - 0.5]
        assert earlier[time_s]["jpeg"] == same["jpeg"]
        np.testing.assert_array_equal(earlier[time_s]["ego_pose"], same["ego_pose"])
    assert earlier[0.0]["jpeg"] != later[0.0]["jpeg"]
    for image, step in ((later[0.0], NOW), (earlier[0.0], NOW - 5)):
        np.testing.assert_allclose(np.reshape(image["ego_pose"], (4, 4)), log.world_from_ego[step], atol=1e-6)


def test_with_an_open_gate_the_log_s_future_is_the_label_of_every_perturbed_state(
    small_town: Path, tmp_path: Path
) -> None:
    work = work_on(small_town, tmp_path, *OPEN, "render=none", "experts=[logged]")
    prepared = prepared_by(work)
    log = work.reader.read(work.reader.index().refs[0]).ego_states
    results = [run_attempt(work, prepared, row.index, "logged") for row in prepared.candidates[:4]]
    assert len(results) == 4
    for result in results:
        assert isinstance(result, SampleColumns)
        now = np.asarray(result.row["now_pose"])
        assert np.hypot(*(now - log[NOW + HORIZON_STEPS, :3])[:2]) > 0.3  # perturbed
        wanted = to_local(now, log[NOW + HORIZON_STEPS + 1 : NOW + 2 * HORIZON_STEPS + 1, :3])
        np.testing.assert_allclose(result.row["proposal_10hz"], wanted, atol=1e-4)  # type: ignore[arg-type]


def test_a_broken_log_fails_with_the_index_s_own_words(small_town: Path, tmp_path: Path) -> None:
    root = tmp_path / "logs"
    shutil.copytree(small_town, root)
    (next(root.glob("*/annotations.feather"))).write_bytes(b"no table")
    work = work_on(root, tmp_path)
    ((ref, said),) = work.broken.items()
    assert "annotations.feather: " in said
    with pytest.raises(BadClip) as raised:
        work.prepare(ref)
    assert str(raised.value) == said == str(copy.copy(raised.value))  # as it is taken apart to leave a worker


def test_what_is_considered_is_what_is_prepared(small_town: Path, tmp_path: Path) -> None:
    work = work_on(small_town, tmp_path, "render=none")
    made = work.read_and_perturb(work.reader.index().refs[0])
    assert isinstance(made, WholeClip) and isinstance(made.found, Perturbation)
    assert [row.vocabulary_index for row in prepared_by(work).candidates] == [
        candidate.vocabulary_index for candidate in made.candidates
    ]
    assert made.found.considered.fate.count("kept") == len(made.candidates) > 0


def test_a_clip_s_candidates_are_drawn_from_a_stream_of_the_run_s_seed_and_its_own_name(
    small_town: Path, tmp_path: Path
) -> None:
    work = work_on(small_town, tmp_path, "render=none", "seed=3")
    ref = work.reader.index().refs[0]
    clip, made = work.reader.read(ref), work.read_and_perturb(ref)
    assert isinstance(made, WholeClip)

    def drawn(seed: int, clip_id: str) -> list[int]:
        rng = random_stream(seed, clip_id, "perturb")
        found = perturb(clip, work.vocabulary, work.perturb, work.traffic, rng)
        assert isinstance(found, Perturbation)
        return [candidate.vocabulary_index for candidate in found.candidates]

    mine = [candidate.vocabulary_index for candidate in made.candidates]
    assert mine == drawn(3, clip.clip_id)
    assert mine != drawn(0, clip.clip_id) and mine != drawn(3, "another")


@pytest.mark.parametrize(
    ("override", "prepares_anew"),
    [
        ("perturb.epdms_min=0.7", True),
        ("traffic=replay", True),
        ("seed=1", True),
        ("reward.progress_above=0.6", False),  # judges attempts only
        ("reward.off_route=false", False),
        ("render.width=128", True),  # another block, which may be refused
        ("render.psnr_min=0", True),
        ("experts=[pdm_closed]", False),
        ("rounds=5", False),
    ],
)
def test_what_a_prepared_clip_depends_on(override: str, prepares_anew: bool) -> None:
    before = run_identity(load_config([]), VOCABULARY, None).prepare_digest
    after = run_identity(load_config([override]), VOCABULARY, None).prepare_digest
    assert (before != after) == prepares_anew


def test_gates_that_are_off_are_no_part_of_what_rows_are_made_under_and_gates_that_are_on_are() -> None:
    """So tables of before there was a choice go on without them, and are refused by name with them."""
    off = run_identity(load_config(["reward.off_route=false", "reward.after=false"]), VOCABULARY, None)
    on = run_identity(load_config([]), VOCABULARY, None)
    assert dict(on.settings) == dict(off.settings) | {"reward.off_route": True, "reward.after": True}
    assert on.settings_hash != off.settings_hash and on.prepare_digest == off.prepare_digest


def test_without_a_gate_the_block_s_settings_are_no_part_of_what_is_prepared() -> None:
    for free in (["render.psnr_min=0"], ["render=none"]):
        small, large = (run_identity(load_config([*free, f"render.width={w}"]), VOCABULARY, None) for w in (64, 128))
        assert small.prepare_digest == large.prepare_digest


@pytest.mark.parametrize("stage", ["clip", "perturb", "rollout", "expert", "reward"])
def test_a_raised_stage_before_the_attempts_prepares_anew(stage: str, monkeypatch: pytest.MonkeyPatch) -> None:
    before = run_identity(load_config([]), VOCABULARY, None).prepare_digest
    raised = [dataclasses.replace(s, version=s.version + (s.name == stage)) for s in stages.STAGES]
    monkeypatch.setattr(stages, "STAGES", tuple(raised))
    assert run_identity(load_config([]), VOCABULARY, None).prepare_digest != before


def test_the_log_s_own_drive_alone_needs_no_candidates_and_no_block(small_town: Path, tmp_path: Path) -> None:
    work = work_on(small_town, tmp_path, "experts=[human]", "render.psnr_min=60")
    ref = work.reader.index().refs[0]
    assert work.block(ref) is None and work_on(small_town, tmp_path).block(ref) is not None
    corrected = work_on(small_town, tmp_path, "experts=[human]", "render.rig.adjust=on")  # its rig alone
    assert corrected.block(ref) is not None
    prepared = work.prepare(ref)
    assert isinstance(prepared, PreparedClip)
    assert prepared.candidates == () and prepared.dropped is None and work.identity.prepare_digest == UNLISTED
    accepted = run_attempt(work, prepared, HUMAN_CANDIDATE, "human")
    assert isinstance(accepted, SampleColumns) and accepted.row["image_source"] == "photo"
    logged = work.reader.read(ref).ego_states[NOW : NOW + 1 + HORIZON_STEPS, :3]
    label = to_local(logged[0], logged[1:])  # to the last bit of a float32: no tracker drove it
    assert np.array_equal(np.float32(accepted.row["label_10hz"]), np.float32(label))  # type: ignore[arg-type]
    assert "`human`: as logged" in COLUMNS["label_10hz"].about
    assert not list(tmp_path.rglob("block-*"))
