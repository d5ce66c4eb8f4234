"""The render stage: a sample's images, from the block's scene, the log's own photos, the map or the reader's painter.

A human sample of a clip with photos keeps them, whatever its block. Every other sample is drawn from the block where
`factory.stages.assets.block_sensing` finds something to make it of, else written with image_source=none and no images.
Photos without lidar give coarse pictures, tagged `photos_only`.
"""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, lru_cache
from itertools import islice
from pathlib import Path

import numpy as np

from factory.graph.steps import StopCheck, never_stop
from factory.readers.base import BadClip, Painter
from factory.stages.assets import (
    RIG_SUFFIX,
    CorrectedRig,
    Sensing,
    block_sensing,
    load_or_build_scene,
    load_or_correct_rig,
    scene_path,
)
from factory.stages.rows import NO_IMAGES, agent_columns
from factory.stages.sensors import block_of, choose_cameras, files_of_cameras, load_photos
from tasks.attempt import Judged
from tasks.perturb import Candidate
from tasks.render.gate import (
    BlockVerdict,
    VehiclePhoto,
    VehiclePhotos,
    check_drive_pictures,
    estimate_fading,
    find_sightings,
    gate_picture_size,
    judge_block,
    likeness_to_photo,
)
from tasks.render.scene.asset import RenderAsset
from tasks.render.scene.engine import encode_jpeg, render_jpegs
from tasks.render.scene.movers import agents_at_time
from tasks.render.scene.sensed import Photo
from tasks.render.seen import PhotoSights, photo_sights
from tasks.render.settings import STEPS_OF, ImageSource, RenderMode, RenderSettings
from tasks.render.views import MAP_RIG, draw_map_views, instants_of_views
from tasks.stages import Rejected
from tasks.world.arrays import Array, Bytes
from tasks.world.clip import HORIZON_STEPS, NOW, STEP_S, AgentTracks, Camera, Clip, Scene, SensorFile
from tasks.world.frames import HEADING, pose_on_ground

PHOTOS_ONLY = "photos_only"  # tag: depth is guessed from parallax, markings shear off the photos' path
GATE_STRIDE = 5  # steps of 0.1 s between the pictures that are looked at: 2 Hz
PHOTO_SLACK_S = 0.06  # a photo belongs to an instant of the 2 Hz grid when it was taken this close to it


@dataclass(frozen=True)
class Imaging:
    """What a sample's image columns are made from."""

    settings: RenderSettings
    cache_dir: str
    painter: Painter | None = None  # of the reader's clips

    def build(self, clip: Clip, threads: int, stopped: StopCheck = never_stop) -> tuple[bool, float | None]:
        """Make sure of the clip's block in the cache: whether it was there, and its PSNR in dB where it has one.

        Raises BadClip for a broken sensor file, TaskStopped where a fit is `stopped`.
        """
        found = block_sensing(clip, self.settings) is not Sensing.NOTHING and (
            scene_path(clip, self.settings, self.cache_dir).exists()
        )
        asset = load_or_build_scene(clip, self.settings, self.cache_dir, threads, stopped)
        return found, asset.psnr_db if asset is not None and np.isfinite(asset.psnr_db) else None

    def build_rig(self, clip: Clip) -> bool:
        """Make sure of what the photos of the clip's block say of its rig: whether nothing was left to find out.

        Raises BadClip for a broken photo.
        """
        said = scene_path(clip, self.settings, self.cache_dir).with_suffix(RIG_SUFFIX)
        before = said.exists()
        load_or_correct_rig(clip, self.settings, self.cache_dir)
        return said.exists() == before

    def block_verdict(self, clip: Clip) -> BlockVerdict:
        """Build the clip's block, once, and say what it is good for.

        Raises BadClip for a broken sensor file.
        """
        fit_for_all = BlockVerdict({}, float("nan"), None)
        if self.settings.mode is not RenderMode.AUTO:
            return fit_for_all
        if block_sensing(clip, self.settings) is Sensing.NOTHING:
            return fit_for_all
        rig = choose_cameras(clip.cameras, self.settings.cameras)
        return judge_block(_scene_of_block(clip, self.settings, self.cache_dir), rig, self.settings)

    def pictures(self, samples: Sequence[tuple[Clip, Candidate | None, Judged]]) -> list[dict[str, object]]:
        """Of each of a clip's samples: the image columns, the `tags` they add to its own, and heights as its pictures
        show them.

        A human sample of a clip with photos keeps the photos, cut and described by the rig as the scene has it; all
        others are drawn at the simulated poses, those that a block's scene shows together. Raises BadClip for a broken
        sensor file, and for a human sample that lacks some of its photos.
        """
        found = [self._not_of_scene(*sample) for sample in samples]
        of_scene = [(clip, judged) for (clip, _, judged), known in zip(samples, found) if known is None]
        shown = iter(self._of_scene(of_scene) if of_scene else ())
        return [next(shown) if known is None else known for known in found]

    def _not_of_scene(self, clip: Clip, candidate: Candidate | None, judged: Judged) -> dict[str, object] | None:
        """A sample's columns where its pictures are not drawn from its block's scene."""
        match self.settings.mode:
            case RenderMode.MAP:
                return self._mapped(clip, judged)
            case RenderMode.PAINTER:
                return self._painted(clip, judged)
            case RenderMode.NONE:
                return NO_IMAGES
        cameras = choose_cameras(clip.cameras, self.settings.cameras)
        if candidate is None and files_of_cameras(cameras, (*clip.images, *block_of(clip).images)):
            return self._photos(clip, judged, cameras)
        return NO_IMAGES if block_sensing(clip, self.settings) is Sensing.NOTHING else None

    def _of_scene(self, samples: Sequence[tuple[Clip, Judged]]) -> list[dict[str, object]]:
        clip, _ = samples[0]
        asset = scene_in_clip_time(clip, _scene_of_block(clip, self.settings, self.cache_dir))
        cameras = choose_cameras(clip.cameras, self.settings.cameras)
        said, tags = judge_block(asset, cameras, self.settings), list[str]()
        if block_sensing(clip, self.settings) is Sensing.PHOTOS_ONLY:
            tags.append(PHOTOS_ONLY)
        psnr = said.psnr_db if np.isfinite(said.psnr_db) else None
        left_out = [{"camera": name, "why": why} for name, why in said.left_out.items()]
        block = {"tags": tags, "psnr": psnr, "cameras_left_out": left_out, "asset_digest": asset.digest}
        return [columns | block for columns in self._drawn(samples, asset, asset.as_corrected(cameras), said.left_out)]

    def unfit(self, clip: Clip, candidate: Candidate, judged: Judged, shared: Sequence[int] = ()) -> Rejected | None:
        """Why a simulated drive cannot be shown: what `tasks.render.gate` finds on its pictures from T to T+2H.

        Vehicles are held against photos on the pictures that are stored, all else too where there are `shared` steps
        of several samples of the drive, which fall together. None where nothing is rendered from photos. Raises BadClip
        for a broken sensor file.
        """
        if self.settings.mode is not RenderMode.AUTO or not self.settings.gate.enabled:
            return None
        if block_sensing(clip, self.settings) is Sensing.NOTHING:
            return None
        start, now = candidate.rollout.start_step, judged.scene.step
        rig = choose_cameras(clip.cameras, self.settings.cameras)
        left_out = self.block_verdict(clip).left_out
        steps: Sequence[int] = range(start, now + HORIZON_STEPS + 1, GATE_STRIDE)
        stored = sorted({at + offset for at in shared or (now,) for offset in STEPS_OF[self.settings.frames]})
        if shared:
            steps = stored
        looks, block = self.settings.gate.vehicle_min > 0.0, _block_key(clip, self.settings, self.cache_dir)
        album = _cached_vehicle_photos(block) if looks else None  # at vehicles
        sights = _cached_sights(block) if self.settings.gate.guessed_max < 1.0 else None
        states = np.concatenate([candidate.rollout.ego_states, judged.rollout.ego_states[1:]])
        asset = scene_in_clip_time(clip, _scene_of_block(clip, self.settings, self.cache_dir))
        agents = judged.scene.agents.overwritten(now, judged.rollout.agents)
        return check_drive_pictures(
            asset,
            asset.as_corrected([camera for camera in rig if camera.name not in left_out]),
            pose_on_ground(asset.on_road(clip.world_from_ego), states[[step - start for step in steps]]),
            asset.lifted(agents, clip_offset_s(clip)),
            steps,
            (self.settings.width, self.settings.height),
            self.settings.gate,
            self.settings.backend,
            album,
            stored,
            sights,
        )

    def _ego_states(self, judged: Judged) -> Array:
        """(F, 11) at the instants that are drawn."""
        driven = np.concatenate([judged.scene.ego_history, judged.rollout.ego_states[1:]])  # rows -15 .. 40 around now
        return driven[[offset + NOW for offset in STEPS_OF[self.settings.frames]]]

    def _drawn(
        self,
        samples: Sequence[tuple[Clip, Judged]],
        asset: RenderAsset,
        rig: Sequence[Camera],
        left_out: Collection[str],
    ) -> Iterator[dict[str, object]]:
        """All samples' pictures are asked of the scene at once."""
        cameras = [camera for camera in rig if camera.name not in left_out]
        moments = [self._moments(clip, judged, asset) for clip, judged in samples]
        size = self.settings.width, self.settings.height
        asked = [instants_of_views(asset, cameras, *moment, *size) for moment in moments]
        instants, bodies = [instant for of_sample, _ in asked for instant in of_sample], asked[0][1]
        images = iter(render_jpegs(asset, instants, bodies, self.settings.jpeg_quality, self.settings.backend))
        for (clip, judged), (poses, lifted, steps) in zip(samples, moments):
            columns = self._columns(rig, cameras, poses, [*islice(images, len(steps))], ImageSource.RENDER)
            if asset.taken:
                on_road = asset.on_road(asset.on_road(clip.world_from_ego))
                columns |= height_columns(judged.scene, on_road, lifted)
            yield columns

    def _mapped(self, clip: Clip, judged: Judged) -> dict[str, object]:
        rig = choose_cameras(clip.cameras or MAP_RIG, self.settings.cameras)
        poses, agents, steps = self._moments(clip, judged, None)
        size = self.settings.width, self.settings.height
        images = [[*pictures] for pictures in draw_map_views(clip.road_map, rig, poses, agents, steps, *size)]
        return self._columns(rig, rig, poses, images, ImageSource.MAP)

    def _moments(self, clip: Clip, judged: Judged, asset: RenderAsset | None) -> tuple[Array, AgentTracks, list[int]]:
        """Poses (F, 4, 4), agents and steps of the instants that are drawn."""
        scene = judged.scene
        agents = scene.agents.overwritten(scene.step, judged.rollout.agents)
        if asset is not None:
            agents = asset.lifted(agents, clip_offset_s(clip))
        logged = clip.world_from_ego if asset is None else asset.on_road(clip.world_from_ego)
        steps = [scene.step + offset for offset in STEPS_OF[self.settings.frames]]
        return pose_on_ground(logged, self._ego_states(judged)), agents, steps

    def _columns(
        self,
        rig: Sequence[Camera],
        shown: Sequence[Camera],
        poses: Array,
        images: Sequence[Sequence[Bytes | bytes]],
        source: ImageSource,
    ) -> dict[str, object]:
        found = [
            self.image(camera.name, offset * STEP_S, pose, picture)
            for offset, pose, pictures in zip(STEPS_OF[self.settings.frames], poses, images, strict=True)
            for camera, picture in zip(shown, pictures, strict=True)
        ]
        return {"cameras": self.rig(rig), "images": found, "image_source": str(source)}

    def _painted(self, clip: Clip, judged: Judged) -> dict[str, object]:
        assert self.painter is not None, "render.mode=painter goes with a reader that has one"
        scene, states = judged.scene, self._ego_states(judged)
        cameras = painted_cameras(self.painter, clip, self.settings)
        agents = scene.agents.overwritten(scene.step, judged.rollout.agents)
        found: list[dict[str, object]] = []
        for offset, state in zip(STEPS_OF[self.settings.frames], states):
            pose, taken = self.painter.pictures(clip, cameras, agents, scene.step + offset, state)
            found += [self.image(one.name, offset * STEP_S, pose, rgb) for one, rgb in zip(cameras, taken)]
        return {"cameras": self.rig(cameras), "images": found, "image_source": str(ImageSource.PAINTER)}

    def _photos(self, clip: Clip, judged: Judged, cameras: Sequence[Camera]) -> dict[str, object]:
        now_s = judged.scene.step * STEP_S
        files = [
            nearest_photo(clip, camera.name, now_s + offset * STEP_S)
            for offset in STEPS_OF[self.settings.frames]
            for camera in cameras
        ]
        corrected, higher = _cached_rig(_block_key(clip, self.settings, self.cache_dir)), dict[str, object]()
        if corrected is not None:
            first_s = clip_offset_s(clip)
            cameras, files = corrected.as_corrected(cameras), list(corrected.posed(files, first_s))
            agents = judged.scene.agents.overwritten(judged.scene.step, judged.rollout.agents)
            higher = height_columns(judged.scene, corrected.on_road(), corrected.lifted(agents, first_s))
        photos = load_photos(files, cameras, self.settings.width, self.settings.height)
        poses = {(file.sensor, file.time_s): file.world_from_ego for file in files}
        found = [
            self.image(photo.camera, photo.time_s - now_s, poses[photo.camera, photo.time_s], photo.rgb)
            for photo in photos
        ]
        return {"cameras": self.rig(cameras), "images": found, "image_source": str(ImageSource.PHOTO), **higher}

    def image(self, camera: str, time_s: float, pose: Array, picture: Bytes | bytes) -> dict[str, object]:
        """An entry of the column `images`: `time_s` from now, of the ego at `pose` (4, 4), rgb (H, W, 3) or a JPEG."""
        return {
            "camera": camera,
            "time_s": float(time_s),
            "ego_pose": pose.ravel(),
            "jpeg": picture if isinstance(picture, bytes) else encode_jpeg(picture, self.settings.jpeg_quality),
        }

    def rig(self, cameras: Sequence[Camera]) -> list[dict[str, object]]:
        """The pinholes the images were drawn with: resized, without distortion."""
        resized = [camera.resized(self.settings.width, self.settings.height) for camera in cameras]
        return [
            {
                "name": camera.name,
                "width": camera.width,
                "height": camera.height,
                "intrinsics": camera.intrinsics.ravel(),
                "distortion": np.zeros(5),
                "ego_from_camera": camera.ego_from_camera.ravel(),
            }
            for camera in resized
        ]


def painted_cameras(painter: Painter, clip: Clip, settings: RenderSettings) -> tuple[Camera, ...]:
    """The chosen cameras as pinholes of the settings' size. Raises ValueError for one that the rig does not have."""
    rig = painter.rig(clip, settings.width, settings.height)
    return tuple(one.resized(settings.width, settings.height) for one in choose_cameras(rig, settings.cameras))


def height_columns(scene: Scene, on_road: Array, lifted: AgentTracks) -> dict[str, object]:
    """The columns that say how high ego and agents of a sample are, where photos say what the log does not.

    on_road: (P, 4, 4) poses of the ego on the road as photos show it; lifted: the sample's agents, as high above it as
    they were logged. So they stand in its pictures where its pictures show them.
    """
    columns = agent_columns(lifted, scene.step, scene.ego_state[: HEADING + 1])
    return {
        "world_from_ego": pose_on_ground(on_road, scene.ego_state[None])[0],
        "agent_center_z": columns["agent_center_z"],
    }


def nearest_photo(clip: Clip, camera: str, time_s: float) -> SensorFile:
    """The clip's photo of a camera nearest to a time since its first step. Raises BadClip where none is near."""
    mine = [file for file in clip.images if file.sensor == camera]
    nearest = min(mine, key=lambda file: abs(file.time_s - time_s), default=None)
    if nearest is None or abs(nearest.time_s - time_s) > PHOTO_SLACK_S:
        at_s = clip.start_s + time_s
        raise BadClip(
            f"log {clip.log_id}",
            f"camera {camera}",
            f"no photo within {PHOTO_SLACK_S:g} s of {at_s:.2f} s of the log ({time_s:.2f} s of the clip): "
            "restore the missing file, or leave the camera out by render.cameras=[...]",
        )
    return nearest


def _scene_of_block(clip: Clip, settings: RenderSettings, cache_dir: str) -> RenderAsset:
    asset = _cached_scene(_block_key(clip, settings, cache_dir))
    assert asset is not None, "asked for a block only where there are sensors"
    return asset


def scene_in_clip_time(clip: Clip, asset: RenderAsset) -> RenderAsset:
    """The scene of a clip's block, its times counted from the clip's first step."""
    return asset.since(clip_offset_s(clip))


def clip_offset_s(clip: Clip) -> float:
    """Seconds from the first step of a clip's block to its own."""
    return clip.start_s - block_of(clip).start_s


def scene_cache_counts() -> tuple[int, int]:
    """How often a scene was wanted in this process: found in its memory, read or built."""
    info = _cached_scene.cache_info()
    return info.hits, info.misses


@dataclass(frozen=True)
class _BlockKey:
    """A clip and how its block is drawn; in the caches of a worker, `key` stands for it."""

    key: tuple[object, ...]
    clip: Clip = field(compare=False)
    settings: RenderSettings = field(compare=False)
    cache_dir: str = field(compare=False)


def _block_key(clip: Clip, settings: RenderSettings, cache_dir: str) -> _BlockKey:
    """Equal for all clips of a block, so that a worker that goes from clip to clip reads its scene once."""
    how = repr(settings)
    of_clip = _BlockKey((clip.clip_id, clip.content_digest, how, cache_dir), clip, settings, cache_dir)
    return replace(of_clip, key=(_cached_scene_path(of_clip), how))


@lru_cache(maxsize=16)
def _cached_scene_path(of_clip: _BlockKey) -> Path:
    return scene_path(of_clip.clip, of_clip.settings, of_clip.cache_dir)


@lru_cache(maxsize=2)
def _cached_scene(block: _BlockKey) -> RenderAsset | None:
    return load_or_build_scene(block.clip, block.settings, Path(block.cache_dir))


@lru_cache(maxsize=2)
def _cached_rig(block: _BlockKey) -> CorrectedRig | None:
    return load_or_correct_rig(block.clip, block.settings, Path(block.cache_dir))


def lazy_vehicle_photos(clip: Clip, asset: RenderAsset, settings: RenderSettings) -> VehiclePhotos:
    """The photos of a clip's block; one is opened when a vehicle is first held against it. Raises BadClip then."""
    block, cameras = block_of(clip), asset.as_corrected(choose_cameras(clip.cameras, settings.cameras))
    files = asset.photos_of(block.images)
    agents = asset.settled(block.agents, 0.0)
    shown = find_sightings(files, cameras, agents)
    tracks: dict[int, list[str]] = {}
    for track_id, seen in shown.items():
        for row in seen.photos:
            tracks.setdefault(int(row), []).append(track_id)
    size = gate_picture_size((settings.width, settings.height), settings.gate)
    known: dict[int, dict[str, float]] = {}

    @cache
    def photo(row: int) -> Photo:
        return load_photos([files[row]], cameras, *size)[0]

    def likeness(track_id: str, row: int) -> float:
        if row not in known:
            known[row] = likeness_to_photo(asset, photo(row), agents, tracks[row], settings.backend)
        return known[row][track_id]

    def taken(track_id: str, row: int) -> VehiclePhoto:
        there = agents_at_time(agents, photo(row).time_s)
        own = there.track_ids.index(track_id)
        return VehiclePhoto(photo(row), there.boxes[own], np.delete(there.boxes, own, axis=0))

    held_out = {(view.camera, view.time_s) for view in asset.views if view.held_out}
    rows = frozenset(row for row, file in enumerate(files) if (file.sensor, file.time_s) in held_out)
    return VehiclePhotos(shown, likeness, cache(lambda: estimate_fading(shown, likeness, rows)), taken)


@lru_cache(maxsize=2)
def _cached_vehicle_photos(block: _BlockKey) -> VehiclePhotos:
    return lazy_vehicle_photos(block.clip, _scene_of_block(block.clip, block.settings, block.cache_dir), block.settings)


@lru_cache(maxsize=2)
def _cached_sights(block: _BlockKey) -> PhotoSights | None:
    """Of the photos that the clip's block was made of; None where it was made of lidar alone."""
    clip, settings = block.clip, block.settings
    asset = _scene_of_block(clip, settings, block.cache_dir)
    files, cameras = asset.photos_of(block_of(clip).images), choose_cameras(clip.cameras, settings.cameras)
    sights = photo_sights(asset, files, asset.as_corrected(cameras), settings.backend)
    return sights if len(sights) else None
