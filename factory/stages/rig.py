"""A block's cameras and poses corrected by its photos before anything is made of them, and what that changed, on disk.

`block-<id>.rig.json` lies beside the scene: what was corrected camera by camera, photos that show something else than
what their neighbours say, and the cameras as they were used.
"""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from factory.stages.own_body import NO_MASKS
from factory.stages.sensors import SensorData, opened_photos, poses_of, taken_by
from factory.store.disk import whole_file
from tasks.render.rig.corners import corners_of
from tasks.render.rig.correct import Correction, corrected
from tasks.render.rig.ground import ground_below
from tasks.render.rig.masks import hidden_by
from tasks.render.rig.settings import Adjust, RigSettings
from tasks.render.scene.driven_road import driven_roads
from tasks.render.scene.features import Known
from tasks.sealed import Damaged, sealed_json, unsealed_json
from tasks.world.arrays import Bools
from tasks.world.camera import Camera
from tasks.world.clip import Block

SAID = ".rig.json"
log = logging.getLogger(__name__)


def wanted(block: Block, settings: RigSettings) -> bool:
    """Whether the block's rig is to be corrected."""
    return bool(block.images) and (
        settings.adjust is Adjust.ON or (settings.adjust is Adjust.AUTO and not block.sweeps)
    )


def corrected_rig(
    path: Path,
    block: Block,
    cameras: Sequence[Camera],
    settings: RigSettings,
    own_body: Mapping[str, Bools] = NO_MASKS,
) -> tuple[Block, tuple[Camera, ...], Correction | None]:
    """Block and cameras as the photos say they are, and what was found, which is written beside `path`.

    As given, and None, where too few corners are shared to find anything. Raises BadClip for a photo that is
    missing, broken or not of its camera's size.
    """
    files = taken_by(cameras, block.images)
    corners = {}
    for row, image in opened_photos(files, cameras):
        (camera,) = (camera for camera in cameras if camera.name == files[row].sensor)
        hidden = hidden_by(block.agents, camera, files[row], own_body.get(camera.name))
        corners[row] = corners_of(image, settings.width, settings.corners, hidden)
    found = corrected(cameras, files, [corners[row] for row in range(len(files))], settings)
    if found is None:
        log.warning("%s: too few corners are shared by the photos: calibration and poses are used as given", path.stem)
        return block, tuple(cameras), None
    for line in lines_of(found):
        log.info("%s: %s", path.stem, line)
    text = sealed_json(described(found))
    with whole_file(path.with_suffix(SAID), len(text)) as draft:
        draft.write_text(text)
    for file in (files[row] for row in found.strangers):
        log.warning("%s: %s at %.2f s is left out: it does not show what its neighbours do: %s", path.stem, file.sensor,
                    file.time_s, file.uri)  # fmt: skip
    kept = tuple(file for row, file in enumerate(found.files) if row not in found.strangers)
    return replace(block, images=kept), found.cameras, found


def said_again(
    path: Path, block: Block, cameras: Sequence[Camera], settings: RigSettings, own_body: Mapping[str, Bools] = NO_MASKS
) -> None:
    """Writes what was found anew where the file beside `path` is damaged; the scene there stays. Raises BadClip."""
    said = path.with_suffix(SAID)
    try:
        unsealed_json(said.read_bytes())
    except FileNotFoundError:  # nothing was found, or somebody took it away
        return
    except Damaged as error:
        log.warning("%s: %s; it is written again", said, error)
        corrected_rig(path, block, cameras, settings, own_body)


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


def described(found: Correction) -> dict[str, object]:
    """What was found, as plain JSON values."""
    return {
        "cameras": [asdict(change) for change in found.changes],
        "ego_shift_m": found.ego_shift_m,
        "ego_turn_deg": found.ego_turn_deg,
        "points": len(found.points),
        "left_out": [[found.files[row].sensor, found.files[row].time_s] for row in found.strangers],
        "used": [
            {
                "name": camera.name,
                "intrinsics": camera.intrinsics.tolist(),
                "distortion": camera.distortion.tolist(),
                "ego_from_camera": camera.ego_from_camera.tolist(),
            }
            for camera in found.cameras
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
