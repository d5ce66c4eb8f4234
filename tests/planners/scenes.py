"""Batches whose pictures decide everything: small enough for a network to learn by heart in seconds."""

import numpy as np
import torch

from planners.batch import Batch, ImageLayout
from tasks.reward.label_bytes import VocabularyLabels

PICTURE = ImageLayout(width=64, height=32)


def vocabulary(k: int, seed: int = 0) -> np.ndarray:
    """k arcs (k, 40, 3) of different speed and curvature."""
    rng = np.random.default_rng(seed)
    time = np.arange(1, 41)[None] * 0.1
    heading = rng.uniform(-0.25, 0.25, (k, 1)) * time
    step = rng.uniform(0.5, 12.0, (k, 1)) * 0.1 * np.ones_like(time)
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
        one = VocabularyLabels("v", "idm", 20.0, ep_raw_m=np.maximum(x, 0.0), **scores)
        for name, score in (scores | {"ep": one.ep("masked")}).items():
            named.setdefault(name, []).append(score)
        final.append(one.pdm_score("masked"))
    tensors = {name: torch.tensor(np.stack(rows), dtype=torch.float32) for name, rows in named.items()}
    return tensors, torch.tensor(np.stack(final), dtype=torch.float32)


def batch(n: int, plans: np.ndarray, layout: ImageLayout = PICTURE, seed: int = 0, **more: object) -> Batch:
    """n scenes with pictures of coarse random blocks and plans (n, 40, 3)."""
    rng = np.random.default_rng(seed)
    coarse = rng.integers(0, 256, (n, 3, layout.height // 8, layout.width // 8), dtype=np.uint8)
    status = np.zeros((n, 8), np.float32)
    status[:, 1], status[:, 4] = 1.0, 5.0
    at_10hz = torch.tensor(plans, dtype=torch.float32)
    return Batch(
        tuple(f"scene {i}" for i in range(n)),
        torch.tensor(status),
        torch.zeros(n, 4, 3),
        at_10hz[:, 4::5],
        at_10hz,
        torch.zeros(n, dtype=torch.bool),
        torch.ones(n, dtype=torch.bool),
        image=torch.tensor(coarse.repeat(8, axis=2).repeat(8, axis=3)),
        **more,  # type: ignore[arg-type]
    )
