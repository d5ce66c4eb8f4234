"""Vehicles in a picture are held beside a photo, place by place of their boxes."""

from dataclasses import replace

import numpy as np
import pytest
import street
from numpy.typing import NDArray

from tasks.render import gate
from tasks.render.gate import (
    BEHIND_BOX_M,
    BESIDE_GAP,
    BESIDE_RAD,
    GateSettings,
    Sightings,
    VehiclePhoto,
    VehiclePhotos,
    intersect_box,
    likeness_beside_photo,
    likeness_to_nearest_photo,
    to_box_frame,
    vehicle_fault,
)
from tasks.render.scene.movers import PlacedAgents
from tasks.render.scene.sensed import Photo
from tasks.render.splatting.raster import View
from tasks.world.clip import AgentKind, Pinhole

Array = NDArray[np.float64]
INTRINSICS = np.array([[110.0, 0.0, 80.0], [0.0, 110.0, 45.0], [0.0, 0.0, 1.0]])
WIDTH, HEIGHT = 160, 90
AHEAD = street.EGO_FROM_CAMERA[:3, :3]
BOX = np.array([10.0, 1.0, 0.8, -0.3, 4.4, 1.9, 1.6])
NOBODY = np.zeros((0, 7))


def eye_at(x: float, y: float = 0.0, z: float = 1.5) -> Pinhole:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = AHEAD, (x, y, z)
    return Pinhole(INTRINSICS, pose, WIDTH, HEIGHT)


def rays_of(eye: Pinhole) -> Array:
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    local = np.stack([(u - 80.0) / 110.0, (v - 45.0) / 110.0, np.ones_like(u)], -1).reshape(-1, 3)
    return np.asarray(local @ eye.world_from_camera[:3, :3].T)


def marched(box: Array, eye: Array, rays: Array) -> Array:
    """Slow twin of `intersect_box`: the first of many places along each ray (N, 3) in the box; inf for none."""
    c, s = np.cos(box[3]), np.sin(box[3])
    found = np.full(len(rays), np.inf)
    for along in np.arange(20.0, 0.0, -0.01):
        dx, dy, dz = (eye + along * rays - box[:3]).T
        inside = (np.abs(c * dx + s * dy) < box[4] / 2) & (np.abs(c * dy - s * dx) < box[5] / 2)
        found[inside & (np.abs(dz) < box[6] / 2)] = along
    return found


def painted(eye: Pinhole, boxes: Array, phase: float = 0.0) -> NDArray[np.float32]:
    """(H, W, 3) boxes with a pattern on them, before grey."""
    rays, nearest = rays_of(eye), np.full(WIDTH * HEIGHT, np.inf)
    rgb = np.full((WIDTH * HEIGHT, 3), 0.5)
    for number, box in enumerate(boxes):
        points, _, _, along = intersect_box(box, eye.world_from_camera[:3, 3], rays)
        front = along < nearest
        pattern = (
            0.5
            + 0.2 * np.sin(4.0 * points[:, 0] + phase)
            + 0.25 * np.sin(5.0 * points[:, 2] + 3.0 * points[:, 1] + phase)
        )
        rgb[front] = pattern[front, None] * [[1.0, 0.8, 0.6], [0.3, 0.2, 0.9]][number]
        nearest = np.fmin(nearest, along)
    return rgb.reshape(HEIGHT, WIDTH, 3).astype(np.float32)


def vehicle_photo(eye: Pinhole, box: Array = BOX, others: Array = NOBODY) -> VehiclePhoto:
    rgb = np.rint(255.0 * painted(eye, np.concatenate([box[None], others]))).astype(np.uint8)
    return VehiclePhoto(Photo("front", 0.0, rgb, INTRINSICS, eye.world_from_camera), box, others)


def test_rays_meet_a_box_where_a_walk_along_them_first_enters_it() -> None:
    eye = eye_at(1.0, -0.5)
    rays = rays_of(eye)[::7]
    place = eye.world_from_camera[:3, 3]
    points, axis, side, along = intersect_box(BOX, place, rays)
    slow = marched(BOX, place, rays)
    grazed = np.isfinite(slow) != np.isfinite(along)
    assert grazed.sum() <= 3 and np.isfinite(along).sum() > 50  # through a corner of less than a step
    both = np.isfinite(along) & ~grazed
    assert np.abs(slow[both] - along[both]).max() < 0.011
    assert points[both][np.arange(both.sum()), axis[both]] == pytest.approx((side * BOX[4:7][axis] / 2.0)[both])
    assert set(zip(axis[both], side[both], strict=True)) == {(0, -1.0), (1, -1.0)}  # its back and its right side


def test_a_vehicle_whole_from_elsewhere_is_like_its_photo_and_one_torn_is_not() -> None:
    here, taken = eye_at(1.5, -0.8), vehicle_photo(eye_at(0.0))
    whole = painted(here, BOX[None])
    alike, share = likeness_beside_photo(whole, here, BOX, NOBODY, taken)
    assert alike > 0.93 and share > 0.9
    rng = np.random.default_rng(0)
    rows = np.clip(np.arange(HEIGHT)[:, None] + rng.integers(-6, 7, (HEIGHT, WIDTH)), 0, HEIGHT - 1)
    torn = whole[rows, np.arange(WIDTH)]
    assert likeness_beside_photo(torn, here, BOX, NOBODY, taken)[0] < 0.68
    assert likeness_beside_photo(painted(here, BOX[None], phase=2.5), here, BOX, NOBODY, taken)[0] < 0.7


def test_it_does_not_matter_where_in_the_world_both_are() -> None:
    here, taken = eye_at(1.5, -0.8), vehicle_photo(eye_at(0.0))
    whole = painted(here, BOX[None])
    c, s = np.cos(0.7), np.sin(0.7)
    move = np.eye(4)
    move[:2, :2], move[:3, 3] = [[c, -s], [s, c]], (30.0, -4.0, 1.0)
    elsewhere = np.concatenate([move[:3, :3] @ BOX[:3] + move[:3, 3], [BOX[3] + 0.7], BOX[4:]])
    there = replace(here, world_from_camera=move @ here.world_from_camera)
    assert likeness_beside_photo(whole, there, elsewhere, NOBODY, taken) == pytest.approx(
        likeness_beside_photo(whole, here, BOX, NOBODY, taken), abs=0.02
    )


def test_a_pixel_or_two_off_is_forgiven() -> None:
    here, taken = eye_at(0.0), vehicle_photo(eye_at(0.0))
    moved = np.roll(painted(here, BOX[None]), (1, 2), axis=(0, 1))
    assert likeness_beside_photo(moved, here, BOX, NOBODY, taken)[0] > 0.97


@pytest.mark.parametrize("size", [(160, 90), (107, 60), (160, 91)])
def test_only_the_part_around_a_vehicle_is_compared_and_nothing_else_would_tell(
    size: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same likeness as of the whole picture, at its edges too."""
    rng, (width, height) = np.random.default_rng(8), size
    rgb = rng.uniform(size=(height, width, 3)).astype(np.float32)
    photo = np.rint(255.0 * rng.uniform(size=(height, width, 3))).astype(np.uint8)
    columns, rows = (grid.astype(np.float32) for grid in np.meshgrid(np.arange(width), np.arange(height)))
    for left, top, wide, high in ((0, 0, 12, 9), (60, 30, 33, 21), (90, 50, 30, 60), (width - 8, 3, 8, 70)):
        clear = np.zeros((height, width), bool)
        clear[top : top + high, left : left + wide] = True
        of_part = gate._best_shifted_likeness(rgb, photo, columns, rows, clear)
        with monkeypatch.context() as patch:
            patch.setattr(gate, "_window_around", lambda _: (slice(None), slice(None)))
            assert of_part == pytest.approx(gate._best_shifted_likeness(rgb, photo, columns, rows, clear), abs=1e-6)
        assert of_part > 0.0


def test_faces_that_the_photo_does_not_show_say_nothing() -> None:
    behind, beside = eye_at(0.0, 1.0), eye_at(10.0 - 3.0, -7.0)
    straight = BOX * [1, 1, 1, 0, 1, 1, 1]
    _, share = likeness_beside_photo(
        painted(beside, straight[None]), beside, straight, NOBODY, vehicle_photo(behind, straight)
    )
    assert share == 0.0  # of the side from the side: from behind there is the back alone
    ahead = eye_at(30.0)
    assert likeness_beside_photo(painted(ahead, BOX[None]), ahead, BOX, NOBODY, vehicle_photo(behind)) == (0.0, 0.0)


@pytest.mark.parametrize("hidden", ["here", "in the photo"])
def test_what_others_hide_says_nothing(hidden: str) -> None:
    here, then = eye_at(0.5, -0.3), eye_at(0.0)
    other = np.array([[5.0, 0.0, 0.6, 0.0, 1.0, 1.2, 1.2]])
    mine, theirs = (other, NOBODY) if hidden == "here" else (NOBODY, other)
    picture = painted(here, np.concatenate([BOX[None], mine]))
    alike, share = likeness_beside_photo(picture, here, BOX, mine, vehicle_photo(then, BOX, theirs))
    assert 0.2 < share < 0.9 and alike > 0.9
    assert (
        likeness_beside_photo(
            picture, here, BOX, NOBODY, vehicle_photo(then, BOX, theirs) if len(mine) else vehicle_photo(then)
        )[1]
        > share
    )


def test_only_a_photo_from_near_enough_is_held_beside() -> None:
    here, then = eye_at(1.5, -0.8), eye_at(0.0)
    there = PlacedAgents(("car",), (AgentKind.VEHICLE,), BOX[None])
    wrong = painted(here, BOX[None], phase=2.5)
    view = View(wrong, np.full((HEIGHT, WIDTH), 20.0, np.float32), np.ones((HEIGHT, WIDTH), np.float32))

    def album(eye: Array) -> VehiclePhotos:
        return VehiclePhotos(
            {"car": Sightings(np.array([0]), eye[None])}, lambda *_: 1.0, taken=lambda *_: vehicle_photo(then)
        )

    near = to_box_frame(then.world_from_camera[:3, 3], BOX)
    assert likeness_to_nearest_photo(album(near), there, 0, here, view) < 0.7
    settings = GateSettings(vehicle_share=0.03)
    found = vehicle_fault(album(near), there, here, view, settings)
    assert found is not None and found[0] == "unlike_photos" and "beside a photo" in found[1]
    assert vehicle_fault(album(near), there, here, view, replace(settings, beside_min=0.0)) is None
    for eye, inner in ((eye, to_box_frame(eye.world_from_camera[:3, 3], BOX)) for eye in (here, eye_at(6.0, -0.3))):
        most = min(BESIDE_GAP, BESIDE_RAD * float(np.linalg.norm(inner)) / BEHIND_BOX_M)
        assert likeness_to_nearest_photo(album(inner * (1.0 + 0.99 * most)), there, 0, eye, view) < 1.0
        assert likeness_to_nearest_photo(album(inner * (1.0 + 1.01 * most)), there, 0, eye, view) == 1.0
    assert most < BESIDE_GAP
    assert likeness_to_nearest_photo(replace(album(near), sightings={}), there, 0, here, view) == 1.0
    assert likeness_to_nearest_photo(replace(album(near), taken=None), there, 0, here, view) == 1.0
