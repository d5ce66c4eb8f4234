"""Real logs, damaged: `python -m tests.chaos.damaged_logs SHARED [seeds=200] [of=av2,nuscenes,navsim] [rows=0]`.

Of each data set a log a seed is copied with two to four damages of the kinds below, at random, and read. Held against
the log as it is

- no window that lies outside of all damages is lost (0.6 s around a damage count as inside: velocities are fitted to
  the frames around), and what is read there is the same to the byte. nuScenes' ego alone is smoothed as a whole, on a
  clock that all frames tell: what is done to it moves it by less than 0.3 m outside;
- inside, things that no damage touches are the same to the byte too, and where anything differs a repair says so.

Prints a table by data set and kind. rows=N: of N seeds also two whole runs, without pictures: the samples of windows
outside are the same but for the digest of the log's files. NAVSIM's logs are frames that `factory export navsim` wrote
of a run on the Argoverse logs, the samples of a log joined to one log again.
"""

import copy
import pickle
import sys
import tempfile
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pyarrow as pa
import pyarrow.feather as feather

from factory.datasets.av2 import ANNOTATIONS, POSES
from factory.datasets.av2.reader import KIND_OF_CATEGORY, AV2Reader, read_log
from factory.datasets.navsim.log import KIND_OF_NAME
from factory.datasets.navsim.reader import NavsimReader
from factory.datasets.scenarionet.reader import KINDS, ScenarioNetReader
from factory.readers.base import BadClip, ClipReader
from factory.run import main as run
from factory.store.samples import Store
from tasks.world.clip import CLIP_STEPS, STEP_S, AgentKind, AgentTracks, Clip
from tasks.world.repair.records import Repair
from tasks.world.repair.tracks import EGO

AROUND_S = 0.6  # of a damage: half the window that velocities are fitted in, and half a step
ALL = "*"  # things that a damage touches: whatever its frames show
MOST_DAMAGES = 4
FRAMES_A_THING = 12  # things that are seen for less are not damaged
PLACES = ("x", "y", "z")
SIZES = ("length", "width", "height")
FAR_M, FAR_RAD, FAR_MPS = 1.0, 0.5, 5.0  # from where a thing is in truth: more is no repair

Rng = np.random.Generator


@dataclass(frozen=True)
class Damage:
    """What was done to a log."""

    kind: str
    things: frozenset[str]  # that it touches, empty: none; ALL
    first_s: float = -np.inf  # since the log's first frame
    last_s: float = np.inf
    ego: bool = False  # the ego's own poses
    loses: bool = False  # windows may be lost inside

    def holds(self, start_s: float, around_s: float) -> bool:
        """Whether the window from start_s on lies in it."""
        last_s = start_s + (CLIP_STEPS - 1) * STEP_S
        return start_s - around_s <= self.last_s and last_s + around_s >= self.first_s


class DamagedLog(ABC):
    """A log of one format in memory: its frames, and what can be done to them."""

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
    def put(self, thing: str, frames: np.ndarray, name: str, value: float, *, moved: bool = False) -> None:
        """A value of a thing's box (x, y, z, length, width, height, vx, vy); moved: added to what is there."""

    @abstractmethod
    def turn(self, thing: str, frames: np.ndarray) -> None:
        """By pi."""

    @abstractmethod
    def list_again(self, thing: str, name: str, rng: Rng) -> None:
        """Under another name, off by 5 cm."""

    @abstractmethod
    def list_the_ego(self, name: str) -> None:
        """Among the others."""

    @abstractmethod
    def drop_frame(self, frame: int) -> None: ...

    @abstractmethod
    def stretch(self, share: float) -> None:
        """All stamps, so many times as far apart."""

    @abstractmethod
    def lose_ego(self, frame: int) -> None:
        """NaN in its pose."""

    @abstractmethod
    def misname(self, thing: str, frame: int, name: str | None) -> tuple[float, float]:
        """A token that is none; since when and until when it shows."""

    @abstractmethod
    def misclass(self, thing: str, frame: int) -> tuple[float, float]: ...

    def life_s(self, thing: str) -> tuple[float, float]:
        """When it is seen first and last."""
        frames = self.seen()[thing]
        return float(self.times_s[frames[0]]), float(self.times_s[frames[-1]])

    @abstractmethod
    def write(self, folder: Path) -> Path:
        """The log below an empty folder; the root for its reader."""


# The kinds of damages. Each changes the log in hand, and says what it has done; None: this log has no place for it.

Inject = Callable[[DamagedLog, Rng], Damage | None]


def _some_thing(log: DamagedLog, rng: Rng, kinds: Sequence[AgentKind] = ()) -> str | None:
    known = [
        thing
        for thing, frames in log.seen().items()
        if len(frames) >= FRAMES_A_THING and thing not in log.touched and (not kinds or log.kind_of(thing) in kinds)
    ]
    if not known:
        return None
    thing = str(rng.choice(sorted(known)))
    log.touched.add(thing)
    return thing


def _inner(log: DamagedLog, rng: Rng) -> int:
    return int(rng.choice(log.frames_left()))


def _value(kind: str, name: Callable[[Rng], str], value: Callable[[Rng], float]) -> Inject:
    """One value of one box in one frame."""

    def inject(log: DamagedLog, rng: Rng) -> Damage | None:
        thing = _some_thing(log, rng)
        if thing is None:
            return None
        frame = rng.choice(log.seen()[thing], 1)
        log.put(thing, frame, name(rng), value(rng))
        t = float(log.times_s[frame[0]])
        return Damage(kind, frozenset({thing}), t, t)

    return inject


def _frame_missing(log: DamagedLog, rng: Rng) -> Damage:
    frame = _inner(log, rng)
    t = float(log.times_s[frame])
    log.drop_frame(frame)
    return Damage("frame missing", frozenset({ALL}), t, t, loses=isinstance(log, NavsimLog))


def _clock(log: DamagedLog, rng: Rng) -> Damage:
    log.stretch(float(rng.choice([0.97, 1.03])))
    return Damage("clock 3 % off", frozenset({ALL}), ego=True)


def _bad_in_most(log: DamagedLog, rng: Rng) -> Damage | None:
    thing = _some_thing(log, rng)
    if thing is None:
        return None
    frames = log.seen()[thing]
    bad = rng.choice(frames, int(np.ceil(rng.uniform(0.6, 0.95) * len(frames))), replace=False)
    log.put(thing, bad, str(rng.choice([*PLACES, *SIZES])), np.nan)
    return Damage("bad in most frames", frozenset({thing}), *log.life_s(thing))


def _twice(log: DamagedLog, rng: Rng) -> Damage | None:
    thing = _some_thing(log, rng)
    if thing is None:
        return None
    name = f"{rng.integers(16**8):08x}-{thing}"
    log.touched.add(name)
    log.list_again(thing, name, rng)
    return Damage("listed twice", frozenset({thing, name}), *log.life_s(thing))


def _ego_listed(log: DamagedLog, rng: Rng) -> Damage:
    name = f"{rng.integers(16**8):08x}-ego"
    log.touched.add(name)
    log.list_the_ego(name)
    return Damage("ego among agents", frozenset({name}))


def _token(log: DamagedLog, rng: Rng) -> Damage | None:
    thing = _some_thing(log, rng)
    if thing is None:
        return None
    frame = int(rng.choice(log.seen()[thing]))
    return Damage("token missing", frozenset({thing}), *log.misname(thing, frame, [None, "", " "][rng.integers(3)]))


def _class(log: DamagedLog, rng: Rng) -> Damage | None:
    thing = _some_thing(log, rng)
    if thing is None:
        return None
    return Damage("class unknown", frozenset({thing}), *log.misclass(thing, int(rng.choice(log.seen()[thing]))))


def _jump(log: DamagedLog, rng: Rng) -> Damage | None:
    thing = _some_thing(log, rng)
    if thing is None:
        return None
    frames = log.seen()[thing]
    at = int(rng.integers(4, len(frames) - 4))
    log.put(thing, frames[at:], str(rng.choice(["x", "y"])), float(rng.choice([-8.0, 8.0])), moved=True)
    t = log.times_s[frames]
    return Damage("identity jumps 8 m", frozenset({thing}), float(t[at - 1]), float(t[-1]))


def _spike(log: DamagedLog, rng: Rng) -> Damage | None:
    thing = _some_thing(log, rng)
    if thing is None:
        return None
    frame = rng.choice(log.seen()[thing], 1)
    log.put(thing, frame, str(rng.choice(["x", "y"])), float(rng.choice([-1, 1]) * rng.uniform(8.0, 60.0)), moved=True)
    t = float(log.times_s[frame[0]])
    return Damage("spike", frozenset({thing}), t, t)


def _turned(log: DamagedLog, rng: Rng) -> Damage | None:
    thing = _some_thing(log, rng, kinds=(AgentKind.VEHICLE, AgentKind.BICYCLE))
    if thing is None:
        return None
    n = int(rng.integers(1, 4))
    frames = log.seen()[thing]
    at = int(rng.integers(0, len(frames) - n + 1))
    log.turn(thing, frames[at : at + n])
    t = log.times_s[frames[at : at + n]]
    return Damage("heading off by pi", frozenset({thing}), float(t[0]), float(t[-1]))


def _ego_nan(log: DamagedLog, rng: Rng) -> Damage:
    frame = _inner(log, rng)
    log.lose_ego(frame)
    t = float(log.times_s[frame])
    return Damage("ego pose NaN", frozenset({ALL}), t, t, ego=True, loses=isinstance(log, NavsimLog))


def _out_of_order(log: DamagedLog, rng: Rng) -> Damage | None:
    if isinstance(log, NuscenesLog):
        return None  # its frames have one clock, in order
    frame = _inner(log, rng)
    log.swap(frame)  # type: ignore[attr-defined]
    t = float(log.times_s[frame])
    touched = frozenset({ALL}) if isinstance(log, NavsimLog) else frozenset[str]()
    return Damage("poses out of order", touched, t, t + 0.5, loses=isinstance(log, NavsimLog))


def _repeated(log: DamagedLog, rng: Rng) -> Damage | None:
    thing = _some_thing(log, rng)
    if thing is None or isinstance(log, NuscenesLog):
        return None  # a track has one row a frame
    frame = int(rng.choice(log.seen()[thing]))
    log.repeat(thing, frame)  # type: ignore[attr-defined]
    t = float(log.times_s[frame])
    return Damage("row twice", frozenset({thing}), t, t)


def _malformed(log: DamagedLog, rng: Rng) -> Damage | None:
    if not isinstance(log, NavsimLog):
        return None
    frame = _inner(log, rng)
    log.malform(frame, rng)
    t = float(log.times_s[frame])
    return Damage("frame malformed", frozenset({ALL}), t, t, loses=True)


def _nan_velocity(log: DamagedLog, rng: Rng) -> Damage | None:
    inject = _value("velocity NaN", lambda rng: str(rng.choice(["vx", "vy"])), lambda _: np.nan)
    return inject(log, rng) if isinstance(log, NavsimLog) else None


def _any_of(names: Sequence[str]) -> Callable[[Rng], str]:
    return lambda rng: str(rng.choice(names))


INJECTIONS: dict[str, Inject] = {
    "frame missing": _frame_missing,
    "clock 3 % off": _clock,
    "size negative": _value("size negative", _any_of(SIZES), lambda rng: -float(rng.uniform(0.1, 5.0))),
    "size NaN": _value("size NaN", _any_of(SIZES), lambda _: np.nan),
    "size infinite": _value("size infinite", _any_of(SIZES), lambda _: np.inf),
    "size huge": _value("size huge", _any_of(SIZES), lambda rng: float(10.0 ** rng.uniform(2.1, 9.0))),
    "place NaN": _value("place NaN", _any_of(PLACES), lambda _: np.nan),
    "place 1e12": _value("place 1e12", _any_of(PLACES), lambda _: 1e12),
    "velocity NaN": _nan_velocity,
    "bad in most frames": _bad_in_most,
    "listed twice": _twice,
    "ego among agents": _ego_listed,
    "token missing": _token,
    "class unknown": _class,
    "identity jumps 8 m": _jump,
    "spike": _spike,
    "heading off by pi": _turned,
    "ego pose NaN": _ego_nan,
    "poses out of order": _out_of_order,
    "frame malformed": _malformed,
    "row twice": _repeated,
}
LAST = ("frame missing", "clock 3 % off")  # frames have other numbers or times behind them
LOSE = ("frame missing", "ego pose NaN", "poses out of order", "frame malformed")  # windows of NAVSIM's logs


# Argoverse 2: two tables, boxes in the ego's frame.

COLUMN = {"x": "tx_m", "y": "ty_m", "z": "tz_m", **{name: f"{name}_m" for name in SIZES}}
TURN = {"qw": ("qz", -1.0), "qx": ("qy", 1.0), "qy": ("qx", -1.0), "qz": ("qw", 1.0)}  # q (0, 0, 0, 1)


class AV2Files(DamagedLog):
    """An Argoverse log's two tables."""

    def __init__(self, folder: Path) -> None:
        """Raises OSError."""
        super().__init__()
        self.folder = folder
        self.boxes, self.poses = (_columns(folder / name) for name in (ANNOTATIONS, POSES))
        self.stamps = np.unique(self.boxes["timestamp_ns"])
        self.times_s = (self.stamps - self.stamps[0]) / 1e9

    def _rows(self, thing: str, frames: np.ndarray) -> np.ndarray:
        mine = np.flatnonzero(self.boxes["track_uuid"] == thing)
        return mine[np.isin(self.boxes["timestamp_ns"][mine], self.stamps[frames])]

    def seen(self) -> dict[str, np.ndarray]:
        frame = np.searchsorted(self.stamps, self.boxes["timestamp_ns"])
        names = self.boxes["track_uuid"]
        return {str(name): np.unique(frame[names == name]) for name in {n for n in names.tolist() if n and n.strip()}}

    def kind_of(self, thing: str) -> AgentKind:
        first = np.flatnonzero(self.boxes["track_uuid"] == thing)[0]
        return KIND_OF_CATEGORY.get(self.boxes["category"][first], AgentKind.GENERIC_OBJECT)

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

    def list_again(self, thing: str, name: str, rng: Rng) -> None:
        rows = self._rows(thing, self.seen()[thing])
        again = {column: values[rows].copy() for column, values in self.boxes.items()}
        again["track_uuid"][:] = name
        for axis in ("tx_m", "ty_m"):
            again[axis] += rng.normal(0.0, 0.05, len(rows))
        self._append(again)

    def list_the_ego(self, name: str) -> None:
        n = len(self.stamps)
        ego = {column: np.zeros(n, values.dtype) for column, values in self.boxes.items()}
        for column, value in {"qw": 1.0, "tx_m": 1.46, "tz_m": 0.8}.items():
            ego[column][:] = value
        for column, value in {"length_m": 4.9, "width_m": 2.0, "height_m": 1.7}.items():
            ego[column][:] = value
        ego["timestamp_ns"][:], ego["track_uuid"][:], ego["category"][:] = self.stamps, name, "REGULAR_VEHICLE"
        self._append(ego)

    def drop_frame(self, frame: int) -> None:
        left = self.boxes["timestamp_ns"] != self.stamps[frame]
        self.boxes = {name: column[left] for name, column in self.boxes.items()}

    def stretch(self, share: float) -> None:
        for table in (self.boxes, self.poses):
            since = table["timestamp_ns"] - self.stamps[0]
            table["timestamp_ns"] = self.stamps[0] + np.round(since * share).astype(np.int64)
        self.stamps = self.stamps[0] + np.round((self.stamps - self.stamps[0]) * share).astype(np.int64)

    def lose_ego(self, frame: int) -> None:
        self.poses["tx_m"][self.poses["timestamp_ns"] == self.stamps[frame]] = np.nan

    def swap(self, frame: int) -> None:
        """Two rows of poses."""
        (row,) = np.flatnonzero(self.poses["timestamp_ns"] == self.stamps[frame])
        for column in self.poses.values():
            column[[row, row + 5]] = column[[row + 5, row]]

    def misname(self, thing: str, frame: int, name: str | None) -> tuple[float, float]:
        self.boxes["track_uuid"][self._rows(thing, np.array([frame]))] = name
        return float(self.times_s[frame]), float(self.times_s[frame])

    def misclass(self, thing: str, frame: int) -> tuple[float, float]:
        self.boxes["category"][self._rows(thing, np.array([frame]))] = "SPACESHIP"
        return float(self.times_s[frame]), float(self.times_s[frame])

    def repeat(self, thing: str, frame: int) -> None:
        """A row of it, once more."""
        rows = self._rows(thing, np.array([frame]))
        self._append({name: column[rows] for name, column in self.boxes.items()})

    def write(self, folder: Path) -> Path:
        root = folder / "val" / self.folder.name
        root.mkdir(parents=True)
        for path in self.folder.iterdir():
            if path.name not in (ANNOTATIONS, POSES, "sensors"):
                (root / path.name).symlink_to(path)
        for name, table in ((ANNOTATIONS, self.boxes), (POSES, self.poses)):
            feather.write_feather(pa.table({column: pa.array(values) for column, values in table.items()}), root / name)
        return folder


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
        self.scenario: dict[str, Any] = pickle.loads(path.read_bytes())
        self.sdc = self.scenario["metadata"]["sdc_id"]
        self.times_s = np.asarray(self.scenario["metadata"]["ts"])[: self.scenario["length"]]
        self.times_s = self.times_s - self.times_s[0]

    @property
    def tracks(self) -> dict[Any, Any]:
        return self.scenario["tracks"]

    def seen(self) -> dict[str, np.ndarray]:
        return {
            thing: np.flatnonzero(track["state"]["valid"] > 0.5)
            for thing, track in self.tracks.items()
            if thing != self.sdc and isinstance(thing, str) and thing.strip()
        }

    def kind_of(self, thing: str) -> AgentKind:
        return KINDS.get(self.tracks[thing]["type"], AgentKind.GENERIC_OBJECT)

    def put(self, thing: str, frames: np.ndarray, name: str, value: float, *, moved: bool = False) -> None:
        state = self.tracks[thing]["state"]
        column = state["position"][:, PLACES.index(name)] if name in PLACES else state[name].reshape(-1)
        column[frames] = column[frames] + value if moved else value
        if name in SIZES:
            state[name] = column.reshape(state[name].shape)

    def turn(self, thing: str, frames: np.ndarray) -> None:
        self.tracks[thing]["state"]["heading"][frames] += np.pi

    def list_again(self, thing: str, name: str, rng: Rng) -> None:
        again = self.tracks[name] = copy.deepcopy(self.tracks[thing])
        again["state"]["position"][:, :2] += rng.normal(0.0, 0.05, (len(self.times_s), 2))

    def list_the_ego(self, name: str) -> None:
        self.tracks[name] = copy.deepcopy(self.tracks[self.sdc])

    def drop_frame(self, frame: int) -> None:
        self.scenario["length"] -= 1
        self.scenario["metadata"]["ts"] = np.delete(self.scenario["metadata"]["ts"], frame)
        self.times_s = np.delete(self.times_s, frame)
        for track in self.tracks.values():
            track["state"] = {name: np.delete(values, frame, axis=0) for name, values in track["state"].items()}

    def stretch(self, share: float) -> None:
        self.scenario["metadata"]["ts"] = np.asarray(self.scenario["metadata"]["ts"]) * share

    def lose_ego(self, frame: int) -> None:
        self.tracks[self.sdc]["state"]["position"][frame, 0] = np.nan

    def misname(self, thing: str, frame: int, name: str | None) -> tuple[float, float]:
        span = self.life_s(thing)
        self.tracks[name] = self.tracks.pop(thing)
        return span

    def misclass(self, thing: str, frame: int) -> tuple[float, float]:
        self.tracks[thing]["type"] = "SPACESHIP"
        return self.life_s(thing)

    def write(self, folder: Path) -> Path:
        (folder / self.path.name).write_bytes(pickle.dumps(self.scenario))
        return folder


# NAVSIM: a list of frames, boxes in the ego's frame.

BOX_COLUMN = {"x": 0, "y": 1, "z": 2, "length": 3, "width": 4, "height": 5}
BREAKS: Sequence[Callable[[dict[str, Any]], Any]] = (
    lambda frame: None,
    lambda frame: {name: value for name, value in frame.items() if name != "ego2global_translation"},
    lambda frame: frame | {"anns": "none"},
    lambda frame: frame | {"driving_command": np.array([0, 1, 0])},
    lambda frame: frame | {"anns": frame["anns"] | {"gt_boxes": frame["anns"]["gt_boxes"][:-1]}},
    lambda frame: frame | {"token": None},
)


class NavsimLog(DamagedLog):
    """A log's list of frames."""

    around_s = 0.0  # a window is made of its own frames

    def __init__(self, path: Path) -> None:
        """Raises OSError."""
        super().__init__()
        self.path = path
        self.frames: list[Any] = pickle.loads(path.read_bytes())
        self.times_s = np.array([(f["timestamp"] - self.frames[0]["timestamp"]) / 1e6 for f in self.frames])

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
                if thing and thing.strip():
                    found.setdefault(thing, []).append(number)
        return {thing: np.array(sorted(frames)) for thing, frames in found.items()}

    def kind_of(self, thing: str) -> AgentKind:
        anns, row = next(self._at(thing, np.arange(len(self.times_s))))
        return KIND_OF_NAME.get(str(anns["gt_names"][row]), AgentKind.GENERIC_OBJECT)

    def put(self, thing: str, frames: np.ndarray, name: str, value: float, *, moved: bool = False) -> None:
        for anns, row in self._at(thing, frames):
            if name in BOX_COLUMN:
                at = row, BOX_COLUMN[name]
                anns["gt_boxes"][at] = anns["gt_boxes"][at] + value if moved else value
            else:
                anns["gt_velocity_3d"][row, ["vx", "vy"].index(name)] = value

    def turn(self, thing: str, frames: np.ndarray) -> None:
        for anns, row in self._at(thing, frames):
            anns["gt_boxes"][row, 6] += np.pi

    def _append(self, anns: dict[str, Any], box: np.ndarray, name: str, kind: str, velocity: np.ndarray) -> None:
        anns["gt_boxes"] = np.vstack([anns["gt_boxes"], box])
        anns["gt_velocity_3d"] = np.vstack([anns["gt_velocity_3d"], velocity])
        anns["gt_names"] = np.append(anns["gt_names"], kind)
        anns["track_tokens"] = [*anns["track_tokens"], name]
        anns["instance_tokens"] = [*anns["instance_tokens"], f"{name}-i"]

    def list_again(self, thing: str, name: str, rng: Rng) -> None:
        for anns, row in list(self._at(thing, np.arange(len(self.times_s)))):
            box = anns["gt_boxes"][row] + np.append(rng.normal(0.0, 0.05, 2), np.zeros(5))
            self._append(anns, box, name, str(anns["gt_names"][row]), anns["gt_velocity_3d"][row])

    def list_the_ego(self, name: str) -> None:
        for frame in self.frames:
            if isinstance(frame, dict) and isinstance(frame.get("anns"), dict):
                box = np.array([1.46, 0.0, 0.8, 4.9, 2.0, 1.7, 0.0])
                velocity = np.append(frame["ego_dynamic_state"][:2], 0.0)
                self._append(frame["anns"], box, name, "vehicle", velocity)

    def _place(self, frame: int) -> int:
        return next(
            i for i, item in enumerate(self.frames) if isinstance(item, dict) and item.get("frame_idx") == frame
        )

    def drop_frame(self, frame: int) -> None:
        del self.frames[self._place(frame)]

    def stretch(self, share: float) -> None:
        first = self.frames[0]["timestamp"]
        for frame in self.frames:
            if isinstance(frame, dict):
                frame["timestamp"] = first + round((frame["timestamp"] - first) * share)

    def lose_ego(self, frame: int) -> None:
        item = self.frames[self._place(frame)]
        item["ego2global_translation"] = np.array([np.nan, *item["ego2global_translation"][1:]])

    def swap(self, frame: int) -> None:
        """Two frames."""
        at = self._place(frame)
        self.frames[at], self.frames[at + 1] = self.frames[at + 1], self.frames[at]

    def misname(self, thing: str, frame: int, name: str | None) -> tuple[float, float]:
        for anns, row in self._at(thing, np.array([frame])):
            anns["track_tokens"][row] = name
        return float(self.times_s[frame]), float(self.times_s[frame])

    def misclass(self, thing: str, frame: int) -> tuple[float, float]:
        for anns, row in self._at(thing, np.array([frame])):
            anns["gt_names"] = anns["gt_names"].astype("U32")
            anns["gt_names"][row] = "spaceship"
        return float(self.times_s[frame]), float(self.times_s[frame])

    def repeat(self, thing: str, frame: int) -> None:
        """A row of it, once more."""
        for anns, row in list(self._at(thing, np.array([frame]))):
            box, velocity = anns["gt_boxes"][row], anns["gt_velocity_3d"][row]
            self._append(anns, box, thing, str(anns["gt_names"][row]), velocity)

    def malform(self, frame: int, rng: Rng) -> None:
        """A frame that is none."""
        at = self._place(frame)
        self.frames[at] = BREAKS[rng.integers(len(BREAKS))](self.frames[at])

    def write(self, folder: Path) -> Path:
        (folder / self.path.name).write_bytes(pickle.dumps(self.frames))
        return folder


# The undamaged log against a damaged one.


@dataclass(frozen=True)
class DataSet:
    """Logs of one format."""

    logs: tuple[Path, ...]
    opened: Callable[[Path], DamagedLog]
    reader: Callable[[Path, Path], ClipReader]  # of a root that `write` gave, and of the log that it is a copy of


@dataclass
class Told:
    """What came of the damages of one kind."""

    injected: int = 0
    clips: int = 0  # windows of the logs that have it
    repaired: int = 0  # of those inside, read with a repair that the log as it is has not
    lost_inside: int = 0
    lost_outside: int = 0
    unequal_outside: int = 0
    unequal_others: int = 0  # inside, of things that no damage touches
    silent: int = 0  # inside, things that differ where no repair says so
    wrong: int = 0  # inside, things that are not where they are in truth

    @property
    def is_fine(self) -> bool:
        return not (self.lost_outside or self.unequal_outside or self.unequal_others or self.silent or self.wrong)


def read_all(reader: ClipReader) -> tuple[dict[int, Clip], list[str]]:
    """Clips by the milliseconds at which they begin, and what was said of the others."""
    index = reader.index()
    said, clips = [*index.broken.values(), *index.skipped_logs.values()], {}
    for ref in index.refs:
        try:
            clips[ref.start_ms] = reader.read(ref)
        except BadClip as error:
            said.append(str(error))
    return clips, said


def same(a: Any, b: Any) -> bool:
    """To the byte."""
    if isinstance(a, np.ndarray):
        return isinstance(b, np.ndarray) and a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    if is_dataclass(a):
        return type(a) is type(b) and all(same(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))
    if isinstance(a, tuple | list):
        return type(a) is type(b) and len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    return bool(a == b)


# nuScenes' ego is the smooth drive nearest to all of its log, on a clock that all of it tells: where a frame goes, the
# sign of a lost message of 20 ms may go with it.
SMOOTHED, SLACK = ("ego_states", "world_from_ego"), 0.3
APART = ("agents", "repairs", "content_digest")  # fields of a clip that are looked at apart, or are to differ


def same_but_agents(a: Clip, b: Clip, slack: float) -> bool:
    """Ego, map, route, lights, names; slack: of the ego's states and poses, in their units."""
    names = {f.name for f in fields(Clip)} - {*APART}
    if slack:
        names -= {*SMOOTHED}
        near = (np.abs(getattr(a, name) - getattr(b, name)).max() <= slack for name in SMOOTHED)
        return all(near) and all(same(getattr(a, name), getattr(b, name)) for name in names)
    return all(same(getattr(a, name), getattr(b, name)) for name in names)


def _of_thing(agents: AgentTracks, thing: str) -> tuple[Any, ...] | None:
    if thing not in agents.track_ids:
        return None
    n = agents.track_ids.index(thing)
    columns = agents.boxes[:, n], agents.velocities[:, n], agents.valid[:, n], agents.center_z[:, n]
    return agents.kinds[n], agents.heights[n], *(column.copy() for column in columns)


def differing(a: AgentTracks, b: AgentTracks) -> set[str]:
    """Things that are not the same to the byte."""
    return {t for t in {*a.track_ids, *b.track_ids} if not same(_of_thing(a, t), _of_thing(b, t))}


def is_far(found: AgentTracks, thing: str, truth: AgentTracks, true_thing: str) -> bool:
    """Whether a thing is away from where it is in truth at a step that both have."""
    if not {thing} <= {*found.track_ids} or not {true_thing} <= {*truth.track_ids}:
        return False
    n, m = found.track_ids.index(thing), truth.track_ids.index(true_thing)
    both = found.valid[:, n] & truth.valid[:, m]
    off = found.boxes[both, n] - truth.boxes[both, m]
    turned = np.abs((off[:, 2] + np.pi) % (2 * np.pi) - np.pi)
    sped = np.hypot(*(found.velocities[both, n] - truth.velocities[both, m]).T)
    far = np.hypot(*off[:, :2].T) > FAR_M, turned > FAR_RAD, sped > FAR_MPS, np.abs(off[:, 3:]).max(axis=1) > FAR_M
    return bool(np.any(far))


def thing_of(name: str) -> str:
    """What a piece of it is called after."""
    return name.partition("#")[0]


def _tells(repair: Repair, thing: str, inside: Sequence[Damage]) -> bool:
    """Whether a repair is of the thing, or of a frame, the ego or a nameless box at the time of what was done to it."""
    if thing_of(repair.thing) == thing:
        return True
    last_s = max(repair.time_s, repair.until_s)
    return (repair.thing in ("", EGO) or repair.thing.startswith("box ")) and any(
        d.first_s - 1.5 * STEP_S <= last_s and repair.time_s <= d.last_s + STEP_S
        for d in inside
        if d.things & {thing, ALL}
    )


def repaired_already(clip: Clip) -> set[str]:
    """Things that the log as it is has repairs of, and those that these name."""
    said = [(thing_of(repair.thing), f"{repair.was} {repair.now}") for repair in clip.repairs]
    return {thing for thing, _ in said} | {t for t in clip.agents.track_ids if any(t in words for _, words in said)}


@dataclass
class Trial:
    """One damaged log, read."""

    damages: tuple[Damage, ...]
    findings: list[str] = field(default_factory=list)


def injected(log: DamagedLog, rng: Rng) -> tuple[Damage, ...]:
    """Two to four kinds, of those that lose windows one at most; in place."""
    order = sorted(str(kind) for kind in rng.choice(list(INJECTIONS), rng.integers(2, MOST_DAMAGES + 1), replace=False))
    order.sort(key=lambda kind: LAST.index(kind) if kind in LAST else -1)
    damages = list[Damage]()
    for kind in order:
        if kind in LOSE and isinstance(log, NavsimLog) and any(damage.loses for damage in damages):
            continue
        damage = INJECTIONS[kind](log, rng)
        if damage is not None:
            damages.append(damage)
    return tuple(damages)


def tried(data: DataSet, path: Path, golden: dict[int, Clip], seed: int, table: dict[str, Told]) -> Trial:
    """One log with two to four damages, counted into the table by kind."""
    rng, log = np.random.default_rng(seed), data.opened(path)
    log.touched |= {name for clip in golden.values() for name in repaired_already(clip)}
    damages = injected(log, rng)
    trial = Trial(damages)
    with tempfile.TemporaryDirectory() as folder:
        try:
            found, said = read_all(data.reader(log.write(Path(folder)), path))
        except Exception as error:  # a crash is what is looked for
            found, said = {}, [f"raised {type(error).__name__}: {error}"]
    rows = [table.setdefault(damage.kind, Told()) for damage in damages]
    for row in rows:
        row.injected += 1
        row.clips += len(golden)
    smoothed = isinstance(log, NuscenesLog) and any(d.ego or d.kind == "frame missing" for d in damages)
    off_clock = any(damage.kind == "clock 3 % off" for damage in damages)
    for start_ms, truth in golden.items():
        inside = [d for d in damages if d.holds(start_ms / 1000, log.around_s)]
        here = [row for row, damage in zip(rows, damages) if damage in inside]

        def note(name: str, what: str, rows: Sequence[Told] = here, start_ms: int = start_ms) -> None:
            for row in rows:
                setattr(row, name, getattr(row, name) + 1)
            if name not in ("repaired", "lost_inside"):
                trial.findings.append(f"{start_ms} ms: {name} {what}")

        clip = found.get(start_ms)
        if clip is None:
            if not inside:
                note("lost_outside", "; ".join(said), rows)
            else:
                note("lost_inside", "")
                if not off_clock and not any(damage.loses for damage in inside):
                    trial.findings.append(f"{start_ms} ms: lost inside {'; '.join(said)}")
            continue
        unlike, rest = differing(clip.agents, truth.agents), same_but_agents(clip, truth, SLACK * smoothed)
        if not inside:
            if unlike or not rest:
                note("unequal_outside", f"{sorted(unlike)}, rest {rest}", rows)
            continue
        new = set(clip.repairs) - set(truth.repairs)
        if new:
            note("repaired", "")
        if off_clock:
            if not any(repair.what == "clock" for repair in new) and not isinstance(log, NavsimLog):
                note("silent", "clock")
            continue
        touched = frozenset[str]().union(*(damage.things for damage in inside))
        others = set() if ALL in touched else {t for t in unlike if thing_of(t) not in touched}
        if others or not (rest or ALL in touched):
            note("unequal_others", f"{sorted(others)}, rest {rest}")
        for thing in sorted(unlike - others):
            if not any(_tells(repair, thing_of(thing), inside) for repair in new):
                note("silent", thing)
            true_thing = next((t for t in truth.agents.track_ids if thing.endswith(t)), thing)
            if is_far(clip.agents, thing, truth.agents, true_thing):
                note("wrong", thing)
        if not rest and not any(_tells(repair, ALL, inside) for repair in new):
            note("silent", "the ego")
        if np.hypot(*(clip.ego_states - truth.ego_states)[:, :2].T).max() > FAR_M:
            note("wrong", "the ego")
    return trial


def data_sets(shared: Path, folder: Path, of: Sequence[str]) -> Iterator[tuple[str, DataSet]]:
    """The shared logs, and such as an export writes below a folder."""
    av2 = tuple(sorted((shared / "data/av2/sensor/val").iterdir()))
    if "av2" in of:
        yield "av2", DataSet(av2, AV2Files, lambda root, _: AV2Reader(root))
    if "nuscenes" in of:
        files = sorted((shared / "data/scenarionet/nuscenes").glob("*.pkl"))
        moving = tuple(path for path in files if "0553" not in path.name)  # whose ego stands
        yield "nuscenes", DataSet(moving, NuscenesLog, lambda root, _: ScenarioNetReader(root))
    if "navsim" in of:
        logs = tuple(exported_logs(av2[0].parent, folder / "navsim"))

        def reader(root: Path, log: Path) -> ClipReader:
            return NavsimReader(root, log.parent / "maps", stride_s=0.5, cache_dir=str(root / "tables"))

        yield "navsim", DataSet(logs, NavsimLog, reader)


def exported_logs(av2: Path, folder: Path) -> Iterator[Path]:
    """What `factory export navsim` writes of the human samples of Argoverse logs, joined to a log again, and its map.

    A sample is 12 frames and begins a second after the one before: two of each, and all of the last.
    """
    from factory.__main__ import main as factory
    from tests.factory.datasets.navsim.geopackage_writer import CITIES, ORIGIN, town_rows, write_geopackage

    out, to = folder / "run", folder / "export"
    words = ["clips=av2", f"clips.root={av2}", "experts=[human]", "rounds=1", "render=none", "reward.labels=none"]
    if code := run([*words, "executor=local", f"out={out}"]):
        raise RuntimeError(f"the run to export ended with {code}")
    city = "us-ma-boston"
    if code := factory(["export", "navsim", f"out={out}", f"to={to}", f"map_location={city}", "missing=none"]):
        raise RuntimeError(f"the export ended with {code}")
    samples = [pickle.loads(path.read_bytes()) for path in sorted(to.glob("navsim_logs/*/*.pkl"))]
    for log_folder in sorted(av2.iterdir()):
        name = log_folder.name.replace("-", "_")
        own = sorted((s for s in samples if s[0]["log_name"].startswith(name)), key=lambda s: s[0]["timestamp"])
        frames = [*(frame for sample in own[:-1] for frame in sample[:2]), *own[-1]]
        road_map = read_log(log_folder).road_map
        rows, (version, zone) = town_rows(road_map), CITIES[city]
        blocks = road_map.roadblock_of
        number = {blocks[str(row["fid"])]: str(row["lane_group_fid"]) for row in rows["lanes_polygons"]}
        number |= {blocks[str(row["fid"])]: str(row["lane_group_connector_fid"]) for row in rows["lane_connectors"]}
        (folder / name).mkdir()
        write_geopackage(folder / name / "maps" / city / version / "map.gpkg", rows, zone)
        for k, frame in enumerate(frames):
            route = [number.get(block, "0") for block in frame["roadblock_ids"]]
            frame |= {"log_name": name, "frame_idx": k, "roadblock_ids": route}
            frame["ego2global_translation"] = frame["ego2global_translation"] + np.append(ORIGIN, 0.0)
        path = folder / name / f"{name}.pkl"
        path.write_bytes(pickle.dumps(frames))
        yield path


def damaged(data: DataSet, seeds: Sequence[int], say: Callable[[str], object] = print) -> dict[str, Told]:
    """Kind -> what came of it, of one log a seed; findings are said."""
    golden: dict[Path, dict[int, Clip]] = {}
    table: dict[str, Told] = {}
    for seed in seeds:
        path = data.logs[seed % len(data.logs)]
        if path not in golden:
            with tempfile.TemporaryDirectory() as folder:
                golden[path], said = read_all(data.reader(data.opened(path).write(Path(folder)), path))
            assert golden[path] and not said, said
        trial = tried(data, path, golden[path], seed, table)
        if trial.findings:
            say(f"seed {seed}, {path.name}: {', '.join(f'{d.kind} {d.first_s:.1f}' for d in trial.damages)}")
            for finding in trial.findings:
                say(f"    {finding[:300]}")
    return table


SMALL = ("experts=[human,pdm_closed]", "rounds=1", "render=none", "reward.labels=none", "vocabulary.k=256")
SEES_THE_LOG = "content_digest"  # the column that is to differ: of the log's files


def rows_of(clips: str, root: Path, out: Path) -> dict[tuple[int, str], dict[str, str]]:
    """Samples of a small run, by milliseconds at which the clip begins and attempt; values as text."""
    words = [f"clips={clips}", f"clips.root={root}", "clips.split=train", "clips.stride_s=2.0", "executor=local"]
    if code := run([*words, *SMALL, f"out={out}"]):
        raise RuntimeError(f"the run on {root} ended with {code}")
    rows = Store(str(out)).samples.read().to_pylist()
    return {
        (round(1000 * row["clip_start_s"]), row["attempt_id"]): {
            name: repr(value) for name, value in row.items() if name != SEES_THE_LOG
        }
        for row in rows
    }


def unequal_rows(clips: str, data: DataSet, seed: int) -> tuple[int, list[str]]:
    """Rows of a run on a log that lie outside of all damages, and those that are not in the run on the damaged one."""
    path = data.logs[seed % len(data.logs)]
    rng, log, as_it_is = np.random.default_rng(seed), data.opened(path), data.opened(path)
    damages = injected(log, rng)
    with tempfile.TemporaryDirectory() as folder:
        places = [Path(folder) / name for name in ("a", "b")]
        for place in places:
            place.mkdir()
        truth, found = (
            rows_of(clips, one.write(place), Path(folder) / f"out-{place.name}")
            for one, place in zip((as_it_is, log), places)
        )
    outside = [key for key in truth if not any(d.holds(key[0] / 1000, log.around_s) for d in damages)]
    wrong = []
    for key in outside:
        if key not in found:
            wrong.append(f"{key}: no such row")
        elif columns := [name for name in truth[key] if truth[key][name] != found[key][name]]:
            wrong.append(f"{key}: {', '.join(columns)}")
    return len(outside), wrong


CLIPS = {"av2": "av2", "nuscenes": "scenarionet"}  # that a run names so


def main(argv: Sequence[str]) -> int:
    """The table; 1 where anything is not as it should be."""
    shared, *words = argv
    given = dict(word.split("=", 1) for word in words)
    seeds, of = range(int(given.get("seeds", 200))), given.get("of", "av2,nuscenes,navsim").split(",")
    n_rows = int(given.get("rows", 0))
    fine = True
    lines, rows = [], []
    with tempfile.TemporaryDirectory() as folder:
        for name, data in data_sets(Path(shared).resolve(), Path(folder), of):
            for kind, told in sorted(damaged(data, seeds).items()):
                lines.append(f"| {name} | {kind} | {' | '.join(str(value) for value in vars(told).values())} |")
                fine &= told.is_fine
            for seed in range(n_rows if name in CLIPS else 0):
                n, wrong = unequal_rows(CLIPS[name], data, seed)
                rows.append(f"{name}, seed {seed}: {n} rows outside, unequal {len(wrong)} {'; '.join(wrong)}")
                fine &= not wrong
    print("| logs | damage |", " | ".join(f.name.replace("_", " ") for f in fields(Told)), "|")
    print("|---|---|" + "---|" * len(fields(Told)))
    print("\n".join([*lines, *rows]))
    return 0 if fine else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
