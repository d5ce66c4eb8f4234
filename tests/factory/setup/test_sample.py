"""`sample=`: which clips a run draws, in which order it tries candidates, and what it needs to know for that."""

from dataclasses import replace
from pathlib import Path

import pytest

from factory.config.run import RunConfig, load_config
from factory.config.words import ConfigError
from factory.readers.base import ClipRef
from factory.setup.sample import choose_sample, chosen_clips
from factory.setup.settings import identity_of
from tasks.sampling import CellWeights
from tasks.world.kinematic_vocabulary import kinematic_trajectories
from tasks.world.vocabulary import Vocabulary
from tests.factory.store.test_explored import row, written

REFS = [ClipRef("town", f"log{i // 4}", 1000 * (i % 4)) for i in range(40)]
WEAK = REFS[17].clip_id


def config(*words: str) -> RunConfig:
    return load_config(["executor=local", *words])


@pytest.fixture(scope="module")
def scores(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A planner that fails in one clip of forty, the only one with a pedestrian."""
    folder = tmp_path_factory.mktemp("scores")
    good = [row(ref.clip_id, score=1.0, fails="", drifts=()) for ref in REFS if ref.clip_id != WEAK]
    written(folder, *good, row(WEAK, score=0.0, fails="dac", tags=("near_pedestrian",)))
    return folder


def test_without_a_draw_a_limit_takes_the_first_clips_as_ever() -> None:
    plain = config("limit=3")
    assert chosen_clips(plain, REFS, choose_sample(plain)) == REFS[:3]
    everything = config("sample.drawn=true")
    assert chosen_clips(everything, REFS, choose_sample(everything)) == REFS


def test_a_draw_keeps_the_order_of_the_index_and_goes_by_the_seed() -> None:
    def taken(*words: str) -> list[ClipRef]:
        made = config("sample.drawn=true", *words)
        return chosen_clips(made, REFS, choose_sample(made))

    some = taken("limit=10")
    assert len(some) == 10 and some == sorted(some, key=REFS.index) and some != REFS[:10]
    assert set(some) < set(taken("limit=20"))
    assert taken("limit=10") == some != taken("limit=10", "seed=1")


def test_a_targeted_draw_goes_where_the_planner_is_weak(scores: Path) -> None:
    """Alone of forty it weighs (40 / 1) ** 0.5 for being rare, 20 times as much for its score, and more for failing."""
    made = config("sample=targeted", f"sample.scores={scores}", "limit=1")
    found = choose_sample(made)
    assert found.clips[WEAK] > 20.0 * 40.0**0.5 * found.clips[REFS[0].clip_id]
    first = [chosen_clips(replace(made, seed=seed), REFS, found)[0].clip_id for seed in range(20)]
    assert first.count(WEAK) >= 12


def test_candidates_are_weighed_by_cell_and_rows_say_by_whose_drives(scores: Path) -> None:
    made, plain = config("sample=targeted", f"sample.scores={scores}"), config()
    found, vocabulary = choose_sample(made), Vocabulary(kinematic_trajectories(20, seed=0))
    assert found.cells == CellWeights({(0, 0): (1.0 + 2.0 * 0.5) / 4.0}, 0.5)
    ours, before = identity_of(made, vocabulary, None, None, found.digest), identity_of(plain, vocabulary, None)
    assert dict(ours.settings) == dict(before.settings) | {"sample.candidates": found.digest}
    assert found.digest.startswith("someone 0a1b ")
    assert ours.prepare_digest != before.prepare_digest and ours.vocabulary_digest != before.vocabulary_digest
    drawn = config("sample=targeted", f"sample.scores={scores}", "sample.candidates=listed")
    assert choose_sample(drawn).digest == "" and choose_sample(drawn).cells is None


def test_scores_are_explore_s_where_none_are_named(scores: Path) -> None:
    assert choose_sample(config("sample=targeted", f"explore={scores}")).clips[WEAK] > 0.0


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["sample=targeted"], "give sample.scores="),
        (["sample=targetted"], "did you mean sample=targeted"),
        (["sample.rarity=1"], "drawn=true"),
        (["sample.drawn=true", "sample.tags={slow: -1}"], "not negative"),
        (["sample.rareness=1"], "sample.rareness"),
        (["sample=targeted", "sample.scores=x", "perturb=dense"], "two orders"),
        (["sample=targeted", "sample.scores=nowhere"], "no drifts in"),
    ],
)
def test_what_cannot_be_drawn_is_refused(words: list[str], said: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=said):
        choose_sample(config(*words))
