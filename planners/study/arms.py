"""What the arms of an experiment come to in closed loop, and beside the bounds: every number with an interval.

An arm is one set-up's trainings with several seeds. All are held against each other on the drives that everybody has
made; intervals are over whole towns, or whole logs or clips where there are no two towns, and over pairs of seeds.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from factory.exits import Failed, Stopped
from planners.drive.drive import drive_all, read_drives
from planners.drive.settings import DriveSettings, settings_of
from planners.drive.summary import M_PER_KM, SHARES, coarsest_clusters, start_kind
from planners.evaluation.aggregation import BOUNDS, score_column, scores_in_percent, write_csv
from planners.evaluation.bootstrap import Interval, paired_interval
from planners.evaluation.compare import CompareSettings, compare, difference_columns
from planners.study.report import FRAMES, markdown_table, read_study
from planners.study.setups import Setup
from planners.training.many import SweepResources, Training
from tasks.world.arrays import Array

Row = Mapping[str, Any]
Start = tuple[str, int]  # clip, number of the start
KINDS = ("logged", "perturbed")
STAGES = (("stage_two", "none"), ("final", "unfiltered"))  # of the benchmark, as the paper's tables have them
DRIVES = "drives"
RULES = CompareSettings(a="", b="")  # draws, confidence and seed as `python -m planners compare` has them


PER_KM = "incidents_per_km"
DRIVEN = (*SHARES, PER_KM)  # measures, the first of them the one that arms are judged by


@dataclass(frozen=True)
class HeldAgainst:
    """One arm beside another."""

    part: str
    arm: str
    reference: str


@dataclass(frozen=True)
class ArmDrives:
    """Drives of arms and bounds from the same starts of one kind."""

    kind: str  # of KINDS
    rows: Mapping[str, Sequence[Sequence[Row]]]  # arm or bound -> seed -> start
    level: str  # that intervals draw: town, else log, else clip
    clusters: Sequence[str]  # of each start

    def values(self, who: str, measure: str) -> tuple[Array, Array]:
        """(seeds, starts) of a measure, and what each counts in a mean."""
        if measure != PER_KM:
            found = np.array([[100.0 * SHARES[measure](row) for row in rows] for rows in self.rows[who]])
            return found, np.ones_like(found)
        km = np.array([[max(row["dist_traveled_m"] / M_PER_KM, 1e-9) for row in rows] for rows in self.rows[who]])
        return np.array([[row["offroad_or_collision_at_fault"] for row in rows] for rows in self.rows[who]]) / km, km

    def difference(self, who: str, reference: str | None, measure: str) -> Interval:
        """Of a measure from the reference's; None: from nothing."""
        b, weight_b = self.values(who, measure)
        a, weight_a = (np.zeros_like(b), weight_b) if reference is None else self.values(reference, measure)
        return paired_interval(a, b, weights=(weight_a, weight_b), clusters=self.clusters)


def drive_settings(arms: Sequence[Training], out: str, drives: str) -> DriveSettings:
    """Of these trainings and the bounds. Raises ConfigError."""
    named = ",".join(f"{one.label}: '{one.spec(Path(out))}'" for one in arms)
    return settings_of([*drives.split(), f"planners={{{named}}}", f"out={Path(out) / DRIVES}"])


def drive_arms(arms: Sequence[Training], out: str, drives: str, resources: SweepResources) -> Stopped | None:
    """Drive what is not driven, seed by seed; why it is not all. Raises Stopped where it is interrupted, Failed for
    drives that could not be made."""
    for seed, batch in groupby(arms, key=lambda one: one.facts["seed"]):
        chosen = drive_settings(list(batch), out, drives)
        if resources.left_s == 0.0:
            if read_drives(chosen)[1]:
                continue
            return Stopped(f"drives of seed {seed} and those behind it are not made: the same command goes on")
        _, failed = drive_all(chosen)
        if failed:
            raise Failed(
                f"{len(failed)} drives could not be made, the first of clip {failed[0].clip_id}: {failed[0].why}"
            )
    return None


def read_arm_drives(arms: Sequence[Training], out: str, drives: str) -> list[ArmDrives]:
    """What is driven so far, by kind of start: seeds with which every arm has driven, starts that all have made."""
    trained = [one for one in arms if (Path(out) / "trainings" / one.label).is_dir()]
    rows = read_drives(drive_settings(trained, out, drives))[0] if trained else []
    found = []
    for kind in KINDS:
        by_label: dict[str, dict[Start, Row]] = {}
        for row in rows:
            if start_kind(row) == kind:
                by_label.setdefault(row["planner"], {})[row["clip_id"], row["start"]] = row
        if one := _paired(kind, by_label, [one.label for one in arms]):
            found.append(one)
    return found


def _paired(kind: str, by_label: Mapping[str, Mapping[Start, Row]], labels: Sequence[str]) -> ArmDrives | None:
    names = list(dict.fromkeys(label.rpartition("-")[0] for label in labels))
    seeds = sorted({label.rpartition("-")[2] for label in labels}, key=int)
    whole = [seed for seed in seeds if all(f"{name}-{seed}" in by_label for name in names)]
    sides = {name: [by_label[f"{name}-{seed}"] for seed in whole] for name in names}
    sides |= {name: [by_label[name]] for name in BOUNDS if name in by_label}
    every = [one for side in sides.values() for one in side]
    starts = sorted(set.intersection(*(set(one) for one in every))) if whole else []
    if not starts:
        return None
    level, clusters = coarsest_clusters([every[0][start] for start in starts])
    return ArmDrives(
        kind, {name: [[one[s] for s in starts] for one in side] for name, side in sides.items()}, level, clusters
    )


def arm_differences(found: Sequence[ArmDrives], pairs: Sequence[HeldAgainst]) -> list[dict[str, Any]]:
    """Rows of driving_differences.csv: pairs of arms, and each arm beside the bounds that drive."""
    arms = list(dict.fromkeys(one.arm for one in pairs) | dict.fromkeys(one.reference for one in pairs))
    rows = []
    for one in found:
        bounds = [name for name in ("constant_velocity", "pdm_closed") if name in one.rows]
        every = [*pairs, *(HeldAgainst(bound, arm, bound) for bound in bounds for arm in arms)]
        for pair in every:
            facts = {**vars(pair), "start": one.kind, "seeds": len(one.rows[pair.arm]), "level": one.level}
            rows += [facts | _bounds(name, one.difference(pair.arm, pair.reference, name)) for name in DRIVEN]
    return rows


def _bounds(measure: str, one: Interval) -> dict[str, Any]:
    return {"measure": measure, "difference": one.difference, "low": one.low, "high": one.high}


def against_bounds(report: Path, setups: Sequence[Setup], seeds: int) -> list[dict[str, Any]]:
    """Rows of bounds_held.csv: each arm on the benchmark, less constant velocity and PDM-Closed, in points of EPDMS."""
    clips = read_study(report / FRAMES).clips
    rows = []
    for bound in ("constant_velocity", "pdm_closed"):
        for setup in dict.fromkeys(setups):
            runs = [clips[label] for seed in range(seeds) if (label := setup.label_of(seed)) in clips]
            if not runs or bound not in clips:
                continue
            intervals = compare([clips[bound]], runs, RULES)
            for stage in STAGES:
                each = [scores_in_percent(run)[score_column(*stage)] for run in runs]
                facts = {"arm": setup.label, "reference": bound, "seeds": len(runs), "stage": stage[0]}
                rows.append(facts | {"epdms": float(np.mean(each))} | difference_columns(intervals.get(stage)))
    return rows


def write_arms(
    report: Path,
    found: Sequence[ArmDrives],
    differences: Sequence[Mapping[str, Any]],
    held: Sequence[Mapping[str, Any]],
) -> None:
    """driving.csv, driving_differences.csv, bounds_held.csv and arms.md."""
    rows = []
    for one in found:
        for name, drives in one.rows.items():
            facts = {"arm": name, "start": one.kind, "seeds": len(drives), "starts": len(drives[0]), "level": one.level}
            for measure in DRIVEN:
                mean = one.difference(name, None, measure)
                rows.append(facts | {"measure": measure, "mean": mean.b, "low": mean.low, "high": mean.high})
    write_csv(report / "driving.csv", rows)
    write_csv(report / "driving_differences.csv", differences)
    if held:
        write_csv(report / "bounds_held.csv", held)
    (report / "arms.md").write_text(comparison_tables(found, differences, held) + "\n", encoding="utf-8")


def comparison_tables(
    found: Sequence[ArmDrives], differences: Sequence[Mapping[str, Any]], held: Sequence[Mapping[str, Any]]
) -> str:
    """Tables to be read: means of each arm and bound, then what is held against what."""
    lines: list[str] = []
    for one in found:
        seeds = max(len(drives) for drives in one.rows.values())
        n = len(next(iter(one.rows.values()))[0])
        lines += [f"## Driving from {one.kind} starts", ""]
        lines += [f"{n} starts, {seeds} seeds; 95 % intervals over {one.level}s.", ""]
        lines += markdown_table(["", *map(words_of, DRIVEN)], [[name, *_means(one, name)] for name in one.rows])
        mine = [row for row in differences if row["start"] == one.kind]
        pairs = list(dict.fromkeys((row["arm"], row["reference"]) for row in mine))
        at = {(row["arm"], row["reference"], row["measure"]): row for row in mine}
        body = [[f"{arm} - {other}", *(_apart(at[arm, other, name]) for name in DRIVEN)] for arm, other in pairs]
        lines += markdown_table(["", *map(words_of, DRIVEN)], body)
    if held:
        lines += [
            "## The benchmark beside the bounds",
            "",
            "EPDMS in percent; 95 % intervals over clips and towns.",
            "",
        ]
        lines += markdown_table(["", "stage", "EPDMS", "over clips", "over towns"], [_held(row) for row in held])
    return "\n".join(lines)


def words_of(measure: str) -> str:
    """A measure as a table's head."""
    return f"{measure.replace('_', ' ')}{'' if measure == PER_KM else ' %'}"


def _means(one: ArmDrives, name: str) -> list[str]:
    found = [one.difference(name, None, measure) for measure in DRIVEN]
    return [f"{mean.b:.1f} [{mean.low:.1f}, {mean.high:.1f}]" for mean in found]


def _apart(row: Mapping[str, Any]) -> str:
    bold = "**" if row["low"] > 0.0 or row["high"] < 0.0 else ""
    return f"{bold}{row['difference']:+.1f}{bold} [{row['low']:+.1f}, {row['high']:+.1f}]"


def _held(row: Mapping[str, Any]) -> list[str]:
    spans = [f"{row[low]:+.1f} .. {row[high]:+.1f}" if row[low] != "" else "" for low, high in _ENDS]
    return [
        f"{row['arm']} - {row['reference']}",
        row["stage"],
        f"{row['epdms']:.1f} ({row['difference']:+.1f})",
        *spans,
    ]


_ENDS = (("low", "high"), ("low_town", "high_town"))
