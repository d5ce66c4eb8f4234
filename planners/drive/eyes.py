"""What a driver is shown: a sample's row of the scene it has come to, with the pictures of its cameras."""

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

import numpy as np

from factory.stages.rows import scene_columns
from factory.store.reader import Sample
from factory.store.schema import COLUMNS
from tasks.render.settings import ImageSource
from tasks.render.views import pose_on_ground
from tasks.world.arrays import Array
from tasks.world.clip import HISTORY_STEPS, HORIZON_STEPS, STEP_S, Clip, Scene
from tasks.world.route import driving_command
from tasks.world.vehicle import HEADING

Images = Sequence[Mapping[str, Any]]  # entries of the column `images`
DRIVEN = "drive"  # where a sample names its expert


class Eyes(Protocol):
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

    def look(self, scene: Scene, offset: int) -> Images:
        """What they see `offset` steps from the scene's, not after it."""
        ...


@dataclass(frozen=True)
class NoEyes:
    """No cameras."""

    source: ImageSource = ImageSource.NONE
    rig: None = None
    offsets: tuple[int, ...] = (0,)

    def look(self, scene: Scene, offset: int) -> Images:
        """Nothing."""
        return ()


@dataclass(frozen=True)
class Looked:
    """A look at a scene."""

    images: Images  # of now
    sample: Callable[[], Sample]  # the row, made when it is asked for


class Sight:
    """Looks at one scene after another, 0.5 s apart, and keeps what a sample's earlier pictures are."""

    def __init__(self, eyes: Eyes) -> None:
        self._eyes = eyes
        self._seen: deque[tuple[int, Images]] = deque(maxlen=len(eyes.offsets))

    def look(self, scene: Scene) -> Looked:
        """At the first scene those before it are looked at too, from where the ego came."""
        offsets = self._eyes.offsets if not self._seen else (0,)
        self._seen += [(scene.step + offset, self._eyes.look(scene, offset)) for offset in offsets]
        images = [{**image, "time_s": (step - scene.step) * STEP_S} for step, taken in self._seen for image in taken]
        return Looked(self._seen[-1][1], partial(sample_of, scene, self._eyes, images))


def sample_of(scene: Scene, eyes: Eyes, images: Images) -> Sample:
    """The row of a scene nobody has driven on from: its labels are zeros."""
    pose = scene.ego_state[: HEADING + 1]
    place = pose_on_ground(scene.clip.world_from_ego, scene.ego_state[None])[0]
    columns = scene_columns(scene, scene.agents, place, driving_command(scene.centerline, pose))
    return dict.fromkeys(COLUMNS) | columns | {
        "attempt_id": f"{scene.clip.clip_id}-{scene.step}",
        "expert": DRIVEN,
        "label_10hz": np.zeros((HORIZON_STEPS, 3)),
        "label_2hz": np.zeros((HORIZON_STEPS // 5, 3)),
        "cameras": eyes.rig,
        "images": list(images) or None,
        "image_source": str(eyes.source),
    }  # fmt: skip


def states_at(scene: Scene, offset: int) -> Array:
    """(1, 11) of the ego `offset` steps from the scene's, within its history."""
    return scene.ego_history[HISTORY_STEPS + offset][None]


def ground_of(clip: Clip) -> Array:
    """(L, 4, 4) poses that tell how the road lies, of the clip's ego and of its block's sensors."""
    files = () if clip.block is None else (*clip.block.images, *clip.block.sweeps)
    return np.concatenate([clip.world_from_ego, *(file.world_from_ego[None] for file in files)])
