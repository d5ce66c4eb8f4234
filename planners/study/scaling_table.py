"""`python -m planners scaling_table folder=<report>`: a sweep's tables again, from its per-frame rows alone.

    python -m planners scaling_table folder=docs/study/logs/av2_7fab2350/stage_two

`folder` holds the frames.parquet that `python -m planners scaling` wrote. Made of it: `scaling.csv` (one row a
training), `comparisons.csv` (what simulated samples add to real ones alone, with intervals) and `bounds.csv`.
"""

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from factory.config.compose import ConfigError, fill
from planners.evaluation.aggregation import MEASURES
from planners.evaluation.compare import ByLevel, CompareSettings, Measure, compare, row_of
from planners.evaluation.scores import BOUNDS, name_of, scores_of_clips, write_csv
from planners.study.frames_file import FRAMES, Clips, StudyFrames, read_frames

BAD_CONFIG = 2
Row = dict[str, Any]
Setup = tuple[tuple[str, Any], ...]  # facts of a training that are the same for all seeds
NOT_OF_SETUP = ("training", "seed", "real", "simulated", "samples")
RULES = CompareSettings(a="", b="")  # draws, confidence and seed as `python -m planners compare` has them


@dataclass(frozen=True)
class TableSettings:
    """The command's keys."""

    folder: str
    out: str | None = None  # None: the folder


def write_tables(frames: StudyFrames, report: Path) -> tuple[list[Row], list[Row]]:
    """The files of this module's docstring; returns the rows of scaling.csv and of comparisons.csv."""
    rows = [_scored(facts, frames.clips) for facts in frames.trainings]
    differences = compared(frames.trainings, frames.clips)
    for name, table in {"scaling": rows, "comparisons": differences, "bounds": bounds(frames.clips)}.items():
        if table:
            write_csv(report / f"{name}.csv", table)
    return rows, differences


def _scored(facts: Mapping[str, Any], clips: Clips) -> Row:
    told = {name: value for name, value in facts.items() if name != "training"}
    return told | scores_of_clips(clips[facts["training"]])


def compared(trainings: Sequence[Mapping[str, Any]], clips: Clips) -> list[Row]:
    """A row for each setup, which is all facts but the seed, and each of MEASURES.

    In percent: the mean over seeds, the range of single seeds, and the difference from real samples alone with its
    95 % intervals (paired bootstrap over seeds and clips, logs, towns), empty for those themselves and where the sweep
    has none.
    uniform_share is the mean share of clips none of whose follow-ups starts near the plan's end.
    """
    setups: dict[Setup, list[str]] = {}
    for facts in sorted(trainings, key=lambda facts: facts["seed"]):
        setups.setdefault(_setup(facts), []).append(facts["training"])
    rows = []
    for setup, labels in setups.items():
        scores = [scores_of_clips(clips[label]) for label in labels]
        reference = _real_alone(dict(setup), setups)
        differences: Mapping[Measure, ByLevel] = {}
        if reference:
            a, b = ([clips[label] for label in side] for side in (reference, labels))
            differences = compare(a, b, RULES)
        for stage, human_filter in MEASURES:
            each = [score[name_of(stage, human_filter)] for score in scores]
            row: Row = {**dict(setup), "seeds": len(labels), "stage": stage, "human_filter": human_filter}
            row |= {"epdms": float(np.mean(each)), "lowest_seed": min(each), "highest_seed": max(each)}
            row |= row_of(differences.get((stage, human_filter)))
            row["uniform_share"] = float(np.mean([score["uniform_share"] for score in scores]))
            rows.append(row)
    return rows


def bounds(clips: Clips) -> list[Row]:
    """The scores of those bounds that were evaluated."""
    return [{"planner": name, **scores_of_clips(clips[name])} for name in BOUNDS if name in clips]


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


def _setup(facts: Mapping[str, Any]) -> Setup:
    return tuple((name, value) for name, value in facts.items() if name not in NOT_OF_SETUP)


def _real_alone(setup: Mapping[str, Any], setups: Mapping[Setup, list[str]]) -> list[str]:
    """The trainings that a setup is held against; none where it is real samples alone, or the sweep has none."""
    if setup["rounds"] == 0:
        return []
    imitation = "none" if setup["imitation"] == "none" else "all"
    alone = {**setup, "expert": "", "rounds": 0, "sim_ratio": "natural", "imitation": imitation}
    return setups.get(tuple(alone.items()), [])


def main(argv: Sequence[str]) -> int:
    """The command; 2 with a message for what is no sweep's folder."""
    if not argv or {"-h", "--help"} & set(argv):
        print(__doc__)
        return 0
    try:
        wrong = [word for word in argv if "=" not in word]
        if wrong:
            raise ConfigError(f"{wrong[0]}: give key=value: folder=, out=")
        settings = fill(TableSettings, dict(word.split("=", 1) for word in argv), "scaling_table")
        frames = read_frames(Path(settings.folder) / FRAMES)
        out = Path(settings.out or settings.folder)
        out.mkdir(parents=True, exist_ok=True)
        write_tables(frames, out)
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return BAD_CONFIG
    print(f"tables: {out}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
