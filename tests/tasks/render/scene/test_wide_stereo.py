"""Depth from photos that lie metres apart: a wall with a box before it, printed with blots."""

from dataclasses import replace

import cv2
import numpy as np

from tasks.render.scene.sensed import Photo
from tasks.render.scene.stereo import choose_partners, locally_normalised, wide_baseline_depth

WIDTH, HEIGHT, FOCAL, WALL_M, BOX_M = 240, 160, 180.0, 12.0, 6.0
K = np.array([[FOCAL, 0.0, WIDTH / 2], [0.0, FOCAL, HEIGHT / 2], [0.0, 0.0, 1.0]])
ALL = np.ones((HEIGHT, WIDTH), bool)
NOTHING = np.zeros((HEIGHT, WIDTH), np.float32)


def print_of(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    sheet = sum(cv2.resize(rng.uniform(0, 1, (n, 2 * n)).astype(np.float32), (1600, 800)) for n in (25, 100, 200))
    return np.asarray(255.0 * sheet / 3.0, np.float32)


def photo(right_m: float, camera: str = "left") -> tuple[Photo, np.ndarray]:
    """A picture from `right_m` to the right, looking along world z, and its true depth (H, W)."""
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    x, y = (u - WIDTH / 2) / FOCAL, (v - HEIGHT / 2) / FOCAL
    depth = np.where((np.abs(BOX_M * x + right_m - 1.0) < 1.2) & (BOX_M * y > -0.5), BOX_M, WALL_M)
    grey = np.zeros((HEIGHT, WIDTH), np.float32)
    for seed, z in ((0, WALL_M), (1, BOX_M)):
        at = ((z * x + right_m + 20.0) * 40.0).astype(np.float32), ((z * y + 10.0) * 40.0).astype(np.float32)
        grey = np.where(depth == z, cv2.remap(print_of(seed), *at, cv2.INTER_LINEAR), grey)
    pose = np.eye(4)
    pose[0, 3] = right_m
    rgb = np.repeat(np.rint(grey).astype(np.uint8)[..., None], 3, axis=-1)
    return Photo(camera, right_m, rgb, K, pose), depth


def swept(gain: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Depth found, and true, of the middle one of three photos 2 m apart; the others shine `gain` times as bright."""
    (here, depth), others = photo(2.0), [photo(at)[0] for at in (0.0, 4.0)]
    brighter = [replace(o, rgb=np.rint(gain * o.rgb).astype(np.uint8)) for o in others]
    rgb = here.rgb.astype(np.float32) / 255.0
    compared = choose_partners(here, brighter, 4)
    assert len(compared) == 2
    camera = here.intrinsics, here.world_from_camera
    found, cost, sky_cost = wide_baseline_depth(rgb, NOTHING, NOTHING, compared, *camera, ALL)
    assert np.isinf(sky_cost).mean() > 0.95 and np.median(cost) < 0.2
    return found, depth


def test_a_wall_and_a_box_are_where_they_are_whatever_the_exposure() -> None:
    for gain in (1.0, 0.7):
        found, depth = swept(gain)
        off = np.abs(np.log(found / depth))[8:-8, 40:-40]
        assert np.median(off) < 0.01 and (off < 0.05).mean() > 0.85, (gain, np.median(off), (off < 0.05).mean())


def test_nothing_lies_below_the_road_but_what_may_be_lower_by_a_tenth() -> None:
    """Faint texture that fits best at the wall, 12 m away, where the road is met after 7 m."""
    here, others = photo(2.0)[0], [photo(at)[0] for at in (0.0, 4.0)]
    faint = [replace(p, rgb=np.uint8(90.0 + 0.04 * (p.rgb.astype(float) - 120.0))) for p in (here, *others)]
    rgb, compared = faint[0].rgb.astype(np.float32) / 255.0, choose_partners(faint[0], faint[1:], 4)
    low = (np.arange(HEIGHT)[:, None] >= HEIGHT // 2) & ALL
    camera = K, here.world_from_camera
    unbounded, _, _ = wide_baseline_depth(rgb, NOTHING, NOTHING, compared, *camera, ALL)
    found, _, _ = wide_baseline_depth(
        rgb, NOTHING, np.where(low, np.float32(7.0), np.float32(0.0)), compared, *camera, ALL
    )
    slack, _, _ = wide_baseline_depth(
        rgb, NOTHING, np.where(low, np.float32(11.3), np.float32(0.0)), compared, *camera, ALL
    )
    assert (unbounded[HEIGHT // 2 + 4 :] > 9.0).mean() > 0.6
    assert found[HEIGHT // 2 + 4 :].max() < 8.5
    assert (slack[HEIGHT // 2 + 4 :] > 11.5).mean() > 0.4


def test_below_the_horizon_there_is_no_sky_however_bright_and_smooth() -> None:
    here, others = photo(2.0)[0], [photo(at)[0] for at in (0.0, 4.0)]
    white = [replace(p, rgb=np.full_like(p.rgb, 220)) for p in (here, *others)]
    rgb, compared = white[0].rgb.astype(np.float32) / 255.0, choose_partners(white[0], white[1:], 4)
    high = (np.arange(HEIGHT)[:, None] < HEIGHT // 2) & ALL
    floor = np.where(high, np.float32(0.0), np.float32(30.0))
    _, _, sky_cost = wide_baseline_depth(rgb, NOTHING, floor, compared, K, here.world_from_camera, ALL)
    assert ((sky_cost == 0.0) == high).all()


def test_bright_and_smooth_above_the_horizon_is_sky_whatever_fits_as_well() -> None:
    here, others = photo(2.0)[0], [photo(at)[0] for at in (0.0, 4.0)]
    white = []
    for p in (here, *others):
        rgb = p.rgb.copy()
        rgb[:40] = 220
        white.append(replace(p, rgb=rgb))
    rgb, compared = white[0].rgb.astype(np.float32) / 255.0, choose_partners(white[0], white[1:], 4)
    _, _, sky_cost = wide_baseline_depth(rgb, NOTHING, NOTHING, compared, K, here.world_from_camera, ALL)
    assert (sky_cost[:34] == 0.0).all() and np.isinf(sky_cost[50:]).mean() > 0.95


def test_partners_show_what_no_other_shows_and_never_nothing() -> None:
    here, _ = photo(2.0)
    away, _ = photo(60.0, "front")
    twin, _ = photo(2.05, "front")  # no parallax
    far, _ = photo(5.0, "front")
    chosen = choose_partners(here, [away, twin, far], 3)
    places = [float(pose[0, 3]) for _, _, pose in chosen]
    assert places[0] == 5.0 and 60.0 not in places


def test_colours_count_against_those_around_them() -> None:
    rgb = photo(0.0)[0].rgb.astype(np.float32) / 255.0
    np.testing.assert_allclose(locally_normalised(0.6 * rgb + 0.2), locally_normalised(rgb), atol=0.2)
    assert np.abs(locally_normalised(np.full((20, 20, 3), 0.4, np.float32))).max() < 1e-3
