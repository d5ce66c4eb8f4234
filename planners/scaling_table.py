"""The tables of a sweep: what simulated samples add to real ones alone, with intervals, and the bounds beside them."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from planners.aggregation import MEASURES, ClipResult, by_clip
from planners.compare import CompareSettings, compare, row_of
from planners.score_rows import read_rows
from planners.scores import BOUNDS, name_of, scores_of
from planners.sweep import Training

Setup = tuple[tuple[str, Any], ...]  # facts of a training but its seed
RULES = CompareSettings(a="", b="")  # draws, confidence and seed as `python -m planners.compare` has them


def compared(trainings: Sequence[Training], evaluations: Path) -> list[dict[str, Any]]:
    """A row for each setup, which is all facts but the seed, and each of MEASURES.

    In percent: the mean over seeds, the range of single seeds, and the difference from real samples alone with its
    95 % intervals (paired bootstrap over seeds and clips, logs, towns), empty for those themselves and where the sweep
    has none.
    uniform_share is the mean share of clips none of whose follow-ups starts near the plan's end.
    """
    setups: dict[Setup, list[str]] = {}
    for training in sorted(trainings, key=lambda training: training.facts["seed"]):
        setups.setdefault(_setup(training), []).append(training.label)
    rows = []
    for setup, labels in setups.items():
        scores = [scores_of(evaluations / label) for label in labels]
        reference = _real_alone(dict(setup), setups)
        differences = {}
        if reference:
            differences = compare(_runs(reference, evaluations), _runs(labels, evaluations), RULES)
        for stage, human_filter in MEASURES:
            each = [score[name_of(stage, human_filter)] for score in scores]
            row = {**dict(setup), "seeds": len(labels), "stage": stage, "human_filter": human_filter}
            row |= {"epdms": float(np.mean(each)), "lowest_seed": min(each), "highest_seed": max(each)}
            found = differences.get((stage, human_filter))
            row |= row_of(found)
            row["uniform_share"] = float(np.mean([score["uniform_share"] for score in scores]))
            rows.append(row)
    return rows


def bounds(evaluations: Path) -> list[dict[str, Any]]:
    """The scores of those bounds that were evaluated."""
    return [{"planner": name, **scores_of(evaluations / name)} for name in BOUNDS if (evaluations / name).is_dir()]


def text_of(rows: Sequence[Mapping[str, Any]], stage: str, human_filter: str) -> str:
    """The rows of one of MEASURES, to be printed."""
    lines = [f"{'planner':<22}{'trained on':<26}{'EPDMS':>7}{'difference':>12}   95 % interval"]
    for row in rows:
        if (row["stage"], row["human_filter"]) == (stage, human_filter):
            on = f"{row['expert']}, rounds {row['rounds']}" if row["rounds"] else "real alone"
            line = f"{row['planner']:<22}{on:<26}{row['epdms']:7.2f}"
            if row["difference"] != "":
                line += f"{row['difference']:+12.2f}   {row['low']:+.2f} .. {row['high']:+.2f}"
            lines.append(line)
    return "\n".join(lines)


def _setup(training: Training) -> Setup:
    return tuple((name, value) for name, value in training.facts.items() if name != "seed")


def _real_alone(setup: Mapping[str, Any], setups: Mapping[Setup, list[str]]) -> list[str]:
    """The trainings that a setup is held against; none where it is real samples alone, or the sweep has none."""
    if setup["rounds"] == 0:
        return []
    imitation = "none" if setup["imitation"] == "none" else "all"
    alone = {**setup, "expert": "", "rounds": 0, "sim_ratio": "natural", "imitation": imitation}
    return setups.get(tuple(alone.items()), [])


def _runs(labels: Sequence[str], evaluations: Path) -> list[list[ClipResult]]:
    return [by_clip(read_rows(evaluations / label)) for label in labels]
