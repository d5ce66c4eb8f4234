"""Vocabulary labels of a scene: the reward's own scores, whatever the chunks, among the sample's own traffic."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from tasks.attempt import Judged, drive_and_judge, drive_under_log_replay, perturbed_scene, vocabulary_labels
from tasks.experts.protocol import Human, Plan
from tasks.reward.epdms import Scores, prepare_scene, score
from tasks.reward.label_bytes import HALVES, WHOLES, VocabularyLabels
from tasks.rollout.lqr import track
from tasks.rollout.simulate import TrafficSettings, simulate
from tasks.world.clip import NOW, Scene, scene_of_clip
from tasks.world.frames import to_world
from tasks.world.vocabulary import Vocabulary, kinematic_trajectories
from tests.tasks.streets import street_clip

IDM = TrafficSettings(yields=False)  # who yields does as in the log here
VOCABULARY = Vocabulary(kinematic_trajectories(60, 3))
KEPT = (*HALVES, *WHOLES, "ep_raw_m")


def ahead(scene: Scene, speed_mps: float) -> NDArray[np.float64]:
    """(40, 3) straight on from the scene's ego."""
    way = speed_mps * 0.1 * np.arange(1, 41)
    return to_world(scene.ego_state[:3], np.column_stack([way, np.zeros((40, 2))]))


@pytest.fixture(scope="module")
def simulated() -> Judged:
    """Four seconds at half the log's speed, which the traffic behind answered to, then four more."""
    first = scene_of_clip(street_clip())
    scene = perturbed_scene(street_clip(), simulate(first, ahead(first, 4.0), IDM))
    return drive_and_judge(scene, Plan(ahead(scene, 6.0)), IDM)


@pytest.fixture(scope="module")
def human() -> Judged:
    return drive_under_log_replay(scene_of_clip(street_clip()), Human(), np.random.default_rng(0))


def labelled(judged: Judged, vocabulary: Vocabulary = VOCABULARY) -> VocabularyLabels:
    return vocabulary_labels(vocabulary, judged.scene, judged.prepared, judged.reference)


def in_pairs(judged: Judged, agents_of: str) -> Scores:
    """PDM-Closed and the vocabulary in one call of the reward, among the rollout's agents or the log's."""
    scene = judged.scene
    log = scene.clip.agents.window(scene.step, scene.step + 41)
    prepared = prepare_scene(scene, judged.rollout.agents if agents_of == "rollout" else log)
    driven = track(scene.ego_state, to_world(scene.ego_state[:3], VOCABULARY.trajectories))
    return score(prepared, np.concatenate([judged.reference[None], driven]), normalise="pairs")


def assert_labels_are(labels: VocabularyLabels, scores: Scores) -> None:
    for name in KEPT:
        np.testing.assert_array_equal(getattr(labels, name), getattr(scores, name)[1:], err_msg=name)
    np.testing.assert_array_equal(labels.ep(), scores.ep[1:])
    np.testing.assert_allclose(labels.pdm_score(), scores.pdm_score[1:], rtol=0, atol=1e-15)


def test_labels_are_the_reward_s_scores_in_pairs_with_pdm_closed(simulated: Judged) -> None:
    labels = labelled(simulated)
    assert_labels_are(labels, in_pairs(simulated, "rollout"))
    assert labels.vocabulary == VOCABULARY.digest
    assert len({*np.round(labels.pdm_score(), 3)}) > 10, "a vocabulary of all kinds of drives"


def test_the_judged_drive_itself_is_labelled_as_it_was_judged(simulated: Judged) -> None:
    start = simulated.scene.ego_state[:3]
    local = simulated.plan.poses - [*start[:2], 0.0]  # the street runs along x and the ego with it
    labels = labelled(simulated, vocabulary=Vocabulary(local[None]))
    for name in KEPT:
        assert getattr(labels, name)[0] == pytest.approx(getattr(simulated.scores, name)[1], abs=1e-9), name
    assert labels.pdm_score()[0] == pytest.approx(simulated.scores.pdm_score[1], abs=1e-9)


def test_a_simulated_sample_meets_its_simulated_traffic_and_not_the_log(simulated: Judged) -> None:
    labels, among_log = labelled(simulated), in_pairs(simulated, "log")
    differ = [name for name in KEPT if (getattr(labels, name) != getattr(among_log, name)[1:]).any()]
    assert {"nc", "ttc"} <= set(differ), "the log's traffic does other harm here: replaying it would be seen"


def test_a_human_sample_meets_the_log(human: Judged) -> None:
    assert human.scene.step == NOW
    assert_labels_are(labelled(human), in_pairs(human, "log"))


def test_chunks_leave_every_label_as_it_is(simulated: Judged, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = labelled(simulated)
    monkeypatch.setattr("tasks.attempt.TRAJECTORIES_AT_ONCE", 7)
    chunked = labelled(simulated)
    for name in KEPT:
        np.testing.assert_array_equal(getattr(chunked, name), getattr(whole, name))
    assert chunked.reference_progress_m == whole.reference_progress_m


def test_a_reference_at_fault_leaves_no_progress_to_be_held_against(human: Judged) -> None:
    off_road = human.reference.copy()
    off_road[:, 1] += 30.0
    labels = labelled(replace(human, reference=off_road))
    assert labels.reference_progress_m == 0.0
    np.testing.assert_array_equal(labels.ep()[labels.multiplier == 1.0], 1.0)
