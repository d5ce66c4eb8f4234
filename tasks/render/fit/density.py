"""Where Gaussians are needed: relocation and growth of 3DGS-MCMC (Kheradmand et al. 2024).

A Gaussian that became transparent is put on top of one that matters, and the number grows by a share until it is full.
Both of a pair are made weaker and narrower so that the picture stays the same (their equation 9).
"""

import math

import numpy as np

from tasks.kernels.compiled import kernel
from tasks.render.fit.settings import FitSettings
from tasks.render.fit.state import SHAPES, FitState, logits_of, opacities_of
from tasks.render.splatting.gaussians import rotations_of
from tasks.world.arrays import F32, Array, Ints

MOST_COPIES = 51  # of one Gaussian at once, as in the authors' code
LEAST_OPACITY = 0.005
DEAD_OPACITY = 0.01  # below which a Gaussian is moved elsewhere
JITTER = 0.5  # how far from its source a copy is put, in standard deviations of it


def refine(state: FitState, settings: FitSettings) -> None:
    """Relocates and grows, in place; a function of seed and iteration alone."""
    rng = np.random.Generator(np.random.Philox(key=[settings.seed, 2**32 + state.iteration]))
    opacities = opacities_of(state.learned["logits"].values[:, 0]).astype(np.float64)
    dead = opacities < DEAD_OPACITY
    weight = np.where(dead, 0.0, opacities * state.wanted)
    if weight.sum() > 0.0:
        free = np.flatnonzero(dead)
        target = min(settings.most_gaussians, int(len(state) * (1.0 + settings.growth)))
        n_new = max(target - len(state), 0)
        sources = rng.choice(len(state), len(free) + n_new, p=weight / weight.sum())
        _copy(state, np.concatenate([free, np.arange(len(state), len(state) + n_new)]), sources, rng)
    state.wanted = np.zeros(len(state), np.float32)


def _copy(state: FitState, targets: Ints, sources: Ints, rng: np.random.Generator) -> None:
    """Puts copies of `sources` at the rows `targets` (M,), where rows beyond the last are new."""
    if len(targets) == 0:
        return
    named, counts = np.unique(sources, return_counts=True)
    logits, log_scales = state.learned["logits"].values, state.learned["log_scales"].values
    opacities, shrink = shared(opacities_of(logits[named, 0]).astype(np.float64), counts + 1)
    logits[named, 0] = logits_of(np.maximum(opacities, LEAST_OPACITY))
    log_scales[named] += np.log(shrink)[:, None].astype(np.float32)
    rows = np.arange(max(len(state), int(targets.max()) + 1))
    rows[targets] = sources
    state.rows(rows)
    means = state.learned["means"].values
    means[targets] += JITTER * _within(state, targets, rng)
    for name in SHAPES:
        state.learned[name].forget(np.concatenate([named, targets]))
    state.rows(np.argsort(state.owner, kind="stable"))


def _within(state: FitState, rows: Ints, rng: np.random.Generator) -> F32:
    """Random offsets (M, 3) as far as the Gaussians at `rows` reach."""
    quats = state.learned["quats"].values[rows]
    turns = rotations_of(quats / np.linalg.norm(quats, axis=1, keepdims=True))
    local = rng.standard_normal((len(rows), 3)) * np.exp(state.learned["log_scales"].values[rows])
    return np.einsum("nij,nj->ni", turns, local).astype(np.float32)


@kernel
def _shrink(opacity: float, shared_opacity: float, n: int) -> float:
    total = 0.0
    for i in range(1, n + 1):
        binomial = 1.0
        for k in range(i):
            total += binomial * (-1.0) ** k * shared_opacity ** (k + 1) / math.sqrt(k + 1.0)
            binomial *= (i - 1 - k) / (k + 1.0)
    return opacity / total


@kernel
def shared(opacities: Array, counts: Ints) -> tuple[Array, Array]:
    """Opacity and factor of the scales, (N,) each, of each of `counts` Gaussians that together show what one did."""
    out, shrink = np.empty(len(opacities)), np.empty(len(opacities))
    for i in range(len(opacities)):
        n = min(counts[i], MOST_COPIES)
        out[i] = 1.0 - (1.0 - opacities[i]) ** (1.0 / n)
        shrink[i] = _shrink(opacities[i], out[i], n)
    return out, shrink
