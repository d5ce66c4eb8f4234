"""In which order samples are seen: a function of the data, the mix, the seed and the epoch, of nothing else.

The samples of a side form an endless stream of passes. A pass permutes the row groups, cuts them into windows of a
bounded size, and permutes the samples of every window; where everything fits into one window that is a uniform
shuffle, and where the files' layout does not matter. With weights a pass has as many samples as without, and visits
each floor(w) or ceil(w) times. Global batches are cut from the streams; ranks take equal slices of them.

`sim_ratio=natural`: real and simulated samples are one side, an epoch is a pass. `sim_ratio=f`: an epoch is a pass over
the real side; the simulated stream goes on from epoch to epoch.
"""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from tasks.world.arrays import Array, Bools, Ints, ShortInts

WindowKey = tuple[int, int, int]  # side, pass, window


@dataclass(frozen=True)
class Bins:
    """Weights by a number: weights[i] is for what is below edges[i] and not below an earlier edge."""

    edges: tuple[float, ...]
    weights: tuple[float, ...]  # one more than edges

    def __post_init__(self) -> None:
        if len(self.weights) != len(self.edges) + 1 or list(self.edges) != sorted(set(self.edges)):
            raise ValueError(f"edges {self.edges} must rise and have one less than weights {self.weights}")

    def of(self, values: Array) -> Array:
        """(n,) weight of each value."""
        return np.asarray(self.weights, np.float64)[np.searchsorted(self.edges, values, side="right")]


@dataclass(frozen=True)
class Weights:
    """How often samples are seen against others of their side; what is not named weighs 1, and all are multiplied."""

    round: dict[int, float] = field(default_factory=dict)  # of simulated samples
    expert: dict[str, float] = field(default_factory=dict)  # of simulated samples
    longitudinal_m: Bins | None = None  # of simulated samples: |distance| of the perturbed end from the log's
    lateral_m: Bins | None = None
    reward: Bins | None = None  # stage2_score, of real samples too

    def __post_init__(self) -> None:
        bins = [b.weights for b in (self.longitudinal_m, self.lateral_m, self.reward) if b is not None]
        every = [*self.round.values(), *self.expert.values(), *(w for weights in bins for w in weights)]
        if not all(np.isfinite(w) and w >= 0.0 for w in every):
            raise ValueError(f"weights must be finite and not negative, got {every}")
        if "human" in self.expert:
            raise ValueError("expert: weights are among simulated samples; the share of real ones is mix.sim_ratio's")


@dataclass(frozen=True)
class MixSettings:
    """conf/mix."""

    sim_ratio: Literal["natural"] | float = "natural"  # or sim / (sim + real) in every global batch, below 1
    imitation: Literal["all", "real", "none"] = "all"  # the samples whose plan is a label
    shuffle_mb: int = 2048  # memory of a process for the samples that are shuffled
    weights: Weights = field(default_factory=Weights)

    def __post_init__(self) -> None:
        if self.shuffle_mb < 1:
            raise ValueError(f"shuffle_mb={self.shuffle_mb}: must be at least 1")
        if self.sim_ratio == 1:
            raise ValueError(
                "sim_ratio=1 leaves no real samples to measure an epoch by: give data.real=[] and sim_ratio=natural, "
                "and an epoch is a pass over the simulated samples"
            )
        if self.sim_ratio != "natural" and not 0.0 <= self.sim_ratio < 1.0:
            raise ValueError(f"sim_ratio={self.sim_ratio}: must be natural, or from 0 to less than 1")

    @property
    def ratio(self) -> Fraction | None:
        """The number that is written, exactly; None for natural."""
        return None if self.sim_ratio == "natural" else Fraction(repr(float(self.sim_ratio)))


@dataclass(frozen=True, eq=False)
class Samples:
    """What the order depends on, of n samples in the order of their ids."""

    simulated: Bools  # (n,)
    group: Ints  # (n,) row group it stands in
    size: Ints  # (n,) bytes in memory
    weight: Array  # (n,) not yet normalised


@dataclass(frozen=True, eq=False)
class Side:
    """The samples of one stream."""

    number: int
    rows: Ints  # (m,) places in Samples, rising
    group: Ints  # (m,)
    size: Ints  # (m,)
    weight: Array  # (m,) of mean 1 among the real and among the simulated
    window_bytes: float

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def fits(self) -> bool:
        """Whether a pass is one window."""
        return bool(self.size.sum() <= self.window_bytes)


@dataclass(frozen=True, eq=False)
class EpochOrder:
    """The global batches of one epoch."""

    rows: Ints  # (batches, B) places in Samples
    window: Ints  # (batches, B) place in `keys` of the window that a sample is read with
    keys: tuple[WindowKey, ...]


@dataclass(frozen=True, eq=False)
class Order:
    """The order of one training."""

    sides: tuple[Side, ...]  # one, or real and simulated
    ratio: Fraction | None
    batch_size: int
    seed: int

    @property
    def n_batches(self) -> int:
        """Global batches of an epoch; what is left of its pass is less than a batch, and dropped."""
        return batches_in(len(self.sides[0]), self.batch_size, self.ratio)

    @property
    def sim_per_epoch(self) -> int:
        """Simulated samples of an epoch that has a ratio."""
        return self._n_sim(self.n_batches)

    def epoch(self, epoch: int) -> EpochOrder:
        """The same for the same epoch, whatever was asked before."""
        n, size = self.n_batches, self.batch_size
        from_sim = np.zeros((n, size), bool)
        if self.ratio is not None:
            counts = np.diff([self._n_sim(i) for i in range(n + 1)])
            from_sim = np.arange(size) < counts[:, None]
        rows, window = np.empty((n, size), np.int64), np.empty((n, size), np.int64)
        keys: list[WindowKey] = []
        for side, mask in zip(self.sides, (~from_sim, from_sim)):
            count = int(mask.sum())
            first = epoch * count if side.number else epoch * len(side)
            rows[mask], inner, side_keys = self._piece(side, first, count)
            window[mask] = inner + len(keys)
            keys += side_keys
        rng = stream(self.seed, "batches", epoch)
        places = rng.permuted(np.broadcast_to(np.arange(size), (n, size)), axis=1)
        return EpochOrder(np.take_along_axis(rows, places, 1), np.take_along_axis(window, places, 1), tuple(keys))

    def _n_sim(self, n_batches: int) -> int:
        """Simulated samples in the first batches of an epoch: the error is carried, and less than one sample."""
        assert self.ratio is not None
        return _simulated_in(n_batches, self.batch_size, self.ratio)

    def _piece(self, side: Side, first: int, count: int) -> tuple[Ints, Ints, list[WindowKey]]:
        """Samples first .. first + count of a side's endless stream, with their windows."""
        rows, windows = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
        keys: list[WindowKey] = []
        while count > 0:
            number, skip = divmod(first, len(side))
            one, window = pass_order(side, self.seed, number)
            taken = slice(skip, skip + count)
            rows.append(one[taken])
            windows.append(window[taken] + len(keys))
            keys += [(side.number, number, w) for w in range(int(window[-1]) + 1)]
            first, count = first + len(one[taken]), count - len(one[taken])
        return np.concatenate(rows), np.concatenate(windows), keys


def batches_in(n_first: int, batch_size: int, ratio: Fraction | None) -> int:
    """Global batches of a pass over `n_first` samples, of which a batch takes all but `ratio` of its places."""
    if ratio is None:
        return n_first // batch_size
    n = int(n_first / (batch_size * (1 - ratio))) + 1
    while n * batch_size - _simulated_in(n, batch_size, ratio) > n_first:
        n -= 1
    return n


def _simulated_in(n_batches: int, batch_size: int, ratio: Fraction) -> int:
    return int(n_batches * batch_size * ratio)  # truncates, which is floor here


def fitting_batch(simulated: Bools, mix: MixSettings, batch_size: int, parts: int = 1) -> int:
    """The largest batch of up to `batch_size`, in equal parts, that a pass over the samples has; 0 for none.

    simulated: (n,) of each sample.
    """
    n_first = len(simulated) if mix.ratio is None else int((~simulated).sum())
    sizes = range(batch_size, 0, -parts)
    return next((size for size in sizes if batches_in(n_first, size, mix.ratio)), 0)


def check_sides(mix: MixSettings, simulated: Bools) -> None:
    """Raises ValueError where there are none of the samples that a ratio takes."""
    if mix.sim_ratio == "natural":
        return
    for name, missing in (("real", simulated.all()), ("simulated", not simulated.any() and mix.sim_ratio != 0)):
        if missing:
            raise ValueError(
                f"mix.sim_ratio={mix.sim_ratio} needs real and simulated samples, and there are no {name} ones: "
                f"give data.{'sim' if name == 'simulated' else 'real'}=[...] with them, or mix.sim_ratio=natural"
            )


def make_order(samples: Samples, mix: MixSettings, batch_size: int, seed: int) -> Order:
    """Raises ValueError where there are fewer samples than one batch takes, or a side that the ratio needs is empty."""
    check_sides(mix, samples.simulated)
    weight = samples.weight.astype(np.float64)
    for part, name in ((~samples.simulated, "real"), (samples.simulated, "simulated")):
        if part.any():
            if not weight[part].sum() > 0.0:
                raise ValueError(f"mix.weights: every {name} sample weighs 0")
            weight[part] *= part.sum() / weight[part].sum()
    half = mix.shuffle_mb * 2**20 / 2  # a window is read while the one before it is used
    ratio = mix.ratio
    everything = np.ones(len(weight), bool)
    parts = (everything,) if ratio is None else (~samples.simulated, samples.simulated)
    shares = (1.0,) if ratio is None else (1.0 - float(ratio), float(ratio))
    sides = []
    for number, (part, share) in enumerate(zip(parts, shares)):
        rows = np.flatnonzero(part)
        sides.append(Side(number, rows, samples.group[rows], samples.size[rows], weight[rows], half * share))
    order = Order(tuple(sides), ratio, batch_size, seed)
    if order.n_batches < 1:
        raise ValueError(
            f"{len(sides[0])} {'samples' if ratio is None else 'real samples'} are less than one batch of {batch_size} "
            f"takes: lower planner.training.batch_size"
        )
    return order


def pass_order(side: Side, seed: int, number: int) -> tuple[Ints, Ints]:
    """Pass `number` over a side: its samples (m,) in order and the window (m,) of each, rising from 0."""
    visits = systematic(side.weight, stream(seed, side.number, "visits", number))
    window = np.zeros(len(side), np.int64)
    if not side.fits:
        window = _windows(side, stream(seed, side.number, "groups", number))
    rows: list[Ints] = []
    windows: list[Ints] = []
    for kept in range(int(window.max()) + 1):
        inside = np.flatnonzero(window == kept)
        seen = np.repeat(side.rows[inside], visits[inside])
        if len(seen):
            rows.append(stream(seed, side.number, "samples", number, kept).permutation(seen))
            windows.append(np.full(len(seen), len(windows), np.int64))
    return np.concatenate(rows), np.concatenate(windows)


def _windows(side: Side, rng: np.random.Generator) -> Ints:
    """(m,) window of each sample: permuted row groups, as many as fit, at least one."""
    groups, of = np.unique(side.group, return_inverse=True)
    sizes = np.bincount(of, weights=side.size)
    window_of, current, held = np.empty(len(groups), np.int64), 0, 0.0
    for group in rng.permutation(len(groups)):
        if held and held + sizes[group] > side.window_bytes:
            current, held = current + 1, 0.0
        window_of[group] = current
        held += sizes[group]
    return window_of[of]


def systematic(weight: Array, rng: np.random.Generator) -> Ints:
    """(m,) visits, floor(w) or ceil(w) and w on average, whose sum is m = sum(weight) always."""
    if (weight == 1.0).all():
        return np.ones(len(weight), np.int64)
    shuffled = rng.permutation(len(weight))  # so that neighbours are drawn independently of each other
    marks = np.cumsum(weight[shuffled])
    marks = np.floor(marks / marks[-1] * len(weight) + rng.random())  # divided: the last is m in spite of rounding
    visits = np.empty(len(weight), np.int64)
    visits[shuffled] = np.diff(marks, prepend=0.0).astype(np.int64)
    return visits


def stream(seed: int, *words: object) -> np.random.Generator:
    """The Philox stream of these words; equal arguments give equal numbers anywhere."""
    digest = hashlib.sha256("\x1f".join(map(str, ("mix", seed, *words))).encode()).digest()
    return np.random.Generator(np.random.Philox(key=np.frombuffer(digest[:16], dtype=np.uint64)))


def sample_weights(
    weights: Weights,
    simulated: Bools,
    round_: ShortInts,
    expert: Sequence[str] | NDArray[np.str_],
    perturbation_m: Array,
    reward: Array,
) -> Array:
    """(n,) products of the weights, of what index.Rows holds.

    Raises ValueError for an expert that made none of the samples, and where a weight needs what a sample has not.
    """
    total, experts = np.ones(len(simulated)), np.asarray(expert)
    unknown = sorted(set(weights.expert) - set(experts[simulated].tolist()))
    if unknown:
        have = sorted(set(experts[simulated].tolist()))
        raise ValueError(f"mix.weights.expert: no simulated samples of {', '.join(unknown)}; there are those of {have}")
    by_name: tuple[tuple[Mapping[int, float] | Mapping[str, float], NDArray[np.generic]], ...] = (
        (weights.round, np.asarray(round_)),
        (weights.expert, experts),
    )
    for given, values in by_name:
        for name, weight in given.items():
            total[simulated & (values == name)] *= weight
    everything = np.ones(len(total), bool)
    for what, bins, numbers, part in (
        ("longitudinal_m", weights.longitudinal_m, np.abs(perturbation_m[:, 0]), simulated),
        ("lateral_m", weights.lateral_m, np.abs(perturbation_m[:, 1]), simulated),
        ("reward", weights.reward, reward, everything),
    ):
        if bins is not None:
            if np.isnan(numbers[part]).any():
                raise ValueError(f"mix.weights.{what}: {np.isnan(numbers[part]).sum()} samples have no such number")
            total[part] *= bins.of(numbers[part])
    return total
