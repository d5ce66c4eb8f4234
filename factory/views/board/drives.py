"""Planners in closed loop, where `python -m planners drive` wrote its drives into the folder of the run.

Its table is read by the columns named here; what the command prints has intervals too, which stand in summary.csv.
"""

import threading
from collections.abc import Mapping, Sequence
from typing import Any

import pyarrow as pa

from factory.store.location import Location
from factory.store.schema import TableSpec
from factory.store.table import KeyedTable

FILMS = "films"  # folder below the run, <drive_id>.mp4
MOST_SHOWN = 200  # drives, those that failed first
_TEXTS = ("drive_id", "clip_id", "log_id", "planner", "pictures", "ended", "hit_kind", "film")
_NUMBERS = ("duration_s", "distance_m", "route_completed", "comfortable")
SCHEMA = pa.schema(
    [
        *((name, pa.string()) for name in _TEXTS),
        *((name, pa.float64()) for name in _NUMBERS),
        ("start", pa.int32()),  # -1: from the log
        ("off_road_events", pa.int32()),
        ("at_fault_collision", pa.bool_()),
    ]
)
Row = Mapping[str, Any]


class Drives:
    """The drives of one run, read again when some were committed."""

    def __init__(self, out: Location) -> None:
        self._out, self._lock = out, threading.Lock()
        self._table = KeyedTable(out.child("drives"), TableSpec("drives", SCHEMA, "drive_id"))
        self._seen: int | None = None
        self._rows: list[dict[str, Any]] = []

    def rows(self) -> Sequence[Row]:
        """All of them, in the order of their ids; none where nobody has driven."""
        with self._lock:
            self._table.refresh()
            if self._table.version != self._seen:
                self._rows = sorted(self._table.read().to_pylist(), key=lambda row: str(row["drive_id"]))
                self._seen = self._table.version
            return self._rows

    def film(self, drive_id: str) -> bytes | None:
        """The MP4 of a drive; None where it has none."""
        return self._out.read(f"{FILMS}/{drive_id}.mp4")


def drives_as_json(rows: Sequence[Row], with_films: bool = True) -> dict[str, Any]:
    """What GET /api/drives answers: a line for each planner, kind of pictures and of start; and drives one by one."""
    groups: dict[tuple[str, str, str], list[Row]] = {}
    for row in rows:
        start = "logged" if row["start"] < 0 else "perturbed"
        groups.setdefault((row["planner"], row["pictures"], start), []).append(row)
    listed = sorted(rows, key=lambda row: (-_failures(row), row["route_completed"], row["drive_id"]))[:MOST_SHOWN]
    facts = [name for name in SCHEMA.names if with_films or name != "film"]
    return {
        "total": len(rows),
        "lines": [_line(*key, group) for key, group in sorted(groups.items())],
        "drives": [{name: row[name] for name in facts} for row in listed],
    }


def _failures(row: Row) -> int:
    return int(row["off_road_events"]) + int(row["at_fault_collision"])


def _line(planner: str, pictures: str, start: str, rows: Sequence[Row]) -> dict[str, Any]:
    failures, metres = sum(map(_failures, rows)), sum(row["distance_m"] for row in rows)
    return {
        "planner": planner,
        "pictures": pictures,
        "start": start,
        "drives": len(rows),
        "route_completed": sum(row["route_completed"] for row in rows) / len(rows),
        "at_fault_collision": sum(row["at_fault_collision"] for row in rows) / len(rows),
        "off_road": sum(row["off_road_events"] > 0 for row in rows) / len(rows),
        "comfortable": sum(row["comfortable"] for row in rows) / len(rows),
        "km": metres / 1000.0,
        "failures": failures,
        "m_between_failures": metres / failures if failures else None,
    }
