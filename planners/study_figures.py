"""Learning curves of many trainings on one sheet: whether each ran past its plateau."""

import csv
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from planners.curves import LOSSES, VALIDATION

COLUMNS = 6
SMOOTH_STEPS = 20  # of which a loss that is drawn is the mean


def draw_learning(folders: Mapping[str, Path], path: Path) -> None:
    """A small panel for each training: its loss (left axis), and its distance from held-out human plans (right)."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    n_rows = -(-len(folders) // COLUMNS)
    figure, axes = pyplot.subplots(n_rows, COLUMNS, figsize=(3.0 * COLUMNS, 2.1 * n_rows), squeeze=False)
    for panel in axes.flat[len(folders) :]:
        panel.axis("off")
    for panel, (label, folder) in zip(axes.flat, folders.items()):
        steps, losses = column(folder / LOSSES, "total")
        n = len(losses) // SMOOTH_STEPS * SMOOTH_STEPS
        panel.plot(
            steps[:n].reshape(-1, SMOOTH_STEPS).mean(axis=1),
            losses[:n].reshape(-1, SMOOTH_STEPS).mean(axis=1),
            color="#1f6fb4",
            linewidth=1,
        )
        if (folder / VALIDATION).is_file():
            other = panel.twinx()
            other.plot(*column(folder / VALIDATION, "ade_m"), color="#d1561c", linewidth=1)
            other.tick_params(labelsize=6, colors="#d1561c")
        panel.set_title(label, fontsize=6)
        panel.tick_params(labelsize=6)
    figure.suptitle(
        "loss (blue), mean distance from held-out human plans [m] (orange), over optimiser steps", fontsize=9
    )
    figure.tight_layout(rect=(0, 0, 1, 0.98))
    figure.savefig(path, dpi=100)
    pyplot.close(figure)


def column(path: Path, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Steps and values of one column of a curve."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    return np.array([int(row["step"]) for row in rows]), np.array([float(row[name]) for row in rows])
