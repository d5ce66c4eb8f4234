"""`python -m planners analysis run=<evaluated planner>`: EPDMS on real against simulated frames, and by scenario tag.

    python -m planners analysis run=evaluations/runs_ego_mlp out=analysis

As in the paper's supplement. Real frames are the benchmark's logged ones at T (stage one), simulated frames its
follow-ups at T+H (stage two): of the same held-out clips, among the same reactive traffic. Both scores are unfiltered,
since only logged frames have a human whose faults could be forgiven. Training samples are not scored: their tables hold
the map and the log around a sample, but not the scene from which traffic could answer to a plan.

    distribution.csv      share of frames in each tenth of EPDMS
    tags.csv              frames and mean EPDMS of each tag, hardest in simulation first
    analysis.png          both, drawn
"""

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from factory.config.arguments import parse
from planners.command import command
from planners.evaluation.frames import FOLLOW_UP_KINDS, LOGGED_KINDS
from planners.evaluation.score_rows import FrameRow, read_rows
from tasks.reward.one_stage import COLUMNS
from tasks.world.arrays import Array, Image

EDGES = np.linspace(0.0, 1.0, 11)
REAL, SIMULATED = (90, 130, 170), (224, 122, 32)  # RGB
INK, PAPER, FAINT = (30, 30, 30), (252, 252, 250), (200, 200, 200)
PANEL_PX, ROW_PX, FONT, SIZE = 420, 24, cv2.FONT_HERSHEY_SIMPLEX, 0.42


@dataclass(frozen=True)
class AnalysisSettings:
    """The keys of this command."""

    run: str  # folder of an evaluated planner
    out: str | None = None  # a folder; None: the run's


@dataclass(frozen=True)
class TagScore:
    """Frames of one tag; means are NaN where there is none."""

    tag: str
    n_real: int
    real: float
    n_simulated: int
    simulated: float


@dataclass(frozen=True)
class Analysis:
    """Scores of one planner, unfiltered EPDMS."""

    real: Array  # (R,)
    simulated: Array  # (S,)
    tags: tuple[TagScore, ...]  # hardest in simulation first, those without simulated frames last

    @property
    def shares(self) -> tuple[Array, Array]:
        """(10,) of real and of simulated frames in each tenth; the last one includes 1."""
        counts = (np.histogram(scores, EDGES)[0] for scores in (self.real, self.simulated))
        real, simulated = (count / max(count.sum(), 1) for count in counts)
        return real, simulated


def analyse(rows: Sequence[FrameRow]) -> Analysis:
    """Real frames at T against follow-ups at T+H. Raises ValueError where either is missing or was not scored."""
    place = COLUMNS.index("score")
    sides = (("stage_one", LOGGED_KINDS[0]), ("stage_two", FOLLOW_UP_KINDS[0]))
    real, simulated = ([r for r in rows if (r.stage, r.key.kind) == side] for side in sides)
    scores = [np.array([row.scores.unfiltered[place] for row in side]) for side in (real, simulated)]
    for name, found in zip(("logged", "follow-up"), scores):
        if not len(found) or np.isnan(found).any():
            raise ValueError(f"no scores of {name} frames: evaluate a planner that plans from them")

    def of_tag(tag: str) -> TagScore:
        own = [found[[tag in row.tags for row in side]] for side, found in zip((real, simulated), scores)]
        n_real, n_simulated = map(len, own)
        means = [float(found.mean()) if len(found) else float("nan") for found in own]
        return TagScore(tag, n_real, means[0], n_simulated, means[1])

    known = [of_tag(tag) for tag in {tag for row in (*real, *simulated) for tag in row.tags}]
    ranked = sorted(known, key=lambda tag: (np.isnan(tag.simulated), tag.simulated, tag.tag))
    return Analysis(scores[0], scores[1], tuple(ranked))


def write_analysis(folder: Path, analysis: Analysis, title: str) -> None:
    """The three files of this module's docstring."""
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "distribution.csv").open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(["from", "to", "real_share", "simulated_share"])
        table.writerows(zip(EDGES[:-1].round(3), EDGES[1:].round(3), *analysis.shares))
    with (folder / "tags.csv").open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(["tag", "real_frames", "real_epdms", "simulated_frames", "simulated_epdms"])
        for tag in analysis.tags:
            table.writerow([tag.tag, tag.n_real, _plain(tag.real), tag.n_simulated, _plain(tag.simulated)])
    done, data = cv2.imencode(".png", cv2.cvtColor(picture(analysis, title), cv2.COLOR_RGB2BGR))
    assert done, "OpenCV cannot write .png"
    (folder / "analysis.png").write_bytes(bytes(data))


def picture(analysis: Analysis, title: str) -> Image:
    """Histogram on the left, tags on the right: RGB."""
    height = max(PANEL_PX, (len(analysis.tags) + 4) * ROW_PX)
    image = np.full((height, 2 * PANEL_PX + 160, 3), PAPER, np.uint8)
    _write(image, title, 16, 22)
    _histogram(image[40:PANEL_PX, :PANEL_PX], analysis)
    _bars(image[40:, PANEL_PX:], analysis.tags)
    return image


def _histogram(panel: Image, analysis: Analysis) -> None:
    left, bottom, top = 44, panel.shape[0] - 40, 44
    shares = analysis.shares
    tallest = max(float(max(map(np.max, shares))), 1e-9)
    step = (panel.shape[1] - left - 16) / len(EDGES[:-1])
    names = (f"real, mean {analysis.real.mean():.3f}", f"simulated, mean {analysis.simulated.mean():.3f}")
    for side, (share, colour, name) in enumerate(zip(shares, (REAL, SIMULATED), names)):
        for i, value in enumerate(share):
            x0 = round(left + step * (i + 0.08 + 0.42 * side))
            y0 = round(bottom - (bottom - top) * value / tallest)
            cv2.rectangle(panel, (x0, y0), (round(x0 + 0.4 * step), bottom), colour, -1)
        _write(panel, name, left + 190 * side, 20, colour)
    for i in range(0, len(EDGES), 2):
        _write(panel, f"{EDGES[i]:.1f}", round(left + step * i) - 10, bottom + 18)
    _write(panel, f"{100 * tallest:.0f} %", 4, top + 4)
    _write(panel, "EPDMS, unfiltered", left + 120, bottom + 36)


def _bars(panel: Image, tags: Sequence[TagScore]) -> None:
    left, width = 140, panel.shape[1] - 260
    for row, tag in enumerate(tags):
        y = 30 + row * ROW_PX
        _write(panel, tag.tag, 8, y + 14)
        cv2.line(panel, (left, y + ROW_PX - 3), (left + width, y + ROW_PX - 3), FAINT, 1)
        for offset, value, colour in ((2, tag.real, REAL), (11, tag.simulated, SIMULATED)):
            if np.isfinite(value):
                cv2.rectangle(panel, (left, y + offset), (left + round(width * value), y + offset + 7), colour, -1)
        _write(panel, f"{tag.n_real} / {tag.n_simulated}", left + width + 10, y + 14)
    _write(panel, "mean EPDMS by tag; frames real / simulated", 8, 14)


def _write(image: Image, text: str, x: int, y: int, colour: tuple[int, int, int] = INK) -> None:
    cv2.putText(image, text, (x, y), FONT, SIZE, colour, 1, cv2.LINE_AA)


def _plain(value: float) -> float | str:
    return "" if np.isnan(value) else value


@command
def main(argv: Sequence[str]) -> None:
    """The command."""
    settings = parse(AnalysisSettings, argv)
    analysis = analyse(read_rows(Path(settings.run)))
    out = Path(settings.out or settings.run)
    counts = f"{len(analysis.real)} real, {len(analysis.simulated)} simulated frames"
    write_analysis(out, analysis, f"{Path(settings.run).name}: {counts}")
    print(f"EPDMS {analysis.real.mean():.4f} on real, {analysis.simulated.mean():.4f} on simulated frames")
    print(f"look at {out / 'analysis.png'}")
