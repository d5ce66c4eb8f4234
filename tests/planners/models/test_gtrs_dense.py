"""GTRS-Dense: what it learns, from whom, and what it chooses."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from planners.data.batch import Batch, ImageLayout, Needs
from planners.models.gtrs_dense import GtrsDense, imitation_target, random_shift
from planners.models.planner import TrainingData
from planners.models.settings import GtrsDenseSettings
from tasks.subscores import LABELLED
from tasks.world.vocabulary import Vocabulary
from tests.planners import scenes
from tests.planners.made_batch import made_batch

K = 24
TINY = GtrsDenseSettings(image=scenes.PICTURE, encoder="picture", sizes=scenes.SIZES)
EXACT = replace(TINY, kept=1.0, velocity_noise_mps=(0.0, 0.0), image_shift=0.0)


def planner(settings: GtrsDenseSettings = TINY, k: int = K, seed: int = 0) -> GtrsDense:
    torch.manual_seed(seed)
    return GtrsDense(settings, {"vocabulary": scenes.vocabulary(k)})


def labelled(n: int, k: int = K) -> tuple[Batch, torch.Tensor]:
    """n scenes whose drivers drive the best trajectory, and the final scores (n, k)."""
    trajectories = scenes.vocabulary(k)
    labels, final = scenes.labels(n, trajectories)
    best = torch.tensor(trajectories[final.argmax(1)], dtype=torch.float32)
    return replace(made_batch(Needs(scenes.PICTURE), n), plan_2hz=best[:, 4::5], plan_10hz=best, labels=labels), final


@pytest.mark.slow
def test_scores_are_probabilities_over_the_vocabulary_and_the_plan_is_its_entry() -> None:
    batch, _ = labelled(3)
    model = planner().eval()
    scores = model.scores(batch)
    assert set(scores) == {*LABELLED, "imitation"}
    assert all(value.shape == (3, K) and value.dtype == torch.float32 for value in scores.values())
    assert all(((value >= 0) & (value <= 1)).all() for value in scores.values())
    torch.testing.assert_close(scores["imitation"].sum(dim=1), torch.ones(3))
    expected = torch.tensor(scenes.vocabulary(K)).float()[model.choose(scores)]
    assert torch.equal(model.plan(batch), expected) and expected.shape == (3, 40, 3)


def test_a_training_step_sees_half_the_vocabulary_by_torchs_own_dice() -> None:
    model = planner()
    torch.manual_seed(3)
    first, second = model._picked(), model._picked()
    torch.manual_seed(3)
    assert len(first) == K // 2 and torch.equal(model._picked(), first) and not torch.equal(first, second)
    assert torch.equal(model.eval()._picked(), torch.arange(K))


def test_the_public_one_has_no_head_for_history_comfort() -> None:
    batch, _ = labelled(2)
    model, whole = planner(replace(TINY, variant="public")), planner()
    assert set(model(batch)) == set(whole(batch)) - {"hc"}
    assert model.plan(batch).shape == (2, 40, 3)


def test_noise_is_one_for_the_batch_or_another_for_each_sample() -> None:
    batch, _ = labelled(4)
    for variant, distinct in (("public", 1), ("paper", 4)):
        model = planner(replace(TINY, variant=variant))
        torch.manual_seed(0)
        off = model._noisy(batch.status) - batch.status
        assert len(off[:, 4].unique()) == len(off[:, 5].unique()) == distinct
        assert not off[:, :4].any() and not off[:, 6:].any()
    torch.manual_seed(0)
    along, across = torch.randn(()), torch.randn(())  # as the public code draws them
    off = planner(replace(TINY, variant="public"))
    torch.manual_seed(0)
    drawn = (off._noisy(torch.zeros(1, 8)))[0, 4:6]
    torch.testing.assert_close(drawn, torch.stack([along, across * 0.2]))


def test_the_imitated_distribution_is_a_softmax_of_squared_distances() -> None:
    at_2hz = torch.zeros(3, 8, 3)
    at_2hz[1, 0, 0], at_2hz[2, 4, 2] = 1.0, 0.5  # squared distances 0, 1, 0.25
    target = imitation_target(at_2hz, torch.zeros(1, 8, 3), torch.tensor([True]), sigma_m2=0.5)
    torch.testing.assert_close(target, torch.tensor([[0.0, -2.0, -0.5]]).softmax(dim=1))


def test_half_points_count_as_none() -> None:
    batch, _ = labelled(2)
    assert batch.labels is not None
    model = planner(EXACT).eval()
    as_half = model.losses(replace(batch, labels=batch.labels | {"nc": torch.full((2, K), 0.5)}))
    as_none = model.losses(replace(batch, labels=batch.labels | {"nc": torch.zeros(2, K)}))
    assert torch.equal(as_half["nc"], as_none["nc"])


def test_pictures_move_by_whole_pixels_with_their_edges_repeated() -> None:
    image = torch.arange(12, dtype=torch.uint8).reshape(1, 1, 3, 4)
    torch.manual_seed(0)
    seen = {tuple(random_shift(image, 1).flatten().tolist()) for _ in range(60)}
    assert len(seen) == 9  # one step along each axis, or none
    assert tuple(image.flatten().tolist()) in seen
    assert (1, 2, 3, 3, 5, 6, 7, 7, 9, 10, 11, 11) in seen  # one column to the left
    assert random_shift(image, 0) is image


def test_it_chooses_from_fewer_or_other_trajectories_than_it_was_trained_on() -> None:
    batch, _ = labelled(2)
    half = planner(replace(TINY, inference_entries=K // 2)).eval()
    assert torch.equal(half.choices, planner().trajectories[::2])
    assert half.scores(batch)["nc"].shape == (2, K // 2)
    other = scenes.vocabulary(5, seed=9)
    torch.manual_seed(0)
    settings = replace(TINY, inference_vocabulary="other.npy")
    model = GtrsDense(settings, {"vocabulary": scenes.vocabulary(K), "inference_vocabulary": other}).eval()
    assert model.scores(batch)["nc"].shape == (2, 5)
    assert torch.equal(model.plan(batch), torch.tensor(other).float()[model.choose(model.scores(batch))])
    assert model.needs.labels == Vocabulary(scenes.vocabulary(K)).digest
    with pytest.raises(ValueError, match="inference_entries=25: the vocabulary has 24"):
        planner(replace(TINY, inference_entries=K + 1))


def test_a_wrong_or_missing_vocabulary_is_refused_with_the_setting(tmp_path) -> None:  # type: ignore[no-untyped-def]
    file = tmp_path / "vocabulary.npy"
    np.save(file, scenes.vocabulary(K))
    digest = Vocabulary(scenes.vocabulary(K)).digest

    def arrays(path: str | None, labelled_with: str | None) -> dict[str, np.ndarray]:
        data = TrainingData(lambda: np.zeros((0, 8, 3)), labelled_with)
        return GtrsDense.fixed_arrays(replace(TINY, vocabulary=path), data)

    assert np.array_equal(arrays(str(file), digest)["vocabulary"], scenes.vocabulary(K))
    with pytest.raises(ValueError, match=f"vocabulary: give the .npy file .* {digest}"):
        arrays(None, digest)
    with pytest.raises(ValueError, match=f"has digest {digest}, the samples are labelled with 0123"):
        arrays(str(file), "0123")
    with pytest.raises(ValueError, match="these samples carry none"):
        arrays(str(file), None)
    with pytest.raises(ValueError, match=r"vocabulary=.*nowhere\.npy: not readable"):
        arrays(str(tmp_path / "nowhere.npy"), digest)


def test_settings_that_contradict_themselves_are_refused() -> None:
    with pytest.raises(ValueError, match="give one of them"):
        replace(TINY, inference_vocabulary="a.npy", inference_entries=3)
    with pytest.raises(ValueError, match=r"kept=0\.0"):
        replace(TINY, kept=0.0)
    with pytest.raises(ValueError, match="divisible by 32"):
        planner(replace(TINY, image=ImageLayout(width=100, height=32)))
