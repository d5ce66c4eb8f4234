"""The body of a vehicle that photos show in part, or while it drives."""

from dataclasses import replace

import numpy as np
import pytest
import street

from tasks.render.fit.start import prepare_fit
from tasks.render.gate import intersect_box
from tasks.render.scene import body
from tasks.render.scene.body import FAR_M, body_boxes, nearest_box_along_rays, unseen_body_gaussians, with_body_depths
from tasks.render.scene.depth import SHALLOW, STREET, PhotoDepth
from tasks.render.scene.sensed import Tracks
from tasks.render.scene.sky import pixel_directions
from tasks.render.settings import FitSettings
from tasks.render.splatting.gaussians import Gaussians
from tasks.world.clip import AgentTracks

AT_S = 0.5


def rear(size: np.ndarray) -> Gaussians:
    """Half of it red, half of it blue."""
    y, z = np.meshgrid(np.linspace(-size[1] / 2, size[1] / 2, 20), np.linspace(-size[2] / 2, size[2] / 2, 20))
    means = np.stack([np.full(y.size, -size[0] / 2), y.ravel(), z.ravel()], 1).astype(np.float32)
    n = len(means)
    colours = np.where(means[:, 1:2] > 0.0, [[1.0, 0.0, 0.0]], [[0.0, 0.0, 1.0]]).astype(np.float32)
    quats = np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1))
    return Gaussians(means, quats, np.full((n, 3), -3.0, np.float32), np.full(n, 0.5, np.float32), colours)


@pytest.mark.parametrize("size", [np.array([4.4, 1.9, 1.6]), np.array([10.5, 2.5, 3.0])])
def test_a_body_fills_the_box_where_nothing_was_seen(size: np.ndarray) -> None:
    seen = rear(size)
    body = unseen_body_gaussians(seen, size)
    assert (np.abs(body.means) <= size / 2).all()
    away = np.linalg.norm(body.means[:, None] - seen.means[None], axis=-1).min(axis=1)
    assert (away > FAR_M).all()
    reach = body.means.max(axis=0)
    assert (reach > 0.8 * size / 2).all(), "front, sides and roof"
    left, right = body.means[:, 1] > 0.3, body.means[:, 1] < -0.3
    assert (body.colours[left, 0] == 1.0).all() and (body.colours[right, 2] == 1.0).all()


def test_what_was_seen_all_around_needs_no_body() -> None:
    size = np.array([4.4, 1.9, 1.6])
    whole = unseen_body_gaussians(rear(size), size)
    assert len(whole) > 100 and len(unseen_body_gaussians(whole, size)) < 0.1 * len(whole)


def test_the_nearest_box_is_the_nearest_of_all_boxes_one_by_one() -> None:
    rng = np.random.default_rng(0)
    boxes = np.column_stack(
        [rng.uniform(-20, 20, (30, 2)), rng.uniform(0, 2, 30), rng.uniform(-3, 3, 30), rng.uniform(0.5, 6.0, (30, 3))]
    )
    eye = np.array([0.5, -0.2, 1.4])
    turn, local = boxes[:, 3], eye - boxes[:, :3]
    along = np.cos(turn) * local[:, 0] + np.sin(turn) * local[:, 1]
    across = np.cos(turn) * local[:, 1] - np.sin(turn) * local[:, 0]
    inside = (np.abs(np.column_stack([along, across, local[:, 2]])) < boxes[:, 4:] / 2).all(axis=1)
    boxes = boxes[~inside]
    rays = rng.normal(size=(4000, 3)) * rng.uniform(0.2, 3.0, (4000, 1))
    each = np.stack([intersect_box(box, eye, rays)[3] for box in boxes])
    found, which = nearest_box_along_rays(rays, eye, boxes)
    np.testing.assert_allclose(found, each.min(axis=0), rtol=1e-9)
    met = np.isfinite(found)
    assert 500 < met.sum() < 3500
    np.testing.assert_array_equal(which[met], each.argmin(axis=0)[met])
    assert (which[~met] == -1).all()


def test_a_box_around_the_eye_is_not_met() -> None:
    around = np.array([[0.0, 0.0, 1.0, 0.3, 4.0, 2.0, 2.0]])
    found, which = nearest_box_along_rays(np.eye(3), np.array([0.1, 0.0, 1.0]), around)
    assert np.isinf(found).all() and (which == -1).all()


@pytest.mark.parametrize(("height", "n"), [(1.6, 2), (3.2, 1)])
def test_the_boxes_of_a_body_lie_in_the_vehicle_s_own(height: float, n: int) -> None:
    box = np.array([5.0, -2.0, 1.1, 0.7, 4.6, 1.9, height])
    parts = body_boxes(box)
    assert len(parts) == n
    for part in parts:
        np.testing.assert_array_equal(part[[0, 1, 3]], box[[0, 1, 3]])
        assert (part[4:] < box[4:]).all()
        assert box[2] - box[6] / 2 < part[2] - part[6] / 2 and part[2] + part[6] / 2 < box[2] + box[6] / 2


def sighted(
    agents: AgentTracks, label: int = SHALLOW, depth_m: float = 30.0
) -> tuple[PhotoDepth, PhotoDepth, np.ndarray]:
    """A photo of the street whose every pixel is sky at one depth, as found and on bodies; and how far the car is."""
    photo = street.photo(2.0, 0.0, AT_S)
    shape = photo.rgb.shape[:2]
    flat = np.full(shape, depth_m, np.float32)
    seen = PhotoDepth(flat, np.full(shape, label, np.int32), np.ones(shape, bool), np.zeros(shape, bool))
    (found,) = with_body_depths([photo], [seen], Tracks(agents, np.zeros(3)))
    rays = pixel_directions(photo.intrinsics, photo.world_from_camera, *shape[::-1]).reshape(-1, 3)
    away, _ = nearest_box_along_rays(rays, photo.world_from_camera[:3, 3], np.stack(body_boxes(street.car_box(AT_S))))
    return seen, found, away.reshape(shape)


def test_pixels_that_look_at_a_car_which_drives_lie_on_its_body() -> None:
    seen, found, away = sighted(street.tracks())
    on = np.isfinite(away)
    assert on.sum() > 100
    np.testing.assert_allclose(found.depth[on], away[on], rtol=1e-6)
    assert not found.sky[on].any() and (found.label[on] == SHALLOW).all()
    for name in ("depth", "label", "sky"):
        np.testing.assert_array_equal(getattr(found, name)[~on], getattr(seen, name)[~on], err_msg=name)


def test_a_car_that_drives_past_the_camera_lies_on_its_body_as_well() -> None:
    """Its middle is nearer than half its length; the camera looks along its side."""
    past = street.tracks()
    boxes = past.boxes.copy()
    boxes[:, 0, 0] += street.photo(2.0, 0.0, AT_S).world_from_camera[0, 3] + 0.5 - street.car_box(AT_S)[0]
    boxes[:, 0, 1] = 1.7
    seen, found, _ = sighted(replace(past, boxes=boxes))
    on = found.depth != seen.depth
    assert on.sum() > 100 and found.depth[on].max() < 3.0


def test_a_parked_car_keeps_what_photos_found_of_it() -> None:
    moving = street.tracks()
    at = round(10 * AT_S)
    parked = replace(moving, boxes=np.repeat(moving.boxes[at : at + 1], moving.n_steps, axis=0))
    seen, found, _ = sighted(parked)
    np.testing.assert_array_equal(found.depth, seen.depth)


def test_a_parked_car_hides_the_one_that_drives_behind_it() -> None:
    moving = street.tracks()
    before = moving.boxes.copy()
    before[:, 0, 0], before[:, 0, 1] = 8.0, 1.6
    both = AgentTracks(
        ("car", "parked"),
        moving.kinds * 2,
        np.concatenate([moving.boxes, before], axis=1),
        np.zeros((moving.n_steps, 2, 2)),
        np.ones((moving.n_steps, 2), bool),
        np.repeat(moving.center_z, 2, axis=1),
        np.repeat(moving.heights, 2),
    )
    alone, (_, found, _) = sighted(moving)[1], sighted(both)
    hidden = (alone.depth != found.depth) & (alone.depth < 30.0)
    assert hidden.sum() > 50 and (found.depth[hidden] == 30.0).all()


@pytest.mark.parametrize(
    ("label", "depth_m", "stays"), [(STREET, 6.0, True), (STREET, 30.0, False), (SHALLOW, 6.0, False)]
)
def test_what_photos_agree_on_before_a_car_stays_there(label: int, depth_m: float, stays: bool) -> None:
    seen, found, away = sighted(street.tracks(), label, depth_m)
    on = np.isfinite(away)
    assert (found.depth[on] == seen.depth[on]).all() == stays


def test_the_own_body_is_no_other_vehicle(monkeypatch: pytest.MonkeyPatch) -> None:
    photo = street.photo(2.0, 0.0, AT_S)
    own = replace(photo, own_body=np.ones(photo.rgb.shape[:2], bool))
    monkeypatch.setattr(street, "photo", lambda *_: own)
    seen, found, _ = sighted(street.tracks())
    np.testing.assert_array_equal(found.depth, seen.depth)


def test_without_lidar_the_rear_of_a_car_that_drives_is_where_photos_show_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """A sweep finds most of it elsewhere, for photos show it elsewhere: what is seen of it is then made up."""
    photos, _ = street.drive(6)
    settings = FitSettings(start_gaussians=1500, most_gaussians=5000, stereo_photos=1, start_node_gaussians=3000)
    on_rear = []
    for reach in (0.0, body.REACH_M):
        monkeypatch.setattr(body, "REACH_M", reach)
        _, state = prepare_fit(photos, [], street.tracks(), settings)
        seen = (state.owner == 0) & (state.learned["logits"].values[:, 0] == 0.0)  # the body begins more opaque
        x = state.learned["means"].values[seen, 0]
        on_rear.append(int((np.abs(x + body.LOWER[0] * street.CAR[0] / 2) < 0.05).sum()))
    assert on_rear[1] > 2 * on_rear[0] + 20
