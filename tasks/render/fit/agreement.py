"""Cameras that see the same points made to agree about colour, without one of them being the truth.

Both sides of a comparison are noisy: the same spot of the street falls on other pixels, a window mirrors, a depth is a
little off. Least squares from one side to the other takes that noise for contrast that the other lacks; two equal
cameras with noise of 0.10 would each lose a fifth of theirs. So moments are matched instead: a camera is given the mean
and the covariance that the others show on the points they share, by the optimal transport between two normal
distributions (Knott and Smith 1984). Equal cameras get the identity, and from there to here is the inverse of from here
to there.
"""

from dataclasses import dataclass
from typing import cast

import numpy as np
from scipy.sparse.csgraph import connected_components

from tasks.world.arrays import F32, Array, Bools

ROUNDS = 60  # of fitting each camera to all others; of a ring of eight 5 % of an error are left after 20
LEAST = 8  # shared points that say something
BRIGHTNESS_ROUNDS, DISAGREES = 10, 0.05  # of reweighting, and the difference of log colours from which less counts
FLOOR, PULL = 1e-4, 0.2  # added to variances in [0, 1]^2: FLOOR always, PULL / n for n points


@dataclass(frozen=True)
class Shared:
    """What C cameras show of points that another camera sees as well: moments of colours in [0, 1], by pair."""

    count: Array  # (C, C) points that cameras c and d both see; nothing on the diagonal
    first: Array  # (C, C, 3) sums of the colours that c shows of them
    second: Array  # (C, C, 3, 3) sums of their products

    def __add__(self, other: "Shared") -> "Shared":
        """Of the points of both."""
        return Shared(self.count + other.count, self.first + other.first, self.second + other.second)


def shared(colours: Array, seen: Bools) -> Shared:
    """The moments of M points' `colours` (C, M, 3) in [0, 1] in C cameras that have `seen` (C, M) them."""
    n, both = len(colours), seen.astype(np.float64)
    products = colours[..., :, None] * colours[..., None, :]
    masked = both[..., None] * np.concatenate([colours, products.reshape(*seen.shape, 9)], axis=-1)
    sums = np.einsum("cmk,dm->cdk", masked, both, optimize=True)
    count = both @ both.T
    others = 1.0 - np.eye(n)
    sums, count = sums * others[..., None], count * others
    return Shared(count, sums[..., :3], sums[..., 3:].reshape(n, n, 3, 3))


def aligned(of: Shared) -> F32:
    """Rows (C, 12) that make cameras agree on the points that several of them see.

    A row is a 3 x 3 matrix minus the identity, then 3 offsets (`tasks.render.fit.corrections`). What brings the common
    colours back to a camera's is, as a mean over the cameras that are tied together, the identity: the common colours
    are those of photos. Cameras that share fewer than LEAST points keep theirs.
    """
    n = len(of.count)
    matrices, offsets = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3))
    tied = np.flatnonzero(of.count.sum(axis=1) >= LEAST)
    for _ in range(ROUNDS):
        for c in tied.tolist():
            shown = _moments(of.count[c], of.first[c], of.second[c])
            now = _developed(of, matrices, offsets, c)
            matrices[c], offsets[c] = _transport(*shown, *_moments(*now), PULL / of.count[c].sum())
    _, group = connected_components(of.count > 0, directed=False)
    for number in np.unique(group[tied]):
        _to_photos(matrices, offsets, tied[group[tied] == number])
    return np.column_stack([(matrices - np.eye(3)).reshape(n, 9), offsets]).astype(np.float32)


def brightness(grey: F32, seen: Bools) -> Array:
    """Log of how much brighter each of N photos shows its points than the others do (N,); their mean is 0.

    `grey` (N, M) in (0, 1] of M points in the photos that have `seen` (N, M) them. Least squares over log grey =
    photo + point with Cauchy's weights; a photo that shares fewer than LEAST points with others gets 0.
    """
    logs = np.log(np.maximum(grey, 1e-2)).astype(np.float64)
    shares = (seen & (seen.sum(axis=0) > 1)).astype(np.float64)
    tied = shares.sum(axis=1) >= LEAST
    out = np.zeros(len(grey))
    for turn in range(BRIGHTNESS_ROUNDS if tied.any() else 0):
        if turn == 0:
            weight = shares
        else:
            weight = shares / (1.0 + ((logs - out[:, None] - _point_means(logs, out, weight)) / DISAGREES) ** 2)
        of = np.maximum(weight.sum(axis=0), 1e-12)
        system = np.diag(weight.sum(axis=1) + 1.0) - (weight / of) @ weight.T  # a point's own colour is eliminated
        right = (weight * logs).sum(axis=1) - weight @ ((weight * logs).sum(axis=0) / of)
        out = np.linalg.solve(system, right)
        out[~tied] = 0.0
        out[tied] -= out[tied].mean()
    return out


def _point_means(logs: Array, photos: Array, weight: Array) -> Array:
    return np.asarray((weight * (logs - photos[:, None])).sum(axis=0) / np.maximum(weight.sum(axis=0), 1e-12))


def _moments(count: Array, first: Array, second: Array) -> tuple[Array, Array]:
    """Mean (3,) and covariance (3, 3) over all pairs (D, ...)."""
    n = count.sum()
    mean = first.sum(axis=0) / n
    return mean, second.sum(axis=0) / n - np.outer(mean, mean)


def _developed(of: Shared, matrices: Array, offsets: Array, c: int) -> tuple[Array, Array, Array]:
    """Moments (D, ...) of what the other cameras, as they are aligned by now, show of the points shared with `c`."""
    count, first, second = of.count[:, c], of.first[:, c], of.second[:, c]
    turned = np.einsum("dij,dj->di", matrices, first)
    mixed = turned[:, :, None] * offsets[:, None, :]
    square = np.einsum("dij,djk,dlk->dil", matrices, second, matrices) + mixed + mixed.transpose(0, 2, 1)
    square += count[:, None, None] * offsets[:, :, None] * offsets[:, None, :]
    return count, turned + count[:, None] * offsets, square


def _transport(mean: Array, cov: Array, to_mean: Array, to_cov: Array, pull: float) -> tuple[Array, Array]:
    """The symmetric matrix and the offset that take one mean and covariance to another; `pull` towards the identity."""
    noise = (FLOOR + pull) * np.eye(3)
    root = _root(cov + noise)
    back = np.linalg.inv(root)
    matrix = back @ _root(root @ (to_cov + noise) @ root) @ back
    return matrix, to_mean - matrix @ mean


def _root(matrix: Array) -> Array:
    """The symmetric root of a positive matrix (3, 3)."""
    values, vectors = np.linalg.eigh(matrix)
    return cast(Array, (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)


def _to_photos(matrices: Array, offsets: Array, rows: Array) -> None:
    """Moves the common colours of cameras `rows`, in place: the exposures' inverses are the identity on average."""
    back = np.linalg.inv(matrices[rows])
    turn, shift = back.mean(axis=0), -np.einsum("cij,cj->ci", back, offsets[rows]).mean(axis=0)
    matrices[rows] = turn @ matrices[rows]
    offsets[rows] = offsets[rows] @ turn.T + shift
