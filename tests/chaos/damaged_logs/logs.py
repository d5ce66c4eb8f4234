"""Logs of three formats in memory: their frames, boxes, maps and lights, and what can be done to each."""

import copy
import json
import pickle
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pyarrow as pa
import pyarrow.feather as feather
import shapely

from factory.datasets.av2 import ANNOTATIONS, POSES
from factory.datasets.av2.reader import KIND_OF_CATEGORY, LIGHTS, map_file
from factory.datasets.navsim.log import KIND_OF_NAME
from factory.datasets.scenarionet.reader import KINDS
from tasks.world.clip import AgentKind
from tests.factory.datasets.navsim.geopackage_writer import CITIES, Row, write_geopackage
from tests.writable import load_writable

AROUND_S = 0.6  # of a damage: half the window that velocities are fitted in, and half a step
PLACES = ("x", "y", "z")
SIZES = ("length", "width", "height")
VELOCITY = ("vx", "vy")
LIT_LANES = 3  # lanes of each log that get a light
GREEN_S = 5.0  # and as long a red
NOWHERE = "987654321"  # a lane of no map

Rng = np.random.Generator
Line = Callable[[np.ndarray], np.ndarray]  # points (N, 2+) as others


class DamagedLog(ABC):
    """A log of one format in memory. The maps, and lights that the real logs have none of, can be damaged too."""

    around_s: ClassVar[float] = AROUND_S
    times_s: np.ndarray  # (F,) of its frames, since the first

    def __init__(self) -> None:
        self.touched: set[str] = set()  # things that are damaged already

    def frames_left(self) -> np.ndarray:
        """Those that no damage has taken out, less the first and the last two: a log begins and ends with them."""
        return np.arange(2, len(self.times_s) - 2)

    @abstractmethod
    def seen(self) -> dict[str, np.ndarray]:
        """Thing -> the frames that show it."""

    @abstractmethod
    def kind_of(self, thing: str) -> AgentKind:
        """As its file has it."""

    @abstractmethod
    def place(self, thing: str, frames: np.ndarray) -> np.ndarray:
        """(K, 2) where a thing is at frames that show it, as the file has it [m]; apart in space is apart here."""

    @abstractmethod
    def speed_mps(self, thing: str) -> float:
        """Its mean speed over ground, as far as it goes on forward."""

    @abstractmethod
    def put(self, thing: str, frames: np.ndarray, name: str, value: float, *, moved: bool = False) -> None:
        """A value of a thing's box (PLACES, SIZES, VELOCITY, heading); moved: added to what is there."""

    @abstractmethod
    def turn(self, thing: str, frames: np.ndarray) -> None:
        """By pi."""

    @abstractmethod
    def list_again(self, thing: str, name: str, frames: np.ndarray, rng: Rng) -> None:
        """At some frames under another name, a little off, and of another size."""

    @abstractmethod
    def list_the_ego(self, name: str, off_m: float) -> None:
        """Among the others, so far ahead of itself."""

    @abstractmethod
    def swap_names(self, thing: str, other: str, frames: np.ndarray) -> None:
        """Of two things, at frames that show both."""

    @abstractmethod
    def drop_frame(self, frame: int) -> None: ...

    @abstractmethod
    def repeat_frame(self, frame: int) -> None:
        """All of it once more, its stamp too."""

    @abstractmethod
    def stamp_as_before(self, frame: int) -> None:
        """The stamp of the frame before it."""

    @abstractmethod
    def swap(self, frame: int) -> None:
        """Its place in the file with another's."""

    @abstractmethod
    def warp(self, moved_s: Callable[[np.ndarray], np.ndarray]) -> None:
        """All stamps by a function of themselves."""

    @abstractmethod
    def put_ego(self, frame: int, moved_m: float) -> None:
        """Added to its pose."""

    @abstractmethod
    def misname(self, thing: str, frame: int, name: str | float | None) -> tuple[float, float]:
        """A token that is none; since when and until when it shows."""

    @abstractmethod
    def misclass(self, thing: str, frame: int) -> tuple[float, float]: ...

    def share_name(self, thing: str, other: str, frame: int) -> bool:
        """The other's box of a frame gets the thing's name too; False: the format cannot say it."""
        return False

    def repeat(self, thing: str, frame: int) -> bool:
        """A row of it, once more; False: as above."""
        return False

    def malform(self, frame: int, rng: Rng) -> bool:
        """A frame that is none; False: as above."""
        return False

    # Of the map: ids as repairs name them.

    def lanes(self) -> Sequence[str]:
        """That can be damaged."""
        return ()

    def crossings(self) -> Sequence[str]:
        """That can be damaged: four corners or more."""
        return ()

    def areas(self) -> Sequence[str]:
        """That can be damaged."""
        return ()

    def change_lane(self, lane: str, change: Line) -> None:
        """A line that it is made of."""
        raise NotImplementedError

    def reverse_boundary(self, lane: str) -> bool:
        """One of its two; False: the format has none."""
        return False

    def change_crossing(self, crossing: str, change: Line) -> None:
        """Its outline."""
        raise NotImplementedError

    def tie(self, crossing: str) -> None:
        """Its outline crosses itself."""
        self.change_crossing(crossing, lambda points: points[[0, 2, 1, *range(3, len(points))]])

    def change_area(self, area: str, change: Line) -> None:
        """Its outline."""
        raise NotImplementedError

    @abstractmethod
    def light_nowhere(self) -> None:
        """A light on a lane of no map."""

    def misstate(self, rng: Rng) -> tuple[str, float, float] | None:
        """A state that is none, of a light; its lane, since when and until when. None: the format has only two."""
        return None

    def life_s(self, thing: str) -> tuple[float, float]:
        """When it is seen first and last."""
        frames = self.seen()[thing]
        return float(self.times_s[frames[0]]), float(self.times_s[frames[-1]])

    @abstractmethod
    def write(self, folder: Path) -> Path:
        """The log below an empty folder; the root for its reader."""


def mean_forward_mps(xy: np.ndarray, heading: np.ndarray, times_s: np.ndarray) -> float:
    """Of places (K, 2) and headings (K,) at times (K,)."""
    moved = np.diff(xy, axis=0)
    along = np.cos(heading[:-1]) * moved[:, 0] + np.sin(heading[:-1]) * moved[:, 1]
    return float(along.sum() / (times_s[-1] - times_s[0]))


# Argoverse 2: two tables, boxes in the ego's frame; a map in JSON; lights as the synthetic town writes them.

COLUMN = {"x": "tx_m", "y": "ty_m", "z": "tz_m", "heading": "qz", **{name: f"{name}_m" for name in SIZES}}
TURN = {"qw": ("qz", -1.0), "qx": ("qy", 1.0), "qy": ("qx", -1.0), "qz": ("qw", 1.0)}  # q (0, 0, 0, 1)


class AV2Files(DamagedLog):
    """An Argoverse log's tables and map."""

    def __init__(self, folder: Path) -> None:
        """Raises OSError."""
        super().__init__()
        self.folder = folder
        self.boxes, self.poses = (_columns(folder / name) for name in (ANNOTATIONS, POSES))
        self.stamps = np.unique(self.boxes["timestamp_ns"])
        self.times_s = (self.stamps - self.stamps[0]) / 1e9
        self.map = json.loads(map_file(folder).read_text(encoding="utf-8"))
        lit = sorted(key for key, lane in self.map["lane_segments"].items() if lane["is_intersection"])[:LIT_LANES]
        phases = [(stamp, lane, k % 2) for lane in lit for k, stamp in enumerate(self.stamps[:: round(GREEN_S / 0.1)])]
        stamps, lanes, red = zip(*phases)
        states = np.array(["GREEN", "RED"], object)[list(red)]
        self.lights = {"timestamp_ns": np.array(stamps), "lane_id": np.array(lanes, object), "state": states}

    def _rows(self, thing: str, frames: np.ndarray) -> np.ndarray:
        mine = np.flatnonzero(self.boxes["track_uuid"] == thing)
        return mine[np.isin(self.boxes["timestamp_ns"][mine], self.stamps[frames])]

    def seen(self) -> dict[str, np.ndarray]:
        frame = np.searchsorted(self.stamps, self.boxes["timestamp_ns"])
        names = self.boxes["track_uuid"]
        texts = {name for name in names.tolist() if isinstance(name, str) and name.strip()}
        return {name: np.unique(frame[names == name]) for name in texts}

    def kind_of(self, thing: str) -> AgentKind:
        first = np.flatnonzero(self.boxes["track_uuid"] == thing)[0]
        return KIND_OF_CATEGORY.get(self.boxes["category"][first], AgentKind.GENERIC_OBJECT)

    def place(self, thing: str, frames: np.ndarray) -> np.ndarray:
        rows = self._rows(thing, frames)
        rows = rows[np.argsort(self.boxes["timestamp_ns"][rows], kind="stable")]
        return np.stack([self.boxes["tx_m"][rows], self.boxes["ty_m"][rows]], axis=1)

    def speed_mps(self, thing: str) -> float:
        rows = np.flatnonzero(self.boxes["track_uuid"] == thing)
        rows = rows[np.argsort(self.boxes["timestamp_ns"][rows], kind="stable")]
        stamps = self.boxes["timestamp_ns"][rows]
        known, first = np.unique(self.poses["timestamp_ns"], return_index=True)
        poses = first[np.searchsorted(known, stamps)]
        yaw, own = (2.0 * np.arctan2(t["qz"][i], t["qw"][i]) for t, i in ((self.poses, poses), (self.boxes, rows)))
        x, y = self.boxes["tx_m"][rows], self.boxes["ty_m"][rows]
        xy = np.stack([np.cos(yaw) * x - np.sin(yaw) * y, np.sin(yaw) * x + np.cos(yaw) * y], axis=1)
        xy += np.stack([self.poses["tx_m"][poses], self.poses["ty_m"][poses]], axis=1)
        return mean_forward_mps(xy, yaw + own, (stamps - stamps[0]) / 1e9)

    def put(self, thing: str, frames: np.ndarray, name: str, value: float, *, moved: bool = False) -> None:
        column, rows = self.boxes[COLUMN[name]], self._rows(thing, frames)
        column[rows] = column[rows] + value if moved else value

    def turn(self, thing: str, frames: np.ndarray) -> None:
        rows = self._rows(thing, frames)
        turned = {name: sign * self.boxes[other][rows] for name, (other, sign) in TURN.items()}
        for name, values in turned.items():
            self.boxes[name][rows] = values

    def _append(self, rows: dict[str, np.ndarray]) -> None:
        self.boxes = {name: np.concatenate([column, rows[name]]) for name, column in self.boxes.items()}

    def list_again(self, thing: str, name: str, frames: np.ndarray, rng: Rng) -> None:
        rows = self._rows(thing, frames)
        again = {column: values[rows].copy() for column, values in self.boxes.items()}
        again["track_uuid"][:] = name
        for axis, off_m, size in zip(("tx_m", "ty_m", "tz_m"), moved_by(rng), SIZES):
            again[axis] += off_m + rng.normal(0.0, 0.01, len(rows))
            again[COLUMN[size]] *= rng.uniform(*OTHER_SIZE)
        self._append(again)

    def list_the_ego(self, name: str, off_m: float) -> None:
        n = len(self.stamps)
        ego = {column: np.zeros(n, values.dtype) for column, values in self.boxes.items()}
        for column, value in {"qw": 1.0, "tx_m": 1.46 + off_m, "tz_m": 0.8}.items():
            ego[column][:] = value
        for column, value in {"length_m": 4.9, "width_m": 2.0, "height_m": 1.7}.items():
            ego[column][:] = value
        ego["timestamp_ns"][:], ego["track_uuid"][:], ego["category"][:] = self.stamps, name, "REGULAR_VEHICLE"
        self._append(ego)

    def swap_names(self, thing: str, other: str, frames: np.ndarray) -> None:
        one, two = (self._rows(name, frames) for name in (thing, other))
        self.boxes["track_uuid"][one], self.boxes["track_uuid"][two] = other, thing

    def share_name(self, thing: str, other: str, frame: int) -> bool:
        self.boxes["track_uuid"][self._rows(other, np.array([frame]))] = thing
        return True

    def drop_frame(self, frame: int) -> None:
        left = self.boxes["timestamp_ns"] != self.stamps[frame]
        self.boxes = {name: column[left] for name, column in self.boxes.items()}

    def repeat_frame(self, frame: int) -> None:
        rows = np.flatnonzero(self.boxes["timestamp_ns"] == self.stamps[frame])
        self._append({name: column[rows] for name, column in self.boxes.items()})

    def stamp_as_before(self, frame: int) -> None:
        stamps = self.boxes["timestamp_ns"]
        stamps[stamps == self.stamps[frame]] = self.stamps[frame - 1]

    def warp(self, moved_s: Callable[[np.ndarray], np.ndarray]) -> None:
        def moved(stamps: np.ndarray) -> np.ndarray:
            return self.stamps[0] + np.round(1e9 * moved_s((stamps - self.stamps[0]) / 1e9)).astype(np.int64)

        for table in (self.boxes, self.poses, self.lights):
            table["timestamp_ns"] = moved(table["timestamp_ns"])
        self.stamps = moved(self.stamps)

    def put_ego(self, frame: int, moved_m: float) -> None:
        self.poses["tx_m"][self.poses["timestamp_ns"] == self.stamps[frame]] += moved_m

    def swap(self, frame: int) -> None:
        (row,) = np.flatnonzero(self.poses["timestamp_ns"] == self.stamps[frame])
        for column in self.poses.values():
            column[[row, row + 5]] = column[[row + 5, row]]

    def misname(self, thing: str, frame: int, name: str | float | None) -> tuple[float, float]:
        name = name if isinstance(name, str) else None  # a column of texts holds no NaN
        self.boxes["track_uuid"][self._rows(thing, np.array([frame]))] = name
        return float(self.times_s[frame]), float(self.times_s[frame])

    def misclass(self, thing: str, frame: int) -> tuple[float, float]:
        self.boxes["category"][self._rows(thing, np.array([frame]))] = "SPACESHIP"
        return float(self.times_s[frame]), float(self.times_s[frame])

    def misstamp(self, thing: str, frame: int, stamp: int) -> None:
        """A stamp of no frame."""
        self.boxes["timestamp_ns"][self._rows(thing, np.array([frame]))] = stamp

    def repeat(self, thing: str, frame: int) -> bool:
        rows = self._rows(thing, np.array([frame]))
        self._append({name: column[rows] for name, column in self.boxes.items()})
        return True

    def lanes(self) -> Sequence[str]:
        return sorted(self.map["lane_segments"])

    def crossings(self) -> Sequence[str]:
        return sorted(self.map["pedestrian_crossings"])

    def areas(self) -> Sequence[str]:
        return sorted(self.map["drivable_areas"])

    def change_lane(self, lane: str, change: Line) -> None:
        self._change(self.map["lane_segments"][lane], "left_lane_boundary", change)

    def reverse_boundary(self, lane: str) -> bool:
        self._change(self.map["lane_segments"][lane], "right_lane_boundary", lambda points: points[::-1])
        return True

    def change_crossing(self, crossing: str, change: Line) -> None:
        self._change(self.map["pedestrian_crossings"][crossing], "edge2", change)

    def tie(self, crossing: str) -> None:
        self.change_crossing(crossing, lambda points: points[::-1])

    def change_area(self, area: str, change: Line) -> None:
        self._change(self.map["drivable_areas"][area], "area_boundary", change)

    def _change(self, owner: dict[str, Any], name: str, change: Line) -> None:
        points = np.array([[point[axis] for axis in PLACES] for point in owner[name]], np.float64)
        owner[name] = [dict(zip(PLACES, point)) for point in change(points).tolist()]

    def light_nowhere(self) -> None:
        row = {"timestamp_ns": self.stamps[:1], "lane_id": [NOWHERE], "state": ["RED"]}
        self.lights = {name: np.append(column, np.array(row[name])) for name, column in self.lights.items()}

    def misstate(self, rng: Rng) -> tuple[str, float, float] | None:
        row = int(rng.integers(len(self.lights["state"])))
        self.lights["state"][row] = "PURPLE"
        since = float(self.lights["timestamp_ns"][row] - self.stamps[0]) / 1e9
        return str(self.lights["lane_id"][row]), since, since + GREEN_S

    def write(self, folder: Path) -> Path:
        root = folder / "val" / self.folder.name
        (root / "map").mkdir(parents=True)
        for path in self.folder.iterdir():
            if path.name not in (ANNOTATIONS, POSES, "sensors", "map"):
                (root / path.name).symlink_to(path)
        (root / "map" / map_file(self.folder).name).write_text(json.dumps(self.map), encoding="utf-8")
        for name, table in ((ANNOTATIONS, self.boxes), (POSES, self.poses), (LIGHTS, self.lights)):
            feather.write_feather(pa.table({column: pa.array(values) for column, values in table.items()}), root / name)
        return folder


OTHER_SIZE = (0.93, 1.07)  # times a double's


def moved_by(rng: Rng) -> np.ndarray:
    """(3,) where a double stands beside its original [m]."""
    return np.append(rng.uniform(-0.05, 0.05, 2), 0.0)


def _columns(path: Path) -> dict[str, np.ndarray]:
    table = feather.read_table(path)
    return {name: table[name].to_numpy().copy() for name in table.column_names}


# nuScenes by ScenarioNet: a dict of tracks, boxes in the world.


class NuscenesLog(DamagedLog):
    """A scenario's dict."""

    def __init__(self, path: Path) -> None:
        """Raises OSError."""
        super().__init__()
        self.path = path
        self.scenario: dict[str, Any] = load_writable(path)
        self.sdc = self.scenario["metadata"]["sdc_id"]
        n = self.scenario["length"]
        stamps = np.asarray(self.scenario["metadata"]["ts"])[:n]
        self.scenario["metadata"]["ts"], self.times_s = stamps, stamps - stamps[0]
        red = (self.times_s // GREEN_S).astype(int) % 2
        for lane in sorted(map(str, self.lanes()))[:LIT_LANES]:
            states = np.array(["TRAFFIC_LIGHT_GREEN", "TRAFFIC_LIGHT_RED"])[red].tolist()
            self.lights[f"light {lane}"] = {"lane": lane, "state": {"object_state": states}}

    def frames_left(self) -> np.ndarray:
        """The last second tells the ego's clock, by which all windows of a log begin."""
        return np.arange(2, len(self.times_s) - 12)

    @property
    def tracks(self) -> dict[Any, Any]:
        return self.scenario["tracks"]

    @property
    def lights(self) -> dict[Any, Any]:
        return self.scenario["dynamic_map_states"]

    def seen(self) -> dict[str, np.ndarray]:
        return {
            thing: np.flatnonzero(track["state"]["valid"] > 0.5)
            for thing, track in self.tracks.items()
            if thing != self.sdc and isinstance(thing, str) and thing.strip()
        }

    def kind_of(self, thing: str) -> AgentKind:
        return KINDS.get(self.tracks[thing]["type"], AgentKind.GENERIC_OBJECT)

    def place(self, thing: str, frames: np.ndarray) -> np.ndarray:
        return self.tracks[thing]["state"]["position"][frames, :2]

    def speed_mps(self, thing: str) -> float:
        frames = self.seen()[thing]
        heading = self.tracks[thing]["state"]["heading"].reshape(-1)[frames]
        return mean_forward_mps(self.place(thing, frames), heading, self.times_s[frames])

    def put(self, thing: str, frames: np.ndarray, name: str, value: float, *, moved: bool = False) -> None:
        state = self.tracks[thing]["state"]
        if name in PLACES:
            column = state["position"][:, PLACES.index(name)]
        elif name in VELOCITY:
            column = state["velocity"][:, VELOCITY.index(name)]
        else:
            column = state[name].reshape(-1)
        column[frames] = column[frames] + value if moved else value

    def turn(self, thing: str, frames: np.ndarray) -> None:
        self.tracks[thing]["state"]["heading"][frames] += np.pi

    def list_again(self, thing: str, name: str, frames: np.ndarray, rng: Rng) -> None:
        again = self.tracks[name] = copy.deepcopy(self.tracks[thing])
        state = again["state"]
        state["valid"] = state["valid"] * np.isin(np.arange(len(state["valid"])), frames)
        state["position"][:, :2] += moved_by(rng)[:2] + rng.normal(0.0, 0.01, (len(self.times_s), 2))
        for size in SIZES:
            state[size] = state[size] * rng.uniform(*OTHER_SIZE)

    def list_the_ego(self, name: str, off_m: float) -> None:
        again = self.tracks[name] = copy.deepcopy(self.tracks[self.sdc])
        heading = again["state"]["heading"].reshape(-1)
        again["state"]["position"][:, :2] += off_m * np.stack([np.cos(heading), np.sin(heading)], axis=1)

    def swap_names(self, thing: str, other: str, frames: np.ndarray) -> None:
        one, two = (self.tracks[name]["state"] for name in (thing, other))
        for name in one:
            one[name][frames], two[name][frames] = two[name][frames].copy(), one[name][frames].copy()

    def _of_frames(self, rows: np.ndarray) -> None:
        """The log of these of its frames."""
        self.scenario["length"] = len(rows)
        self.scenario["metadata"]["ts"] = self.scenario["metadata"]["ts"][rows]
        for track in self.tracks.values():
            track["state"] = {name: values[rows] for name, values in track["state"].items()}
        for light in self.lights.values():
            states = light["state"]["object_state"]
            light["state"]["object_state"] = [states[row] for row in rows]

    def drop_frame(self, frame: int) -> None:
        self._of_frames(np.delete(np.arange(len(self.times_s)), frame))
        self.times_s = np.delete(self.times_s, frame)

    def repeat_frame(self, frame: int) -> None:
        self._of_frames(np.insert(np.arange(len(self.times_s)), frame, frame))
        self.times_s = np.insert(self.times_s, frame, self.times_s[frame])

    def stamp_as_before(self, frame: int) -> None:
        self.scenario["metadata"]["ts"][frame] = self.scenario["metadata"]["ts"][frame - 1]

    def swap(self, frame: int) -> None:
        order = np.arange(len(self.times_s))
        order[[frame, frame + 1]] = frame + 1, frame
        self._of_frames(order)
        self.times_s = self.times_s[order]

    def warp(self, moved_s: Callable[[np.ndarray], np.ndarray]) -> None:
        stamps = self.scenario["metadata"]["ts"]
        self.scenario["metadata"]["ts"] = stamps[0] + moved_s(stamps - stamps[0])

    def put_ego(self, frame: int, moved_m: float) -> None:
        self.tracks[self.sdc]["state"]["position"][frame, 0] += moved_m

    def misname(self, thing: str, frame: int, name: str | float | None) -> tuple[float, float]:
        span = self.life_s(thing)
        self.tracks[name] = self.tracks.pop(thing)
        return span

    def misclass(self, thing: str, frame: int) -> tuple[float, float]:
        self.tracks[thing]["type"] = "SPACESHIP"
        return self.life_s(thing)

    def _features(self, kind: str, part: str) -> Sequence[str]:
        features = self.scenario["map_features"].items()
        return sorted(key for key, one in features if one["type"].startswith(kind) and len(one.get(part, ())) > 3)

    def lanes(self) -> Sequence[str]:
        return self._features("LANE_SURFACE", "polyline")

    def crossings(self) -> Sequence[str]:
        return self._features("CROSSWALK", "polygon")

    def areas(self) -> Sequence[str]:
        return [key for key in self._features("", "polyline") if str(key).startswith("boundary_")]

    def _change(self, name: str, part: str, change: Line) -> None:
        feature = self.scenario["map_features"][name]
        feature[part] = change(np.asarray(feature[part], np.float64))

    def change_lane(self, lane: str, change: Line) -> None:
        self._change(lane, "polyline", change)

    def change_crossing(self, crossing: str, change: Line) -> None:
        self._change(crossing, "polygon", change)

    def change_area(self, area: str, change: Line) -> None:
        self._change(area, "polyline", change)

    def light_nowhere(self) -> None:
        states = ["TRAFFIC_LIGHT_RED"] * self.scenario["length"]
        self.lights["light nowhere"] = {"lane": NOWHERE, "state": {"object_state": states}}

    def misstate(self, rng: Rng) -> tuple[str, float, float] | None:
        light, frame = self.lights[str(rng.choice(sorted(self.lights)))], int(rng.integers(len(self.times_s)))
        light["state"]["object_state"][frame] = str(rng.choice(["TRAFFIC_LIGHT_PURPLE", ""]))
        return light["lane"], float(self.times_s[frame]), float(self.times_s[frame]) + 0.1

    def write(self, folder: Path) -> Path:
        (folder / self.path.name).write_bytes(pickle.dumps(self.scenario))
        return folder


# NAVSIM: a list of frames, boxes in the ego's frame; a city's map in layers.

BOX_COLUMN = {"x": 0, "y": 1, "z": 2, "length": 3, "width": 4, "height": 5, "heading": 6}
BREAKS: Sequence[Callable[[dict[str, Any]], Any]] = (
    lambda frame: None,
    lambda frame: {name: value for name, value in frame.items() if name != "ego2global_translation"},
    lambda frame: frame | {"anns": "none"},
    lambda frame: frame | {"anns": None},
    lambda frame: frame | {"anns": frame["anns"] | {"gt_boxes": frame["anns"]["gt_boxes"][:-1]}},
    *(lambda frame, token=token: frame | {"token": token} for token in (None, "", np.nan)),
    *(lambda frame, stamp=stamp: frame | {"timestamp": stamp} for stamp in (None, np.nan, -1, 10**18)),
    *(lambda frame, x=x: frame | {"ego2global_rotation": np.full(4, x)} for x in (np.nan, np.inf, 0.0, 1e12)),
    *(lambda frame, x=x: frame | {"ego_dynamic_state": np.full(4, x)} for x in (np.nan, -np.inf)),
    lambda frame: frame | {"map_location": None},
    lambda frame: frame | {"roadblock_ids": [None]},
    lambda frame: frame | {"log_name": "another"},
    lambda frame: frame | {"scene_token": np.nan},
    lambda frame: frame | {"traffic_lights": [("1", "purple")]},
    lambda frame: frame | {"traffic_lights": [(np.nan, True)]},
    lambda frame: frame | {"cams": {}},
)


class NavsimLog(DamagedLog):
    """A log's list of frames, and the map beside it."""

    around_s = 0.0  # nothing in a window is fitted to frames around it

    def __init__(self, path: Path, rows: dict[str, list[Row]], city: str) -> None:
        """rows: of the map, which is written when it is damaged. Raises OSError."""
        super().__init__()
        self.path, self.rows, self.city, self.is_map_whole = path, rows, city, True
        self.frames: list[Any] = load_writable(path)
        self.times_s = np.array([(f["timestamp"] - self.frames[0]["timestamp"]) / 1e6 for f in self.frames])
        lit = [str(row["fid"]) for row in rows["lane_connectors"][:LIT_LANES]]
        for frame, t in zip(self.frames, self.times_s):
            frame["traffic_lights"] = [(lane, bool(t // GREEN_S % 2)) for lane in lit]
        for k, frame in enumerate(self.frames):
            frame["frame_idx"] = k

    def frames_left(self) -> np.ndarray:
        here = {number for number, _ in self._whole()}
        return np.array([frame for frame in super().frames_left() if {frame - 1, frame, frame + 1} <= here])

    def _whole(self) -> Iterator[tuple[int, dict[str, Any]]]:
        """By the number that a frame had."""
        for frame in self.frames:
            if isinstance(frame, dict) and isinstance(frame.get("anns"), dict):
                yield frame["frame_idx"], frame["anns"]

    def _at(self, thing: str, frames: np.ndarray) -> Iterator[tuple[dict[str, Any], int]]:
        for number, anns in self._whole():
            if number in frames and thing in anns["track_tokens"]:
                yield anns, anns["track_tokens"].index(thing)

    def seen(self) -> dict[str, np.ndarray]:
        found: dict[str, list[int]] = {}
        for number, anns in self._whole():
            for thing in dict.fromkeys(anns["track_tokens"]):
                if isinstance(thing, str) and thing.strip():
                    found.setdefault(thing, []).append(number)
        return {thing: np.array(sorted({*frames})) for thing, frames in found.items()}

    def kind_of(self, thing: str) -> AgentKind:
        anns, row = next(self._at(thing, np.arange(len(self.times_s))))
        return KIND_OF_NAME.get(str(anns["gt_names"][row]), AgentKind.GENERIC_OBJECT)

    def place(self, thing: str, frames: np.ndarray) -> np.ndarray:
        return np.array([anns["gt_boxes"][row, :2] for anns, row in self._at(thing, frames)])

    def speed_mps(self, thing: str) -> float:
        boxes = [(anns["gt_boxes"][row, 6], anns["gt_velocity_3d"][row]) for anns, row in self._at(thing, ANY_FRAME)]
        return float(np.mean([np.cos(heading) * v[0] + np.sin(heading) * v[1] for heading, v in boxes]))

    def put(self, thing: str, frames: np.ndarray, name: str, value: float, *, moved: bool = False) -> None:
        for anns, row in self._at(thing, frames):
            if name in BOX_COLUMN:
                at = row, BOX_COLUMN[name]
                anns["gt_boxes"][at] = anns["gt_boxes"][at] + value if moved else value
            else:
                anns["gt_velocity_3d"][row, VELOCITY.index(name)] = value

    def turn(self, thing: str, frames: np.ndarray) -> None:
        for anns, row in self._at(thing, frames):
            anns["gt_boxes"][row, 6] += np.pi

    def _append(self, anns: dict[str, Any], box: np.ndarray, name: str, kind: str, velocity: np.ndarray) -> None:
        anns["gt_boxes"] = np.vstack([anns["gt_boxes"], box])
        anns["gt_velocity_3d"] = np.vstack([anns["gt_velocity_3d"], velocity])
        anns["gt_names"] = np.append(anns["gt_names"], kind)
        anns["track_tokens"] = [*anns["track_tokens"], name]
        anns["instance_tokens"] = [*anns["instance_tokens"], f"{name}-i"]

    def list_again(self, thing: str, name: str, frames: np.ndarray, rng: Rng) -> None:
        off_m, size = moved_by(rng), rng.uniform(*OTHER_SIZE, 3)
        for anns, row in list(self._at(thing, frames)):
            box = anns["gt_boxes"][row] * np.concatenate([np.ones(3), size, np.ones(1)])
            box[:3] += off_m + np.append(rng.normal(0.0, 0.01, 2), 0.0)
            self._append(anns, box, name, str(anns["gt_names"][row]), anns["gt_velocity_3d"][row])

    def list_the_ego(self, name: str, off_m: float) -> None:
        for frame in self.frames:
            if isinstance(frame, dict) and isinstance(frame.get("anns"), dict):
                box = np.array([1.46 + off_m, 0.0, 0.8, 4.9, 2.0, 1.7, 0.0])
                velocity = np.append(frame["ego_dynamic_state"][:2], 0.0)
                self._append(frame["anns"], box, name, "vehicle", velocity)

    def swap_names(self, thing: str, other: str, frames: np.ndarray) -> None:
        one, two = (list(self._at(name, frames)) for name in (thing, other))
        for (anns, row), (_, other_row) in zip(one, two, strict=True):
            anns["track_tokens"][row], anns["track_tokens"][other_row] = other, thing

    def share_name(self, thing: str, other: str, frame: int) -> bool:
        for anns, row in self._at(other, np.array([frame])):
            anns["track_tokens"][row] = thing
        return True

    def _place(self, frame: int) -> int:
        return next(
            i for i, item in enumerate(self.frames) if isinstance(item, dict) and item.get("frame_idx") == frame
        )

    def drop_frame(self, frame: int) -> None:
        del self.frames[self._place(frame)]

    def repeat_frame(self, frame: int) -> None:
        at = self._place(frame)
        self.frames.insert(at, copy.deepcopy(self.frames[at]))

    def stamp_as_before(self, frame: int) -> None:
        at = self._place(frame)
        self.frames[at]["timestamp"] = self.frames[at - 1]["timestamp"]

    def warp(self, moved_s: Callable[[np.ndarray], np.ndarray]) -> None:
        first = self.frames[0]["timestamp"]
        for frame in self.frames:
            if isinstance(frame, dict):
                since_s = np.array([(frame["timestamp"] - first) / 1e6])
                frame["timestamp"] = first + round(float(moved_s(since_s)[0]) * 1e6)

    def put_ego(self, frame: int, moved_m: float) -> None:
        item = self.frames[self._place(frame)]
        item["ego2global_translation"] = item["ego2global_translation"] + np.array([moved_m, 0.0, 0.0])

    def swap(self, frame: int) -> None:
        at = self._place(frame)
        self.frames[at], self.frames[at + 1] = self.frames[at + 1], self.frames[at]

    def misname(self, thing: str, frame: int, name: str | float | None) -> tuple[float, float]:
        for anns, row in self._at(thing, np.array([frame])):
            anns["track_tokens"][row] = name
        return float(self.times_s[frame]), float(self.times_s[frame])

    def misclass(self, thing: str, frame: int) -> tuple[float, float]:
        for anns, row in self._at(thing, np.array([frame])):
            anns["gt_names"] = anns["gt_names"].astype("U32")
            anns["gt_names"][row] = "spaceship"
        return float(self.times_s[frame]), float(self.times_s[frame])

    def repeat(self, thing: str, frame: int) -> bool:
        for anns, row in list(self._at(thing, np.array([frame]))):
            box, velocity = anns["gt_boxes"][row], anns["gt_velocity_3d"][row]
            self._append(anns, box, thing, str(anns["gt_names"][row]), velocity)
        return True

    def malform(self, frame: int, rng: Rng) -> bool:
        at = self._place(frame)
        self.frames[at] = BREAKS[rng.integers(len(BREAKS))](self.frames[at])
        return True

    def _row(self, layer: str, fid: str) -> Row:
        return next(row for row in self.rows[layer] if str(row["fid"]) == fid)

    def _change(self, layer: str, fid: str, change: Line) -> None:
        self.is_map_whole, self.rows = False, copy.deepcopy(self.rows)
        row = self._row(layer, fid)
        shape = shapely.Polygon if layer == "crosswalks" else shapely.LineString
        row["shape"] = shape(change(shapely.get_coordinates(row["shape"])))

    def lanes(self) -> Sequence[str]:
        return sorted(str(row["fid"]) for row in self.rows["lanes_polygons"])

    def crossings(self) -> Sequence[str]:
        return sorted(str(row["fid"]) for row in self.rows["crosswalks"])

    def change_lane(self, lane: str, change: Line) -> None:
        baselines = (row for row in self.rows["baseline_paths"] if str(row["lane_fid"]) == lane)
        self._change("baseline_paths", str(next(baselines)["fid"]), change)

    def reverse_boundary(self, lane: str) -> bool:
        boundary = self._row("lanes_polygons", lane)["right_boundary_fid"]
        self._change("boundaries", str(boundary), lambda points: points[::-1])
        return True

    def change_crossing(self, crossing: str, change: Line) -> None:
        self._change("crosswalks", crossing, change)

    def light_nowhere(self) -> None:
        for frame in self.frames:
            if isinstance(frame, dict):
                frame["traffic_lights"] = [*frame["traffic_lights"], (NOWHERE, True)]

    def write(self, folder: Path) -> Path:
        (folder / self.path.name).write_bytes(pickle.dumps(self.frames))
        if not self.is_map_whole:
            version, zone = CITIES[self.city]
            write_geopackage(folder / "maps" / self.city / version / "map.gpkg", self.rows, zone)
        return folder


ANY_FRAME = np.arange(100_000)
