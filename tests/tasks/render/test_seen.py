"""What of a picture is a guess: by how far and from which side photos show it, what stood between, and how like it is.

Seen is a wall across the way, by a lens on the axle.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
import street

from tasks.render.gate import GateSettings, check_drive_pictures, worst_quarter
from tasks.render.scene.asset import RenderAsset
from tasks.render.scene.sky import pixel_directions, plain_sky
from tasks.render.seen import ANGLE_RAD, WIDTH, PhotoSights, best_sights, guessed_pixels, photo_sights, street_views
from tasks.render.splatting.gaussians import EMPTY, Gaussians, concatenate
from tasks.world.arrays import F32, Array, Bools
from tasks.world.clip import Camera, SensorFile

MOUNT = street.EGO_FROM_CAMERA.copy()
MOUNT[:3, 3] = 0.0
LENS = Camera("lens", street.WIDTH, street.HEIGHT, street.INTRINSICS, np.zeros(5), MOUNT)
WALL_M, NOBODY = 20.0, np.zeros((0, 7))
MIDDLE = (WIDTH * street.HEIGHT // street.WIDTH // 2, WIDTH // 2)


def wall(x: float, low: float, high: float, seed: int | None = None) -> Gaussians:
    """Opaque balls on the plane at x, y from low to high; grey, or of colours drawn for squares of 2 m."""
    y, z = (grid.ravel() for grid in np.meshgrid(np.arange(low, high, 0.25), np.arange(-12.0, 12.0, 0.25)))
    n = len(y)
    colours = np.full((n, 3), 0.5, np.float32)
    if seed is not None:
        squares = np.random.default_rng(seed).uniform(0.0, 1.0, (100, 100))
        colours[:] = squares[((y + 100.0) // 2.0).astype(int), ((z + 100.0) // 2.0).astype(int)][:, None]
    quats = np.tile(np.array([1.0, 0.0, 0.0, 0.0], np.float32), (n, 1))
    sizes = np.full((n, 3), math.log(0.15), np.float32)
    means = np.column_stack([np.full_like(y, x), y, z]).astype(np.float32)
    return Gaussians(means, quats, sizes, np.full(n, 0.99, np.float32), colours)


def scene(*walls: Gaussians) -> RenderAsset:
    return RenderAsset(np.zeros(3), concatenate([EMPTY, *walls]), {}, plain_sky(), float("nan"))


def pose(x: float, y: float = 0.0, degrees: float = 0.0) -> Array:
    at = street.ego_pose(x, y)
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    at[:2, :2] = [[c, -s], [s, c]]
    return at


def sights_of(asset: RenderAsset, *photos: Array) -> PhotoSights:
    return photo_sights(asset, [SensorFile("lens", "", 0.0, one) for one in photos], [LENS])


def sight_of_middle(asset: RenderAsset, here: Array, *photos: Array) -> float:
    """Of the wall's middle, to an eye that looks at it."""
    place, eye = np.array([[[WALL_M, 0.0, 0.0]]]), here[:3, 3].copy()
    nothing = np.zeros((1, 1, 3), np.float32)
    return float(best_sights(sights_of(asset, *photos), place, eye, place[0, 0] - eye, nothing)[0][0, 0])


@pytest.mark.parametrize(
    ("here", "photos", "expected"),
    [
        (pose(0.0), [pose(0.0)], 1.0),
        (pose(10.0), [pose(0.0)], 0.5),  # from twice as far
        (pose(0.0), [pose(10.0)], 1.0),  # from half as far
        (pose(10.0), [pose(0.0), pose(5.0)], 10.0 / 15.0),  # the best counts
        (pose(0.0), [pose(0.0, -20.0 * math.tan(ANGLE_RAD), 15.0)], math.exp(-1.0) * math.cos(ANGLE_RAD)),
        (pose(0.0), [pose(0.0, 0.0, 60.0)], 0.0),  # out of the frame
        (pose(0.0), [pose(0.0, 0.0, 180.0)], 0.0),  # behind it
        (pose(0.0), [pose(-30.0)], 20.0 / 50.0),
    ],
)
def test_a_place_counts_as_much_as_the_best_photo_shows_it(here: Array, photos: list[Array], expected: float) -> None:
    assert sight_of_middle(scene(wall(WALL_M, -30.0, 30.0)), here, *photos) == pytest.approx(expected, abs=1e-5)


def test_of_many_photos_each_pixel_has_the_best_of_all_alone() -> None:
    rng, asset = np.random.default_rng(6), scene(wall(WALL_M, -30.0, 30.0, seed=1), wall(14.0, -4.0, -2.0, seed=2))
    photos = [pose(rng.uniform(-40.0, 9.0), rng.uniform(-6.0, 6.0), rng.uniform(-25.0, 25.0)) for _ in range(48)]
    sights = sights_of(asset, *photos)
    eye, view = next(street_views(asset, [(LENS, pose(4.0, 1.0, 5.0))]))
    here, ahead = (np.ascontiguousarray(eye.world_from_camera[:3, k]) for k in (3, 2))
    rays = pixel_directions(eye.intrinsics, eye.world_from_camera, eye.width, eye.height)
    places = here + (view.depth / (rays @ ahead))[..., None] * rays

    def of(rows: slice) -> tuple[F32, F32]:
        parts = {name: getattr(sights, name)[rows] for name in vars(sights)}
        return best_sights(PhotoSights(**parts), places, here, ahead, view.rgb)

    best, shown = of(slice(None))
    scores, pictures = map(np.stack, zip(*[of(slice(i, i + 1)) for i in range(len(photos))]))
    np.testing.assert_array_equal(best, scores.max(axis=0))
    of_best = np.take_along_axis(pictures, scores.argmax(axis=0)[None, ..., None], axis=0)[0]
    np.testing.assert_array_equal(shown, np.where(best[..., None] > 0.0, of_best, view.rgb))
    assert (best > 0.5).mean() > 0.5


def test_what_stood_before_a_place_in_a_photo_hides_it() -> None:
    far, before, beside = wall(WALL_M, -30.0, 30.0), wall(5.0, -3.0, 3.0), pose(0.0, 6.0)
    assert sight_of_middle(scene(far), beside, pose(0.0)) > 0.25
    assert sight_of_middle(scene(far, before), beside, pose(0.0)) == 0.0


def guessed(asset: RenderAsset, here: Array, *photos: Array, boxes: Array = NOBODY) -> Bools:
    return guessed_pixels(sights_of(asset, *photos), *next(street_views(asset, [(LENS, here)])), boxes)


def test_a_guess_is_what_photos_do_not_show_and_what_does_not_look_like_there() -> None:
    plain = scene(wall(WALL_M, -30.0, 30.0, seed=1))
    assert not guessed(plain, pose(3.0, 1.0, 5.0), pose(0.0), pose(0.0, 0.0, 30.0)).any()
    assert guessed(plain, pose(15.0), pose(0.0)).mean() > 0.9  # four times as near
    # A scrap near the lens looks like the wall from the photo's place; from aside it is before the wrong part of it.
    scrap = scene(wall(WALL_M, -30.0, 30.0, seed=1), wall(6.0, -1.0, 1.0, seed=2))
    assert not guessed(scrap, pose(0.0), pose(0.0)).any()
    seen = guessed(scrap, pose(0.0, 1.5), pose(0.0))
    assert 0.02 < seen.mean() < 0.3
    shown = sights_of(plain, pose(0.0))
    other = replace(shown, pictures=np.ascontiguousarray(shown.pictures[:, :, ::-1]))
    assert guessed_pixels(other, *next(street_views(plain, [(LENS, pose(0.0))])), NOBODY).mean() > 0.5


def test_the_sky_and_what_vehicles_hide_is_no_guess() -> None:
    asset = scene(wall(WALL_M, -30.0, 30.0))
    assert not guessed(scene(), pose(0.0)).any()
    assert guessed(asset, pose(0.0)).all()
    hidden = guessed(asset, pose(0.0), boxes=np.array([[10.0, 0.0, 0.0, 0.0, 4.0, 2.0, 2.0]]))
    assert not hidden[MIDDLE] and hidden[MIDDLE[0], 0]


def test_the_worst_quarter_is_the_densest_window_of_half_the_size() -> None:
    rng = np.random.default_rng(0)
    found = rng.uniform(size=(45, 80)) < np.linspace(0.0, 0.6, 80)
    windows = [found[i : i + 22, j : j + 40].mean() for i in range(24) for j in range(41)]
    assert worst_quarter(found) == pytest.approx(max(windows))
    corner = np.zeros((45, 80), bool)
    corner[:22, :40] = True
    assert worst_quarter(corner) == 1.0 and worst_quarter(~corner & False) == 0.0


def test_the_gate_refuses_a_stored_picture_that_is_a_guess(street_asset: RenderAsset) -> None:
    camera = Camera("front", street.WIDTH, street.HEIGHT, street.INTRINSICS, np.zeros(5), street.EGO_FROM_CAMERA)
    first = street.drive(10)[0][0]
    file = SensorFile("front", "", first.time_s, first.world_from_camera @ np.linalg.inv(camera.ego_from_camera))
    sights = photo_sights(street_asset, [file], [camera])

    def reason(at: Array, stored: tuple[int, ...], guessed_max: float = 0.36) -> str | None:
        settings = GateSettings(width=128, guessed_max=guessed_max)
        size = (street.WIDTH, street.HEIGHT)
        found = check_drive_pictures(
            street_asset, [camera], at[None], street.tracks(), [8], size, settings, stored=stored, sights=sights
        )
        return None if found is None else found.reason

    near, on = street.ego_pose(1.0), street.ego_pose(9.0)
    assert reason(near, (8,)) is None
    assert reason(on, (8,)) == "guessed"
    assert reason(on, ()) is None and reason(on, (8,), guessed_max=1.0) is None
