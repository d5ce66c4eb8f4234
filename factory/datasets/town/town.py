"""The town as one object, and its logs' plans: pure functions of the seed, nothing is written here."""

import hashlib
import json
import logging
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.feather
import shapely
from scipy.spatial.transform import Rotation

from factory.datasets.av2.reader import POSE_COLUMNS, SIZE_COLUMNS
from factory.datasets.town.draw import (
    MOUNT_M,
    REAR_AXLE_Z_M,
    TownRenderer,
    build_rig,
    paint,
    scan_lidar,
    world_from_ego,
)
from factory.datasets.town.drive import GREEN, RED, SCENARIOS, YELLOW, TownDrive, TownTrack, parked_cars, plan_drive
from factory.datasets.town.scenery import Scenery, build_scenery
from factory.datasets.town.settings import LOG_STEPS, LOGS_PER_TOWN, STEPS_PER_SWEEP, TownSettings
from factory.datasets.town.streets import Streets, TownLane, build_streets
from factory.exits import ignore_terminal_signals, terminal_signals_blocked
from factory.files import matching_below
from factory.wording import time_text
from tasks.caches import Damaged, json_with_checksum, parse_json_with_checksum
from tasks.world.arrays import Array, Ints
from tasks.world.clip import Camera

# A folder of files that can be made again: it is there whole or not at all, and holds the checksums of its files.
#
# What writes it must give the same bytes each time. Several processes may write one folder at once; the first wins.

log = logging.getLogger(__name__)

SUMS = "checksums.json"

Write = Callable[[Path], object]  # fills an empty folder


def write_once(root: Path, write: Write) -> None:
    """The folder `root` with what `write` writes into it, unless it is there: whole or not at all."""
    if not root.is_dir():
        fill_and_place(make_unfinished_folder(root), root, write)


def make_unfinished_folder(root: Path) -> Path:
    """A new empty folder beside `root`, or beside what a link of that name leads to, to become it."""
    root = root.resolve()
    root.parent.mkdir(parents=True, exist_ok=True)
    return Path(tempfile.mkdtemp(prefix=f".{root.name}-", dir=root.parent))


def fill_and_place(unfinished: Path, root: Path, write: Write) -> None:
    """Has `unfinished` written and renames it to `root`; it is gone afterwards, whatever happened."""
    try:
        _fill(unfinished, write, root.name)
        _place(unfinished, root)
    except OSError as error:
        error.filename = error.filename or str(root)  # Arrow and a flush name none
        raise
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


def repair_folder(root: Path, write: Write) -> None:
    """Holds a folder that is there against its checksums; where it is damaged it is made again and takes its place.

    One line in the log says what was wrong.
    """
    if not (wrong := _find_damage(root)):
        return
    log.warning("%s is damaged (%s); it is made again", root, wrong)
    anew, old = make_unfinished_folder(root), make_unfinished_folder(root)
    try:
        _fill(anew, write, root.name)
        with suppress(FileNotFoundError):  # another worker is about to put the same there
            os.rename(root.resolve(), old / root.name)
        _place(anew, root)
    finally:
        for folder in (anew, old):
            shutil.rmtree(folder, ignore_errors=True)


def _place(unfinished: Path, root: Path) -> None:
    try:
        os.rename(unfinished, root.resolve())
    except OSError:
        if not root.is_dir():  # else another worker was first, with the same bytes
            raise


def _fill(folder: Path, write: Write, named: str) -> None:
    write(folder)
    sums = {name: _digest(folder / name) for name in _files(folder)}
    (folder / SUMS).write_text(json_with_checksum({"folder": named, "files": sums}))


def _find_damage(root: Path) -> str:
    """The first file that is not as it was written, and why; empty: all are."""
    try:
        told = parse_json_with_checksum((root / SUMS).read_bytes())
    except FileNotFoundError:
        return f"no {SUMS}"
    except Damaged as error:
        return f"{SUMS}: {error}"
    if told.get("folder") != root.name:
        return f"{SUMS} is of {told.get('folder')}"
    for name, digest in told["files"].items():
        if not (root / name).is_file():
            return f"{name} is missing"
        if _digest(root / name) != digest:
            return f"{name}: its checksum is another than when it was written"
    return ""


def _files(folder: Path) -> list[str]:
    """All but the checksums."""
    names = (path.relative_to(folder).as_posix() for path in matching_below(folder, "*") if path.is_file())
    return sorted(name for name in names if name != SUMS)


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


WINDOWS_PER_LOG = 3  # of 9.5 s at stride 1 s


@dataclass(frozen=True)
class Town:
    """Streets, what is parked there, what it looks like, and its weather."""

    seed: int
    number: int
    streets: Streets
    parked: tuple[TownTrack, ...]
    sun_azimuth: float
    sun_elevation: float
    sky_seed: int

    @property
    def name(self) -> str:
        """As the files of its map say it."""
        return f"SYN{self.number:02d}"

    @cached_property
    def scenery(self) -> Scenery:
        """Houses, trees, road marks: seconds to build, so logs that nobody sees go without."""
        return build_scenery(self.streets, np.random.default_rng([self.seed, self.number, 2]))


@lru_cache(maxsize=1)
def build_town(seed: int, number: int) -> Town:
    """Town `number` of a seed."""
    streets = build_streets(np.random.default_rng([seed, number, 0]))
    parked = parked_cars(streets, np.random.default_rng([seed, number, 1]))
    rng = np.random.default_rng([seed, number, 3])
    return Town(
        seed,
        number,
        streets,
        parked,
        float(rng.uniform(-np.pi, np.pi)),
        float(np.deg2rad(rng.uniform(35.0, 55.0))),
        int(rng.integers(1 << 20)),
    )


def log_name(seed: int, index: int) -> str:
    """The log's id; sorts in the order of the logs."""
    kind = SCENARIOS[index % LOGS_PER_TOWN].kind.lower().replace(" ", "-")
    return f"town-{seed}-{index:04d}-{kind}"


def plan_log(seed: int, index: int) -> tuple[Town, TownDrive]:
    """The drive of log `index`, and the town it leads through."""
    town = build_town(seed, index // LOGS_PER_TOWN)
    return town, plan_drive(town.streets, town.parked, SCENARIOS[index % LOGS_PER_TOWN], LOG_STEPS, [seed, index, 4])


# Writes drives through the town as Argoverse 2 sensor logs, plus one file for the phases of the lights.
#
# Argoverse 2's layout (Wilson et al. 2021): annotations, ego poses, calibration, vector map, images and sweeps by
# stamp.

LICENCE = "Apache-2.0 (synthetic)"
ANNOTATION_RANGE_M = 100.0
MAP_RANGE_M = 260.0  # of the drive
LIDARS = ("up_lidar", "down_lidar")  # Argoverse's two names, which converters look up; here they are one and the same
STEP_NS = 100_000_000
FIRST_STAMP_NS = 315_970_000_000_000_000
LOG_SPACING_NS = 60_000_000_000
PAINTED_EVERY_S = 5.0  # between two lines that tell how far it is
STATE_NAMES = {GREEN: "GREEN", YELLOW: "YELLOW", RED: "RED"}


def write_town(out: Path, n_clips: int, seed: int, settings: TownSettings, threads: int = 2) -> list[Path]:
    """Writes the logs that hold the seed's first `n_clips` clips under `out`; returns their folders.

    Logs are whole, so the last may hold up to two windows more. The same arguments give the same bytes, whatever
    `threads`; a longer run starts with the logs of a shorter one. Raises ValueError for n_clips < 1.
    """
    if n_clips < 1:
        raise ValueError(f"a town needs at least one clip, not {n_clips}")
    return write_logs(out, range(-(-n_clips // WINDOWS_PER_LOG)), seed, settings, threads)


def paint_smallest() -> None:
    """Writes the smallest log of a town into a folder that is thrown away, by which every kernel is entered."""
    settings = TownSettings(cameras=("ring_front_center",), width=16, height=16, lidar_beams=1, lidar_azimuths=8)
    with tempfile.TemporaryDirectory() as folder:
        write_town(Path(folder), 1, 0, settings, threads=1)


def write_logs(out: Path, indices: Collection[int], seed: int, settings: TownSettings, threads: int = 2) -> list[Path]:
    """Writes these logs of the seed under `out`; a log's bytes depend on its index, not on the others.

    Logs with sensors take a minute of a core each, so how far it is goes to stderr.
    """
    began, said, n = 0.0, 0.0, len(indices)

    def show(whole: int, share: float) -> None:
        nonlocal began, said
        now, logs = time.monotonic(), whole + share
        if not began:  # the first instant may have waited for the painter to be compiled
            began = said = now
        elif logs == n or now - said >= PAINTED_EVERY_S:
            said, left = now, time_text((now - began) / logs * (n - logs))
            print(f"town {seed}: {100.0 * logs / n:.0f} % painted  ETA {left}", file=sys.stderr, flush=True)

    if settings.cameras or settings.lidar_beams:
        about = "once for these settings; half a minute more where the painter is compiled first"
        print(f"painting town {seed}, logs: {n}, {about}", file=sys.stderr, flush=True)
    return [
        write_log(out / log_name(seed, i), *plan_log(seed, i), settings, i, threads, partial(show, k))
        for k, i in enumerate(indices)
    ]


def write_log(
    folder: Path,
    town: Town,
    drive: TownDrive,
    settings: TownSettings,
    number: int = 0,
    threads: int = 2,
    show: Callable[[float], object] = lambda share: None,
) -> Path:
    """Writes one drive as a log folder; show: is told which share of its instants is sensed."""
    folder.mkdir(parents=True, exist_ok=True)
    stamps = FIRST_STAMP_NS + number * LOG_SPACING_NS + np.arange(LOG_STEPS, dtype=np.int64) * STEP_NS
    _feather(folder / "city_SE3_egovehicle.feather", _poses(drive, stamps))
    _feather(folder / "annotations.feather", _annotations(drive, stamps))
    if lights := _lights(town.streets, drive, stamps):
        _feather(folder / "traffic_lights.feather", lights)
    rig = build_rig(settings.cameras, settings.width, settings.height)
    _calibration(folder, rig, LIDARS if settings.lidar_beams else ())
    (folder / "map").mkdir(exist_ok=True)
    content = json.dumps(_vector_map(town.streets, drive), separators=(",", ":"))
    (folder / "map" / f"log_map_archive_{folder.name}____{town.name}_city_0.json").write_text(content, encoding="utf-8")
    (folder / "LICENSE").write_text(
        f"{LICENCE}\nMade by the data factory's synthetic town; test data.\n", encoding="utf-8"
    )
    _sensors(folder, town, drive, rig, settings, stamps, threads, show)
    return folder


def _sensors(
    folder: Path,
    town: Town,
    drive: TownDrive,
    rig: tuple[Camera, ...],
    settings: TownSettings,
    stamps: Ints,
    threads: int,
    show: Callable[[float], object],
) -> None:
    kinds = [f"cameras/{camera.name}" for camera in rig] + ["lidar"] * bool(settings.lidar_beams)
    if not kinds:
        return
    renderer = TownRenderer(town.scenery, drive, town.sun_azimuth, town.sun_elevation, town.sky_seed)
    for kind in kinds:
        (folder / "sensors" / kind).mkdir(parents=True, exist_ok=True)
    photographed = range(0, settings.photo_steps if rig else 0, settings.steps_per_photo)
    swept = range(0, LOG_STEPS if settings.lidar_beams else 0, STEPS_PER_SWEEP)

    def record(step: int) -> None:
        scene, pose, stamp = renderer.scene_at(step), world_from_ego(drive.ego[step]), int(stamps[step])
        for camera in rig if step in photographed else ():
            picture = cv2.cvtColor(paint(scene, camera, pose), cv2.COLOR_RGB2BGR)
            _ok, jpeg = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, settings.jpeg_quality])
            (folder / "sensors" / "cameras" / camera.name / f"{stamp}.jpg").write_bytes(jpeg.tobytes())
        if step in swept:
            sweep = scan_lidar(scene, pose, settings.lidar_beams, settings.lidar_azimuths)
            columns = {axis: pa.array(sweep.points[:, k]) for k, axis in enumerate("xyz")}
            columns |= {name: pa.array(getattr(sweep, name)) for name in ("intensity", "laser_number", "offset_ns")}
            _feather(folder / "sensors" / "lidar" / f"{stamp}.feather", columns)

    with ThreadPoolExecutor(max_workers=threads) as pool:
        instants = sorted({*photographed, *swept})
        for done, _ in enumerate(pool.map(record, instants), start=1):
            show(done / len(instants))


def _feather(path: Path, columns: Mapping[str, Any]) -> None:
    pyarrow.feather.write_feather(pa.table(columns), path)


def _yaw_columns(yaw: Array) -> dict[str, Any]:
    zero = np.zeros(len(yaw))
    return {"qw": np.cos(yaw / 2), "qx": zero, "qy": zero, "qz": np.sin(yaw / 2)}


def _poses(drive: TownDrive, stamps: Ints) -> dict[str, Any]:
    place = {"tx_m": drive.ego[:, 0], "ty_m": drive.ego[:, 1], "tz_m": np.full(len(stamps), REAR_AXLE_Z_M)}
    return {"timestamp_ns": stamps, **_yaw_columns(drive.ego[:, 2]), **place}


def _annotations(drive: TownDrive, stamps: Ints) -> dict[str, Any]:
    """One row per box and frame, box pose in the ego frame of that frame."""
    poses = np.stack([track.poses for track in drive.tracks], axis=1)
    delta = poses[..., :2] - drive.ego[:, None, :2]
    step, which = np.nonzero(np.hypot(delta[..., 0], delta[..., 1]) < ANNOTATION_RANGE_M)
    heading = drive.ego[step, 2]
    dx, dy = delta[step, which].T
    sizes = np.array([track.size for track in drive.tracks])[which]
    distance = np.hypot(dx, dy)
    return {
        "timestamp_ns": stamps[step],
        "track_uuid": [drive.tracks[k].track_id for k in which],
        "category": [drive.tracks[k].category for k in which],
        **dict(zip(SIZE_COLUMNS, sizes.T)),
        **_yaw_columns(poses[step, which, 2] - heading),
        "tx_m": np.cos(heading) * dx + np.sin(heading) * dy,
        "ty_m": -np.sin(heading) * dx + np.cos(heading) * dy,
        "tz_m": sizes[:, 2] / 2 - REAR_AXLE_Z_M,
        "num_interior_pts": np.maximum(1, 40_000 / np.maximum(distance, 4.0) ** 2).astype(np.int64),
    }


def _lights(streets: Streets, drive: TownDrive, stamps: Ints) -> dict[str, Any]:
    """A row per frame and light-governed connector of the map; empty where it has none."""
    governed = [lane for lane in _near_lanes(streets, drive) if lane.light_group >= 0]
    if not governed:
        return {}
    states = {
        group: [STATE_NAMES[drive.signals.state(group, float(t))] for t in drive.times_s]
        for group in sorted({lane.light_group for lane in governed})
    }
    return {
        "timestamp_ns": np.tile(stamps, len(governed)),
        "lane_id": np.repeat(np.array([lane.lane_id for lane in governed], np.int64), len(stamps)),
        "state": [state for lane in governed for state in states[lane.light_group]],
    }


def _calibration(folder: Path, rig: tuple[Camera, ...], lidars: tuple[str, ...]) -> None:
    """Intrinsics of the cameras, and how cameras and lidars are mounted; nothing for a town without cameras."""
    if not rig:
        return
    (folder / "calibration").mkdir(exist_ok=True)
    names, k = {"sensor_name": [camera.name for camera in rig]}, np.array([camera.intrinsics for camera in rig])
    intrinsics = {"fx_px": k[:, 0, 0], "fy_px": k[:, 1, 1], "cx_px": k[:, 0, 2], "cy_px": k[:, 1, 2]}
    intrinsics |= dict.fromkeys(("k1", "k2", "k3"), np.zeros(len(rig)))
    sides = {f"{side}_px": np.array([getattr(c, side) for c in rig], np.uint16) for side in ("height", "width")}
    _feather(folder / "calibration" / "intrinsics.feather", names | intrinsics | sides)
    mounts = np.array([camera.ego_from_camera for camera in rig])
    columns = np.column_stack([Rotation.from_matrix(mounts[:, :3, :3]).as_quat()[:, [3, 0, 1, 2]], mounts[:, :3, 3]])
    level = np.array([[1.0, 0.0, 0.0, 0.0, *MOUNT_M]] * len(lidars)).reshape(-1, len(POSE_COLUMNS))
    poses = {"sensor_name": [*names["sensor_name"], *lidars]}
    poses |= dict(zip(POSE_COLUMNS, np.concatenate([columns, level]).T))
    _feather(folder / "calibration" / "egovehicle_SE3_sensor.feather", poses)


def _near_lanes(streets: Streets, drive: TownDrive) -> list[TownLane]:
    middle = drive.ego[len(drive.ego) // 2, :2]
    return [lane for lane in streets.lanes.values() if np.hypot(*(lane.center[:, :2] - middle).T).min() < MAP_RANGE_M]


def _vector_map(streets: Streets, drive: TownDrive) -> dict[str, dict[str, Any]]:
    """The vector map around the drive; a neighbour's or successor's id may lie outside it, as in Argoverse's crops."""
    lanes = {
        str(lane.lane_id): {
            "id": lane.lane_id,
            "is_intersection": lane.is_intersection,
            "lane_type": lane.kind,
            "left_lane_boundary": _points(_thinned(lane.left)),
            "left_lane_mark_type": lane.left_mark,
            "right_lane_boundary": _points(_thinned(lane.right)),
            "right_lane_mark_type": lane.right_mark,
            "successors": lane.successors,
            "predecessors": lane.predecessors,
            "right_neighbor_id": lane.right_neighbor,
            "left_neighbor_id": lane.left_neighbor,
        }
        for lane in _near_lanes(streets, drive)
    }
    areas = {
        str(1 + k): {"area_boundary": _points(np.asarray(ring.simplify(0.01).exterior.coords)[:-1]), "id": 1 + k}
        for k, ring in enumerate(map(shapely.Polygon, streets.areas))
    }
    crossings = {
        str(501 + k): {"edge1": _points(crossing.edge1), "edge2": _points(crossing.edge2), "id": 501 + k}
        for k, crossing in enumerate(streets.crossings)
    }
    return {"lane_segments": lanes, "drivable_areas": areas, "pedestrian_crossings": crossings}


def _points(line: Array) -> list[dict[str, float]]:
    return [{"x": round(float(x), 4), "y": round(float(y), 4), "z": 0.0} for x, y in line[:, :2]]


def _thinned(line: Array) -> Array:
    """Every other point of more than four, both ends kept: 2 m apart."""
    return line if len(line) <= 4 else line[np.unique(np.append(np.arange(0, len(line) - 1, 2), len(line) - 1))]


# Several towns at once, each written by a process of its own: planning a drive is Python, and holds the interpreter.
#
#     python -m factory.datasets.town.town <a town as JSON>       what such a process runs
#
# The process that waits for them owns the folders they write in. To stop them it kills them and removes those: an
# interrupt is an exception in Python, and one that arrives while a kernel is compiled or loaded is lost in a
# callback. They end with it, however it ends: it holds the other end of the pipe that is their standard input.
#
# Only towns with sensors are worth a process, which starts in seconds: a log without cameras and lidar is written in
# two.

MOST_PAINTERS = 8  # processes; each takes half a gigabyte
LOOK_EVERY_S = 0.1


@dataclass(frozen=True)
class TownFolder:
    """The chosen logs of one seed's town, and the folder that holds them or will."""

    seed: int
    indices: tuple[int, ...]
    root: Path

    def logs(self) -> dict[str, Path]:
        """Log id -> folder, of logs that may not be written yet."""
        return {name: self.root / name for name in (log_name(self.seed, index) for index in self.indices)}


def write_town_folder(town: TownFolder, settings: TownSettings) -> None:
    """Writes the town whole, unless it is there."""
    write_once(town.root, lambda folder: write_logs(folder, town.indices, town.seed, settings))


def write_towns(towns: Sequence[TownFolder], settings: TownSettings) -> None:
    """Writes the towns that are missing, as many at once as there are cores; how far it is goes to stderr.

    Raises what a process was refused a file with, a full disk say, as if the town had been written here; RuntimeError
    where it ended otherwise, with what it said on stderr. The towns that others were writing are given up then.
    Interrupted, it leaves whole towns and nothing else.
    """
    missing = [town for town in towns if not town.root.is_dir()]
    at_once = min(len(missing), os.cpu_count() or 1, MOST_PAINTERS) if settings.cameras or settings.lidar_beams else 1
    done, began = 0, time.monotonic()

    def show(town: TownFolder) -> None:
        nonlocal done
        done += 1
        left = (time.monotonic() - began) / done * (len(missing) - done)
        told = f"town {done} of {len(missing)}: seed {town.seed}, {len(town.indices)} logs painted"
        print(f"{told}  ETA {time_text(left)}", file=sys.stderr, flush=True)

    if at_once <= 1:
        for town in missing:
            write_town_folder(town, settings)
            show(town)
        return
    waiting, painting, begun = deque(missing), dict[subprocess.Popen[bytes], TownFolder](), list[Path]()
    lifeline, held = os.pipe()
    try:
        while waiting or painting:
            while waiting and len(painting) < at_once:
                town = waiting.popleft()
                begun.append(make_unfinished_folder(town.root))
                paths = {"root": str(town.root), "unfinished": str(begun[-1])}
                told = {"seed": town.seed, "indices": town.indices, "settings": asdict(settings)} | paths
                command = [sys.executable, "-m", __name__, json.dumps(told)]
                with terminal_signals_blocked():  # until it is known, and can be ended
                    child = subprocess.Popen(command, stdin=lifeline, stdout=subprocess.PIPE)  # noqa: S603 - our own
                    painting[child] = town
            for child in [child for child in painting if child.poll() is not None]:
                town = painting.pop(child)
                if refused := child.communicate()[0]:
                    raise OSError(*json.loads(refused))
                if child.returncode != 0:
                    ended = f"its process ended with exit {child.returncode} and said above why"
                    raise RuntimeError(
                        f"town {town.seed}: {ended}; towns that are written stay, the same command goes on"
                    )
                show(town)
            time.sleep(LOOK_EVERY_S)
    finally:
        os.close(held)
        os.close(lifeline)
        for child in painting:
            child.kill()
        for child in painting:
            child.communicate()
        for folder in begun:
            shutil.rmtree(folder, ignore_errors=True)  # where its town is whole, it is gone


def main(told: str) -> None:
    """A painter's process: one town, on one core. Tells on standard output what it is refused."""
    ignore_terminal_signals()
    threading.Thread(target=_end_with_input, daemon=True).start()
    town = json.loads(told)
    arguments = town["indices"], town["seed"], TownSettings(**town["settings"])
    unfinished, root = Path(town["unfinished"]), Path(town["root"])
    try:
        fill_and_place(unfinished, root, lambda folder: write_logs(folder, *arguments, threads=1))
    except OSError as error:
        if error.errno is None:
            raise
        print(json.dumps([error.errno, error.strerror, os.fspath(error.filename)]))


def _end_with_input() -> None:
    os.read(sys.stdin.fileno(), 1)
    os._exit(1)


if __name__ == "__main__":
    main(sys.argv[1])
