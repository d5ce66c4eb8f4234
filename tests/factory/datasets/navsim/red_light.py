"""Logs of one straight road whose connector has a light, and plans that pass it or wait, for scores by two hands.

`python -m tests.factory.datasets.navsim.red_light <folder>` writes the logs, the four cities and plans.npz, from which
NAVSIM's own code scores the plans at the fourth frame of each log.
"""

import sys
from pathlib import Path
from typing import Any

import numpy as np

from tests.factory.datasets.navsim.geopackage_writer import stub_rows, write_root
from tests.factory.datasets.navsim.small import CITY, road_frames, write_log

CONNECTOR = 3  # 50 to 60 m along the road; at T the ego is at 22 m, drives at 8 m/s, and its front is 4 m ahead
RED = {  # log -> frames at which its light is red; the steady plan enters at 3.0 s, the sixth frame after T
    "2021.06.14.18.00.00_veh-51_00000_00100": range(0),  # never
    "2021.06.14.18.00.00_veh-51_00200_00300": range(20),  # always
    "2021.06.14.18.00.00_veh-51_00400_00500": range(9),  # until the plan is there
    "2021.06.14.18.00.00_veh-51_00600_00700": range(9, 20),  # from then on
    "2021.06.14.18.00.00_veh-51_00800_00900": range(10, 20),  # after it has entered
}


def plans() -> np.ndarray:
    """(4, 40, 3) steady 8 m/s; braking to a stop before the light; 10 m/s; slowing down to pass a second later."""
    t = 0.1 * np.arange(1, 41)
    braking = np.where(t < 3.5, 8.0 * t - 0.5 * (8.0 / 3.5) * t**2, 14.0)
    ahead = np.stack([8.0 * t, braking, 10.0 * t, 6.5 * t])
    return np.stack([ahead, 0.0 * ahead, 0.0 * ahead], -1).astype(np.float32)


def frames_of(name: str) -> list[dict[str, Any]]:
    """A log's frames."""
    frames = road_frames(name)
    for k, frame in enumerate(frames):
        frame["traffic_lights"] = [(CONNECTOR, k in RED[name])]
    return frames


def write(root: Path) -> None:
    """The logs below navsim_logs/mini."""
    for name in RED:
        write_log(root, frames_of(name))


if __name__ == "__main__":
    into = Path(sys.argv[1])
    write(into)
    write_root(into / "maps", CITY, stub_rows())
    np.savez(into / "plans.npz", plans=plans(), tokens=[frames_of(name)[3]["token"] for name in RED])
