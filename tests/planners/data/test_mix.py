"""The order of samples: what a pass, an epoch and a batch hold, and what they depend on."""

from collections import Counter
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from factory.config.compose import ConfigError, compose, fill
from planners.data.mix import MixSettings, Order, OrderInputs, make_order, stream

N_REAL, N_SIM = 37, 90
GROUP_ROWS, ROW_BYTES = 6, 2**18  # four rows are a megabyte


def samples(n_real: int = N_REAL, n_sim: int = N_SIM) -> OrderInputs:
    """Real and simulated samples take turns by place; row groups hold one kind each."""
    n = n_real + n_sim
    simulated = stream(0, "sides").permutation(np.arange(n) >= n_real)
    group = np.empty(n, np.int64)
    for kind in (False, True):
        inside = np.flatnonzero(simulated == kind)
        group[inside] = np.arange(len(inside)) // GROUP_ROWS + 1000 * kind
    return OrderInputs(simulated, group, np.full(n, ROW_BYTES))


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


def test_with_one_window_the_files_do_not_matter() -> None:
    mine = samples()
    other = OrderInputs(mine.simulated, stream(0, "groups").permutation(mine.group), mine.size)
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


def test_wishes_that_make_no_sense_are_named() -> None:
    with pytest.raises(ValueError, match="sim_ratio=1 leaves no real samples"):
        MixSettings(sim_ratio=1.0)
    with pytest.raises(ValueError, match=r"sim_ratio=1\.5"):
        MixSettings(sim_ratio=1.5)
    with pytest.raises(ValueError, match="there are no simulated ones"):
        order(MixSettings(sim_ratio=0.5), n_sim=0)
    with pytest.raises(ValueError, match="there are no real ones"):
        order(MixSettings(sim_ratio=0.5), n_real=0)
    with pytest.raises(ValueError, match=r"127 samples are less than one batch of 128 takes"):
        order(MixSettings(), batch_size=128)


@pytest.mark.parametrize("name", ["natural", "half", "rewards_only"])
def test_the_configuration_files_say_all_there_is(name: str) -> None:
    mix = fill(MixSettings, compose(f"mix/{name}", [])["mix"], "mix")
    assert mix.sim_ratio == (0.5 if name == "half" else "natural")
    assert mix.imitation == ("real" if name == "rewards_only" else "all")
    with pytest.raises(ConfigError, match="sim_ratio"):
        fill(MixSettings, {"sim_ratio": "half"}, "mix")
