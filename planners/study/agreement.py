"""`python -m planners agreement first=<study> second=<study>`: whether a study that was made again says the same.

    python -m planners agreement first=docs/study second=docs/study/again out=docs/study/again/agreement.png

Both are folders that `python -m planners study` reported to. What both compared is set side by side, each comparison
once: how many differences of the first are clear (their interval leaves out zero), how many of these have the same sign
in the second, how many are clear there too, and how many are as clearly the other way. `out` is a picture of all
differences of one over those of the other.
"""

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from factory.config.arguments import parse
from planners.command import command
from planners.evaluation.aggregation import MEASURES
from planners.evaluation.scores import title_of
from planners.study.figures import draw_agreement

FACTS = ("setup", "reference", "budget", "stage", "human_filter")  # which comparison
NUMBERS = ("difference", "low", "high")
Key = tuple[str, ...]  # FACTS


@dataclass(frozen=True)
class AgreementRequest:
    """The command's keys."""

    first: str
    second: str
    out: str | None = None  # a picture


@dataclass(frozen=True)
class Difference:
    """Of a setup from what it is held against, with its interval; percent points of EPDMS."""

    difference: float
    low: float
    high: float

    @property
    def is_clear(self) -> bool:
        """Whether zero lies outside of the interval."""
        return self.low > 0.0 or self.high < 0.0

    def __str__(self) -> str:
        return f"{self.difference:+.1f} ({self.low:+.1f} .. {self.high:+.1f})"


@dataclass(frozen=True)
class Agreement:
    """Of one score."""

    both: int  # comparisons that both studies made
    clear: int  # in the first
    same_sign: int  # of these, in the second
    clear_again: int  # of these, with the same sign
    clearly_otherwise: int  # of those clear in the first


Pair = tuple[Difference, Difference]


def read_differences(folder: Path) -> dict[Key, Difference]:
    """FACTS -> difference, of each comparison in the first part that makes it. ValueError for no such table."""
    path = folder / "comparisons.csv"
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    if not rows or not {*FACTS, *NUMBERS} <= set(rows[0]):
        raise ValueError(f"{path}: no table of a study's comparisons: it must have {', '.join((*FACTS, *NUMBERS))}")
    found: dict[Key, Difference] = {}
    for line, row in enumerate(rows, start=2):
        try:
            if row["reference"]:
                one = Difference(*(float(row[name]) for name in NUMBERS))
                found.setdefault(tuple(row[name] for name in FACTS), one)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{path}, line {line}: {error}") from error
    return found


def pairs_of(
    first: Mapping[Key, Difference], second: Mapping[Key, Difference], measure: tuple[str, str]
) -> dict[Key, Pair]:
    """What both compared in one of MEASURES."""
    return {key: (one, second[key]) for key, one in first.items() if key[-2:] == measure and key in second}


def agreement(pairs: Sequence[Pair]) -> Agreement:
    """Counts of one score."""
    clear = [pair for pair in pairs if pair[0].is_clear]
    same = [(one, other) for one, other in clear if one.difference * other.difference > 0.0]
    again = sum(other.is_clear for _, other in same)
    otherwise = sum(other.is_clear for _, other in clear) - again
    return Agreement(len(pairs), len(clear), len(same), again, otherwise)


def text_of(found: Mapping[tuple[str, str], Mapping[Key, Pair]]) -> str:
    """A table to be printed, then each clear difference of the first that has not its sign in the second."""
    counts = f"{'both':>6}{'clear':>7}{'same sign':>11}{'clear again':>13}{'clearly otherwise':>19}"
    lines = [f"{'stage':<11}{'filter':<10}{counts}"]
    otherwise = []
    for (stage, human_filter), pairs in found.items():
        n = agreement(list(pairs.values()))
        counts = f"{n.both:>6}{n.clear:>7}{n.same_sign:>11}{n.clear_again:>13}{n.clearly_otherwise:>19}"
        lines.append(f"{stage:<11}{human_filter:<10}{counts}")
        otherwise += [
            f"{setup} against {reference}, equal {budget}, {stage} {human_filter}: {one}, then {other}"
            for (setup, reference, budget, *_), (one, other) in pairs.items()
            if one.is_clear and one.difference * other.difference <= 0.0
        ]
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
