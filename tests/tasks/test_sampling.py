"""What a budget is spent on: weights in closed form, and lots by how often they fall."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tasks.experts.pdm_closed.planner import PdmSettings
from tasks.perturb import Perturbation, PerturbSettings, perturb
from tasks.rollout.simulate import TrafficSettings
from tasks.sampling import CellWeights, ClipFacts, by_lot, cell_weights, clip_weights, drawn
from tasks.settings import SampleWeights
from tasks.world.chance import stream
from tasks.world.kinematic_vocabulary import kinematic_trajectories
from tasks.world.vocabulary import Vocabulary
from tests.tasks.streets import street_clip

TURN, STRAIGHT = ("command_left",), ("command_straight",)
CLIPS = [
    ClipFacts("a", TURN, 0.2, 4, 3),
    ClipFacts("b", STRAIGHT, 1.0, 4, 0),
    ClipFacts("c", STRAIGHT, 0.7, 4, 1),
    ClipFacts("d", STRAIGHT, 0.9, 4, 0),
]


def test_who_asks_for_nothing_weighs_all_alike() -> None:
    assert set(clip_weights(CLIPS, SampleWeights()).values()) == {1.0}


def test_a_rare_cluster_weighs_a_power_of_how_rare_it_is() -> None:
    found = clip_weights(CLIPS, SampleWeights(rarity=0.5))
    assert found["a"] == pytest.approx(2.0)  # one clip in four
    assert [found[name] for name in "bcd"] == pytest.approx([(4 / 3) ** 0.5] * 3)


def test_a_cluster_weighs_by_how_often_the_planner_fails_there_drawn_towards_how_often_it_does_at_all() -> None:
    """Of 16 drives 4 fail, with two halves beside them 5 in 18; a left turn has 3 of 4, the others 1 of 12."""
    found, overall = clip_weights(CLIPS, SampleWeights(cluster=1.0)), 5.0 / 18.0
    assert found["a"] == pytest.approx((3.0 + 2.0 * overall) / 6.0)
    assert [found[name] for name in "bcd"] == pytest.approx([(1.0 + 2.0 * overall) / 14.0] * 3)


def test_a_clip_weighs_by_what_its_own_score_lacks_and_never_nothing() -> None:
    found = clip_weights(CLIPS, SampleWeights(score=1.0))
    assert [found[name] for name in "abcd"] == pytest.approx([0.8, 0.05, 0.3, 0.1])


def test_factors_multiply_and_a_tag_that_weighs_nothing_is_never_drawn() -> None:
    both = clip_weights(CLIPS, SampleWeights(tags={"command_left": 3.0, "unheard_of": 9.0}, score=1.0))
    assert [both[name] for name in "abcd"] == pytest.approx([2.4, 0.05, 0.3, 0.1])
    without = clip_weights(CLIPS, SampleWeights(tags={"command_straight": 0.0}))
    assert drawn(["a", "b", "c", "d"], without, 4, seed=0) == ["a"]
    with pytest.raises(ValueError, match="every clip weighs 0"):
        clip_weights(CLIPS[1:], SampleWeights(tags={"command_straight": 0.0}))


@pytest.mark.parametrize("wrong", [{"rarity": -1.0}, {"score": float("nan")}, {"tags": {"slow": -0.5}}])
def test_weights_that_are_none_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="finite and not negative"):
        SampleWeights(**wrong)  # type: ignore[arg-type]


@given(st.lists(st.text("abcdef", min_size=1, max_size=4), unique=True), st.integers(0, 9), st.data())
def test_a_larger_draw_holds_the_smaller_one_whatever_the_order_of_the_clips(
    names: list[str], seed: int, data: st.DataObject
) -> None:
    weights = {name: 1.0 + len(name) for name in names[::2]}
    everyone = drawn(names, weights, len(names), seed)
    assert sorted(everyone) == sorted(names)
    n = data.draw(st.integers(0, len(names)))
    assert drawn(data.draw(st.permutations(names)), weights, n, seed) == everyone[:n]


def test_the_first_drawn_is_each_clip_as_often_as_it_weighs() -> None:
    """3,000 seeds; four standard deviations of a share of 0.625 are 0.035."""
    weights = {"a": 1.0, "b": 2.0, "c": 5.0}
    firsts = [drawn(["a", "b", "c"], weights, 1, seed)[0] for seed in range(3000)]
    for name, weight in weights.items():
        assert firsts.count(name) / 3000 == pytest.approx(weight / 8.0, abs=0.035)


def test_a_clip_of_which_nothing_is_known_weighs_as_the_others_do_on_average() -> None:
    firsts = [drawn(["a", "b", "new"], {"a": 1.0, "b": 3.0}, 1, seed)[0] for seed in range(3000)]
    assert firsts.count("new") / 3000 == pytest.approx(2.0 / 6.0, abs=0.035)


def test_places_are_drawn_as_often_as_they_weigh_and_each_once() -> None:
    weights = np.array([1.0, 2.0, 5.0])
    orders = [by_lot(weights, np.random.default_rng(seed)) for seed in range(3000)]
    assert all(sorted(order.tolist()) == [0, 1, 2] for order in orders)
    share = np.bincount([order[0] for order in orders], minlength=3) / 3000
    np.testing.assert_allclose(share, weights / 8.0, atol=0.035)


def test_a_cell_weighs_by_how_often_the_planner_fails_from_there() -> None:
    """Of four ends two fail: with two halves beside them a half; in the cell ahead both of two."""
    found = cell_weights([((1, 0), True), ((1, 0), True), ((0, 0), False), ((0, 1), False)])
    expected = [(2.0 + 1.0) / 4.0, 1.0 / 3.0, 1.0 / 3.0, 0.5]
    assert found.of(np.array([[1, 0], [0, 0], [0, 1], [7, 7]])).tolist() == pytest.approx(expected)


def test_candidates_in_wanted_cells_come_first_and_none_is_lost_or_new() -> None:
    def listed(wanted: CellWeights | None) -> list[tuple[int, tuple[int, int]]]:
        clip, vocabulary = street_clip(), Vocabulary(kinematic_trajectories(500, seed=0))
        rng = stream(0, clip.clip_id, "perturb")
        made = perturb(clip, vocabulary, PerturbSettings(), TrafficSettings(), PdmSettings(), rng, (), wanted)
        assert isinstance(made, Perturbation)
        return [(candidate.vocabulary_index, candidate.cell) for candidate in made.candidates]

    plain = listed(None)
    last = plain[-1][1]
    first, *others = listed(CellWeights({last: 1e12}, 1.0))
    assert first == plain[-1]
    assert sorted([first, *others]) == sorted(plain)
    assert listed(CellWeights({last: 1e12}, 1.0)) == [first, *others]
