"""The Gaussian scene of a clip's block: built once, kept on disk under the digest of what it is built from.

A block is a stretch of a log that several clips lie in (tasks.world.clip.Block). Whoever comes first on a machine
builds the scene while the others wait for it; the file appears by an atomic rename, so that a killed builder leaves
nothing half done.
"""

import hashlib
import json
import logging
import time
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, replace
from enum import Enum
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from factory.files import atomic_file, locked, raising_place_refused
from factory.graph.steps import StopCheck, TaskStopped, never_stop
from factory.readers.pictures import file_and_frame
from factory.stages.scene_file import CALIBRATED, SUFFIX, BadScene, read_scene, write_scene
from factory.stages.sensors import (
    NO_MASKS,
    SensorData,
    block_cameras,
    block_of,
    choose_cameras,
    ego_poses_of_files,
    files_of_cameras,
    load_sensors,
    masks_digest,
    opened_photos,
    own_body_masks,
)
from factory.store.location import Location
from factory.wording import time_text
from tasks.caches import Damaged, append_checksum, json_with_checksum, parse_json_with_checksum, verify_checksum
from tasks.render.fit.reconstruct import finish_scene, fit_backend, run_iterations
from tasks.render.fit.start import prepare_fit
from tasks.render.fit.state import FitState
from tasks.render.rig.correct import RigCorrection, correct_rig, detect_corners, estimate_ground_height, movable_mask
from tasks.render.scene.asset import BlockRange, PhotoPose, RenderAsset, photo_rises
from tasks.render.scene.build import build_asset
from tasks.render.scene.engine import require_backend
from tasks.render.scene.features import KnownPoints, driven_roads
from tasks.render.scene.movers import lift_tracks
from tasks.render.scene.sensed import median_own_bodies
from tasks.render.scene.stereo import MAX_BASELINE_M, MIN_BASELINE_M
from tasks.render.settings import Adjust, Backend, FitSettings, RenderSettings, RigSettings, SceneDtype, SceneFrom
from tasks.world.arrays import Array, Bools
from tasks.world.clip import AgentTracks, Block, Camera, Clip, PhotoDrive, SensorFile, is_of_other_log, own_name

# A block's cameras and poses corrected by its photos before anything is made of them, and what that changed, on disk.
#
# `block-<id>.rig.json` lies beside the scene: what was corrected camera by camera, photos that show something else
# than what their neighbours say, and cameras and poses as they were used. Photos that samples keep are cut and
# described by it as well, without the scene.

RIG_SUFFIX = ".rig.json"
SAME_S = 1e-3  # between the stamp of a photo counted from its clip and from its block
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class CorrectedRig:
    """A block's cameras, and where its photos were taken, as these say; times count from the block's first step."""

    cameras: tuple[Camera, ...]
    taken: tuple[PhotoPose, ...]  # all photos, those among them that were left out of the scene

    def as_corrected(self, cameras: Sequence[Camera]) -> tuple[Camera, ...]:
        """Those of the same names."""
        mine = {camera.name: camera for camera in self.cameras}
        return tuple(mine[camera.name] for camera in cameras)

    def posed(self, files: Sequence[SensorFile], first_s: float) -> tuple[SensorFile, ...]:
        """Photos of the block where they were taken; their own times count from `first_s` of it."""
        return tuple(replace(file, world_from_ego=self._pose(file.sensor, file.time_s + first_s)) for file in files)

    def _pose(self, camera: str, time_s: float) -> Array:
        for photo in self.taken:
            if photo.camera == camera and abs(photo.time_s - time_s) < SAME_S:
                return photo.world_from_ego
        raise KeyError(f"{camera} took no photo of the block at {time_s:.3f} s")

    def on_road(self) -> Array:
        """(P, 4, 4) poses that say how high the road is and how it leans."""
        return np.stack([photo.world_from_ego for photo in self.taken])

    def lifted(self, agents: AgentTracks, first_s: float) -> AgentTracks:
        """Tracks whose first step is at `first_s` of the block, as high above that road as they were logged."""
        times, rises = photo_rises(self.taken)
        return lift_tracks(agents, times - first_s, rises)


def needs_rig_correction(block: Block, settings: RigSettings) -> bool:
    """Whether the block's rig is to be corrected."""
    return bool(block.images) and (
        settings.adjust is Adjust.ON or (settings.adjust is Adjust.AUTO and not block.sweeps)
    )


def correct_block_rig(
    path: Path, block: Block, cameras: Sequence[Camera], own_body: Mapping[str, Bools] = NO_MASKS
) -> tuple[Block, tuple[Camera, ...], RigCorrection | None]:
    """Block and cameras as the photos say they are, and what was found, which is written beside `path`.

    As given, and None, where too few corners are shared to find anything, which is written as well. Raises BadClip for
    a photo that is missing, broken or not of its camera's size.
    """
    files = files_of_cameras(cameras, block.images)
    corners = {}
    for row, image in opened_photos(files, cameras):
        (camera,) = (camera for camera in cameras if camera.name == files[row].sensor)
        hidden = movable_mask(block.agents, camera, files[row], own_body.get(camera.name))
        corners[row] = detect_corners(image, hidden)
    found = correct_rig(cameras, files, [corners[row] for row in range(len(files))])
    if found is None:
        log.warning("%s: too few corners are shared by the photos: calibration and poses are used as given", path.stem)
        _write_rig_file(path, {"cameras": [], "used": [], "taken": []})
        return block, tuple(cameras), None
    for line in rig_report_lines(found):
        log.info("%s: %s", path.stem, line)
    _write_rig_file(path, rig_report(found, files))
    for file in (files[row] for row in found.strangers):
        log.warning("%s: %s at %.2f s is left out: it does not show what its neighbours do: %s", path.stem, file.sensor,
                    file.time_s, file.uri)  # fmt: skip
    kept = tuple(file for row, file in enumerate(found.files) if row not in found.strangers)
    return replace(block, images=kept), found.cameras, found


def _write_rig_file(path: Path, found: dict[str, object]) -> None:
    text = json_with_checksum({"block": path.stem, **found})
    with atomic_file(path.with_suffix(RIG_SUFFIX), len(text)) as draft:
        draft.write_text(text, encoding="utf-8")


def read_rig_file(said: Path) -> dict[str, Any]:
    """What a file tells of its block. Raises Damaged, OSError."""
    told = parse_json_with_checksum(said.read_bytes())
    if told.pop("block", None) != said.name.removesuffix(RIG_SUFFIX):
        raise Damaged("it was written of another block")
    return told


def read_or_correct_rig(
    path: Path, block: Block, cameras: Sequence[Camera], own_body: Callable[[], Mapping[str, Bools]] = dict
) -> CorrectedRig | None:
    """The rig as it is told beside `path`, found first where nothing is told there; None where nothing can be found.

    Raises BadClip.
    """
    said = path.with_suffix(RIG_SUFFIX)
    try:
        told = read_rig_file(said)
    except (FileNotFoundError, Damaged) as error:
        if isinstance(error, Damaged):
            log.warning("%s: %s; it is written again", said, error)
        correct_block_rig(path, block, cameras, own_body())
        told = read_rig_file(said)
    used: dict[str, dict[str, Any]] = {
        row["name"]: {key: np.array(row[key], np.float64) for key in CALIBRATED} for row in told["used"]
    }
    if not used:
        return None
    taken = (PhotoPose(name, time_s, np.reshape(pose, (4, 4)), rise_m) for name, time_s, rise_m, pose in told["taken"])
    return CorrectedRig(tuple(replace(camera, **used[camera.name]) for camera in cameras), tuple(taken))


def known_points(data: SensorData, block: Block, found: RigCorrection) -> KnownPoints:
    """What is known of a corrected block: its corners, and the road, looked for where no reader says where it is."""
    road = data.known.road
    if road is None and not data.sweeps:
        poses, times_s = ego_poses_of_files(block.images)
        ground_m = estimate_ground_height(data.photos, poses)
        if ground_m is not None:
            log.info("road: %.2f m above the ego's origin", ground_m)
            road = driven_roads(poses, times_s, ground_m)
    return KnownPoints(road, found.points)


def photo_poses(given: Sequence[SensorFile], used: Sequence[SensorFile]) -> tuple[PhotoPose, ...]:
    """Where the photos that are used of those given were taken."""
    logged = {(file.sensor, file.time_s): file.world_from_ego[2, 3] for file in given}
    return tuple(
        PhotoPose(f.sensor, f.time_s, f.world_from_ego, float(f.world_from_ego[2, 3] - logged[f.sensor, f.time_s]))
        for f in used
    )


def rig_report(found: RigCorrection, given: Sequence[SensorFile]) -> dict[str, Any]:
    """What was found of the photos as `given`, as plain JSON values."""
    return {
        "cameras": [asdict(change) for change in found.changes],
        "ego_shift_m": found.ego_shift_m,
        "ego_turn_deg": found.ego_turn_deg,
        "points": len(found.points),
        "left_out": [[found.files[row].sensor, found.files[row].time_s] for row in found.strangers],
        "used": [
            {"name": camera.name} | {name: getattr(camera, name).tolist() for name in CALIBRATED}
            for camera in found.cameras
        ],
        "taken": [
            [photo.camera, photo.time_s, photo.rise_m, photo.world_from_ego.ravel().tolist()]
            for photo in photo_poses(given, found.files)
        ],
    }


def rig_report_lines(found: RigCorrection) -> list[str]:
    """What was found, for people: a line for each camera and one for the drive."""
    lines = []
    for change in found.changes:
        shift, turn = 100.0 * np.linalg.norm(change.shift_m), np.linalg.norm(change.turn_deg)
        lines.append(
            f"{change.camera}: moved {shift:.1f} cm, turned {turn:.2f} deg, focal length {change.focal_px[0]:+.1f} px, "
            f"centre {change.centre_px[0]:+.1f} {change.centre_px[1]:+.1f} px, "
            f"{change.corners} corners off by {change.before_px:.2f} px before, {change.after_px:.2f} after"
        )
    lines.append(f"ego: moved {100.0 * found.ego_shift_m:.1f} cm, turned {found.ego_turn_deg:.2f} deg (rms)")
    return lines


# A block's scene fitted to its photos, in stretches: a killed fit goes on where the last stretch ended.

STRETCH = 500  # iterations between two saves
FIT_SUFFIX, PROGRESS_SUFFIX = ".fit.npz", ".fit.json"  # what is half done, and how far it is
FRESH_S = 120.0  # what was said longer ago is no news


def fit_scene(
    path: Path,
    data: SensorData,
    agents: AgentTracks | None,
    settings: FitSettings,
    threads: int,
    stopped: StopCheck = never_stop,
    backend: Backend = Backend.CPU,
) -> RenderAsset:
    """The scene of a block's sensors; what is half done lies beside `path`, where the scene will be stored.

    A fit that was killed or halted comes to the same bytes as one that was not. Raises TaskStopped once it is
    `stopped`, with all of its iterations kept, ValueError without photos to learn from, and BackendMissing.
    """
    require_backend(backend)
    problem, state = prepare_fit(data.photos, data.sweeps, agents, settings, threads=threads, known=data.known)
    begun, said = path.with_suffix(FIT_SUFFIX), path.with_suffix(PROGRESS_SUFFIX)
    state = _resumed(begun, state)

    def say(iteration: int, loss: float, psnr_db: float) -> None:
        per_s = (iteration - first) / (time.monotonic() - began)
        left = time_text((settings.iterations - iteration) / per_s)
        text = f"fit {iteration}/{settings.iterations}, {per_s:.1f} iterations/s, {psnr_db:.1f} dB, ETA {left}"
        log.info("%s: %s, loss %.4f", path.stem, text, loss)
        said.write_text(json.dumps({"block": path.stem, "text": text}))

    with fit_backend(backend, threads, stopped) as drawing:
        first, began = state.iteration, time.monotonic()
        while state.iteration < settings.iterations:
            run_iterations(problem, state, settings, state.iteration + STRETCH, say, threads, stopped, drawing)
            arrays = state.arrays()
            with atomic_file(begun, sum(array.nbytes for array in arrays.values())) as draft:
                with draft.open("wb") as file:
                    np.savez(file, **arrays)  # type: ignore[arg-type]
                append_checksum(draft, begun.name)
            if state.iteration < settings.iterations and stopped():
                said.unlink(missing_ok=True)
                raise TaskStopped(f"{path.stem}: {state.iteration} of {settings.iterations} iterations are done")
    asset = finish_scene(problem, state, threads)
    begun.unlink(missing_ok=True)
    said.unlink(missing_ok=True)
    return asset


def running_fits(folder: Path) -> list[str]:
    """How far each fit in a cache folder is, as it said itself in the last two minutes."""
    found = []
    for path in sorted(folder.glob(f"*{PROGRESS_SUFFIX}")):
        try:
            if time.time() - path.stat().st_mtime < FRESH_S:
                found.append(json.loads(path.read_text())["text"])
        except (OSError, ValueError, KeyError):  # ended, or is being written, at this moment
            continue
    return found


def _resumed(begun: Path, start: FitState) -> FitState:
    if not begun.exists():
        return start
    try:
        verify_checksum(begun, begun.name)
        with np.load(begun, allow_pickle=False) as arrays:
            return FitState.from_arrays(dict(arrays))
    except (ValueError, KeyError, OSError, zipfile.BadZipFile) as error:
        log.warning("%s is damaged (%s); the fit begins again", begun, error)
        return start


ASSET_VERSION = 15  # raised by hand when the same sensors give another scene, or it is kept otherwise
PARALLAX_SHARE = 0.9  # without lidar, the least share of photos with another one close enough for stereo


class Sensing(Enum):
    """What a clip's block was seen by."""

    PHOTOS = "photos"  # and lidar
    PHOTOS_ONLY = "photos_only"  # depth from parallax alone
    NOTHING = "nothing"


def block_sensing(clip: Clip | PhotoDrive, settings: RenderSettings) -> Sensing:
    """What the block can be made of; nothing without photos, or without lidar and parallax.

    Raises ValueError for a camera the rig does not have.
    """
    block, cameras = block_of(clip), choose_cameras(clip.cameras, settings.cameras)
    photos = files_of_cameras(cameras, block.images)
    if block.sweeps and photos:
        return Sensing.PHOTOS
    return Sensing.PHOTOS_ONLY if photos and _parallax_share(photos) >= PARALLAX_SHARE else Sensing.NOTHING


def why_no_scene(drive: PhotoDrive, settings: RenderSettings) -> str:
    """What a drive lacks for a scene, in one line; empty where it can be made. Raises ValueError as `block_sensing`."""
    if block_sensing(drive, settings) is not Sensing.NOTHING:
        return ""
    photos = files_of_cameras(choose_cameras(drive.cameras, settings.cameras), drive.block.images)
    have = f"{_parallax_share(photos):.0%} of {len(photos)}" if photos else "none"
    return (
        f"without lidar {PARALLAX_SHARE:.0%} of the photos need another of their camera {MIN_BASELINE_M:g} to "
        f"{MAX_BASELINE_M:g} m away, {have} have one: the car stands, photos are rare, or poses not in metres"
    )


def _parallax_share(photos: Sequence[SensorFile]) -> float:
    """Share of the photos that another of the same camera lies at a useful distance from for depth by comparison."""
    places: dict[str, list[Array]] = {}
    for file in photos:
        places.setdefault(file.sensor, []).append(file.world_from_ego[:3, 3])
    found = 0
    for mine in places.values():
        apart = np.linalg.norm(np.stack(mine)[:, None] - np.stack(mine), axis=-1)
        found += int(((apart >= MIN_BASELINE_M) & (apart <= MAX_BASELINE_M)).any(axis=1).sum())
    return found / len(photos)


def load_or_build_scene(
    clip: Clip | PhotoDrive,
    settings: RenderSettings,
    cache_dir: str | Path,
    threads: int = 1,
    stopped: StopCheck = never_stop,
) -> RenderAsset | None:
    """The scene of the clip's block with its digest; None where the clip has nothing to make one from.

    Made of photos, with or without lidar (`block_sensing`); the same on any number of threads.
    Raises BadClip where a sensor file is broken, ValueError for a camera the rig does not have, and TaskStopped where a
    fit is `stopped`.
    """
    block, rig = block_of(clip), choose_cameras(clip.cameras, settings.cameras)
    cameras = block_cameras(block, rig)
    if block_sensing(clip, settings) is Sensing.NOTHING:
        return None
    path, masks = scene_path(clip, settings, cache_dir), _own_body(block, cameras, rig, settings)
    with builder_lock(path):
        if path.exists():
            try:
                kept = read_scene(path, path.stem)
            except BadScene as error:
                log.warning("%s; it is built again", error)
            else:
                if needs_rig_correction(block, settings.rig) and path.with_suffix(RIG_SUFFIX).exists():
                    read_or_correct_rig(path, block, cameras, masks)  # written again where it is damaged
                return kept
        agents, taken, found = block.agents, tuple[PhotoPose, ...](), None
        if needs_rig_correction(block, settings.rig):
            given = block.images
            block, cameras, found = correct_block_rig(path, block, cameras, masks())
            taken = photo_poses(given, block.images) if found is not None else ()
            agents = lift_tracks(agents, *photo_rises(taken))
        data = load_sensors(block, cameras, settings.width, settings.height, masks())
        if found is not None:
            data = replace(data, known=known_points(data, block, found))
        if settings.scene is SceneFrom.FIT:
            asset = fit_scene(path, data, agents, settings.fit, threads, stopped, settings.backend)
        else:
            asset = build_asset(data.photos, data.sweeps, agents, settings.asset, data.known)
        asset = replace(asset, rig=cameras if taken else (), taken=taken, bodies=median_own_bodies(data.photos))
        return write_scene(
            path, replace(without_other_logs(asset), block=block_range(clip, block)), settings.scene_dtype
        )


def load_or_correct_rig(clip: Clip, settings: RenderSettings, cache_dir: str | Path) -> CorrectedRig | None:
    """What the photos of the clip's block say of rig and poses, without the scene; None: all is used as given.

    Raises BadClip and ValueError as `load_or_build_scene` does.
    """
    block, rig = block_of(clip), choose_cameras(clip.cameras, settings.cameras)
    if block_sensing(clip, settings) is Sensing.NOTHING or not needs_rig_correction(block, settings.rig):
        return None
    cameras = block_cameras(block, rig)
    path, masks = scene_path(clip, settings, cache_dir), _own_body(block, cameras, rig, settings)
    with builder_lock(path):
        return read_or_correct_rig(path, block, cameras, masks)


def without_other_logs(asset: RenderAsset) -> RenderAsset:
    """A scene without what is of other logs' drives through it alone: their clips have a block of their own."""
    return replace(
        asset,
        nodes={name: node for name, node in asset.nodes.items() if not is_of_other_log(name)},
        exposures=tuple(exposure for exposure in asset.exposures if not is_of_other_log(exposure.camera)),
        rig=tuple(camera for camera in asset.rig if not is_of_other_log(camera.name)),
        taken=tuple(photo for photo in asset.taken if not is_of_other_log(photo.camera)),
        bodies=tuple(body for body in asset.bodies if not is_of_other_log(body.camera)),
        shifts=asset.shifts.select([name for name in asset.shifts.track_ids if not is_of_other_log(name)]),
    )


def _own_body(
    block: Block, cameras: Sequence[Camera], rig: Sequence[Camera], settings: RenderSettings
) -> Callable[[], Mapping[str, Bools]]:
    """What a block's cameras see of the car that carries them, which is found when it is first asked for."""

    @cache
    def masks() -> Mapping[str, Bools]:
        own = own_body_masks(settings.own_body, block.images, rig)
        for name, mask in own.items():
            log.info("%s: %.1f %% of the picture is the car itself", name, 100.0 * mask.mean())
        return block_masks(cameras, own)

    return masks


def block_masks(cameras: Sequence[Camera], own: Mapping[str, Bools]) -> dict[str, Bools]:
    """Masks of a block's cameras from those of its own rig: the same camera of another log's sees about the same of its
    car."""
    masks = {camera.name: own.get(own_name(camera.name)) for camera in cameras}
    size = {camera.name: (camera.height, camera.width) for camera in cameras}
    return {name: mask for name, mask in masks.items() if mask is not None and mask.shape == size[name]}


def scene_path(clip: Clip | PhotoDrive, settings: RenderSettings, cache_dir: str | Path) -> Path:
    """Where the scene of the clip's block is kept."""
    return Path(cache_dir) / f"block-{block_id(clip, settings)}{SUFFIX}"


def block_range(clip: Clip | PhotoDrive, block: Block) -> BlockRange:
    """When and where the sensors of a clip's block were."""
    files = [file for file in (*block.images, *block.sweeps) if file.time_s <= block.own_s]
    places = np.stack([file.world_from_ego[:2, 3] for file in files])
    end_s = block.start_s + max(file.time_s for file in files)
    return BlockRange(clip.dataset, clip.log_id, block.start_s, end_s, places.min(axis=0), places.max(axis=0))


@contextmanager
def builder_lock(path: Path) -> Iterator[None]:
    """Held by one process of the machine at a time; the kernel frees it when its holder dies. Raises PlaceRefused."""
    with ExitStack() as held:
        with raising_place_refused(path.parent):
            path.parent.mkdir(parents=True, exist_ok=True)
            file = held.enter_context(path.with_suffix(".lock").open("w"))
        held.enter_context(locked(file))
        yield


def block_id(clip: Clip | PhotoDrive, settings: RenderSettings) -> str:
    """16 hex digits of everything the scene depends on; of the sensor files, which are not opened, names and sizes."""
    digest = hashlib.sha256()
    block = block_of(clip)
    made_of = (ASSET_VERSION, clip.dataset, clip.log_id, block.start_s, block.ground_m, clip.content_digest)
    part = "fit" if settings.scene is SceneFrom.FIT else "asset"
    made = asdict(settings)[part]
    if settings.scene is SceneFrom.FIT and settings.backend.on_gpu:
        made["backend"] = Backend.GSPLAT  # another fit to the last bits, so that a run on CPUs never meets it
    how: list[object] = [settings.width, settings.height, sorted(settings.cameras), made]
    if needs_rig_correction(block, settings.rig):
        how.append(asdict(settings.rig))
    if settings.own_body:
        how.append(["own_body", masks_digest(settings.own_body)])
    if settings.scene_dtype is not SceneDtype.FLOAT32:
        how.append(["scene_dtype", settings.scene_dtype])
    digest.update(json.dumps([made_of, how], sort_keys=True).encode())
    for file in (*block.images, *block.sweeps):
        path, _ = file_and_frame(file.uri)
        size = path.stat().st_size if path.is_file() else None  # one that is missing is named when it is read
        digest.update(f"{file.sensor}\x1f{Path(file.uri).name}\x1f{size}\x1f{file.time_s!r}".encode())
        digest.update(np.ascontiguousarray(file.world_from_ego).tobytes())
    return digest.hexdigest()[:16]


# Whether what a run keeps of blocks under `out/cache` is whole: scenes, corrected rigs, half-done fits.


def damaged_blocks(out: Location) -> dict[str, str]:
    """File, relative to `out`, -> what is wrong with it; blocks of a URL lie elsewhere."""
    folder = Path(out.uri, "cache")
    found = {}
    for path in sorted(folder.glob("block-*")) if out.is_local else ():
        try:
            if path.name.endswith(SUFFIX):
                read_scene(path, path.stem)
            elif path.name.endswith(FIT_SUFFIX):
                verify_checksum(path, path.name)
            elif path.name.endswith(RIG_SUFFIX):
                read_rig_file(path)
        except (Damaged, BadScene) as error:
            problem = str(error).removeprefix(f"{path}: ")
            found[f"cache/{path.name}"] = f"{problem}; the next run makes it again"
    return found
