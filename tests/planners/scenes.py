"""Small networks, and trajectories with their labels, for planners that are asked for a few steps."""

import numpy as np
import torch

from planners.data.batch import ImageLayout
from planners.models.settings import BackboneSettings, FusionSettings, Sizes
from tasks.reward.label_bytes import VocabularyLabels

PICTURE = ImageLayout(width=64, height=32)
SIZES = Sizes(
    fusion=FusionSettings(
        backbone=BackboneSettings("small", widths=(16, 32, 64, 64)),
        latent_size=32,
        image_tokens=(1, 2),
        latent_tokens=(1, 1),
        layers=1,
        heads=2,
        expansion=2,
        dropout=0.0,
        bev_channels=8,
    ),
    width=48,
    hidden=96,
    layers=1,
    heads=2,
    agents=3,
    cell_m=8.0,
    picture=BackboneSettings("small", widths=(8, 16, 16, 32)),
)


def vocabulary(k: int, seed: int = 0) -> np.ndarray:
    """k arcs (k, 40, 3) of different speed and curvature."""
    rng = np.random.default_rng(seed)
    return arcs(rng.uniform(0.5, 12.0, k), rng.uniform(-0.25, 0.25, k))


def four_ways(n: int, seed: int = 0) -> np.ndarray:
    """Arcs (n, 40, 3), variations of slow, fast, left and right."""
    way, vary = np.arange(n) % 4, np.random.default_rng(seed).uniform(-1.0, 1.0, n)
    speeds = np.array([3.0, 10.0, 6.0, 6.0])[way] * (1.0 + 0.2 * vary)
    yaw_rates = np.array([0.0, 0.0, 0.2, -0.2])[way] + 0.05 * vary
    return arcs(speeds, yaw_rates)


def arcs(speeds: np.ndarray, yaw_rates: np.ndarray) -> np.ndarray:
    """Arcs (n, 40, 3) of n speeds [m/s] and yaw rates [rad/s]."""
    time = np.arange(1, 41)[None] * 0.1
    heading = yaw_rates[:, None] * time
    step = speeds[:, None] * 0.1 * np.ones_like(time)
    xy = np.cumsum(np.stack([step * np.cos(heading), step * np.sin(heading)], axis=-1), axis=1)
    return np.concatenate([xy, heading[..., None]], axis=-1)


def labels(n: int, trajectories: np.ndarray, seed: int = 0) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
    """Sub-scores (n, k) by name and the final scores (n, k) of n scenes, each a lane to be in and an obstacle ahead."""
    rng = np.random.default_rng(seed)
    x, y = trajectories[:, -1, 0], trajectories[:, -1, 1]
    named: dict[str, list[np.ndarray]] = {}
    final = []
    for _ in range(n):
        off = np.abs(y - rng.uniform(-8.0, 8.0))
        gap = rng.uniform(15.0, 45.0) - x
        scores = {
            "nc": np.where(gap > 0.0, 1.0, np.where(gap > -3.0, 0.5, 0.0)),
            "dac": (off < 4.0).astype(float),
            "ddc": np.where(off < 5.0, 1.0, 0.5),
            "tlc": (gap > -6.0).astype(float),
            "ttc": (gap > 3.0).astype(float),
            "lk": (off < 2.0).astype(float),
            "hc": np.ones(len(x)),
        }
        one = VocabularyLabels("v", 20.0, ep_raw_m=np.maximum(x, 0.0), **scores)
        for name, score in (scores | {"ep": one.ep("masked")}).items():
            named.setdefault(name, []).append(score)
        final.append(one.pdm_score("masked"))
    tensors = {name: torch.tensor(np.stack(rows), dtype=torch.float32) for name, rows in named.items()}
    return tensors, torch.tensor(np.stack(final), dtype=torch.float32)
