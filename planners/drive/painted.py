"""A drive's cameras as the synthetic town's painter shows them: pictures without a reconstruction."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from factory.stages.imaging import Imaging
from factory.stages.painted import town_cameras, town_pictures
from planners.drive.eyes import Images, states_at
from tasks.render.settings import STEPS_OF, ImageSource, RenderSettings
from tasks.world.camera import Camera
from tasks.world.clip import STEP_S, Clip, Scene


@dataclass(frozen=True)
class PaintedEyes:
    """The cameras of a clip's rig, or of the town's own where it has none, of the render settings' size."""

    clip: Clip
    settings: RenderSettings
    source: ImageSource = ImageSource.PHOTO  # what a camera would have taken

    @cached_property
    def cameras(self) -> tuple[Camera, ...]:
        """As pinholes of the wanted size. Raises ValueError for one that the rig does not have."""
        return town_cameras(self.clip, self.settings)

    @property
    def rig(self) -> Sequence[Mapping[str, Any]]:
        return self._imaging.rig(self.cameras)

    @property
    def offsets(self) -> tuple[int, ...]:
        return tuple(offset for offset in STEPS_OF[self.settings.frames] if offset <= 0)

    def look(self, scene: Scene, offset: int) -> Images:
        """Raises ValueError where the clip is of no town."""
        state = states_at(scene, offset)[0]
        pose, taken = town_pictures(scene.clip, self.cameras, scene.agents, scene.step + offset, state)
        names = (camera.name for camera in self.cameras)
        return [self._imaging.image(name, offset * STEP_S, pose, rgb) for name, rgb in zip(names, taken)]

    @property
    def _imaging(self) -> Imaging:
        return Imaging(self.settings, "")
