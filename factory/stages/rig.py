"""A block's cameras and poses corrected by its photos before anything is made of them, and what that changed, on disk.

`block-<id>.rig.json` lies beside the scene: what was corrected camera by camera, photos that show something else than
what their neighbours say, and cameras and poses as they were used. Photos that samples keep are cut and described by it
as well, without the scene.
"""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from factory.files import atomic_file
from factory.stages.scene_file import CALIBRATED
from factory.stages.sensors import NO_MASKS, SensorData, opened_photos, poses_of, taken_by
from tasks.caches import Damaged, sealed_json, unsealed_json
from tasks.render.rig.correct import Correction, corners_of, corrected, ground_below, hidden_by
from tasks.render.scene.asset import TakenFrom, rises_of
from tasks.render.scene.driven_road import driven_roads
from tasks.render.scene.features import Known
from tasks.render.scene.movers import lifted
from tasks.render.settings import Adjust, RigSettings
from tasks.world.arrays import Array, Bools
from tasks.world.clip import AgentTracks, Block, Camera, SensorFile

SAID = ".rig.json"
SAME_S = 1e-3  # between the stamp of a photo counted from its clip and from its block
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class UsedRig:
    """A block's cameras, and where its photos were taken, as these say; times count from the block's first step."""

    cameras: tuple[Camera, ...]
    taken: tuple[TakenFrom, ...]  # all photos, those among them that were left out of the scene

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
        times, rises = rises_of(self.taken)
        return lifted(agents, times - first_s, rises)


def wanted(block: Block, settings: RigSettings) -> bool:
    """Whether the block's rig is to be corrected."""
    return bool(block.images) and (
        settings.adjust is Adjust.ON or (settings.adjust is Adjust.AUTO and not block.sweeps)
    )


def corrected_rig(
    path: Path,
    block: Block,
    cameras: Sequence[Camera],
    own_body: Mapping[str, Bools] = NO_MASKS,
) -> tuple[Block, tuple[Camera, ...], Correction | None]:
    """Block and cameras as the photos say they are, and what was found, which is written beside `path`.

    As given, and None, where too few corners are shared to find anything, which is written as well. Raises BadClip for
    a photo that is missing, broken or not of its camera's size.
    """
    files = taken_by(cameras, block.images)
    corners = {}
    for row, image in opened_photos(files, cameras):
        (camera,) = (camera for camera in cameras if camera.name == files[row].sensor)
        hidden = hidden_by(block.agents, camera, files[row], own_body.get(camera.name))
        corners[row] = corners_of(image, hidden)
    found = corrected(cameras, files, [corners[row] for row in range(len(files))])
    if found is None:
        log.warning("%s: too few corners are shared by the photos: calibration and poses are used as given", path.stem)
        _say(path, {"cameras": [], "used": [], "taken": []})
        return block, tuple(cameras), None
    for line in lines_of(found):
        log.info("%s: %s", path.stem, line)
    _say(path, described(found, files))
    for file in (files[row] for row in found.strangers):
        log.warning("%s: %s at %.2f s is left out: it does not show what its neighbours do: %s", path.stem, file.sensor,
                    file.time_s, file.uri)  # fmt: skip
    kept = tuple(file for row, file in enumerate(found.files) if row not in found.strangers)
    return replace(block, images=kept), found.cameras, found


def _say(path: Path, found: dict[str, object]) -> None:
    text = sealed_json({"block": path.stem, **found})
    with atomic_file(path.with_suffix(SAID), len(text)) as draft:
        draft.write_text(text, encoding="utf-8")


def told_of(said: Path) -> dict[str, Any]:
    """What a file tells of its block. Raises Damaged, OSError."""
    told = unsealed_json(said.read_bytes())
    if told.pop("block", None) != said.name.removesuffix(SAID):
        raise Damaged("it was written of another block")
    return told


def used_rig(
    path: Path, block: Block, cameras: Sequence[Camera], own_body: Mapping[str, Bools] = NO_MASKS
) -> UsedRig | None:
    """The rig as it is told beside `path`, found first where nothing is told there; None where nothing can be found.

    Raises BadClip.
    """
    said = path.with_suffix(SAID)
    try:
        told = told_of(said)
    except (FileNotFoundError, Damaged) as error:
        if isinstance(error, Damaged):
            log.warning("%s: %s; it is written again", said, error)
        corrected_rig(path, block, cameras, own_body)
        told = told_of(said)
    used: dict[str, dict[str, Any]] = {
        row["name"]: {key: np.array(row[key], np.float64) for key in CALIBRATED} for row in told["used"]
    }
    if not used:
        return None
    taken = (
        TakenFrom(name, time_s, np.reshape(pose, (4, 4)), rise_m, late_s)
        for name, time_s, rise_m, late_s, pose in told["taken"]
    )
    return UsedRig(tuple(replace(camera, **used[camera.name]) for camera in cameras), tuple(taken))


def said_again(path: Path, block: Block, cameras: Sequence[Camera], own_body: Mapping[str, Bools] = NO_MASKS) -> None:
    """Writes what was found anew where the file beside `path` is damaged; the scene there stays. Raises BadClip."""
    said = path.with_suffix(SAID)
    try:
        told_of(said)
    except FileNotFoundError:  # somebody took it away
        return
    except Damaged as error:
        log.warning("%s: %s; it is written again", said, error)
        corrected_rig(path, block, cameras, own_body)


def known_of(data: SensorData, block: Block, found: Correction) -> Known:
    """What is known of a corrected block: its corners, and the road, looked for where no reader says where it is."""
    road = data.known.road
    if road is None and not data.sweeps:
        poses, times_s = poses_of(block.images)
        ground_m = ground_below(data.photos, poses)
        if ground_m is not None:
            log.info("road: %.2f m above the ego's origin", ground_m)
            road = driven_roads(poses, times_s, ground_m)
    return Known(road, found.points)


def taken_from(given: Sequence[SensorFile], used: Sequence[SensorFile]) -> tuple[TakenFrom, ...]:
    """Where the photos that are used of those given were taken."""
    logged = {(file.sensor, file.time_s): file.world_from_ego[2, 3] for file in given}
    return tuple(
        TakenFrom(
            f.sensor, f.time_s, f.world_from_ego, float(f.world_from_ego[2, 3] - logged[f.sensor, f.time_s]), f.late_s
        )
        for f in used
    )


def described(found: Correction, given: Sequence[SensorFile]) -> dict[str, Any]:
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
            [photo.camera, photo.time_s, photo.rise_m, photo.late_s, photo.world_from_ego.ravel().tolist()]
            for photo in taken_from(given, found.files)
        ],
    }


def lines_of(found: Correction) -> list[str]:
    """What was found, for people: a line for each camera and one for the drive."""
    lines = []
    for change in found.changes:
        shift, turn = 100.0 * np.linalg.norm(change.shift_m), np.linalg.norm(change.turn_deg)
        lines.append(
            f"{change.camera}: moved {shift:.1f} cm, turned {turn:.2f} deg, focal length {change.focal_px[0]:+.1f} px, "
            f"centre {change.centre_px[0]:+.1f} {change.centre_px[1]:+.1f} px, stamp {1000.0 * change.late_s:+.0f} ms, "
            f"{change.corners} corners off by {change.before_px:.2f} px before, {change.after_px:.2f} after"
        )
    lines.append(f"ego: moved {100.0 * found.ego_shift_m:.1f} cm, turned {found.ego_turn_deg:.2f} deg (rms)")
    return lines
