"""The order of samples: what a pass, an epoch and a batch hold, and what they depend on."""

from collections import Counter
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from factory.config.compose import ConfigError, compose, fill
from planners.data.mix import Bins, MixSettings, Order, Samples, Weights, make_order, sample_weights, stream, systematic

N_REAL, N_SIM = 37, 90
GROUP_ROWS, ROW_BYTES = 6, 2**18  # four rows are a megabyte


def samples(n_real: int = N_REAL, n_sim: int = N_SIM, weight: Any = None, row_bytes: int = ROW_BYTES) -> Samples:
    """Real and simulated samples take turns by place; row groups hold one kind each."""
    n = n_real + n_sim
    simulated = stream(0, "sides").permutation(np.arange(n) >= n_real)
    group = np.empty(n, np.int64)
    for kind in (False, True):
        inside = np.flatnonzero(simulated == kind)
        group[inside] = np.arange(len(inside)) // GROUP_ROWS + 1000 * kind
    return Samples(simulated, group, np.full(n, row_bytes), np.ones(n) if weight is None else weight)


def order(mix: MixSettings, batch_size: int = 8, seed: int = 3, **kinds: Any) -> Order:
    return make_order(samples(**kinds), mix, batch_size, seed)


SMALL_WINDOWS = MixSettings(shuffle_mb=6)  # two row groups a window


@pytest.mark.parametrize("mix", [MixSettings(), SMALL_WINDOWS])
def test_an_epoch_sees_every_sample_at_most_once_and_leaves_out_less_than_a_batch(mix: MixSettings) -> None:
    for epoch in range(3):
        rows = order(mix).epoch(epoch).rows.ravel()
        assert len(rows) == (N_REAL + N_SIM) // 8 * 8 and len(set(rows.tolist())) == len(rows)


@pytest.mark.parametrize("mix", [MixSettings(), SMALL_WINDOWS, MixSettings(sim_ratio=0.3, shuffle_mb=6)])
def test_the_order_is_a_function_of_seed_and_epoch(mix: MixSettings) -> None:
    one = order(mix)
    later, earlier = one.epoch(2), one.epoch(1)
    again = order(mix).epoch(2)
    assert np.array_equal(later.rows, again.rows) and later.keys == again.keys
    for other in (earlier, order(mix, seed=4).epoch(2)):
        shared = [set(a) & set(b) for a, b in zip(later.rows.tolist(), other.rows.tolist())]
        assert np.mean([len(both) for both in shared]) < 4, "not the same batches, each in another order"


def test_row_groups_are_read_in_another_order_in_every_pass() -> None:
    kind, one = samples(), order(SMALL_WINDOWS)
    first = [set(kind.group[found.rows[found.window == 0]].tolist()) for found in map(one.epoch, range(4))]
    assert len({frozenset(groups) for groups in first}) > 1


def test_what_a_weight_leaves_to_chance_is_drawn_anew_in_every_pass() -> None:
    """Half of the samples weigh half: each is seen in about half of the passes, never always the same ones."""
    weight = np.where(np.arange(N_REAL + N_SIM) % 2, 1.5, 0.5)
    one = order(MixSettings(), batch_size=127, weight=weight)
    seen = [frozenset(one.epoch(epoch).rows.ravel().tolist()) for epoch in range(3)]
    assert len(set(seen)) == 3


def test_with_one_window_the_files_do_not_matter() -> None:
    mine = samples()
    other = Samples(mine.simulated, stream(0, "groups").permutation(mine.group), mine.size, mine.weight)
    for mix in (MixSettings(), MixSettings(sim_ratio=0.5)):
        a, b = (make_order(s, mix, 8, 3).epoch(0).rows for s in (mine, other))
        assert np.array_equal(a, b)


def test_a_pass_is_a_uniform_shuffle() -> None:
    """Each of the 24 orders of 4 samples comes in 1 of 24 of 2,400 passes; chi-square, 23 degrees, 1e-4.

    In batches of one, so that the order within a batch, which is drawn apart, cannot make up for a pass that is not.
    """
    small = order(MixSettings(), batch_size=1, n_real=2, n_sim=2)
    counts = Counter(tuple(small.epoch(epoch).rows[:, 0].tolist()) for epoch in range(2400))
    assert len(counts) == 24 and sum((count - 100.0) ** 2 / 100.0 for count in counts.values()) < 55.6


def test_windows_hold_whole_row_groups_and_no_more_than_their_bytes() -> None:
    one = order(SMALL_WINDOWS)
    kind = samples()
    found = one.epoch(0)
    flat, window = found.rows.ravel(), found.window.ravel()
    for number in np.unique(window):
        groups = np.unique(kind.group[flat[window == number]])
        assert np.isin(kind.group, groups).sum() * ROW_BYTES <= 3 * 2**20
    groups_of = [set(kind.group[flat[window == number]].tolist()) for number in np.unique(window)]
    assert sum(map(len, groups_of)) == len(set.union(*groups_of)), "a row group is read once"
    seen = [int(w) for w in dict.fromkeys(np.sort(found.window, axis=1).ravel().tolist())]
    assert seen == sorted(seen) and len(seen) > 5, "one window after the other"


@pytest.mark.parametrize("ratio", [0.1, 0.29, 0.3, 1 / 3, 0.5, 0.7, 0.95])
@pytest.mark.parametrize("shuffle_mb", [6, 2048])
def test_a_ratio_holds_in_every_batch_and_its_error_is_carried(ratio: float, shuffle_mb: int) -> None:
    one = order(MixSettings(sim_ratio=ratio, shuffle_mb=shuffle_mb))
    kind = samples()
    for epoch in range(2):
        sim = kind.simulated[one.epoch(epoch).rows].sum(axis=1)
        meant = [Fraction(repr(ratio)) * 8 * (i + 1) for i in range(len(sim))]
        assert np.cumsum(sim).tolist() == [int(m) for m in meant]
        assert abs(sim - 8 * ratio).max() < 1.0


@pytest.mark.parametrize("ratio", [0.0, 0.3, 0.8])
def test_an_epoch_with_a_ratio_is_a_pass_over_the_real_samples(ratio: float) -> None:
    one = order(MixSettings(sim_ratio=ratio))
    rows = one.epoch(1).rows.ravel()
    real = rows[~samples().simulated[rows]].tolist()
    assert len(set(real)) == len(real) and N_REAL - len(real) < 8
    assert one.n_batches == len(rows) // 8


def test_the_simulated_stream_goes_on_from_epoch_to_epoch_and_repeats_evenly() -> None:
    kind = samples(n_sim=50)
    one = make_order(kind, MixSettings(sim_ratio=0.75), 8, 3)
    rows = np.concatenate([one.epoch(epoch).rows.ravel() for epoch in range(4)])
    visits = np.bincount(rows[kind.simulated[rows]], minlength=len(kind.simulated))[kind.simulated]
    assert visits.sum() == 4 * one.sim_per_epoch > 6 * 50
    assert visits.max() - visits.min() <= 1, "after any number of epochs no sample is a pass ahead"


def test_slices_of_ranks_are_equally_mixed() -> None:
    """Of 4 ranks' contiguous and strided slices over 12 epochs of ratio 0.5, none is off by 5 standard deviations."""
    kind = samples(n_real=400, n_sim=400)
    one = make_order(kind, MixSettings(sim_ratio=0.5), 16, 3)
    sim = kind.simulated[np.concatenate([one.epoch(epoch).rows for epoch in range(12)])]
    n = sim.size / 4
    for rank in range(4):
        for part in (sim[:, rank * 4 : rank * 4 + 4], sim[:, rank::4]):
            assert abs(part.sum() - n / 2) < 5 * np.sqrt(n) / 2


def test_weights_make_visits_that_are_right_on_average_and_whole_numbers_around_it() -> None:
    weight = np.where(np.arange(60) % 3 == 0, 2.5, 0.0) + 1.0
    weight *= 60 / weight.sum()
    total = np.zeros(60)
    for number in range(400):
        visits = systematic(weight, stream(0, number))
        assert visits.sum() == 60 and (visits >= np.floor(weight)).all() and (visits <= np.ceil(weight)).all()
        total += visits
    assert abs(total / 400 - weight).max() < 5 * 0.5 / np.sqrt(400)


@pytest.mark.parametrize("shuffle_mb", [6, 2048])
def test_weights_are_among_the_samples_of_a_side(shuffle_mb: int) -> None:
    kind = samples()
    weight = np.where(kind.simulated, 10.0 * (np.arange(len(kind.simulated)) % 2), 1.0)
    n_odd = int(kind.simulated[1::2].sum())
    one = make_order(Samples(kind.simulated, kind.group, kind.size, weight), MixSettings(shuffle_mb=shuffle_mb), 127, 3)
    rows = one.epoch(0).rows.ravel()
    visits = np.bincount(rows, minlength=127)
    assert (visits[~kind.simulated] == 1).all(), "the other side is seen as before"
    assert visits[kind.simulated].sum() == N_SIM and (visits[kind.simulated & (weight == 0.0)] == 0).all()
    odd = visits[kind.simulated & (weight > 0.0)]
    assert odd.min() >= N_SIM // n_odd and odd.max() <= -(-N_SIM // n_odd)


def test_weights_by_round_expert_perturbation_and_reward_are_multiplied() -> None:
    weights = Weights(
        round={1: 3.0},
        expert={"recovery": 0.5},
        longitudinal_m=Bins((5.0,), (1.0, 2.0)),
        lateral_m=Bins((0.5, 1.0), (1.0, 5.0, 7.0)),
        reward=Bins((0.9,), (1.0, 11.0)),
    )
    nan = float("nan")
    rows = [  # simulated, round, expert, longitudinal, lateral, reward, weight
        (False, 1, "human", nan, nan, 0.95, 11.0),
        (True, 0, "recovery", 4.0, -0.2, 0.5, 0.5),
        (True, 1, "recovery", -6.0, 0.5, 0.5, 3 * 0.5 * 2 * 5),
        (True, 0, "pdm_closed", 5.0, -1.5, 0.9, 2 * 7 * 11),
    ]
    simulated, round_, expert, longitudinal, lateral, reward, expected = zip(*rows)
    found = sample_weights(
        weights,
        np.array(simulated),
        np.array(round_, np.int32),
        expert,
        np.array([longitudinal, lateral]).T,
        np.array(reward),
    )
    assert found.tolist() == list(expected)


def weigh(weights: Weights, reward: float = 0.5) -> None:
    ends = np.array([[1.0, 1.0]])
    sample_weights(weights, np.array([True]), np.zeros(1, np.int32), ["recovery"], ends, np.array([reward]))


def test_wishes_that_make_no_sense_are_named() -> None:
    with pytest.raises(ValueError, match="sim_ratio=1 leaves no real samples"):
        MixSettings(sim_ratio=1.0)
    with pytest.raises(ValueError, match=r"sim_ratio=1\.5"):
        MixSettings(sim_ratio=1.5)
    with pytest.raises(ValueError, match="share of real ones is mix"):
        Weights(expert={"human": 2.0})
    with pytest.raises(ValueError, match="not negative"):
        Weights(round={0: -1.0})
    with pytest.raises(ValueError, match="edges"):
        Bins((1.0, 0.5), (1.0, 2.0, 3.0))
    with pytest.raises(ValueError, match=r"no simulated samples of recovry; there are those of \['recovery'\]"):
        weigh(Weights(expert={"recovry": 2.0}))
    with pytest.raises(ValueError, match="reward: 1 samples have no such number"):
        weigh(Weights(reward=Bins((0.5,), (1.0, 2.0))), float("nan"))
    with pytest.raises(ValueError, match="there are no simulated ones"):
        order(MixSettings(sim_ratio=0.5), n_sim=0)
    with pytest.raises(ValueError, match="there are no real ones"):
        order(MixSettings(sim_ratio=0.5), n_real=0)
    with pytest.raises(ValueError, match=r"127 samples are less than one batch of 128 takes"):
        order(MixSettings(), batch_size=128)
    with pytest.raises(ValueError, match="every simulated sample weighs 0"):
        order(MixSettings(), weight=np.where(samples().simulated, 0.0, 1.0))


@pytest.mark.parametrize("name", ["natural", "half", "rewards_only"])
def test_the_configuration_files_say_all_there_is(name: str) -> None:
    mix = fill(MixSettings, compose(f"mix/{name}", ["+mix.weights.round.1=2"])["mix"], "mix")
    assert mix.sim_ratio == (0.5 if name == "half" else "natural")
    assert mix.imitation == ("real" if name == "rewards_only" else "all")
    assert mix.weights == Weights(round={1: 2.0})
    with pytest.raises(ConfigError, match="sim_ratio"):
        fill(MixSettings, {"sim_ratio": "half"}, "mix")
