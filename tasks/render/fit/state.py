"""All that the fit has learned so far: plain arrays, to be stored and handed back."""

from collections.abc import Mapping
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from tasks.render.fit.adam import Learned
from tasks.render.splatting.gaussians import Gaussians
from tasks.world.arrays import F32, Bools, FloatArray, Ints, ShortInts

BACKGROUND = -1
SHAPES = ("means", "quats", "log_scales", "logits", "colours", "sh_rest")  # learned, one row per Gaussian
WORLD = ("sky", "exposure", "poses")


@dataclass
class FitState:
    """N Gaussians, each in the frame of its owner; stepped in place."""

    iteration: int
    learned: dict[str, Learned]  # SHAPES: (N, C); sky (cells, 3); exposure (photos, 12); poses (photos, 6)
    owner: ShortInts  # (N,) ascending: BACKGROUND or row of a track
    road: Bools  # (N,) lies on the road
    nearest: F32  # (N,) [m] depth in the nearest photo so far; inf: not seen yet
    wanted: F32  # (N,) how much more of it was asked for since the density was last looked at

    def __len__(self) -> int:
        return len(self.owner)

    def gaussians(self) -> Gaussians:
        """All of them, in the frames of their owners."""
        values = {name: self.learned[name].values for name in SHAPES}
        n = len(self)
        return Gaussians(
            values["means"],
            values["quats"],
            values["log_scales"],
            opacities_of(values["logits"][:, 0]),
            values["colours"],
            values["sh_rest"].reshape(n, -1, 3),
        )

    def arrays(self) -> dict[str, NDArray[np.generic]]:
        """By name, for whoever stores them."""
        out: dict[str, NDArray[np.generic]] = {
            f"{name}.{field.name}": getattr(learned, field.name)
            for name, learned in self.learned.items()
            for field in fields(Learned)
        }
        out["iteration"] = np.array(self.iteration)
        for name in ("owner", "road", "nearest", "wanted"):
            out[name] = getattr(self, name)
        return out

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[np.generic]]) -> "FitState":
        """The state that `arrays` gave, as a copy of its own. Raises KeyError where one is missing."""
        learned = {
            name: Learned(*(np.array(arrays[f"{name}.{field.name}"]) for field in fields(Learned)))
            for name in SHAPES + WORLD
        }
        rest = (np.array(arrays[name]) for name in ("owner", "road", "nearest", "wanted"))
        return cls(int(arrays["iteration"]), learned, *rest)

    def rows(self, rows: Ints) -> None:
        """Keeps these Gaussians, in this order; one may be named again and again."""
        for name in SHAPES:
            self.learned[name] = self.learned[name].take(rows)
        self.owner, self.road = self.owner[rows], self.road[rows]
        self.nearest, self.wanted = self.nearest[rows], self.wanted[rows]


def opacities_of(logits: F32) -> F32:
    """Opacities (N,) in (0, 1)."""
    return (1.0 / (1.0 + np.exp(-logits))).astype(np.float32)


def logits_of(opacities: FloatArray) -> F32:
    """The inverse of `opacities_of`."""
    return np.log(opacities / (1.0 - opacities)).astype(np.float32)
