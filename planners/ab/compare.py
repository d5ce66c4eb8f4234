"""`python -m planners compare a=<run> b=<run>`: how two evaluated planners differ, with confidence intervals.

    python -m planners compare a=eval/ltf_real b=eval/ltf_sim
    python -m planners compare a=eval/ltf_real b=eval/ltf_sim drives=runs/drives
    python -m planners compare a=[eval/real_0,eval/real_1] b=[eval/sim_0,eval/sim_1] out=difference.csv
    python -m planners compare a=ltf_sim_navhard.csv.gz b=evaluations/ltf

A run is a folder that `python -m planners evaluate` made of one planner, or a table that NAVSIM's own scripts wrote
(`.csv`, `.csv.gz`), against which a folder stands with the tables that it has. Several runs of a side are trainings of
one planner with other seeds: clips and seeds are both drawn, pairs of seeds where both sides have equally many.

The last line is one sentence: the two-stage score of b and a, their difference, its interval over towns (logs or clips
where those are unknown), and whether zero lies outside. With drives= it goes on with the scene scores of drives in
closed loop (docs/driving.md).
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from factory.config.arguments import command
from factory.config.compose import ConfigError, compose, fill
from factory.store.location import Location
from planners.evaluation import navsim
from planners.evaluation.bootstrap import paired_interval
from planners.evaluation.compare import (
    CompareSettings,
    check_same_rules,
    compare,
    compare_tables,
    comparison_text,
    difference_sentence,
    read_runs,
    score_sentence,
    write_csv,
)
from planners.evaluation.score_rows import read_record
from tasks.reward.aggregate import COLUMNS

Record = Mapping[str, Any]  # of an evaluated planner


def drives_sentence(drives: str, a: Sequence[Record], b: Sequence[Record], settings: CompareSettings) -> str:
    """Of the scene scores of both sides' drives. Raises ConfigError where they drove not from equal starts."""
    from planners.drive.summary import coarsest_clusters  # with PyTorch
    from planners.drive.work import FACTS, open_drives

    driven: dict[str, dict[str, Any]] = {}
    for row in open_drives(Location.parse(drives)).read(FACTS).to_pylist():
        rules = json.loads(row["settings"]) | {"pdm": None}  # which PDM-Closed's own drives have beside the others'
        start = f"{row['clip_id']} {row['content_digest']} {row['start']:+d} {row['pictures']} {rules}"
        driven.setdefault(row["planner_digest"], {})[start] = row
    of = [driven.get(record["planner_digest"], {}) for record in (*a, *b)]
    if not of[0] or any(one.keys() != of[0].keys() for one in of):
        counts = ", ".join(f"{record['planner']} {len(one)}" for record, one in zip((*a, *b), of))
        raise ConfigError(
            f"drives={drives}: drives from the same starts are needed, there are of {counts}: let all of them drive "
            "into it by one `python -m planners drive planners=[...]`"
        )
    level, clusters = coarsest_clusters([of[0][start] for start in sorted(of[0])])
    scores = np.array([[one[start]["score"] for start in sorted(one)] for one in of])
    found = paired_interval(
        scores[: len(a)],
        scores[len(a) :],
        clusters=clusters,
        confidence=settings.confidence,
        draws=settings.draws,
        seed=settings.seed,
    )
    return difference_sentence("scene scores driven", found, level, settings.confidence, " %")


@command("compare", CompareSettings)
def main(argv: Sequence[str]) -> None:
    """The command."""
    settings = fill(CompareSettings, compose("compare", argv, CompareSettings), "compare")
    if settings.column not in COLUMNS:
        raise ConfigError(f"compare.column={settings.column}: one of {', '.join(COLUMNS)}")
    a, b = ([side] if isinstance(side, str) else side for side in (settings.a, settings.b))
    if of_tables := any(run.endswith(navsim.SUFFIXES) for run in (*a, *b)):
        if settings.drives is not None:
            raise ConfigError("drives= goes with folders of `python -m planners evaluate`, not with tables of NAVSIM's")
        found = compare_tables(a, b, settings)
    else:
        of_a, of_b = read_runs(a), read_runs(b)
        check_same_rules([*a, *b])
        found = compare(of_a, of_b, settings)
    sentence = score_sentence(found, settings)
    if settings.drives is not None:
        first, second = ([read_record(Path(run)) for run in side] for side in (a, b))
        sentence += f"; {drives_sentence(settings.drives, first, second, settings)}"
    if settings.out is not None:
        Path(settings.out).parent.mkdir(parents=True, exist_ok=True)
        write_csv(Path(settings.out), found)
    print(comparison_text(found, settings.confidence, of_tables))
    print(f"{_names(b)} against {_names(a)}: {sentence}")


def _names(runs: Sequence[str]) -> str:
    return ", ".join(Path(run).name for run in runs)
