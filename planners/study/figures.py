"""The study in pictures: learning curves of many trainings, and what each comparison came to."""

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

from planners.study.tables import is_clear, words_of
from planners.training.curves import LOSSES, VALIDATION

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLUMNS = 6
COLOURS = 32
SMOOTH_STEPS = 20  # of which a loss that is drawn is the mean
DRAWN = {"stage_two": "stage two", "follow_ups": "follow-ups (plain mean)", "final": "final"}  # those that there are
CLEAR, OPEN = "#1f6fb4", "#9aa4ad"  # an interval without and with zero


def draw_learning(folders: Mapping[str, Path], path: Path) -> None:
    """Whether each ran past its plateau.

    A small panel for each training: its loss (left axis), and its distance from held-out human plans (right).
    """
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
    _save(figure, path)
    pyplot.close(figure)


def draw_differences(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Every comparison's difference in percent points with its interval, in stage two and in the final score.

    rows: those of comparisons.csv that have a reference, of one human filter.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    n = sum(row["stage"] == "final" for row in rows)
    drawn = {stage: title for stage, title in DRAWN.items() if any(row["stage"] == stage for row in rows)}
    size = (3.0 + 4.0 * len(drawn), 1.0 + 0.2 * n)
    figure, axes = pyplot.subplots(1, len(drawn), figsize=size, sharey=True, squeeze=False)
    for panel, (stage, title) in zip(axes.flat, drawn.items()):
        chosen = [row for row in rows if row["stage"] == stage]
        for y, row in enumerate(chosen):
            color = CLEAR if is_clear(row) else OPEN
            panel.plot([row["low"], row["high"]], [y, y], color=color, linewidth=2)
            panel.plot(row["difference"], y, "o", color=color, markersize=4)
        for y in range(1, n):
            if chosen[y]["part"] != chosen[y - 1]["part"]:
                panel.axhline(y - 0.5, color="#d0d5da", linewidth=0.8)
        panel.axvline(0.0, color="black", linewidth=0.8)
        panel.set_yticks(range(n), [difference_label(row) for row in chosen], fontsize=7)
        panel.set_title(f"{title}: difference in EPDMS points", fontsize=9)
        panel.tick_params(axis="x", labelsize=7)
    axes.flat[0].set_ylim(n - 0.5, -0.5)
    figure.tight_layout()
    _save(figure, path)
    pyplot.close(figure)


def draw_agreement(points: Mapping[str, Sequence[tuple[float, float, bool]]], path: Path) -> None:
    """Differences of a study made again over those of the first, a panel for each score, blue where both are clear.

    points: title of a score -> (first, second, whether both are clear), percent points of EPDMS.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, len(points), figsize=(3.6 * len(points), 3.8), squeeze=False)
    for panel, (title, drawn) in zip(axes.flat, points.items()):
        for clear, color in ((False, OPEN), (True, CLEAR)):
            chosen = [(one, other) for one, other, is_clear in drawn if is_clear == clear]
            panel.plot(*np.array(chosen).reshape(-1, 2).T, "o", color=color, markersize=4)
        panel.axline((0.0, 0.0), slope=1.0, color="black", linewidth=0.8)
        panel.axhline(0.0, color="#d0d5da", linewidth=0.8, zorder=0)
        panel.axvline(0.0, color="#d0d5da", linewidth=0.8, zorder=0)
        panel.set_aspect("equal", adjustable="datalim")
        panel.set_title(f"{title}:\ndifference in points", fontsize=8)
        panel.set_xlabel("first", fontsize=8)
        panel.set_ylabel("again", fontsize=8)
        panel.tick_params(labelsize=7)
    figure.tight_layout()
    _save(figure, path)
    pyplot.close(figure)


def difference_label(row: Mapping[str, Any]) -> str:
    """Which comparison a line stands for."""
    seeds = "1 seed" if row["seeds"] == 1 else f"{row['seeds']} seeds"
    return f"{row['part']}: {row['planner']} {words_of(row)} (equal {row['budget']}, {seeds})"


def _save(figure: "Figure", path: Path) -> None:
    """A sheet of eighty panels in full colour has 1.5 MB, in a few colours a quarter of it."""
    figure.savefig(path, dpi=100)
    with Image.open(path) as drawn:
        few = drawn.convert("RGB").quantize(COLOURS)
    few.save(path, optimize=True)


def column(path: Path, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Steps and values of one column of a curve."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    return np.array([int(row["step"]) for row in rows]), np.array([float(row[name]) for row in rows])
