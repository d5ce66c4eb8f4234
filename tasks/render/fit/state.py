"""All that the fit has learned so far: plain arrays, to be stored and handed back."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields

import numpy as np
from numpy.typing import NDArray

from tasks.render.fit.adam import Learned
from tasks.render.fit.road import Road, lay_flat
from tasks.render.splatting.gaussians import Gaussians
from tasks.world.arrays import F32, Bools, FloatArray, Ints, ShortInts

BACKGROUND = -1
SHAPES = ("means", "quats", "log_scales", "logits", "colours", "sh_rest")  # learned, one row per Gaussian
WORLD = ("sky", "exposure", "poses", "boxes")
PER_GAUSSIAN = ("owner", "road", "nearest", "wanted")  # fields of FitState
COUNTS = ("iteration", "noted")


@dataclass
class FitState:
    """N Gaussians, each in the frame of its owner; stepped in place.

    Of the world are learned: sky (cells, 3), exposure (photos, 12), poses (photos, 6), and boxes (tracks * knots, 4).
    """

    iteration: int
    learned: dict[str, Learned]  # SHAPES: (N, C); WORLD: see below
    owner: ShortInts  # (N,) ascending: BACKGROUND or row of a track
    road: Bools  # (N,) lies on the road
    nearest: F32  # (N,) [m] depth in the nearest photo so far; inf: not seen yet
    wanted: F32  # (N,) how much more of it was asked for since the density was last looked at
    averages: dict[str, F32] = field(default_factory=dict)  # of what is learned, by name; empty until it is noted
    noted: int = 0  # how often it was

    def __len__(self) -> int:
        return len(self.owner)

    def gaussians(self) -> Gaussians:
        """All of them, in the frames of their owners."""
        means, quats, log_scales, logits, colours, rest = (self.learned[name].values for name in SHAPES)
        rest = rest.reshape(len(self), -1, 3)
        return Gaussians(means, quats, log_scales, opacities_of(logits[:, 0]), colours, rest)

    def seen(self, rows: Ints, depths: F32, screen: F32) -> F32:
        """Notes what a photo says of `rows` (M,): their depths (M,) in it, their derivatives (M, 2) by the place on it.

        Returns the nearest depths (M,) so far.
        """
        self.nearest[rows] = np.minimum(self.nearest[rows], depths)
        self.wanted[rows] += np.hypot(screen[:, 0], screen[:, 1])
        return self.nearest[rows]

    def lay_flat(self, rows: Ints, road: Road) -> None:
        """Those of `rows` (M,) that lie on the road stay on it."""
        means, quats, log_scales = (self.learned[name].values for name in ("means", "quats", "log_scales"))
        lay_flat(means, quats, log_scales, rows[self.road[rows]], road)

    def keep_round(self, rows: Ints, background: float, boxes: float) -> None:
        """Of those of `rows` (M,) that lie on no road, no side stays shorter than the longest by more than a factor.

        `background` and `boxes`: that factor of those of either, 0: none.
        """
        log_scales, owned = self.learned["log_scales"].values, self.owner[rows] != BACKGROUND
        for most, mine in ((background, rows[~owned & ~self.road[rows]]), (boxes, rows[owned])):
            if most > 0.0 and len(mine):
                log_scales[mine] = rounded(log_scales[mine], most)

    def note(self) -> None:
        """Takes what is learned now into its average. Rows must not be moved from the first time on."""
        self.noted += 1
        for name, learned in self.learned.items():
            average = self.averages.setdefault(name, np.zeros_like(learned.values))
            values = learned.values
            if name == "quats":  # which, negated, turn the same way
                values = np.where((average * values).sum(axis=1, keepdims=True) < 0.0, -values, values)
            average += (values - average) / np.float32(self.noted)

    def settle(self, road: Road | None) -> None:
        """Puts everything where it was on average, on the road as well."""
        for name, average in self.averages.items():
            self.learned[name].values[:] = average
        if road is not None:
            self.lay_flat(np.arange(len(self)), road)

    def arrays(self) -> dict[str, NDArray[np.generic]]:
        """By name, for whoever stores them."""
        out: dict[str, NDArray[np.generic]] = {
            f"{name}.{each.name}": getattr(learned, each.name)
            for name, learned in self.learned.items()
            for each in fields(Learned)
        }
        out |= {f"{name}.average": average for name, average in self.averages.items()}
        out |= {name: np.array(getattr(self, name)) for name in COUNTS}
        return out | {name: getattr(self, name) for name in PER_GAUSSIAN}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[np.generic]]) -> "FitState":
        """The state that `arrays` gave, as a copy of its own. Raises KeyError where one is missing."""
        learned = {
            name: Learned(*(np.array(arrays[f"{name}.{each.name}"]) for each in fields(Learned)))
            for name in SHAPES + WORLD
        }
        owner, road, nearest, wanted = (np.array(arrays[name]) for name in PER_GAUSSIAN)
        iteration, noted = (int(arrays[name]) for name in COUNTS)
        averages = {name: np.array(arrays[f"{name}.average"], np.float32) for name in (learned if noted else ())}
        return cls(iteration, learned, owner, road, nearest, wanted, averages, noted)

    def rows(self, rows: Ints) -> None:
        """Keeps these Gaussians, in this order; one may be named again and again."""
        for name in SHAPES:
            self.learned[name] = self.learned[name].take(rows)
        for name in PER_GAUSSIAN:
            setattr(self, name, getattr(self, name)[rows])


def rounded(log_scales: F32, most: float) -> F32:
    """Logarithms (M, 3) of sizes, the shorter ones raised to the longest over `most`."""
    return np.maximum(log_scales, log_scales.max(axis=1, keepdims=True) - np.float32(np.log(most)))


def opacities_of(logits: F32) -> F32:
    """Opacities (N,) in (0, 1)."""
    return (1.0 / (1.0 + np.exp(-logits))).astype(np.float32)


def logits_of(opacities: FloatArray) -> F32:
    """The inverse of `opacities_of`."""
    return np.log(opacities / (1.0 - opacities)).astype(np.float32)
