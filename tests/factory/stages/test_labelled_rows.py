"""Vocabulary labels from the command line to the row: by default, of which vocabulary, among which traffic."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from factory.commands.table import COMMANDS
from factory.config.run import load_config
from factory.graph.steps import HUMAN_CANDIDATE, PreparedClip, SampleColumns, run_attempt
from factory.pipeline import FactoryWork, perturbed_clip_of
from factory.run import main as run_main
from factory.setup.calibrate import estimate_run_size, measure
from factory.setup.settings import Run, assemble
from factory.setup.vocabulary import save_vocabulary
from factory.store.reader import SampleTable, labels_of
from factory.store.schema import LABEL_COLUMNS
from factory.views.pictures import SCORE_COLOURS, sample_bev
from tasks.attempt import Judged
from tasks.experts.protocol import Plan
from tasks.reward.epdms import Scores, prepare_scene, score
from tasks.rollout.lqr import track
from tasks.stages import HUMAN
from tasks.world.clip import HORIZON_STEPS, NOW, AgentTracks, Scene
from tasks.world.frames import to_world
from tasks.world.vocabulary import Vocabulary, kinematic_trajectories

STREET = [
    "clips=custom",
    "clips._target_=tests.factory.street_reader.StreetReader",
    "experts=[pdm_closed,human]",
    "vocabulary.k=150",
    "render=none",
    "executor=local",
]
KEPT = ("nc", "dac", "ddc", "tlc", "ttc", "lk", "hc")


@cache
def street(*overrides: str) -> Run:
    return assemble(load_config([*STREET, "out=nowhere", *overrides]))


@cache
def prepared() -> PreparedClip:
    work = street().work
    found = work.prepare(work.reader.index().refs[0])
    assert isinstance(found, PreparedClip) and found.candidates
    return found


def sample(work: FactoryWork, expert: str) -> tuple[SampleColumns, Judged]:
    """The first accepted attempt of the street, and what was judged in it."""
    for candidate in [HUMAN_CANDIDATE] if expert == HUMAN else range(len(prepared().candidates)):
        result = run_attempt(work, prepared(), candidate, expert)
        if isinstance(result, SampleColumns):
            judged = work.trace(prepared(), candidate, expert).judged
            assert judged is not None
            return result, judged
    raise AssertionError("nothing is accepted")


def among(judged: Judged, agents: AgentTracks, vocabulary: Vocabulary) -> Scores:
    """The vocabulary in pairs with PDM-Closed, from the sample's scene."""
    driven = track(judged.scene.ego_state, to_world(judged.scene.ego_state[:3], vocabulary.trajectories))
    states = np.concatenate([judged.reference[None], driven])
    return score(prepare_scene(judged.scene, agents), states, normalise="pairs")


def differing(row: dict[str, object], scores: Scores) -> list[str]:
    labels = labels_of(row)
    return [name for name in KEPT if (getattr(labels, name) != getattr(scores, name)[1:]).any()]


def test_by_default_a_simulated_sample_is_labelled_among_its_simulated_traffic() -> None:
    work = street("traffic.yields=false").work  # else it is the log's
    accepted, judged = sample(work, "pdm_closed")
    row = dict(accepted.row)
    assert row["label_vocabulary"] == work.vocabulary.digest and row["label_traffic"] == "replay"
    assert differing(row, among(judged, judged.rollout.agents, work.vocabulary)) == []
    log = judged.scene.clip.agents.window(judged.scene.step, judged.scene.step + 41)
    assert differing(row, among(judged, log, work.vocabulary)), "replaying the log would be seen"
    assert accepted.seconds["labels"].cpu_s > 0.0


def test_by_default_a_human_sample_is_labelled_among_the_log() -> None:
    work = street().work
    accepted, judged = sample(work, HUMAN)
    log = judged.scene.clip.agents.window(judged.scene.step, judged.scene.step + 41)
    assert differing(dict(accepted.row), among(judged, log, work.vocabulary)) == []


def test_labels_can_be_switched_off() -> None:
    accepted, _ = sample(street("reward.labels=none").work, HUMAN)
    assert not set(LABEL_COLUMNS) & set(accepted.row) and "labels" not in accepted.seconds


def test_another_vocabulary_can_be_labelled_wherever_its_file_lies(tmp_path: Path) -> None:
    other = Vocabulary(kinematic_trajectories(9, 5))
    for name in ("a.npy", "b.npy"):
        save_vocabulary(tmp_path / name, other, {})
    runs = [street(f"reward.label_vocabulary={tmp_path / name}") for name in ("a.npy", "b.npy")]
    accepted, _ = sample(runs[0].work, HUMAN)
    assert accepted.row["label_vocabulary"] == other.digest and len(labels_of(accepted.row)) == 9
    here, there, default = (run.work.identity for run in (*runs, street()))
    assert here.settings_hash == there.settings_hash != default.settings_hash
    assert here.settings["reward.label_vocabulary"] == other.digest
    assert here.prepare_digest == default.prepare_digest, "perturbing knows nothing of labels"


def test_a_dry_run_counts_the_labels_time_and_bytes() -> None:
    refs = street().index.refs
    with_labels, without = (measure(street(*overrides), refs) for overrides in ((), ("reward.labels=none",)))
    assert with_labels.seconds["labels"].cpu_s > 0.0 and without.seconds["labels"].cpu_s == 0.0
    bytes_each = 9 * -(-150 // 8) + 4 + 2 * 150 + 4
    assert with_labels.row_bytes - without.row_bytes >= with_labels.accepted * bytes_each
    assert "  labels " in estimate_run_size(street(), refs)


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the command leaves behind."""
    folder = tmp_path_factory.mktemp("street") / "out"
    assert run_main([*STREET, f"out={folder}"]) == 0
    return folder


@pytest.mark.slow
def test_a_whole_run_stores_labels_that_a_planner_can_read(out: Path) -> None:
    table, digest = SampleTable(out), street().work.vocabulary.digest
    assert len(table) == 2
    for stored in table.iterate(LABEL_COLUMNS):
        labels = labels_of(stored, vocabulary=digest)
        assert len(labels) == 150 and 0.0 < labels.pdm_score().mean() < 1.0


def test_a_sample_is_shown_with_its_vocabulary_where_that_is_known(
    out: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = [f"out={out}", "sample=0", f"to={tmp_path}"]
    show_main = COMMANDS["show"].load()
    assert show_main(asked) == 0, "the kinematic vocabulary needs no file"
    kinematic = capsys.readouterr().out
    assert "150 trajectories of vocabulary" in kinematic and "draws them" not in kinematic
    save_vocabulary(tmp_path / "same.npy", Vocabulary(kinematic_trajectories(150, 0)), {})
    save_vocabulary(tmp_path / "other.npy", Vocabulary(kinematic_trajectories(150, 1)), {})
    assert show_main([*asked, f"vocabulary={tmp_path / 'same.npy'}"]) == 0
    assert capsys.readouterr().out == kinematic
    assert show_main([*asked, f"vocabulary={tmp_path / 'other.npy'}"]) == 2
    assert "the sample's labels are of" in capsys.readouterr().err


def test_the_picture_draws_each_trajectory_in_the_colour_of_its_score(out: Path) -> None:
    row, vocabulary = SampleTable(out)[0], street().work.vocabulary
    drawn = [sample_bev(row, vocabulary=trajectories) for trajectories in (vocabulary.trajectories, None)]
    green = [(np.abs(image.astype(int) - SCORE_COLOURS[2]).max(axis=-1) < 12).sum() for image in drawn]
    assert labels_of(row).pdm_score().max() > 0.9 and green[0] > 50 > green[1]


class Meddler:
    name = "meddler"

    def digest(self) -> str:
        return "none"

    def plan(self, scene: Scene, rng: np.random.Generator) -> Plan:
        scene.agents.boxes[:] = 0.0
        raise AssertionError("what the next expert drives in was overwritten")


def test_experts_drive_from_the_scene_of_their_candidate_and_none_can_write_to_it() -> None:
    work = replace(street().work, experts={**street().work.experts, "meddler": Meddler()})
    payload = perturbed_clip_of(prepared())
    for candidate in (0, 1, 0):
        with pytest.raises(ValueError, match="read-only"):
            work.trace(prepared(), candidate, "meddler")
        judged = work.trace(prepared(), candidate, "pdm_closed").judged
        assert judged is not None
        scene, rollout = judged.scene, payload.candidates[candidate].rollout
        np.testing.assert_array_equal(scene.ego_state, rollout.ego_states[-1])
        now = slice(NOW, NOW + HORIZON_STEPS + 1)
        np.testing.assert_array_equal(scene.agents.boxes[now], rollout.agents.boxes)
