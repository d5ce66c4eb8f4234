"""Start states where a planner drove itself: `python experiments/exploring/starts.py <drives> <planner> <file>`.

<drives> is the `out` of `planners drive`. Of each drive from the log that lasted 4 s its first 4 s are the way to a
start. Drives that then left the road or came into a collision at fault stand first. The file is
for `python -m factory.run perturb.starts=`.
"""

import sys

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from factory.store.location import Location
from planners.drive.starts import LOGGED
from planners.drive.work import open_drives
from tasks.world.clip import HORIZON_STEPS
from tasks.world.frames import HEADING, to_local

COLUMNS = ("clip_id", "planner", "start", "offroad_or_collision_at_fault", "ego_states")


def starts_of(drives: pa.Table, planner: str) -> pa.Table:
    """clip_id and trajectory (40, 3), in the frame of the ego at T."""
    found = []
    for row in drives.to_pylist():
        poses = np.array(row["ego_states"])[:, : HEADING + 1]
        if row["planner"] == planner and row["start"] == LOGGED and len(poses) > HORIZON_STEPS:
            led = to_local(poses[0], poses[1 : HORIZON_STEPS + 1])
            found.append((-row["offroad_or_collision_at_fault"], row["clip_id"], led.tolist()))
    found.sort()
    return pa.table({"clip_id": [one[1] for one in found], "trajectory": [one[2] for one in found]})


if __name__ == "__main__":
    folder, planner, file = sys.argv[1:]
    starts = starts_of(open_drives(Location.parse(folder)).read(COLUMNS), planner)
    pq.write_table(starts, file)
    print(f"{file}: {len(starts)} starts")
