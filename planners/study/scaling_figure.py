"""The paper's scaling figure: a panel for each planner, its points, fitted curves, residual bands and tops."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from planners.study.scaling_law import FEWEST, ScalingLaw

COLOURS = ("#1f6fb4", "#d1561c", "#2a8a4a", "#8a4fb0", "#b03a5b", "#6b6b6b")


@dataclass(frozen=True)
class Point:
    """One training."""

    samples: int  # real and simulated
    score: float  # percent


@dataclass(frozen=True)
class Curve:
    """The trainings of one planner with one kind of data."""

    planner: str
    label: str
    points: tuple[Point, ...]
    law: ScalingLaw | None  # None: fewer than 4 data sizes

    def row(self) -> dict[str, Any]:
        """Of the table of curves; empty where there is no fit."""
        law = self.law
        top = None if law is None else law.saturation
        return {
            "planner": self.planner,
            "curve": self.label,
            "trainings": len(self.points),
            "a": "" if law is None else law.a,
            "b": "" if law is None else law.b,
            "c": "" if law is None else law.c,
            "residual_std": "" if law is None else law.residual_std,
            "saturation_samples": "" if top is None else f"{top:.0f}",
        }

    def text(self) -> str:
        """A line."""
        if self.law is None:
            return f"{self.planner}, {self.label}: fewer than {FEWEST} data sizes, no curve"
        top = self.law.saturation
        end = "no top" if top is None else f"top at {top:.0f} samples"
        law = f"{self.law.a:+.3f} log^2 N {self.law.b:+.3f} log N {self.law.c:+.3f}"
        return f"{self.planner}, {self.label}: {law}, residuals {self.law.residual_std:.2f}, {end}"


def draw_curves(curves: Sequence[Curve], score: str, path: Path) -> None:
    """Write the figure as PNG; data sizes on a logarithmic axis."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    planners = list(dict.fromkeys(curve.planner for curve in curves))
    figure, axes = pyplot.subplots(1, len(planners), figsize=(1.0 + 4.4 * len(planners), 4.2), squeeze=False)
    for panel, planner in zip(axes[0], planners):
        for colour, curve in zip(COLOURS * len(curves), (c for c in curves if c.planner == planner)):
            sizes = [point.samples for point in curve.points]
            panel.plot(sizes, [p.score for p in curve.points], "o", color=colour, markersize=4, alpha=0.8)
            if curve.law is None:
                panel.plot([], [], "o", color=colour, label=curve.label)
                continue
            along = np.geomspace(min(sizes), max(sizes), 100)
            middle, half = curve.law.score(along), curve.law.residual_std
            panel.plot(along, middle, color=colour, label=curve.label)
            panel.fill_between(along, middle - half, middle + half, color=colour, alpha=0.15, linewidth=0)
            top = curve.law.saturation
            if top is not None and min(sizes) <= top <= max(sizes):
                panel.plot([top], [float(curve.law.score(top))], "*", color=colour, markersize=13)
        panel.set_xscale("log")
        panel.set_title(planner)
        panel.set_xlabel("samples, real and simulated")
        panel.grid(alpha=0.3)
        every = sorted({point.samples for curve in curves if curve.planner == planner for point in curve.points})
        ticks = _apart(every)
        panel.set_xticks(ticks, [str(tick) for tick in ticks])
        panel.minorticks_off()
        panel.legend(fontsize=8)
    axes[0][0].set_ylabel(f"{score} [%]")
    figure.tight_layout()
    figure.savefig(path, dpi=130)
    pyplot.close(figure)


def _apart(sizes: Sequence[int]) -> list[int]:
    """Those of the rising sizes that are far enough from each other to be written side by side on the axis."""
    shown: list[int] = []
    for size in sizes:
        if not shown or math.log(size / shown[-1]) > 0.2:
            shown.append(size)
    return shown
