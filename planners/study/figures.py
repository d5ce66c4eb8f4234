"""The study in pictures: scores over data, learning curves of many trainings, what each comparison came to."""

import csv
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from planners.evaluation.aggregation import words_of_stage
from planners.evaluation.compare import is_clear_row
from planners.evaluation.scaling_law import ScalingLaw
from planners.study.setups import words_of
from planners.training.curves import LOSSES, VALIDATION

COLUMNS = 6
COLOURS = 32  # of a picture: a sheet of eighty panels has 1.5 MB in full colour, a quarter of it in a few
CURVES = ("#1f6fb4", "#d1561c", "#2a8a4a", "#8a4fb0", "#b03a5b", "#6b6b6b")
SMOOTH_STEPS = 20  # of which a loss that is drawn is the mean
DRAWN = ("stage_two", "follow_ups", "final")  # those that there are
CLEAR, OPEN = "#1f6fb4", "#9aa4ad"  # an interval without and with zero


@dataclass(frozen=True)
class Curve:
    """The trainings of one planner with one kind of data."""

    planner: str
    label: str
    samples: tuple[int, ...]  # of each training, real and simulated
    scores: tuple[float, ...]  # percent
    law: ScalingLaw | None  # None: fewer than 4 data sizes

    def row(self) -> dict[str, Any]:
        """Of the table of curves; empty where there is no fit."""
        top = None if self.law is None else self.law.saturation
        fit = {name: getattr(self.law, name, "") for name in ("a", "b", "c", "residual_std")}
        head = {"planner": self.planner, "curve": self.label, "trainings": len(self.samples)}
        return {**head, **fit, "saturation_samples": "" if top is None else f"{top:.0f}"}


@contextmanager
def _sheet(
    path: Path, rows: int, columns: int, size: tuple[float, float], dpi: int = 100, few: bool = True, **more: Any
) -> Iterator[tuple[Any, Any]]:
    """A figure and its panels, which becomes a PNG, of few colours if asked for."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(rows, columns, figsize=size, squeeze=False, **more)
    yield figure, axes
    figure.savefig(path, dpi=dpi)
    pyplot.close(figure)
    if few:
        with Image.open(path) as drawn:
            quantised = drawn.convert("RGB").quantize(COLOURS)
        quantised.save(path, optimize=True)


def draw_curves(curves: Sequence[Curve], score: str, path: Path) -> None:
    """The paper's scaling figure: a panel for each planner, its points, fitted curves, residual bands and tops."""
    planners = list(dict.fromkeys(curve.planner for curve in curves))
    with _sheet(path, 1, len(planners), (1.0 + 4.4 * len(planners), 4.2), dpi=130, few=False) as (figure, axes):
        for panel, planner in zip(axes[0], planners):
            mine = [curve for curve in curves if curve.planner == planner]
            for colour, curve in zip(CURVES * len(mine), mine):
                panel.plot(curve.samples, curve.scores, "o", color=colour, markersize=4, alpha=0.8)
                if curve.law is None:
                    panel.plot([], [], "o", color=colour, label=curve.label)
                    continue
                first, last = min(curve.samples), max(curve.samples)
                along = np.geomspace(first, last, 100)
                middle, half = curve.law.score(along), curve.law.residual_std
                panel.plot(along, middle, color=colour, label=curve.label)
                panel.fill_between(along, middle - half, middle + half, color=colour, alpha=0.15, linewidth=0)
                top = curve.law.saturation
                if top is not None and first <= top <= last:
                    panel.plot([top], [float(curve.law.score(top))], "*", color=colour, markersize=13)
            panel.set(xscale="log", title=planner, xlabel="samples, real and simulated")
            panel.grid(alpha=0.3)
            ticks: list[int] = []  # far enough from each other to be written side by side
            for size in sorted({size for curve in mine for size in curve.samples}):
                if not ticks or math.log(size / ticks[-1]) > 0.2:
                    ticks.append(size)
            panel.set_xticks(ticks, [str(tick) for tick in ticks])
            panel.minorticks_off()
            panel.legend(fontsize=8)
        axes[0][0].set_ylabel(f"{score} [%]")
        figure.tight_layout()


def draw_learning(folders: Mapping[str, Path], path: Path) -> None:
    """Whether each ran past its plateau.

    A small panel for each training: its loss (left axis), and its distance from held-out human plans (right).
    """
    n_rows = -(-len(folders) // COLUMNS)
    with _sheet(path, n_rows, COLUMNS, (3.0 * COLUMNS, 2.1 * n_rows)) as (figure, axes):
        for panel in axes.flat[len(folders) :]:
            panel.axis("off")
        for panel, (label, folder) in zip(axes.flat, folders.items()):
            curve = column(folder / LOSSES, "total")
            whole = curve[:, : curve.shape[1] // SMOOTH_STEPS * SMOOTH_STEPS]
            panel.plot(*whole.reshape(2, -1, SMOOTH_STEPS).mean(axis=2), color="#1f6fb4", linewidth=1)
            if (folder / VALIDATION).is_file():
                other = panel.twinx()
                other.plot(*column(folder / VALIDATION, "ade_m"), color="#d1561c", linewidth=1)
                other.tick_params(labelsize=6, colors="#d1561c")
            panel.set_title(label, fontsize=6)
            panel.tick_params(labelsize=6)
        said = "loss (blue), mean distance from held-out human plans [m] (orange), over optimiser steps"
        figure.suptitle(said, fontsize=9)
        figure.tight_layout(rect=(0, 0, 1, 0.98))


def draw_differences(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Every comparison's difference in percent points with its interval, in stage two and in the final score.

    rows: those of comparisons.csv that have a reference, of one human filter.
    """
    n = sum(row["stage"] == "final" for row in rows)
    drawn = [stage for stage in DRAWN if any(row["stage"] == stage for row in rows)]
    with _sheet(path, 1, len(drawn), (3.0 + 4.0 * len(drawn), 1.0 + 0.2 * n), sharey=True) as (figure, axes):
        for panel, stage in zip(axes.flat, drawn):
            chosen = [row for row in rows if row["stage"] == stage]
            for y, row in enumerate(chosen):
                color = CLEAR if is_clear_row(row) else OPEN
                panel.plot([row["low"], row["high"]], [y, y], color=color, linewidth=2)
                panel.plot(row["difference"], y, "o", color=color, markersize=4)
            for y in range(1, n):
                if chosen[y]["part"] != chosen[y - 1]["part"]:
                    panel.axhline(y - 0.5, color="#d0d5da", linewidth=0.8)
            panel.axvline(0.0, color="black", linewidth=0.8)
            panel.set_yticks(range(n), [difference_label(row) for row in chosen], fontsize=7)
            panel.set_title(f"{words_of_stage(stage)}: difference in EPDMS points", fontsize=9)
            panel.tick_params(axis="x", labelsize=7)
        axes.flat[0].set_ylim(n - 0.5, -0.5)
        figure.tight_layout()


def draw_agreement(points: Mapping[str, Sequence[tuple[float, float, bool]]], path: Path) -> None:
    """Differences of a study made again over those of the first, a panel for each score, blue where both are clear.

    points: title of a score -> (first, second, whether both are clear), percent points of EPDMS.
    """
    with _sheet(path, 1, len(points), (3.6 * len(points), 3.8)) as (figure, axes):
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


def difference_label(row: Mapping[str, Any]) -> str:
    """Which comparison a line stands for."""
    seeds = "1 seed" if row["seeds"] == 1 else f"{row['seeds']} seeds"
    return f"{row['part']}: {row['planner']} {words_of(row)} (equal {row['budget']}, {seeds})"


def column(path: Path, name: str) -> np.ndarray:
    """(2, n) steps and values of one column of a curve."""
    with path.open(newline="", encoding="utf-8") as file:
        return np.array([(float(row["step"]), float(row[name])) for row in csv.DictReader(file)]).T
