"""A drive's film: a picture for every 0.1 s, with what was seen."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from planners.drive.alpasim_score import logged_rollout, score_drive
from planners.drive.films import BEV_PX, CAMERA_PX, HOLD, film_frames
from planners.drive.loop import LoopSettings, drive
from tasks.render.scene.engine import encode_jpeg
from tasks.render.settings import ImageSource
from tasks.world.clip import Scene
from tests.planners.drive.streets import Steady, car, start_on, street_with
from tests.planners.drive.test_drive import towns as towns  # the fixture

SETTINGS = LoopSettings(seconds=1.6)


@dataclass(frozen=True)
class RedEyes:
    """One camera that sees red."""

    source: ImageSource = ImageSource.PHOTO
    rig: tuple[Mapping[str, Any], ...] = ({"name": "front", "ego_from_camera": np.eye(4)[[2, 0, 1, 3]].ravel()},)
    offsets: tuple[int, ...] = (0,)

    def images(self, scene: Scene, offset: int) -> list[Mapping[str, Any]]:
        red = np.full((36, 64, 3), (250, 0, 0), np.uint8)
        return [{"camera": "front", "time_s": 0.0, "jpeg": encode_jpeg(red, 95)}]


@pytest.mark.parametrize("cameras", [None, RedEyes()])
def test_a_film_has_a_picture_for_every_tenth_of_a_second(cameras: RedEyes | None) -> None:
    made = drive(start_on(street_with(car(50.0)), SETTINGS), Steady(8.0), SETTINGS, cameras)
    pictures = list(
        film_frames(made, score_drive(logged_rollout(made, 1.6)), None if cameras is None else cameras.rig, "a")
    )
    assert len(pictures) == made.n_steps + 1 + HOLD == 26
    assert {picture.shape for picture in pictures} == {(BEV_PX[1], BEV_PX[0] + CAMERA_PX[0], 3)}
    middle = pictures[0][CAMERA_PX[1] // 2, BEV_PX[0] + CAMERA_PX[0] // 2].astype(int)
    assert (middle[0] - middle[1] > 200) == (cameras is not None)
    assert (pictures[0] != pictures[5]).any()
