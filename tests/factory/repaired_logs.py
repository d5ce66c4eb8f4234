"""A reader whose logs were repaired: clips=custom clips._target_=tests.factory.repaired_logs.RepairedReader."""

import math
from dataclasses import replace
from pathlib import Path

from examples.csv_logs import CsvReader
from factory.readers.logs import WholeLog
from tasks.world.repair.records import LEFT_OUT, Repair

GAP = Repair("gap", "car", 1.3, "no box", "a box between those of 1.2 s and 1.4 s")
SECOND_GAP = replace(GAP, time_s=3.1)
IMPOSSIBLE = Repair("impossible", "van", 4.0, "length -1.30 m", LEFT_OUT)
CROSSING = Repair("crossing", "pc_1", math.nan, "a bow tie of 62 m2", "a ring of 429 m2")
LATE = Repair("twice", "bus", 11.9, "two boxes", "one box")  # behind a log's first window
REPAIRS = (GAP, SECOND_GAP, IMPOSSIBLE, CROSSING, LATE)
WHOLE = "whole"  # name of logs of which nothing was


class RepairedReader(CsvReader):
    """As that of examples/csv_logs; each log but those called WHOLE has REPAIRS."""

    def load(self, path: Path) -> WholeLog:
        """Raises BadClip."""
        return replace(super().load(path), repairs=() if path.name == WHOLE else REPAIRS)
