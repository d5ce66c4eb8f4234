"""A reader: logs as two CSV files and a JSON map of one's own.

    python -m examples.csv_logs /tmp/logs          writes one such log, to have something to read
    python -m factory.run clips=custom clips._target_=examples.csv_logs.CsvReader +clips.root=/tmp/logs \
        experts=[pdm_closed,human] out=/tmp/samples

    <log>/ego.csv       t,x,y,heading,speed                             10 Hz; m, rad, m/s, world frame
    <log>/agents.csv    t,track,kind,x,y,heading,speed,length,width     the same instants, where it was seen
    <log>/map.json      {"lanes": {id: {left, right, successors, left_neighbor, right_neighbor, junction}},
                         "drivable": [ring, ...]}                       boundaries and rings are lists of [x, y]

`LogReader` finds the windows, cuts, validates, splits and reports. What a clip must hold: docs/extend.md.
"""

import csv
import hashlib
import json
import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from factory.readers.base import BadClip
from factory.readers.logs import LoggedDrive, LogReader, WholeLog, WindowSensors, route_of_drive
from tasks.world.clip import STEP_S, AgentKind, AgentTracks
from tasks.world.frames import AX, EGO_STATE_SIZE, HEADING, VX, YAW_RATE, X, Y
from tasks.world.road_map import (
    NO_LIGHTS,
    Lane,
    MapLayer,
    MapPolygon,
    RoadMap,
    centerline_from_boundaries,
    ring_from_boundaries,
    roadblocks_of,
)

HEIGHT_M = 1.6  # of every box: the files do not tell


class CsvReader(LogReader[WholeLog]):
    """Clips of the folders under `root`."""

    data_set = "csv"

    def logs(self) -> Mapping[str, Path]:
        """Every folder that holds an ego.csv."""
        return {path.parent.name: path.parent for path in sorted(self.root.glob("*/ego.csv"))}

    def drive(self, path: Path) -> LoggedDrive:
        """Raises BadClip."""
        ego = numbers(path / "ego.csv", ("t", "x", "y", "heading", "speed"))
        states = np.zeros((len(ego), EGO_STATE_SIZE))
        states[:, [X, Y, HEADING, VX]] = ego[:, 1:]
        states[:, AX] = np.gradient(ego[:, 4], STEP_S)
        states[:, YAW_RATE] = np.gradient(np.unwrap(ego[:, 3]), STEP_S)
        return LoggedDrive(states, agents_of(path / "agents.csv", ego[:, 0]), np.zeros(len(ego), dtype=np.int64))

    def load(self, path: Path) -> WholeLog:
        """Raises BadClip."""
        drive, road_map = self.drive(path), map_of(path / "map.json")
        read = b"".join((path / name).read_bytes() for name in ("ego.csv", "agents.csv", "map.json"))
        return WholeLog(
            file=str(path),
            ego_states=drive.ego_states,
            agents=drive.agents,
            road_map=road_map,
            route=route_of_drive(road_map, drive.ego_states[:, : HEADING + 1], str(path / "map.json"), "lanes"),
            lights=NO_LIGHTS,
            licence="yours",
            content_digest=hashlib.sha256(read).hexdigest(),
        )

    def recorded(self, log: WholeLog, start: int, stop: int) -> WindowSensors:
        """The ego's pose in space: level ground, no cameras."""
        x, y, heading = log.ego_states[start:stop, : HEADING + 1].T
        poses = np.tile(np.eye(4), (stop - start, 1, 1))
        poses[:, 0, 0] = poses[:, 1, 1] = np.cos(heading)
        poses[:, 1, 0], poses[:, 0, 1] = np.sin(heading), -np.sin(heading)
        poses[:, 0, 3], poses[:, 1, 3] = x, y
        return WindowSensors(poses)


def rows_of(path: Path) -> list[dict[str, str]]:
    """The lines of a CSV file by the names in its first. Raises BadClip where there is none."""
    try:
        with path.open(newline="") as file:
            return list(csv.DictReader(file))
    except OSError as error:
        raise BadClip(str(path), "file", str(error.strerror)) from error


def numbers(path: Path, columns: tuple[str, ...]) -> np.ndarray:
    """(S, C) float64. Raises BadClip naming the column that is missing or holds no numbers."""
    rows = rows_of(path)
    found = np.zeros((len(rows), len(columns)))
    for i, column in enumerate(columns):
        try:
            found[:, i] = [float(row[column]) for row in rows]
        except (KeyError, ValueError) as error:
            raise BadClip(str(path), column, f"expected a column of numbers: {error}") from error
    return found


def agents_of(path: Path, times: np.ndarray) -> AgentTracks:
    """The tracks at `times` (S,). Raises BadClip."""
    rows = rows_of(path)
    of_row = numbers(path, ("t", "x", "y", "heading", "speed", "length", "width"))
    tracks = sorted({row["track"] for row in rows})
    kinds = {row["track"]: row["kind"] for row in rows}
    boxes = np.full((len(times), len(tracks), 5), np.nan)
    velocities = np.full((len(times), len(tracks), 2), np.nan)
    for row, (t, x, y, heading, speed, length, width) in zip(rows, of_row):
        step, track = round((t - times[0]) / STEP_S), tracks.index(row["track"])
        boxes[step, track] = x, y, heading, length, width
        velocities[step, track] = speed * np.cos(heading), speed * np.sin(heading)
    valid = np.isfinite(boxes[..., 0])
    return AgentTracks(
        track_ids=tuple(tracks),
        kinds=tuple(AgentKind(kinds[track]) for track in tracks),
        boxes=boxes,
        velocities=velocities,
        valid=valid,
        center_z=np.where(valid, HEIGHT_M / 2.0, np.nan),
        heights=np.full(len(tracks), HEIGHT_M),
    )


def map_of(path: Path) -> RoadMap:
    """The map of a log: rings and centrelines from boundaries, roadblocks from the graph. Raises BadClip."""
    try:
        told = json.loads(path.read_text())
        lanes = {lane_id: lane_of(lane_id, lane) for lane_id, lane in told["lanes"].items()}
        rings = [np.array(ring, dtype=np.float64) for ring in told["drivable"]]
    except (OSError, ValueError, KeyError) as error:
        raise BadClip(str(path), "map", repr(error)) from error
    areas = tuple(MapPolygon(f"da_{i}", MapLayer.DRIVABLE_AREA, ring) for i, ring in enumerate(rings))
    return RoadMap(lanes=lanes, drivable_areas=areas, roadblock_of=roadblocks_of(lanes))


def lane_of(lane_id: str, told: Mapping[str, object]) -> Lane:
    """Raises KeyError without boundaries."""
    left, right = (np.array(told[side], dtype=np.float64) for side in ("left", "right"))
    return Lane(
        lane_id=lane_id,
        ring=ring_from_boundaries(left, right),
        centerline=centerline_from_boundaries(left, right),
        is_intersection=bool(told.get("junction", False)),
        drives_cars=True,
        successors=tuple(told.get("successors", ())),
        left_neighbor=told.get("left_neighbor"),
        right_neighbor=told.get("right_neighbor"),
    )


def write_log(folder: Path, seconds: float = 12.0, speed_mps: float = 8.0) -> None:
    """A street of two lanes in one direction, the ego in the right one, a car 30 m ahead at the same speed."""
    folder.mkdir(parents=True, exist_ok=True)
    times = [round(STEP_S * k, 1) for k in range(round(seconds / STEP_S))]
    ego = ["t,x,y,heading,speed", *(f"{t},{speed_mps * t:.3f},0,0,{speed_mps}" for t in times)]
    ahead = (f"{t},car,VEHICLE,{30 + speed_mps * t:.3f},0,0,{speed_mps},4.6,1.9" for t in times)
    (folder / "ego.csv").write_text("\n".join(ego) + "\n")
    (folder / "agents.csv").write_text("\n".join(["t,track,kind,x,y,heading,speed,length,width", *ahead]) + "\n")
    edges = {"right": (2, -2, {"left_neighbor": "left"}), "left": (6, 2, {"right_neighbor": "right"})}
    lanes = {
        name: {"left": [[-60, left], [400, left]], "right": [[-60, right], [400, right]], **beside}
        for name, (left, right, beside) in edges.items()
    }
    drivable = [[-60, -3.5], [400, -3.5], [400, 7], [-60, 7], [-60, -3.5]]
    (folder / "map.json").write_text(json.dumps({"lanes": lanes, "drivable": [drivable]}))


if __name__ == "__main__":
    write_log(Path(sys.argv[1]) / "street")
    print(f"one log under {sys.argv[1]}")
