"""What many drives add up to: shares and rates with intervals over clips, logs or towns, and what pictures change."""

import csv
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from planners.drive.starts import LOGGED
from planners.evaluation.bootstrap import LEVELS, Interval, cluster_labels_by_level, paired_interval
from tasks.world.arrays import Array

Row = Mapping[str, Any]  # of the table `drives`
M_PER_KM = 1000.0
SHARES: Mapping[str, Callable[[Row], float]] = {  # of each drive, 0 .. 1
    "score": lambda row: float(row["score"]),
    "progress": lambda row: min(float(row["progress_rel_to_total"]), 1.0),
    "collision_at_fault": lambda row: float(row["collision_at_fault"]),
    "offroad": lambda row: float(row["offroad"]),
    "left_corridor": lambda row: float(row["left_corridor_laterally"]),
}


@dataclass(frozen=True)
class DriveLine:
    """All drives of one planner that saw the same, from starts of one kind."""

    planner: str
    pictures: str
    start: str  # logged, perturbed
    drives: int
    clips: int
    level: str  # of LEVELS, that the intervals are over: the highest of which there are two
    shares: Mapping[str, Interval]  # of SHARES: mean (`b`), low, high
    km: float
    incidents: int  # drives with a collision at fault or off the road
    incidents_per_km: Interval

    @property
    def m_between_incidents(self) -> tuple[float, float, float]:
        """Metres driven for each incident, up to the first of a drive, and bounds; infinite where there was none."""
        rate = self.incidents_per_km
        with np.errstate(divide="ignore"):
            mean, high, low = M_PER_KM / np.maximum(np.array([rate.b, rate.low, rate.high]), 0.0)
        return float(mean), float(low), float(high)


def start_kind(row: Row) -> str:
    """logged or perturbed."""
    return "logged" if row["start"] == LOGGED else "perturbed"


def summarise_drives(rows: Sequence[Row], confidence: float = 0.95) -> list[DriveLine]:
    """A line for each planner, kind of pictures and kind of start, in the order in which they first come."""
    groups: dict[tuple[str, str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["planner"], row["pictures"], start_kind(row)), []).append(row)
    return [_line(*key, group, confidence) for key, group in groups.items()]


def _line(planner: str, pictures: str, start: str, rows: Sequence[Row], confidence: float) -> DriveLine:
    level, clusters = coarsest_clusters(rows)
    km = np.maximum([row["dist_traveled_m"] / M_PER_KM for row in rows], 1e-9)  # a drive that stands weighs nothing
    failed = np.array([row["offroad_or_collision_at_fault"] for row in rows], dtype=float)

    def interval(values: Array, weights: Array | None = None) -> Interval:
        return _mean(values, clusters, confidence, weights)

    return DriveLine(
        planner=planner,
        pictures=pictures,
        start=start,
        drives=len(rows),
        clips=len({row["clip_id"] for row in rows}),
        level=level,
        shares={name: interval(np.array([share(row) for row in rows])) for name, share in SHARES.items()},
        km=float(km.sum()),
        incidents=int(failed.sum()),
        incidents_per_km=interval(failed / km, km),
    )


def _mean(values: Array, clusters: Sequence[str], confidence: float, weights: Array | None = None) -> Interval:
    counts = np.ones_like(values) if weights is None else weights
    return paired_interval(
        np.zeros((1, len(values))),
        values[None],
        weights=(counts[None], counts[None]),
        clusters=clusters,
        confidence=confidence,
    )


def coarsest_clusters(rows: Sequence[Row]) -> tuple[str, Sequence[str]]:
    """Of clips that share a log or a town, whole ones are taken: no independent draws else (planners.evaluation)."""
    known = cluster_labels_by_level([row["clip_id"] for row in rows], [row["log_id"] for row in rows])
    several = [level for level in LEVELS if level in known and len(set(known[level])) > 1]
    level = several[-1] if several else "clip"
    return level, known[level]


@dataclass(frozen=True)
class PictureSourceEffect:
    """What one planner's drives change where it sees the engine's pictures in place of the painter's."""

    planner: str
    start: str
    drives: int  # pairs
    level: str
    shares: Mapping[str, Interval]  # b (engine) - a (truth)


def picture_source_effects(rows: Sequence[Row], confidence: float = 0.95) -> list[PictureSourceEffect]:
    """Over the starts that were driven with both. None where there are none."""
    both: dict[tuple[str, str], dict[tuple[str, int], dict[str, Row]]] = {}
    for row in rows:
        pairs = both.setdefault((row["planner"], start_kind(row)), {})
        pairs.setdefault((row["clip_id"], row["start"]), {})[row["pictures"]] = row
    found = []
    for (planner, start), pairs in both.items():
        twice = [pair for pair in pairs.values() if {"truth", "engine"} <= pair.keys()]
        if not twice:
            continue
        level, clusters = coarsest_clusters([pair["truth"] for pair in twice])
        shares = {
            name: paired_interval(
                np.array([[share(pair["truth"]) for pair in twice]]),
                np.array([[share(pair["engine"]) for pair in twice]]),
                clusters=clusters,
                confidence=confidence,
            )
            for name, share in SHARES.items()
        }
        found.append(PictureSourceEffect(planner, start, len(twice), level, shares))
    return found


def summary_text(lines: Sequence[DriveLine], differences: Sequence[PictureSourceEffect], confidence: float) -> str:
    """Tables to be printed, in percent."""
    head = [
        "planner",
        "pictures",
        "start",
        "drives",
        *(f"{name} %" for name in lines[0].shares),
        "km",
        "incidents",
        "m between",
    ]
    rows = [head]
    for line in lines:
        shares = [_bounded(one.b, one, 100.0) for one in line.shares.values()]
        mean, low, high = line.m_between_incidents
        interval = f"[{_known(low, '.0f')}, {_known(high, '.0f')}]"
        between = f"{mean:.0f} {interval}" if line.incidents else f"> {M_PER_KM * line.km:.0f}"
        facts = [line.planner, line.pictures, line.start, str(line.drives)]
        rows.append([*facts, *shares, f"{line.km:.2f}", str(line.incidents), between])
    told = _table(rows)
    if differences:
        rows = [["engine - truth", "start", "pairs", *(f"{name} %" for name in differences[0].shares)]]
        for one in differences:
            shares = [_bounded(share.difference, share, 100.0, "+") for share in one.shares.values()]
            rows.append([one.planner, one.start, str(one.drives), *shares])
        told += ["", *_table(rows)]
    levels = ", ".join(dict.fromkeys(line.level for line in lines))
    told.append(f"[{100 * confidence:g} % intervals over {levels}s; -: from one alone nothing can be drawn]")
    return "\n".join(told)


def _bounded(value: float, one: Interval, scale: float, sign: str = "") -> str:
    low, high = (_known(scale * end, f"{sign}.1f") for end in (one.low, one.high))
    return f"{_known(scale * value, f'{sign}.1f')} [{low}, {high}]"


def _known(value: float, form: str) -> str:
    return "-" if math.isnan(value) else f"{value:{form}}"


def _table(rows: Sequence[Sequence[str]]) -> list[str]:
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths)).rstrip() for row in rows]


def write_summary(folder: Path, lines: Sequence[DriveLine], differences: Iterable[PictureSourceEffect]) -> None:
    """`summary.csv`, and `differences.csv` where there are any."""
    rows: list[dict[str, object]] = []
    for line in lines:
        mean, low, high = line.m_between_incidents
        facts = {name: getattr(line, name) for name in ("planner", "pictures", "start", "drives", "clips", "level")}
        between = {"m_between_incidents": mean, "m_between_incidents_low": low, "m_between_incidents_high": high}
        rows.append(facts | _columns(line.shares, "b") | {"km": line.km, "incidents": line.incidents} | between)
    _write_csv(folder / "summary.csv", rows)
    apart: list[dict[str, object]] = [
        {"planner": one.planner, "start": one.start, "pairs": one.drives, "level": one.level}
        | _columns(one.shares, "difference")
        for one in differences
    ]
    if apart:
        _write_csv(folder / "differences.csv", apart)


def _columns(shares: Mapping[str, Interval], middle: str) -> dict[str, object]:
    found: dict[str, object] = {}
    for name, one in shares.items():
        found |= {name: getattr(one, middle), f"{name}_low": one.low, f"{name}_high": one.high}
    return found


def _write_csv(path: Path, rows: Sequence[Mapping[str, object]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, list(rows[0]))
        table.writeheader()
        table.writerows(rows)
