"""`python -m planners agreement first=<study> second=<study>`: whether a study that was made again says the same.

    python -m planners agreement first=docs/study second=docs/study/again out=docs/study/again/agreement.png

Both are folders that `python -m planners study` reported to. What both compared is set side by side, each comparison
once: how many differences of the first are clear (their interval leaves out zero), how many of these have the same sign
in the second, how many are clear there too, and how many are as clearly the other way. `out` is a picture of all
differences of one over those of the other.
"""

import csv
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from factory.config.arguments import parse
from planners.command import command
from planners.evaluation.aggregation import MEASURES, title_of
from planners.evaluation.bootstrap import Interval
from planners.study.figures import draw_agreement

FACTS = ("setup", "reference", "budget", "stage", "human_filter")  # which comparison
NUMBERS = ("difference", "low", "high")  # percent points of EPDMS
# Comparisons that both studies made; clear in the first; of these, with the same sign in the second; of these, clear
# there too; clear in both with other signs.
COUNTS = ("both", "clear", "same sign", "clear again", "clearly otherwise")
Key = tuple[str, ...]  # FACTS


@dataclass(frozen=True)
class AgreementRequest:
    """The command's keys."""

    first: str
    second: str
    out: str | None = None  # a picture


Pair = tuple[Interval, Interval]


def read_differences(folder: Path) -> dict[Key, Interval]:
    """FACTS -> difference, of each comparison in the first part that makes it. ValueError for no such table."""
    path = folder / "comparisons.csv"
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    if not rows or not {*FACTS, *NUMBERS} <= set(rows[0]):
        raise ValueError(f"{path}: no table of a study's comparisons: it must have {', '.join((*FACTS, *NUMBERS))}")
    found: dict[Key, Interval] = {}
    for line, row in enumerate(rows, start=2):
        try:
            if row["reference"]:
                one = Interval(*(float(row[name]) for name in NUMBERS))
                found.setdefault(tuple(row[name] for name in FACTS), one)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{path}, line {line}: {error}") from error
    return found


def pairs_of(
    first: Mapping[Key, Interval], second: Mapping[Key, Interval], measure: tuple[str, str]
) -> dict[Key, Pair]:
    """What both compared in one of MEASURES."""
    return {key: (one, second[key]) for key, one in first.items() if key[-2:] == measure and key in second}


def agreement(pairs: Iterable[Pair]) -> tuple[int, ...]:
    """COUNTS of one score."""
    both = list(pairs)
    clear = [pair for pair in both if pair[0].is_clear]
    same = [pair for pair in clear if not _is_otherwise(*pair)]
    again = sum(other.is_clear for _, other in same)
    return len(both), len(clear), len(same), again, sum(other.is_clear for _, other in clear) - again


def _is_otherwise(one: Interval, other: Interval) -> bool:
    return one.difference * other.difference <= 0.0


def text_of(found: Mapping[tuple[str, str], Mapping[Key, Pair]]) -> str:
    """A table to be printed, then each clear difference of the first that has not its sign in the second."""
    lines, otherwise = [f"{'stage':<11}{'filter':<10}  {'  '.join(COUNTS)}"], []
    for (stage, human_filter), pairs in found.items():
        counts = (f"{n:>{len(name) + 2}}" for n, name in zip(agreement(pairs.values()), COUNTS))
        lines.append(f"{stage:<11}{human_filter:<10}{''.join(counts)}")
        for (setup, reference, budget, *_), pair in pairs.items():
            if pair[0].is_clear and _is_otherwise(*pair):
                said = ", then ".join(f"{one.difference:+.1f} ({one.low:+.1f} .. {one.high:+.1f})" for one in pair)
                otherwise.append(f"{setup} against {reference}, equal {budget}, {stage} {human_filter}: {said}")
    return "\n".join([*lines, *otherwise])


@command
def main(argv: Sequence[str]) -> None:
    """The command."""
    request = parse(AgreementRequest, argv)
    first, second = (read_differences(Path(folder)) for folder in (request.first, request.second))
    pairs = {measure: pairs_of(first, second, measure) for measure in MEASURES}
    stages = {measure: both for measure, both in pairs.items() if both}
    if not stages:
        raise ValueError(f"{request.first} and {request.second} have no comparison in common")
    print(text_of(stages))
    if request.out is not None:
        points = {
            title_of(*measure): [(a.difference, b.difference, a.is_clear and b.is_clear) for a, b in both.values()]
            for measure, both in stages.items()
        }
        draw_agreement(points, Path(request.out))
        print(f"look at {request.out}")
