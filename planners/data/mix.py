"""In which order samples are seen: a function of the data, the mix, the seed and the epoch, of nothing else.

The samples of a side form an endless stream of passes. A pass permutes the row groups, cuts them into windows of a
bounded size, and permutes the samples of every window; where everything fits into one window that is a uniform
shuffle, and where the files' layout does not matter. Global batches are cut from the streams; ranks take equal slices
of them.

`sim_ratio=natural`: real and simulated samples are one side, an epoch is a pass. `sim_ratio=f`: an epoch is a pass over
the real side; the simulated stream goes on from epoch to epoch.
"""

import hashlib
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Literal

import numpy as np

from planners.data.jitter import JitterSettings
from tasks.world.arrays import Bools, Ints

WindowKey = tuple[int, int, int]  # side, pass, window


@dataclass(frozen=True)
class MixSettings:
    """conf/mix."""

    sim_ratio: Literal["natural"] | float = "natural"  # or sim / (sim + real) in every global batch, below 1
    imitation: Literal["all", "real", "none"] = "all"  # the samples whose plan is a label
    shuffle_mb: int = 2048  # memory of a process for the samples that are shuffled
    jitter: JitterSettings = field(default_factory=JitterSettings)

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
class OrderInputs:
    """What the order depends on, of n samples in the order of their ids."""

    simulated: Bools  # (n,)
    group: Ints  # (n,) row group it stands in
    size: Ints  # (n,) bytes in memory


@dataclass(frozen=True, eq=False)
class Side:
    """The samples of one stream."""

    number: int
    rows: Ints  # (m,) places in Samples, rising
    group: Ints  # (m,)
    size: Ints  # (m,)
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


def make_order(samples: OrderInputs, mix: MixSettings, batch_size: int, seed: int) -> Order:
    """Raises ValueError where there are fewer samples than one batch takes, or a side that the ratio needs is empty."""
    check_sides(mix, samples.simulated)
    half = mix.shuffle_mb * 2**20 / 2  # a window is read while the one before it is used
    ratio = mix.ratio
    everything = np.ones(len(samples.simulated), bool)
    parts = (everything,) if ratio is None else (~samples.simulated, samples.simulated)
    shares = (1.0,) if ratio is None else (1.0 - float(ratio), float(ratio))
    sides = []
    for number, (part, share) in enumerate(zip(parts, shares)):
        rows = np.flatnonzero(part)
        sides.append(Side(number, rows, samples.group[rows], samples.size[rows], half * share))
    order = Order(tuple(sides), ratio, batch_size, seed)
    if order.n_batches < 1:
        raise ValueError(
            f"{len(sides[0])} {'samples' if ratio is None else 'real samples'} are less than one batch of {batch_size} "
            f"takes: lower planner.training.batch_size"
        )
    return order


def pass_order(side: Side, seed: int, number: int) -> tuple[Ints, Ints]:
    """Pass `number` over a side: its samples (m,) in order and the window (m,) of each, rising from 0."""
    window = np.zeros(len(side), np.int64)
    if not side.fits:
        window = _windows(side, stream(seed, side.number, "groups", number))
    rows: list[Ints] = []
    windows: list[Ints] = []
    for kept in range(int(window.max()) + 1):
        seen = side.rows[window == kept]
        rows.append(stream(seed, side.number, "samples", number, kept).permutation(seen))
        windows.append(np.full(len(seen), kept, np.int64))
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


def stream(seed: int, *words: object) -> np.random.Generator:
    """The Philox stream of these words; equal arguments give equal numbers anywhere."""
    digest = hashlib.sha256("\x1f".join(map(str, ("mix", seed, *words))).encode()).digest()
    return np.random.Generator(np.random.Philox(key=np.frombuffer(digest[:16], dtype=np.uint64)))
