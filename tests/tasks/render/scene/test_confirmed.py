"""Depths that another photo confirms."""

import numpy as np

from tasks.render.scene.depth import ALIKE, ALIKE_PER_M, SHALLOW, PhotoDepth, confirm_depths, label_confirmed
from tasks.render.scene.sensed import Photo
from tasks.render.scene.stereo import FAR_M

WIDTH, HEIGHT, FOCAL, WALL_M = 60, 40, 50.0, 10.0
K = np.array([[FOCAL, 0.0, WIDTH / 2], [0.0, FOCAL, HEIGHT / 2], [0.0, 0.0, 1.0]])


def photo(x_m: float, z_m: float = 0.0) -> Photo:
    """Looks along world z at a wall WALL_M away."""
    pose = np.eye(4)
    pose[:3, 3] = x_m, 0.0, z_m
    return Photo("front", x_m, np.zeros((HEIGHT, WIDTH, 3), np.uint8), K, pose)


def wall(z_m: float = 0.0) -> np.ndarray:
    return np.full((HEIGHT, WIDTH), WALL_M - z_m, np.float32)


def slowly(photos: list[Photo], depths: list[np.ndarray]) -> list[np.ndarray]:
    out = []
    for i, here in enumerate(photos):
        sure = np.zeros((HEIGHT, WIDTH), bool)
        for row in range(HEIGHT):
            for column in range(WIDTH):
                pixel = np.array([column + 0.5, row + 0.5, 1.0])
                point = here.world_from_camera @ np.append(depths[i][row, column] * (np.linalg.inv(K) @ pixel), 1.0)
                for j, other in enumerate(photos):
                    x, y, z = K @ (np.linalg.inv(other.world_from_camera) @ point)[:3]
                    if j == i or depths[i][row, column] == 0.0 or z < 0.5:
                        continue
                    u, v = int(np.floor(x / z)), int(np.floor(y / z))
                    if 0 <= u < WIDTH and 0 <= v < HEIGHT and depths[j][v, u] > 0.0:
                        sure[row, column] |= abs(z - depths[j][v, u]) < (ALIKE + ALIKE_PER_M * z) * z
        out.append(sure)
    return out


def test_a_wall_seen_from_two_places_is_confirmed_and_a_wrong_patch_is_not() -> None:
    photos, depths = [photo(0.0), photo(1.0, 2.0)], [wall(), wall(2.0)]
    depths[0][10:20, 30:40] = 6.0
    here, there = confirm_depths(photos, depths)
    assert not here[10:20, 30:40].any() and not here[:, :3].any(), "wrong, and not in the other picture"
    assert here[25:35, 20:40].all() and there.mean() > 0.8


def test_as_pixel_by_pixel() -> None:
    rng = np.random.default_rng(0)
    photos = [photo(0.0), photo(1.5), photo(0.3, 3.0)]
    depths = [(wall(p.world_from_camera[2, 3]) * rng.uniform(0.93, 1.07, (HEIGHT, WIDTH))) for p in photos]
    depths = [np.where(rng.uniform(size=d.shape) < 0.1, 0.0, d).astype(np.float32) for d in depths]
    for fast, slow in zip(confirm_depths(photos, depths), slowly(photos, depths)):
        assert (fast == slow).all() and 0.3 < fast.mean() < 0.95


def test_only_guesses_are_labelled_anew_and_the_sky_confirms_nothing() -> None:
    nothing = np.zeros((HEIGHT, WIDTH), bool)
    label = np.full((HEIGHT, WIDTH), SHALLOW, np.int32)
    label[:5] = 3  # of a track
    sky = nothing.copy()
    sky[30:] = True
    depth = np.where(sky, np.float32(FAR_M), wall())
    photos = [photo(0.0), photo(0.5)]
    seen = label_confirmed(photos, [PhotoDepth(depth, label, sky, nothing)] * 2)
    assert (seen[0].label[:5] == 3).all()
    assert (seen[0].label[8:28, 10:] == -1).all() and (seen[0].label[30:] == SHALLOW).all()
