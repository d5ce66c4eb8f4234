"""The README's tables, and all others, from the kept frames alone; nothing is trained or planned.

python -m experiments.study.tables                                         the headline, over clips, logs and towns
python -m experiments.study.tables frames=towns out=runs/towns             every comparison: CSVs and tables.md
python -m experiments.study.tables frames=nuscenes out=runs/nuscenes human_filter=filtered
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from factory.config.arguments import INPUT_ERRORS, parse, run_command
from planners.evaluation.aggregation import PAPER, HumanFilter
from planners.evaluation.compare import CompareSettings, compare
from planners.study.report import StudyFrames, read_study, write_tables

KEPT = Path(__file__).parent / "frames"
FAMILIES = ("ltf", "diffusiondrive", "gtrs_dense")
REAL, SIMULATED, LOGGED = "real-steps", "pdm_closed5-epochs", "logged5-steps"  # the largest data's epochs are the steps
SCORES = (("stage_two", "none"), ("final", "unfiltered"))
# What is told: who, with which seeds, trained on what, held against what.
ROWS = (
    *((family, (family,), (0, 1, 2), REAL, SIMULATED) for family in FAMILIES),
    ("mean of the three", FAMILIES, (0, 1, 2), REAL, SIMULATED),
    ("the log's label, from pdm_closed's", FAMILIES, (0, 1), SIMULATED, LOGGED),
)


@dataclass(frozen=True)
class TablesRequest:
    """The command's keys."""

    frames: str = "towns"  # of the folder frames/, without .parquet
    out: str | None = None  # where all tables go; null: the headline alone, printed
    human_filter: HumanFilter = PAPER  # of tables.md; the CSVs hold both


def headline(study: StudyFrames) -> list[str]:
    """A line for each of ROWS and SCORES: EPDMS in percent of both sides, difference, 95 % intervals."""
    lines = [f"{'':<36}{'score':<11}{'from':>7}{'to':>7}{'':>7}   over clips, logs, towns"]
    for who, families, seeds, before, after in ROWS:
        sides = [
            [study.clips[f"{family}-{what}-{seed}"] for family in families for seed in seeds]
            for what in (before, after)
        ]
        found = compare(sides[0], sides[1], CompareSettings(a="", b=""))
        for score in SCORES:
            one = found[score]["clip"]
            said = "   ".join(f"{100 * each.low:+.1f} .. {100 * each.high:+.1f}" for each in found[score].values())
            scores = f"{100 * one.a:7.1f}{100 * one.b:7.1f}{100 * one.difference:+7.1f}"
            lines.append(f"{who:<36}{score[0]:<11}{scores}   {said}")
    return lines


def tables(argv: Sequence[str]) -> None:
    """The command."""
    request = parse(TablesRequest, argv)
    path = KEPT / f"{request.frames}.parquet"
    if request.out is not None:
        write_tables(path, Path(request.out), request.human_filter)
    elif request.frames != "towns":
        raise ValueError("the headline is of frames=towns; of others give out=<folder> for all tables")
    else:
        print("\n".join(headline(read_study(path))))


if __name__ == "__main__":
    sys.exit(run_command(sys.argv[1:], tables, lambda: __doc__, INPUT_ERRORS))
