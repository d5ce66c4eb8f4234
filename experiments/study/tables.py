"""The README's table from the kept frames alone; nothing is trained or planned.

python -m experiments.study.tables           over clips, logs and towns; of few Student's t, wild bootstrap, sign flips
"""

from pathlib import Path

from planners.ab.rows import read_frames
from planners.evaluation.aggregation import ClipResult
from planners.evaluation.compare import CompareSettings, compare

KEPT = Path(__file__).parent / "frames" / "towns.parquet"
FAMILIES = ("ltf", "diffusiondrive", "gtrs_dense")
REAL, SIMULATED, LOGGED = "real-steps", "pdm_closed5-epochs", "logged5-steps"  # the largest data's epochs are the steps
SCORES = (("stage_two", "none"), ("final", "unfiltered"))
# What is told: who, with which seeds, trained on what, held against what.
ROWS = (
    *((family, (family,), (0, 1, 2), REAL, SIMULATED) for family in FAMILIES),
    ("mean of the three", FAMILIES, (0, 1, 2), REAL, SIMULATED),
    ("the log's label, from pdm_closed's", FAMILIES, (0, 1), SIMULATED, LOGGED),
)


def headline(clips: dict[str, list[ClipResult]]) -> list[str]:
    """A line for each of ROWS and SCORES: EPDMS in percent of both sides, difference, 95 % intervals, p over towns."""
    lines = [f"{'':<36}{'score':<11}{'from':>7}{'to':>7}{'':>7}   over clips, logs, towns; t, wild; p"]
    for who, families, seeds, before, after in ROWS:
        sides = [
            [clips[f"{family}-{what}-{seed}"] for family in families for seed in seeds] for what in (before, after)
        ]
        found = compare(sides[0], sides[1], CompareSettings(a="", b=""))
        for score in SCORES:
            one, town = found[score]["clip"], found[score]["town"]
            spans = [*((each.low, each.high) for each in found[score].values()), town.student, town.wild]
            said = "   ".join(f"{100 * low:+.1f} .. {100 * high:+.1f}" for low, high in spans)
            scores = f"{100 * one.a:7.1f}{100 * one.b:7.1f}{100 * one.difference:+7.1f}"
            lines.append(f"{who:<36}{score[0]:<11}{scores}   {said}   {town.p:.2g}")
    return lines


if __name__ == "__main__":
    print("\n".join(headline(read_frames(KEPT))))
