"""What a run's accepted labels are like, told from its files: `python -m experiments.experts.check runs/av2 [LOG ...]`

Nothing of the factory's or the reward's code judges here: shards are read as tables, bodies and roads are polygons, and
speeds are differences of the labels' positions. With LOGs: of these alone. A line for each expert.
"""

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from deltalake import DeltaTable
from numpy.typing import NDArray

Array = NDArray[np.float64]

LENGTH_M, WIDTH_M, REAR_AXLE_TO_CENTER_M = 5.176, 2.297, 1.461  # nuPlan's Pacifica, for which NAVSIM scores
NOW = 15  # of an agent's steps
STEP_S = 0.1
NEAR_M = 15.0  # what lies farther from the rear axle cannot be met
GRAZE_M = 0.1  # boxes are annotated by hand: the ego's is smaller by this on each side
OFF_ROAD_M2 = 0.5  # of its box
ON_LANE_M = 0.5  # of its rear axle at the label's end from a lane of the route
AT_LOG_M, AT_LOG_DEG, AT_LOG_MPS = 2.0, 10.0, 5.0
READ = [
    *("expert", "clip_id", "log_id", "clip_start_s", "candidate_index", "now_pose", "parent_states"),
    *("label_10hz", "label_2hz", "off_log_end", "off_log_most", "agent_kinds", "agent_boxes", "agent_valid"),
    *("drivable_rings", "lane_ids", "lane_polygons", "route_lane_ids"),
]


@dataclass(frozen=True)
class Label:
    """What is measured of one."""

    met: tuple[str, ...]  # kinds of those whose box the ego's meets
    off_road_m2: float  # of its box, at most
    on_route: bool  # where it ends
    at_log: bool | None  # at its end, as its row says; None: the log's own
    jerk_mps3: float  # along, at most
    yaw_rate_radps: float  # at most
    between_rates_m: float  # its 2 Hz poses from those at 10 Hz, at most


def measured(row: Mapping[str, Any]) -> Label:
    """Of a row of `samples` with the columns READ."""
    label, coarse = (np.asarray(row[name], np.float64) for name in ("label_10hz", "label_2hz"))
    path = np.concatenate([np.zeros((1, 3)), label])
    lanes = {name: shapely.Polygon(ring) for name, ring in zip(row["lane_ids"], row["lane_polygons"])}
    road = shapely.union_all([*lanes.values(), *(shapely.Polygon(ring) for ring in row["drivable_rings"])])
    end, off = shapely.Point(label[-1, :2]), row["off_log_end"]
    at_log = off and (off[0] <= AT_LOG_M and np.degrees(off[1]) <= AT_LOG_DEG and off[2] <= AT_LOG_MPS)
    return Label(
        met=_met(row, path),
        off_road_m2=max(float(body(pose).difference(road).area) for pose in path[::5]),
        on_route=any(lanes[name].distance(end) <= ON_LANE_M for name in row["route_lane_ids"] if name in lanes),
        at_log=None if at_log is None else bool(at_log),
        jerk_mps3=float(np.abs(np.diff(_speeds(path), n=2)).max()) / STEP_S**2,
        yaw_rate_radps=float(np.abs(np.diff(np.unwrap(path[:, 2]))).max()) / STEP_S,
        between_rates_m=float(np.abs(label[4::5] - coarse).max()),
    )


def _speeds(path: Array) -> Array:
    """(T - 1,) m/s along the heading of poses (T, 3)."""
    step, heading = np.diff(path[:, :2], axis=0), path[1:, 2]
    return np.asarray((step[:, 0] * np.cos(heading) + step[:, 1] * np.sin(heading)) / STEP_S)


def _met(row: Mapping[str, Any], path: Array) -> tuple[str, ...]:
    boxes, valid = np.asarray(row["agent_boxes"], np.float64), np.asarray(row["agent_valid"], bool)
    met = []
    for kind, track, there in zip(row["agent_kinds"], boxes, valid):
        steps = [
            k for k in range(len(path)) if there[NOW + k] and np.hypot(*(track[NOW + k, :2] - path[k, :2])) < NEAR_M
        ]
        if any(body(path[k], GRAZE_M).intersects(box(*track[NOW + k])) for k in steps):
            met.append(kind)
    return tuple(met)


def box(x: float, y: float, heading: float, length: float, width: float) -> shapely.Polygon:
    """Around its centre."""
    corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * [length / 2.0, width / 2.0]
    c, s = np.cos(heading), np.sin(heading)
    return shapely.Polygon(corners @ np.array([[c, s], [-s, c]]) + [x, y])


def body(pose: Array, smaller_m: float = 0.0) -> shapely.Polygon:
    """The ego's box at a pose (3,) of its rear axle."""
    center = pose[:2] + REAR_AXLE_TO_CENTER_M * np.array([np.cos(pose[2]), np.sin(pose[2])])
    return box(*center, pose[2], LENGTH_M - 2.0 * smaller_m, WIDTH_M - 2.0 * smaller_m)


def off_the_log(rows: Sequence[Mapping[str, Any]]) -> tuple[Array, Array]:
    """(N, 3) m, rad, m/s: what rows say of their labels' ends, and what the windows of their logs 4 s later make of it.

    Such a window's logged ego at T+H is that of T+2H. Labels near the end of their log have none and are left out.
    """
    logged = {(row["log_id"], round(row["clip_start_s"], 1)): np.asarray(row["parent_states"])[1] for row in rows}
    said, found = [], []
    for row in rows:
        state = logged.get((row["log_id"], round(row["clip_start_s"] + 4.0, 1)))
        if state is None or row["off_log_end"] is None:
            continue
        (x, y, turn), label = row["now_pose"], np.asarray(row["label_10hz"], np.float64)
        c, s = np.cos(turn), np.sin(turn)
        metres = np.hypot(*(np.array([x, y]) + np.array([[c, -s], [s, c]]) @ label[-1, :2] - state[:2]))
        off = turn + label[-1, 2] - state[2]
        found.append([metres, abs(np.arctan2(np.sin(off), np.cos(off))), abs(_speeds(label[-2:])[0] - state[3])])
        said.append(row["off_log_end"])
    return np.asarray(said), np.asarray(found)


def rows_of(out: str, logs: Sequence[str] = ()) -> list[dict[str, Any]]:
    """A run's samples, or those of some logs, whose names may be cut short."""
    rows: list[dict[str, Any]] = DeltaTable(f"{out}/samples").to_pyarrow_table(columns=READ).to_pylist()
    return [row for row in rows if not logs or row["log_id"].startswith(tuple(logs))]


HEADS = ["clips", "labels", "meet somebody", "off the road", "end off the route"]
HEADS += ["end at the log", "jerk [m/s3]", "yaw rate [rad/s]", "2 Hz off 10 Hz [m]"]


def cells_of(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Of an expert's line, as HEADS says; of the last three the most."""
    labels = [measured(row) for row in rows]
    clips = len({row["clip_id"] for row in rows})
    human = rows[0]["candidate_index"] < 0
    counts = [
        sum(bool(label.met) for label in labels),
        sum(label.off_road_m2 > OFF_ROAD_M2 for label in labels),
        sum(not label.on_route for label in labels),
    ]
    most = [max(label.jerk_mps3 for label in labels), max(label.yaw_rate_radps for label in labels)]
    return [
        *map(str, (clips, len(labels), *counts)),
        "" if human else str(sum(bool(label.at_log) for label in labels)),
        *(f"{value:.2g}" for value in (*most, max(label.between_rates_m for label in labels))),
    ]


def main(words: Sequence[str]) -> None:
    """Prints the table of a run."""
    out, *logs = words
    rows = rows_of(out, logs)
    print("| expert | " + " | ".join(HEADS) + " |", "|" + "---|" * (1 + len(HEADS)), sep="\n")
    for expert in sorted({row["expert"] for row in rows}):
        cells = cells_of([row for row in rows if row["expert"] == expert])
        print("| " + " | ".join([expert, *cells]) + " |")


if __name__ == "__main__":
    main(sys.argv[1:])
