"""A sample's block seen again: its photos beside their renderings, the same instant from the side, a film of it.

Everything comes from the store: rows, and the scenes in its cache. Photos are those of the log's human samples.
"""

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from factory.stages.scene_file import BadScene, find_scene
from factory.stages.sensors import load_photos
from factory.store.reader import SampleTable, decode_stored_image
from factory.store.samples import Store
from factory.store.schema import AGENT_STEPS, NOW_INDEX, SCHEMA
from factory.views.pictures import (
    BEV_COLUMNS,
    CAPTION_PX,
    captioned_tile,
    ego_poses,
    front_camera,
    padded_to,
    sample_bev,
    side_by_side,
    text_tile,
    tile_grid,
)
from factory.views.status import rows_where
from tasks.caches import user_cache
from tasks.render.scene.asset import RenderAsset, psnr
from tasks.render.scene.engine import render
from tasks.render.scene.movers import agents_at_time
from tasks.render.settings import ImageSource
from tasks.render.views import VISIBLE_M, render_views
from tasks.world.arrays import Array, Image
from tasks.world.clip import STEP_S, AgentKind, AgentTracks, Camera, PhotoDrive, Pinhole
from tasks.world.frames import pose_on_ground, to_world

Row = Mapping[str, Any]

ASIDE_M = (2.0, 1.0, 0.0, -1.0, -2.0)  # left is positive, and on the left of the strip
STRIP_PX = (320, 180 + CAPTION_PX + 4)
HOLD_S = 0.5  # how long a stored image stands in a film: they are taken at 2 Hz,
SLACK_S = 0.06  # give or take this much
VIEW_COLUMNS = (
    *BEV_COLUMNS,
    *(name for name in SCHEMA.names if name.startswith("agent_") and name not in BEV_COLUMNS),
    "attempt_id",
    "clip_id",
    "log_id",
    "clip_start_s",
    "now_s",
    "stage_versions",
    "world_from_ego",
    "cameras",
    "images",
    "image_source",
    "asset_digest",
)


@dataclass(frozen=True)
class CaptionedPicture:
    """A camera's picture with what it shows."""

    pixels: Image
    caption: str


def scene_digest_of(store: Store, row: Row) -> str | None:
    """Of the scene that a row was rendered from, for a row of photos that of another row of its clip; None: none."""
    if row["asset_digest"] is not None:
        return str(row["asset_digest"])
    if row["image_source"] != ImageSource.PHOTO:
        return None
    others = rows_where(store.samples, {"clip_id": row["clip_id"]}, ("asset_digest",))
    return min({other["asset_digest"] for other in others} - {None}, default=None)


def scene_folder(store: Store) -> Path:
    """Where the scenes of a run's blocks are."""
    return Path(store.location.uri, "cache") if store.location.is_local else user_cache() / "assets"


def load_scene(store: Store, digest: str) -> RenderAsset | None:
    """The block's scene of a digest; None where the cache has it no more, or has it damaged."""
    try:
        return find_scene(scene_folder(store), digest)
    except BadScene:
        return None  # the next run builds it again and says so


def nearest_photo_sample(store: Store, row: Row, asset: RenderAsset) -> dict[str, Any] | None:
    """Of the human samples with photos in the scene's stretch of the row's log, the one nearest in time; None: none."""
    first, last = (-np.inf, np.inf) if asset.block is None else (asset.block.start_s, asset.block.end_s)
    wanted = ("attempt_id", "log_id", "image_source", "clip_start_s", "now_s")
    of_log = rows_where(store.samples, {"log_id": row["log_id"], "image_source": ImageSource.PHOTO.value}, wanted)
    found = [other for other in of_log if first <= _log_time_s(other) <= last]
    if not found:
        return None
    nearest = min(found, key=lambda other: (abs(_log_time_s(other) - _log_time_s(row)), other["attempt_id"]))
    return SampleTable(store.location.uri, store.location.options).sample(nearest["attempt_id"], VIEW_COLUMNS)


def photo_rendering_pairs(
    asset: RenderAsset, photos: Row, at_s: float
) -> list[tuple[CaptionedPicture, CaptionedPicture]]:
    """For each camera, left ones first, the photo nearest to a time of the log, and the scene from the same pose.

    `photos`: VIEW_COLUMNS of a human sample, whose agents are the log's.
    """
    agents, pairs, scene = agents_in_world(photos), [], _scene_at_row_times(photos, asset)
    for camera in sorted(photos["cameras"], key=_yaw_to_the_right):
        mine = [image for image in photos["images"] if image["camera"] == camera["name"]]
        nearest = min(mine, key=lambda image: abs(_log_time_s(photos) + image["time_s"] - at_s), default=None)
        if nearest is None:
            continue
        photo = decode_stored_image(nearest)
        (again,) = render_cameras(
            scene, *_camera_and_pose_of_photo(asset, camera, nearest, _log_time_s(photos)), agents, nearest["time_s"]
        )
        gap = _log_time_s(photos) + nearest["time_s"] - at_s
        said = "at the sample's now" if abs(gap) < STEP_S / 2 else f"{gap:+.1f} s from the sample's now"
        pairs.append(
            (
                CaptionedPicture(photo, f"{camera['name']}  photo, {said}"),
                CaptionedPicture(again, f"rendered from its pose: {psnr(photo, again):.1f} dB"),
            )
        )
    return pairs


def _yaw_to_the_right(camera: Mapping[str, Any]) -> float:
    """How far to the right a camera looks, clockwise from behind [rad]."""
    ahead, left = np.reshape(camera["ego_from_camera"], (4, 4))[:2, 2]
    return float(-np.arctan2(left, ahead))


def side_views(asset: RenderAsset, row: Row) -> list[CaptionedPicture]:
    """What the front camera sees at now from ASIDE_M beside the ego; nothing for a row without images."""
    front = front_camera(row)
    if front is None:
        return []
    rig, agents = [camera for camera in row["cameras"] if camera["name"] == front], agents_in_world(row)
    scene = _scene_at_row_times(row, asset)
    out = []
    for aside_m in ASIDE_M:
        pose = ego_pose_at(row, NOW_INDEX)
        pose[:3, 3] += aside_m * pose[:3, 1]
        side = f"{abs(aside_m):g} m to the {'left' if aside_m > 0 else 'right'}"
        caption = side if aside_m else f"{front}, rendered at now"
        out.append(CaptionedPicture(render_cameras(scene, rig, pose, agents, 0.0)[0], caption))
    return out


def photos_and_renderings_sheet(store: Store, row: Row, scene: RenderAsset) -> Image | None:
    """The log's photos nearest in time over their renderings, and below the row's now from the side; None: neither."""
    photos, strip = nearest_photo_sample(store, row, scene), side_views(scene, row)
    pairs = [] if photos is None else photo_rendering_pairs(scene, photos, _log_time_s(row))
    shown = [*(photo for photo, _ in pairs), *(again for _, again in pairs)]
    parts = [
        tile_grid([captioned_tile(s.pixels, s.caption, STRIP_PX) for s in seen], columns)
        for seen, columns in ((shown, len(pairs)), (strip, len(strip)))
        if seen
    ]
    return stack_vertically(parts) if parts else None


def stack_vertically(parts: Sequence[Image]) -> Image:
    """One below the other, narrower ones with background to their right."""
    width = max(part.shape[1] for part in parts)
    return np.concatenate([padded_to(part, part.shape[0], width) for part in parts])


def sample_film(row: Row, asset: RenderAsset | None, logged: Array | None = None) -> Iterator[Image]:
    """A sample at 10 Hz, from 1.5 s before its now to the label's end: from above, and through its cameras.

    A rendered sample is drawn anew at every step where its scene is at hand; else stored images stand until the next.
    """
    agents = agents_in_world(row)
    scene = _scene_at_row_times(row, asset) if asset is not None and row["image_source"] == ImageSource.RENDER else None
    for step in range(AGENT_STEPS):
        time_s = (step - NOW_INDEX) * STEP_S
        if scene is not None:
            views = render_cameras(scene, row["cameras"], ego_pose_at(row, step), agents, time_s)
            named = zip(row["cameras"], views)
            tiles = [captioned_tile(view, f"{camera['name']}  {time_s:+.1f} s") for camera, view in named]
        else:
            tiles = list(_stored_image_tiles(row, time_s)) or [
                text_tile(f"no images: image_source is {row['image_source']}")
            ]
        whole = side_by_side(sample_bev(row, logged, (720, 720), step=step), tiles)
        height, width = whole.shape[:2]
        yield padded_to(whole, height + height % 2, width + width % 2)  # H.264 takes even sides


def shifted_film(
    asset: RenderAsset, drive: PhotoDrive, camera: Camera, aside_m: float, turn_deg: float, width: int
) -> Iterator[Image]:
    """Photo by photo of a camera: left the photo, right the scene from the ego's pose moved to the left by `aside_m`
    and turned to the left by `turn_deg`. Raises BadClip for a photo that is broken.
    """
    (camera,), height = asset.as_corrected([camera]), round(width * camera.height / camera.width)
    files = [file for file in asset.photos_of(drive.block.images) if file.sensor == camera.name]
    angle, shift, agents = np.radians(turn_deg), np.eye(4), asset.settled(drive.block.agents, 0.0)
    shift[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    shift[1, 3] = aside_m
    side = f"{abs(aside_m):g} m to the {'left' if aside_m > 0.0 else 'right'}" if aside_m else "from its place"
    side += f", turned by {turn_deg:g} deg" if turn_deg else ""
    size = width + 8, height + height % 2 + CAPTION_PX + 4  # H.264 takes even sides
    for file, photo in zip(files, load_photos(files, [camera], width, height)):
        pose, step = file.world_from_ego @ shift, file.time_s / STEP_S
        (drawn,) = next(render_views(asset, [camera], pose[None], agents, [step], width, height))
        shown = (photo.rgb, f"{camera.name}  photo at {file.time_s:.1f} s"), (drawn, f"rendered, {side}")
        yield tile_grid([captioned_tile(pixels, caption, size) for pixels, caption in shown], 2)


def _stored_image_tiles(row: Row, time_s: float) -> Iterable[Image]:
    """Tiles of the stored images that were taken last, each camera's for HOLD_S."""
    for camera in row["cameras"] or ():
        taken = [
            image
            for image in row["images"]
            if image["camera"] == camera["name"] and -SLACK_S <= time_s - image["time_s"] < HOLD_S - SLACK_S
        ]
        if taken:
            last = max(taken, key=lambda image: float(image["time_s"]))
            yield captioned_tile(decode_stored_image(last), f"{last['camera']}  {last['time_s']:+.1f} s")
        else:
            yield text_tile(f"{camera['name']}: no image at {time_s:+.1f} s")


def _scene_at_row_times(row: Row, asset: RenderAsset) -> RenderAsset:
    """The scene, its times counted as those of the row's agents."""
    first_s = 0.0 if asset.block is None else _log_time_s(row) - NOW_INDEX * STEP_S - asset.block.start_s
    return asset.since(first_s)


def _camera_and_pose_of_photo(
    asset: RenderAsset, camera: Mapping[str, Any], image: Mapping[str, Any], now_s: float
) -> tuple[list[Mapping[str, Any]], Array]:
    """Camera and pose (4, 4) of a photo as the scene has them, where it corrected them, else as the row has them."""
    if asset.block is not None:
        at_s = now_s + image["time_s"] - asset.block.start_s
        taken = [p.world_from_ego for p in asset.taken if p.camera == camera["name"] and abs(p.time_s - at_s) < 1e-3]
        rig = [mine.resized(camera["width"], camera["height"]) for mine in asset.rig if mine.name == camera["name"]]
        if taken and rig:
            calibration = {"intrinsics": rig[0].intrinsics, "ego_from_camera": rig[0].ego_from_camera}
            return [dict(camera) | calibration], taken[0]
    return [camera], np.reshape(image["ego_pose"], (4, 4))


def render_cameras(
    asset: RenderAsset, cameras: Sequence[Mapping[str, Any]], world_from_ego: Array, agents: AgentTracks, time_s: float
) -> list[Image]:
    """What cameras of a row see from a pose (4, 4), with the row's agents `time_s` after its now.

    The scene's time is that of the agents.
    """
    agents_s = time_s + NOW_INDEX * STEP_S
    there = agents_at_time(agents, agents_s, world_from_ego[:2, 3], VISIBLE_M)
    eyes = [
        Pinhole(
            np.reshape(camera["intrinsics"], (3, 3)),
            world_from_ego @ np.reshape(camera["ego_from_camera"], (4, 4)),
            camera["width"],
            camera["height"],
        )
        for camera in cameras
    ]
    affines = [asset.affine_of(camera["name"], agents_s) for camera in cameras]
    views = render(asset, eyes, there, threads=os.cpu_count() or 1, affines=affines)
    return [np.rint(view.rgb * 255.0).astype(np.uint8) for view in views]


def ego_pose_at(row: Row, step: int) -> Array:
    """(4, 4) 3-D pose of the ego at a 10 Hz step, on the ground that the row's own 3-D poses stand on."""
    known = [np.reshape(image["ego_pose"], (4, 4)) for image in row["images"]]
    way = to_world(np.asarray(row["now_pose"], dtype=float), ego_poses(row)[step : step + 1])
    return pose_on_ground(np.stack(known), way)[0]


def agents_in_world(row: Row) -> AgentTracks:
    """The row's agents in the world, step NOW_INDEX being now."""
    n = len(row["agent_ids"])
    boxes = np.asarray(row["agent_boxes"], dtype=float).reshape(n, AGENT_STEPS, 5).transpose(1, 0, 2).copy()
    pose = np.asarray(row["now_pose"], dtype=float)
    boxes[..., :3] = to_world(pose, boxes[..., :3])
    c, s = np.cos(pose[2]), np.sin(pose[2])
    velocities = np.asarray(row["agent_velocities"], dtype=float).reshape(n, AGENT_STEPS, 2).transpose(1, 0, 2)
    return AgentTracks(
        track_ids=tuple(row["agent_ids"]),
        kinds=tuple(AgentKind(kind) for kind in row["agent_kinds"]),
        boxes=boxes,
        velocities=velocities @ np.array([[c, s], [-s, c]]),
        valid=np.asarray(row["agent_valid"], dtype=bool).reshape(n, AGENT_STEPS).T,
        center_z=np.asarray(row["agent_center_z"], dtype=float).reshape(n, AGENT_STEPS).T,
        heights=np.asarray(row["agent_heights"], dtype=float),
    )


def _log_time_s(row: Row) -> float:
    """Seconds since the log's first instant."""
    return float(row["clip_start_s"] + row["now_s"])
