"""The synthetic town's pictures hold as much detail as a real street's: nuScenes' front camera."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from factory.datasets.town.draw import TownRenderer, build_rig, paint, world_from_ego
from factory.datasets.town.town import plan_log

SIZE = (800, 450)
QUALITY = 90


def detail(picture: NDArray[np.uint8]) -> tuple[float, float]:
    """Mean gradient magnitude of the grey picture [grey levels per pixel], JPEG bytes per pixel."""
    down, right = np.gradient(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY).astype(np.float64))
    _ok, jpeg = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    return float(np.hypot(down, right).mean()), len(jpeg) / (picture.shape[0] * picture.shape[1])


def test_front_pictures_have_half_the_detail_of_nuscenes_at_least(shared_root: Path) -> None:
    real = cv2.imread(str(next((shared_root / "data" / "nuscenes_frame").glob("*__CAM_FRONT__*.jpg"))))
    assert real is not None
    gradient, bytes_per_pixel = detail(cv2.resize(real, SIZE, interpolation=cv2.INTER_AREA).astype(np.uint8))
    camera = build_rig(("ring_front_center",), *SIZE)[0]
    for index in (0, 2, 3):
        town, drive = plan_log(0, index)
        renderer = TownRenderer(town.scenery, drive, town.sun_azimuth, town.sun_elevation, town.sky_seed)
        for step in (20, 90):
            picture = paint(renderer.scene_at(step), camera, world_from_ego(drive.ego[step]))[..., ::-1]
            ours = detail(np.ascontiguousarray(picture))
            assert ours[0] >= 0.5 * gradient
            assert ours[1] >= 0.5 * bytes_per_pixel
