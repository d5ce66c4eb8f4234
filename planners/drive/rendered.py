"""A clip's block as the scene engine shows it, from wherever a drive has come to."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from factory.readers.base import BadClip
from factory.stages.assets import asset_for
from factory.stages.imaging import Imaging, first_of, in_time_of
from factory.stages.sensors import chosen_cameras
from planners.drive.eyes import Images, ground_of, states_at
from tasks.render.gate import poor_block
from tasks.render.scene.asset import RenderAsset
from tasks.render.settings import STEPS_OF, ImageSource, PsnrGate, RenderSettings
from tasks.render.views import pose_on_ground, render_views
from tasks.world.camera import Camera
from tasks.world.clip import STEP_S, Clip, Scene


@dataclass(frozen=True)
class RenderedEyes:
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

    def look(self, scene: Scene, offset: int) -> Images:
        """As a sample's pictures are drawn (factory.stages.imaging)."""
        s, step = self.settings, scene.step + offset
        poses = pose_on_ground(self.asset.on_road(ground_of(self.clip)), states_at(scene, offset))
        agents = self.asset.lifted(scene.agents, first_of(self.clip))
        seen = render_views(self.asset, self.cameras, poses, agents, [step], s.width, s.height, s.backend)[0]
        imaging = Imaging(s, "")
        return [imaging.image(c.name, offset * STEP_S, poses[0], rgb) for c, rgb in zip(self.cameras, seen)]


def rendered_eyes(clip: Clip, settings: RenderSettings, cache_dir: str) -> RenderedEyes:
    """The scene is built where the cache does not hold it, in minutes.

    Raises BadClip for a clip without anything to build it from, for a broken sensor file, and for a scene whose
    held-out photos are below psnr_min where `render.psnr_gate` rejects such.
    """
    built = asset_for(clip, settings, cache_dir)
    if built is None:
        raise BadClip(f"log {clip.log_id}", "cameras", "no photos and no lidar to build a scene from: pictures=none")
    if settings.psnr_gate is PsnrGate.REJECT and (why := poor_block(built, settings)) is not None:
        raise BadClip(f"log {clip.log_id}", "scene", f"{why}; render.psnr_gate=mark drives in it all the same")
    asset = in_time_of(clip, built)
    return RenderedEyes(
        clip, settings, asset, tuple(asset.as_corrected(chosen_cameras(clip.cameras, settings.cameras)))
    )
