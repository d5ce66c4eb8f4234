"""What of a picture from a new place is a guess, told without a photo from there.

A scene is only known from where its photos were taken. So each pixel of a picture is taken to its place in the scene,
and that place to every photo. How well a photo shows it is

    exp(-(a / 15 degrees)^2) min(1, d / d_photo),

a the angle between the two lines of sight, d and d_photo how far the place is from here and from the photo; 0 where it
is out of the photo's frame, or behind what the photo shows there. A pixel is a guess where no photo shows its place
well, or where the picture does not look like the best of them does there: what was fitted at a wrong depth, a torn car
or scraps before a facade, looks right from the photo's own place alone. Photos are taken as the scene shows them from
their places, which the fit has made near enough.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from tasks.kernels.compiled import kernel
from tasks.render.scene.asset import Instant, RenderAsset
from tasks.render.scene.engine import SCENE_S_OWN, render_instants
from tasks.render.scene.movers import NOBODY, behind_boxes
from tasks.render.scene.sky import pixel_directions
from tasks.render.settings import Backend
from tasks.render.splatting.raster import View
from tasks.world.arrays import F32, Array, Bools, Ints
from tasks.world.clip import Camera, Pinhole, SensorFile

WIDTH = 80  # pixels of photos and pictures that are looked at
ANGLE_RAD = np.deg2rad(15.0)
BEHIND, BEHIND_M = 1.15, 0.5  # a place this much farther than what a photo shows there, and this many metres, is hidden
NEAREST_M = 0.1
SOLID = 0.5  # alpha from which a pixel is a place and not sky
SURELY = 1.0 - 1.0e-9  # whatever is rounded
LOOKS_ELSEWHERE = -0.5  # cosine between two optical axes below which one photo says nothing of what the other shows
# Chosen on pictures labelled by eye (docs/reconstruction.md).
SIGHT_MIN = 0.3  # of the best photo of a pixel
LIKE_MIN = 0.6  # SSIM (Wang et al. 2004) of the grey pictures around it
SIGMA_PX, C1, C2 = 1.0, 0.01**2, 0.03**2


@dataclass(frozen=True)
class PhotoSights:
    """P photos of a scene, as it shows them."""

    eyes: Array  # (P, 3) [m] in the world
    cameras_from_world: Array  # (P, 4, 4)
    lenses: Array  # (P, 4) focal lengths, principal point [px]
    heights: Ints  # (P,) rows of each photo's picture, at most H
    depths: F32  # (P, H, WIDTH) [m], 0 where nothing is
    pictures: F32  # (P, H, WIDTH, 3)

    def __len__(self) -> int:
        return len(self.eyes)


def photo_sights(
    asset: RenderAsset, files: Sequence[SensorFile], cameras: Sequence[Camera], backend: Backend = Backend.CPU
) -> PhotoSights:
    """Of photos at the poses that the scene was made with; its vehicles are left out."""
    rig = {camera.name: camera for camera in cameras}
    shots = [(rig[file.sensor], file.world_from_ego) for file in files if file.sensor in rig]
    eyes, views = zip(*street_views(asset, shots, backend)) if shots else ((), ())
    poses = np.array([eye.world_from_camera for eye in eyes]).reshape(-1, 4, 4)
    lenses = np.array([eye.intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]] for eye in eyes]).reshape(-1, 4)
    heights = np.array([eye.height for eye in eyes], np.int64)
    depths = np.zeros((len(eyes), heights.max(initial=0), WIDTH), np.float32)
    pictures = np.zeros((*depths.shape, 3), np.float32)
    for view, height, depth, picture in zip(views, heights, depths, pictures):
        depth[:height], picture[:height] = view.depth, view.rgb
    return PhotoSights(poses[:, :3, 3].copy(), np.linalg.inv(poses), lenses, heights, depths, pictures)


def street_views(
    asset: RenderAsset, shots: Sequence[tuple[Camera, Array]], backend: Backend = Backend.CPU
) -> Iterator[tuple[Pinhole, View]]:
    """What cameras of the ego at poses (4, 4) see of the scene with nobody in it, WIDTH wide, one after the other."""
    eyes = [_eye(camera, pose) for camera, pose in shots]
    seen = render_instants(asset, [Instant([eye], NOBODY, [SCENE_S_OWN]) for eye in eyes], backend)
    return ((eye, view) for eye, (view,) in zip(eyes, seen, strict=True))


def guessed_pixels(sights: PhotoSights, eye: Pinhole, view: View, boxes: Array) -> Bools:
    """(H, WIDTH) which pixels of a street view are a guess.

    Sky is none, nor what vehicles in boxes (N, 7), world, hide: they are known by other photos.
    """
    rays = pixel_directions(eye.intrinsics, eye.world_from_camera, eye.width, eye.height)
    here, ahead = (np.ascontiguousarray(eye.world_from_camera[:3, k]) for k in (3, 2))
    places = here + (view.depth / (rays @ ahead))[..., None] * rays
    street = view.alpha >= SOLID
    if len(boxes):
        hidden = behind_boxes(places.reshape(-1, 3), here, np.ascontiguousarray(boxes))
        street &= ~np.asarray(hidden, bool).reshape(street.shape)
    best, shown = best_sights(sights, places, here, ahead, view.rgb)
    return street & ((best < SIGHT_MIN) | (_likeness(view.rgb, shown) < LIKE_MIN))


def best_sights(sights: PhotoSights, places: Array, here: Array, ahead: Array, rgb: F32) -> tuple[F32, F32]:
    """(H, W) how well the best photo shows each place (H, W, 3) to an eye that looks `ahead` (3,) from `here` (3,).

    And what that photo shows there (H, W, 3); where none shows it `rgb`, the picture itself.
    """
    best, shown = np.zeros(places.shape[:2], np.float32), rgb.copy()
    apart_m = np.linalg.norm(sights.eyes - here, axis=1)  # the nearest first: they leave the others least to better
    order = np.argsort(apart_m, kind="stable")
    photos = sights.eyes, sights.cameras_from_world, sights.lenses, sights.heights, sights.depths, sights.pictures
    _look(places, here, ahead, order, apart_m, *photos, best, shown)
    return best, shown


def _eye(camera: Camera, world_from_ego: Array) -> Pinhole:
    small = camera.resized(WIDTH, max(1, round(WIDTH * camera.height / camera.width)))
    return Pinhole(small.intrinsics, world_from_ego @ small.ego_from_camera, small.width, small.height)


def _likeness(rgb: F32, other: F32) -> Array:
    """SSIM (H, W) of two pictures (H, W, 3), in grey."""

    def blurred(image: Array) -> Array:
        return np.asarray(cv2.GaussianBlur(image, (0, 0), SIGMA_PX))

    a, b = (picture.mean(axis=-1, dtype=np.float64) for picture in (rgb, other))
    mean_a, mean_b = blurred(a), blurred(b)
    spread = blurred(a * a) - mean_a**2 + blurred(b * b) - mean_b**2
    cross = blurred(a * b) - mean_a * mean_b
    return (2.0 * mean_a * mean_b + C1) * (2.0 * cross + C2) / ((mean_a**2 + mean_b**2 + C1) * (spread + C2))


# A photo at least as far from here as the place is shows it no better than d / (d + |here - photo|): with cosine c of
# the angle, d_photo is c (d + |here - photo|) at least, and the exponential is c at most (from 90 degrees on it is less
# than 1e-15, which betters nothing). What holds for one photo does for every farther one.


@kernel
def _look(
    places: Any,
    here: Any,
    ahead: Any,
    order: Any,
    apart_m: Any,
    eyes: Any,
    photos_from_world: Any,
    lenses: Any,
    heights: Any,
    depths: Any,
    pictures: Any,
    best: Any,
    shown: Any,
) -> None:
    far, in_question = np.empty(best.shape), np.ones(best.shape[0], np.bool_)  # [m] each place from here; by row
    for row in range(best.shape[0]):
        for column in range(best.shape[1]):
            x, y, z = places[row, column, 0], places[row, column, 1], places[row, column, 2]
            far[row, column] = np.sqrt((x - here[0]) ** 2 + (y - here[1]) ** 2 + (z - here[2]) ** 2)
    for photo in order:
        m, lens, height, width = photos_from_world[photo], lenses[photo], heights[photo], depths.shape[2]
        if m[2, 0] * ahead[0] + m[2, 1] * ahead[1] + m[2, 2] * ahead[2] <= LOOKS_ELSEWHERE:
            continue
        eye, depth, picture = eyes[photo], depths[photo], pictures[photo]
        for row in range(best.shape[0]):
            if not in_question[row]:
                continue
            in_question[row] = False
            for column in range(best.shape[1]):
                mine, least = far[row, column], best[row, column]
                if mine == 0.0 or (apart_m[photo] >= mine and mine < least * (mine + apart_m[photo]) * SURELY):
                    continue
                in_question[row] = True
                x, y, z = places[row, column, 0], places[row, column, 1], places[row, column, 2]
                its = np.sqrt((x - eye[0]) ** 2 + (y - eye[1]) ** 2 + (z - eye[2]) ** 2)
                dot = (x - here[0]) * (x - eye[0]) + (y - here[1]) * (y - eye[1]) + (z - here[2]) * (z - eye[2])
                cosine, near = min(1.0, max(-1.0, dot / max(mine * its, 1.0e-9))), min(1.0, mine / max(its, 1.0e-9))
                if near < least * (1.0 + 2.0 * (1.0 - cosine) / ANGLE_RAD**2) * SURELY:
                    continue  # below the best: e^-x < 1 / (1 + x), and the angle's square is at least 2 (1 - cosine)
                away = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
                if away < NEAREST_M:
                    continue
                u = lens[0] * (m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]) / away + lens[2]
                v = lens[1] * (m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]) / away + lens[3]
                if not (0.0 <= u < width and 0.0 <= v < height):
                    continue
                first = depth[int(v), int(u)]
                if first > 0.0 and away > BEHIND * first + BEHIND_M:
                    continue
                score = np.exp(-((np.arccos(cosine) / ANGLE_RAD) ** 2)) * near
                if score > least:
                    best[row, column] = score
                    # between the middles of the four pixels around it
                    right, down = min(max(u - 0.5, 0.0), width - 1.0), min(max(v - 0.5, 0.0), height - 1.0)
                    i, j = min(int(right), width - 2), min(int(down), height - 2)
                    a, b = right - i, down - j
                    for k in range(3):
                        upper = (1.0 - a) * picture[j, i, k] + a * picture[j, i + 1, k]
                        lower = (1.0 - a) * picture[j + 1, i, k] + a * picture[j + 1, i + 1, k]
                        shown[row, column, k] = (1.0 - b) * upper + b * lower
