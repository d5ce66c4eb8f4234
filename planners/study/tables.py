"""The study's comparisons as Markdown: a table for each part, to be read, or copied into a document."""

from collections.abc import Mapping, Sequence
from itertools import groupby
from textwrap import wrap
from typing import Any

from planners.evaluation.aggregation import HumanFilter, shown
from planners.evaluation.score_table import FILTERS_NOTE

Row = Mapping[str, Any]  # of comparisons.csv
INTERVALS = (
    "In brackets: the difference from what the setup is held against, its 95 % interval over clips and, of stage two "
    "and the final score, over logs and towns (paired bootstrap, with seeds); bold where zero lies outside of each."
)
CLAIMED = ("stage_two", "final")  # the stages whose intervals over logs and towns are shown too
TITLES = {"follow_ups": "follow-ups (plain mean)"}  # others: the stage's name


def markdown_of(rows: Sequence[Row], human_filter: HumanFilter) -> str:
    """EPDMS in percent; in brackets the difference from the reference with its intervals, bold where all exclude 0.

    The first interval is over clips. rows: those of comparisons.csv, a comparison's measures one after the other; of
    those with and without the human filter one is shown. A row that is itself a reference stands in front of what is
    held against it.
    """
    mine = [row for row in rows if row["human_filter"] in (human_filter, "none")]
    stages = [stage for stage in shown(human_filter) if any(row["stage"] == stage for row in mine)]
    titles = [TITLES.get(stage, stage.replace("_", " ")) for stage in stages]
    head = ("planner", "trained on", "equal", "seeds", *titles, "final of each seed")
    lines = [*wrap(f"Scores are {human_filter}: {FILTERS_NOTE[0]}; {FILTERS_NOTE[1]}.", 120), ""]
    lines += [*wrap(INTERVALS, 120), ""]
    for part, of_part in groupby(mine, key=lambda row: row["part"]):
        rows = list(of_part)
        lines += [f"## {part}", "", _line(head), _line(["---"] * len(head))]
        lines += [_line(_cells(rows[i : i + len(stages)])) for i in range(0, len(rows), len(stages))]
        lines.append("")
    return "\n".join(lines)


def _cells(stages: Sequence[Row]) -> list[str]:
    """Of the rows of one comparison."""
    one = stages[-1]
    facts = [f"`{one['planner']}`", words_of(one), one["budget"], str(one["seeds"])]
    return [*facts, *map(_score, stages), one["each"]]


def _score(row: Row) -> str:
    text = f"{row['epdms']:.1f}"
    if not row["reference"]:
        return text
    bold = "**" if is_clear(row) else ""
    said = [f"{bold}{row['difference']:+.1f}{bold}: {row['low']:+.1f} .. {row['high']:+.1f}"]
    if row["stage"] in CLAIMED:
        known = [level for level in ("log", "town") if row.get(f"low_{level}", "") != ""]
        said += [f"{level}s {row[f'low_{level}']:+.1f} .. {row[f'high_{level}']:+.1f}" for level in known]
    return f"{text} ({'; '.join(said)})"


def is_clear(row: Row) -> bool:
    """Whether zero lies outside of every interval of a row that has a reference: over clips, logs and towns."""
    known = [end for end in ("", "_log", "_town") if row.get(f"low{end}", "") != ""]
    return bool(known) and all(row[f"low{end}"] > 0.0 or row[f"high{end}"] < 0.0 for end in known)


def words_of(row: Row, counted: bool = True) -> str:
    """What a planner was trained on, in words; what is as usual is left out, and the rounds where not `counted`."""
    if row["data"] == "begin":
        return "other towns"
    rounds = "1 round" if row["rounds"] == 1 else f"{row['rounds']} rounds"
    said = ["real"] if row["rounds"] == 0 else [f"+ {row['data']}", rounds] if counted else [row["data"]]
    said += {"all": [], "real": ["rewards only"], "none": ["no imitation"]}[row["imitation"]]
    said += ["replayed traffic"] if row["traffic"] == "replay" else []
    said += [f"sim ratio {row['sim_ratio']}"] if row["sim_ratio"] != "natural" else []
    said += {"any": [], "low": ["low PSNR"], "high": ["high PSNR"]}[row["psnr"]]
    said += [f"{100.0 * row['real_share']:.0f} % of the real"] if row["real_share"] < 1.0 else []
    return ", ".join(said)


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"
