"""What a driver is shown: a sample's row of the scene it has come to, with the pictures of its cameras."""

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any, Protocol

import numpy as np

from factory.readers.base import BadClip, Painter
from factory.stages.assets import load_or_build_scene
from factory.stages.imaging import Imaging, clip_offset_s, painted_cameras, scene_in_clip_time
from factory.stages.rows import scene_columns
from factory.stages.sensors import choose_cameras
from factory.store.reader import Sample
from factory.store.schema import COLUMNS
from tasks.render.gate import judge_block
from tasks.render.scene.asset import RenderAsset
from tasks.render.settings import STEPS_OF, ImageSource, RenderSettings
from tasks.render.views import render_views
from tasks.world.arrays import Array
from tasks.world.clip import HISTORY_STEPS, HORIZON_STEPS, STEP_S, Camera, Clip, Scene
from tasks.world.frames import HEADING, pose_on_ground
from tasks.world.road_map import driving_command

Images = Sequence[Mapping[str, Any]]  # entries of the column `images`
DRIVEN = "drive"  # where a sample names its expert


class DriveCameras(Protocol):
    """The cameras of a drive."""

    @property
    def source(self) -> ImageSource:
        """What their pictures are."""
        ...

    @property
    def rig(self) -> Sequence[Mapping[str, Any]] | None:
        """The column `cameras`; None: there are none."""
        ...

    @property
    def offsets(self) -> tuple[int, ...]:
        """Steps of 0.1 s, at 2 Hz up to now, of which a sample has pictures; the last is 0."""
        ...

    def images(self, scene: Scene, offset: int) -> Images:
        """What they see `offset` steps from the scene's, not after it."""
        ...


@dataclass(frozen=True)
class NoCameras:
    """No cameras."""

    source: ImageSource = ImageSource.NONE
    rig: None = None
    offsets: tuple[int, ...] = (0,)

    def images(self, scene: Scene, offset: int) -> Images:
        """Nothing."""
        return ()


class Observer:
    """Looks at one scene after another, 0.5 s apart, and keeps what a sample's earlier pictures are."""

    def __init__(self, cameras: DriveCameras) -> None:
        self._cameras = cameras
        self._seen: deque[tuple[int, Images]] = deque(maxlen=len(cameras.offsets))

    def observe(self, scene: Scene) -> tuple[Images, Callable[[], Sample]]:
        """The pictures of now, and what makes the row when it is asked for.

        At the first scene those before it are looked at too, from where the ego came."""
        offsets = self._cameras.offsets if not self._seen else (0,)
        self._seen += [(scene.step + offset, self._cameras.images(scene, offset)) for offset in offsets]
        images = [{**image, "time_s": (step - scene.step) * STEP_S} for step, taken in self._seen for image in taken]
        return self._seen[-1][1], partial(sample_of, scene, self._cameras, images)


def sample_of(scene: Scene, cameras: DriveCameras, images: Images) -> Sample:
    """The row of a scene nobody has driven on from: its labels are zeros."""
    pose = scene.ego_state[: HEADING + 1]
    place = pose_on_ground(scene.clip.world_from_ego, scene.ego_state[None])[0]
    columns = scene_columns(scene, scene.agents, place, driving_command(scene.centerline, pose))
    return dict.fromkeys(COLUMNS) | columns | {
        "attempt_id": f"{scene.clip.clip_id}-{scene.step}",
        "expert": DRIVEN,
        "label_10hz": np.zeros((HORIZON_STEPS, 3)),
        "label_2hz": np.zeros((HORIZON_STEPS // 5, 3)),
        "cameras": cameras.rig,
        "images": list(images) or None,
        "image_source": str(cameras.source),
    }  # fmt: skip


def ego_state_at(scene: Scene, offset: int) -> Array:
    """(1, 11) of the ego `offset` steps from the scene's, within its history."""
    return scene.ego_history[HISTORY_STEPS + offset][None]


# A drive's cameras as the painter of its reader shows them: pictures without a reconstruction.


@dataclass(frozen=True)
class PaintedCameras:
    """The cameras of a clip's rig, or the painter's own where it has none, of the render settings' size."""

    clip: Clip
    settings: RenderSettings
    painter: Painter
    source: ImageSource = ImageSource.PHOTO  # what a camera would have taken

    @cached_property
    def cameras(self) -> tuple[Camera, ...]:
        """As pinholes of the wanted size. Raises ValueError for one that the rig does not have."""
        return painted_cameras(self.painter, self.clip, self.settings)

    @property
    def rig(self) -> Sequence[Mapping[str, Any]]:
        return self._imaging.rig(self.cameras)

    @property
    def offsets(self) -> tuple[int, ...]:
        return tuple(offset for offset in STEPS_OF[self.settings.frames] if offset <= 0)

    def images(self, scene: Scene, offset: int) -> Images:
        """Raises ValueError where the clip is not the painter's."""
        state = ego_state_at(scene, offset)[0]
        pose, taken = self.painter.pictures(scene.clip, self.cameras, scene.agents, scene.step + offset, state)
        names = (camera.name for camera in self.cameras)
        return [self._imaging.image(name, offset * STEP_S, pose, rgb) for name, rgb in zip(names, taken)]

    @property
    def _imaging(self) -> Imaging:
        return Imaging(self.settings, "")


# A clip's block as the scene engine shows it, from wherever a drive has come to.


@dataclass(frozen=True)
class RenderedCameras:
    """The cameras of a clip's rig in the scene of its block, with the drive's agents where the simulation has them."""

    clip: Clip
    settings: RenderSettings
    asset: RenderAsset = field(repr=False)  # in the clip's time
    cameras: tuple[Camera, ...]
    source: ImageSource = ImageSource.RENDER

    @property
    def rig(self) -> Sequence[Mapping[str, Any]]:
        return Imaging(self.settings, "").rig(self.cameras)

    @property
    def offsets(self) -> tuple[int, ...]:
        return tuple(offset for offset in STEPS_OF[self.settings.frames] if offset <= 0)

    def images(self, scene: Scene, offset: int) -> Images:
        """As a sample's pictures are drawn (factory.stages.imaging)."""
        s, step = self.settings, scene.step + offset
        files = () if self.clip.block is None else (*self.clip.block.images, *self.clip.block.sweeps)
        known = np.concatenate([self.clip.world_from_ego, *(file.world_from_ego[None] for file in files)])
        poses = pose_on_ground(self.asset.on_road(known), ego_state_at(scene, offset))
        agents = self.asset.lifted(scene.agents, clip_offset_s(self.clip))
        seen = next(render_views(self.asset, self.cameras, poses, agents, [step], s.width, s.height, s.backend))
        imaging = Imaging(s, "")
        return [imaging.image(c.name, offset * STEP_S, poses[0], rgb) for c, rgb in zip(self.cameras, seen)]


def open_rendered_cameras(clip: Clip, settings: RenderSettings, cache_dir: str) -> RenderedCameras:
    """The scene is built where the cache does not hold it, in minutes.

    Raises BadClip for a clip without anything to build it from, for a broken sensor file, and for a scene whose
    held-out photos are below what the settings ask for.
    """
    built = load_or_build_scene(clip, settings, cache_dir)
    if built is None:
        raise BadClip(f"log {clip.log_id}", "cameras", "no photos and no lidar to build a scene from: pictures=none")
    rig = choose_cameras(clip.cameras, settings.cameras)
    if (why := judge_block(built, rig, settings).fault) is not None:
        raise BadClip(f"log {clip.log_id}", "scene", f"{why}; render.psnr_min=0 drives in it all the same")
    asset = scene_in_clip_time(clip, built)
    return RenderedCameras(clip, settings, asset, tuple(asset.as_corrected(rig)))
