"""Vehicles near the camera are held against the photo from nearest to here: torn ones are refused, whole ones pass."""

from dataclasses import replace

import numpy as np
import pytest
import street
from numpy.typing import NDArray

from tasks.render.gate import (
    FADING,
    LEAST_HELD_OUT,
    OTHERS_WAY,
    GateSettings,
    Sightings,
    VehiclePhotos,
    box_mask,
    check_drive_pictures,
    estimate_fading,
    expected_likeness,
    find_sightings,
    large_vehicles,
    likeness_to_photo,
    ssim_map,
    to_box_frame,
)
from tasks.render.scene.asset import Exposure, RenderAsset
from tasks.render.scene.engine import render
from tasks.render.scene.movers import BEYOND_M, PlacedAgents, agents_at_time
from tasks.render.splatting.gaussians import Gaussians
from tasks.render.splatting.raster import View
from tasks.stages import Rejected
from tasks.world.clip import AgentKind, Camera, Pinhole, SensorFile

FRONT = Camera("front", street.WIDTH, street.HEIGHT, street.INTRINSICS, np.zeros(5), street.EGO_FROM_CAMERA)
SIZE = (street.WIDTH, street.HEIGHT)
SETTINGS = GateSettings(width=street.WIDTH, vehicle_share=0.03)
FILES = [SensorFile("front", "", 0.25 * k, street.ego_pose(1.0 * k)) for k in range(10)]
CAR_AT_STEP_4 = street.car_box(0.4)
BEHIND_IT = street.ego_pose(CAR_AT_STEP_4[0] - 9.0, 0.5)  # 5.8 m from the lens to its back


def album_of(asset: RenderAsset) -> VehiclePhotos:
    def likeness(track_id: str, row: int) -> float:
        shown = street.photo(1.0 * row, 0.0, 0.25 * row)
        return likeness_to_photo(asset, shown, street.tracks(), [track_id])[track_id]

    return VehiclePhotos(find_sightings(FILES, [FRONT], street.tracks()), likeness)


def fault_at(
    asset: RenderAsset, pose: NDArray[np.float64], step: int = 4, settings: GateSettings = SETTINGS
) -> Rejected | None:
    return check_drive_pictures(
        asset, [FRONT], pose[None], street.tracks(), [step], SIZE, settings, album=album_of(asset), stored=[step]
    )


def with_car(asset: RenderAsset, car: Gaussians) -> RenderAsset:
    return replace(asset, nodes={"car": car})


def see_through(asset: RenderAsset, opacity: float) -> RenderAsset:
    car = asset.nodes["car"]
    return with_car(asset, replace(car, opacities=car.opacities * np.float32(opacity)))


def torn(asset: RenderAsset) -> RenderAsset:
    """Its car as few long streaks off their places, as a fit leaves one that passed in a few photos."""
    car, rng = asset.nodes["car"], np.random.default_rng(0)
    some = car.take(np.arange(0, len(car), 6))
    longer = some.log_scales + np.log([[9.0, 1.0, 1.0]]).astype(np.float32)
    off = rng.normal(0.0, 0.25, some.means.shape).astype(np.float32)
    return with_car(asset, replace(some, means=some.means + off, log_scales=longer))


def test_a_car_as_the_photos_show_it_passes(street_asset: RenderAsset) -> None:
    assert fault_at(street_asset, BEHIND_IT) is None


@pytest.mark.parametrize("opacity", [0.05, 0.15])
def test_the_same_car_translucent_is_refused(street_asset: RenderAsset, opacity: float) -> None:
    found = fault_at(see_through(street_asset, opacity), BEHIND_IT)
    assert found is not None and found.reason == "unlike_photos" and "track car on" in found.detail


def test_a_car_torn_to_streaks_is_refused_also_where_a_photo_was_taken(street_asset: RenderAsset) -> None:
    for pose, step in ((BEHIND_IT, 4), (street.ego_pose(1.0), 2)):
        found = fault_at(torn(street_asset), pose, step)
        assert found is not None and found.reason == "unlike_photos"


def test_a_torn_car_that_is_small_is_let_be(street_asset: RenderAsset) -> None:
    poor, far = torn(street_asset), street.ego_pose(street.car_box(2.0)[0] - 23.0, 0.5)
    assert fault_at(poor, far, step=20) is None
    found = fault_at(poor, far, step=20, settings=replace(SETTINGS, vehicle_share=0.002))
    assert found is not None and found.reason == "unlike_photos"


def test_what_stands_behind_an_opaque_car_does_not_matter(street_asset: RenderAsset) -> None:
    photo, agents = street.photo(2.0, 0.0, 0.5), street.tracks()
    here = likeness_to_photo(street_asset, photo, agents, ["car"])["car"]
    moved = street_asset.background.means + np.array([[1.4, 0.0, 0.0]], np.float32)
    elsewhere = replace(street_asset, background=replace(street_asset.background, means=moved))
    assert likeness_to_photo(elsewhere, photo, agents, ["car"])["car"] == pytest.approx(here, abs=0.1)
    assert fault_at(elsewhere, BEHIND_IT, settings=replace(SETTINGS, vehicle_min=0.7)) is None


def test_no_vehicle_is_looked_at_without_an_album_or_where_no_picture_is_stored_or_at_zero(
    street_asset: RenderAsset,
) -> None:
    poor = torn(street_asset)
    args = ([FRONT], BEHIND_IT[None], street.tracks(), [4], SIZE)
    assert check_drive_pictures(poor, *args, SETTINGS, stored=[4]) is None
    assert check_drive_pictures(poor, *args, SETTINGS, album=album_of(poor), stored=[3, 5]) is None
    assert fault_at(poor, BEHIND_IT, settings=replace(SETTINGS, vehicle_min=0.0)) is None


def test_a_track_that_no_photo_shows_is_like_nothing(street_asset: RenderAsset) -> None:
    unseen = VehiclePhotos({}, lambda _track, _row: 1.0)
    found = check_drive_pictures(
        street_asset, [FRONT], BEHIND_IT[None], street.tracks(), [4], SIZE, SETTINGS, album=unseen, stored=[4]
    )
    assert found is not None and found.detail.endswith("expected likeness 0.00")


def test_likeness_fades_with_the_way_from_the_nearest_photo() -> None:
    seen = Sightings(np.array([7, 3]), np.array([[-10.0, 0.0, 0.0], [0.0, 5.0, 0.0]]))
    album = VehiclePhotos({"car": seen}, lambda _track, row: {7: 0.9, 3: 0.5}[row])
    assert expected_likeness(album, "car", np.array([-10.0, 0.0, 0.0])) == pytest.approx(0.9)
    assert expected_likeness(album, "car", np.array([-8.0, 0.0, 0.0])) == pytest.approx(
        0.9 * np.exp(-FADING * 2.0 / 8.0)
    )
    assert expected_likeness(album, "car", np.array([0.0, 4.0, 0.0])) == pytest.approx(
        0.5 * np.exp(-FADING * 1.0 / 4.0)
    )


def looks(n: int, of: str) -> dict[str, Sightings]:
    """n tracks that two photos show, 10 m away and, held out (rows from 100 on), 8 m: a quarter of the way there."""
    eyes = np.array([[-10.0, 0.0, 0.0], [-8.0, 0.0, 0.0]])
    return {f"{of}{k}": Sightings(np.array([0, 100 + k]), eyes) for k in range(n)}


def test_fading_is_what_photos_held_out_lose_by_the_way_to_the_nearest_other() -> None:
    poor, fine = looks(LEAST_HELD_OUT, "poor"), looks(LEAST_HELD_OUT, "fine")
    alike = {"poor": 0.9 * np.exp(-1.5 * 0.25), "fine": 0.9}

    def likeness(track_id: str, row: int) -> float:
        return 0.9 if row < 100 else float(alike[track_id[:4]])

    held_out = range(100, 200)
    found = estimate_fading(poor, likeness, held_out)
    assert found == pytest.approx(dict.fromkeys(poor, 1.5))
    # Half of them lose nothing: each is between itself and what all lose, 0.75, which weighs as much as OTHERS_WAY.
    both = estimate_fading(
        {**poor, **fine, "unseen": Sightings(np.array([0]), np.array([[-9.0, 0.0, 0.0]]))}, likeness, held_out
    )
    assert both["poor0"] == pytest.approx((1.5 * 0.25 + 0.75 * OTHERS_WAY) / (0.25 + OTHERS_WAY))
    assert both["fine3"] == pytest.approx(0.75 * OTHERS_WAY / (0.25 + OTHERS_WAY))
    assert both["unseen"] == pytest.approx(0.75)
    assert estimate_fading(fine, likeness, held_out) == pytest.approx(dict.fromkeys(fine, FADING))


def test_too_few_or_too_near_looks_say_nothing_of_fading() -> None:
    few = looks(LEAST_HELD_OUT - 1, "poor")
    assert estimate_fading(few, lambda _track, row: 0.9 if row < 100 else 0.1, range(100, 200)) == {}
    near = {name: replace(mine, eyes=mine.eyes * [[1.0], [1.2]]) for name, mine in looks(40, "poor").items()}
    assert estimate_fading(near, lambda _track, row: 0.9 if row < 100 else 0.1, range(100, 200)) == {}
    assert estimate_fading(looks(40, "poor"), lambda _track, row: 0.9 if row < 100 else 0.1, ()) == {}


def test_a_vehicle_is_expected_to_fade_as_its_album_says() -> None:
    seen = Sightings(np.array([7]), np.array([[-10.0, 0.0, 0.0]]))
    album = VehiclePhotos({"car": seen}, lambda _track, _row: 0.9, lambda: {"car": 1.1})
    assert expected_likeness(album, "car", np.array([-8.0, 0.0, 0.0])) == pytest.approx(0.9 * np.exp(-1.1 * 2.0 / 8.0))


def test_an_eye_in_box_coordinates_stays_where_both_move_and_turn() -> None:
    box = np.array([3.0, 1.0, 0.8, 0.4, 4.4, 1.9, 1.6])
    eye = np.array([-5.0, 2.0, 1.5])
    c, s = np.cos(1.1), np.sin(1.1)
    turn, shift = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), np.array([50.0, -7.0, 2.0])
    there = np.concatenate([turn @ box[:3] + shift, [box[3] + 1.1], box[4:]])
    np.testing.assert_allclose(to_box_frame(turn @ eye + shift, there), to_box_frame(eye, box), atol=1e-12)
    ahead = box[:3] + 7.0 * np.array([np.cos(0.4), np.sin(0.4), 0.0])
    np.testing.assert_allclose(to_box_frame(ahead, box), [7.0, 0.0, 0.0], atol=1e-12)


def test_photos_that_show_the_car_are_found_with_where_they_were_taken_from() -> None:
    found = find_sightings(FILES, [FRONT], street.tracks())["car"]
    assert found.photos.tolist() == list(range(10))  # it drives ahead of the camera all the time
    lens = street.ego_pose(3.0) @ street.EGO_FROM_CAMERA
    np.testing.assert_allclose(found.eyes[3], lens[:3, 3] - street.car_box(0.75)[:3], atol=1e-9)
    turned = replace(FRONT, ego_from_camera=np.diag([-1.0, -1.0, 1.0, 1.0]) @ street.EGO_FROM_CAMERA)
    assert find_sightings(FILES, [turned], street.tracks()) == {}  # looks back
    assert find_sightings(FILES, [replace(FRONT, name="rear")], street.tracks()) == {}  # took none of them


def ahead(*distances_m: float) -> tuple[PlacedAgents, Pinhole]:
    """Cars of 2 x 2 m straight ahead at these distances from the lens to their backs, and a camera at the origin."""
    boxes = np.array([[d + 2.0, 0.0, 0.0, 0.0, 4.0, 2.0, 2.0] for d in distances_m])
    pose = street.EGO_FROM_CAMERA.copy()
    pose[:3, 3] = 0.0
    names = tuple(f"car-{k}" for k in range(len(boxes)))
    return PlacedAgents(names, (AgentKind.VEHICLE,) * len(boxes), boxes), Pinhole(street.INTRINSICS, pose, *SIZE)


def empty_view() -> View:
    nothing = np.zeros((street.HEIGHT, street.WIDTH), np.float32)
    return View(np.zeros((street.HEIGHT, street.WIDTH, 3), np.float32), nothing, nothing)


def test_a_vehicle_s_share_is_that_of_its_outline() -> None:
    there, eye = ahead(8.0)
    ((j, share),) = large_vehicles(there, eye, empty_view(), 0.01)
    side = 100.0 * (2.0 + 2.0 * BEYOND_M) / (8.0 - BEYOND_M)  # px, of its back
    assert j == 0 and share == pytest.approx(side**2 / (street.WIDTH * street.HEIGHT), rel=0.06)
    assert box_mask(there.boxes[0], eye).mean() == pytest.approx(share)
    assert list(large_vehicles(there, eye, empty_view(), 2.0 * share)) == []


def test_a_vehicle_behind_another_or_behind_a_wall_is_not_looked_at() -> None:
    there, eye = ahead(14.0, 5.0)
    assert [j for j, _ in large_vehicles(there, eye, empty_view(), 0.01)] == [1]  # the farther one is hidden
    wall = replace(empty_view(), depth=np.full((72, 128), 3.0, np.float32), alpha=np.ones((72, 128), np.float32))
    assert list(large_vehicles(there, eye, wall, 0.01)) == []
    behind, _ = ahead(-12.0)
    assert list(large_vehicles(behind, eye, empty_view(), 0.0)) == []
    walker = replace(there, kinds=(AgentKind.PEDESTRIAN,) * 2)
    assert list(large_vehicles(walker, eye, empty_view(), 0.01)) == []
    assert list(large_vehicles(PlacedAgents((), (), np.zeros((0, 7))), eye, empty_view(), 0.01)) == []


def test_a_vehicle_beside_the_camera_counts_though_part_of_it_lies_behind() -> None:
    there, eye = ahead(-1.0)
    boxes = there.boxes + np.array([[0.0, 2.0, 0.0, 0.0, 0.0, 0.0, 0.0]])
    ((_, share),) = large_vehicles(replace(there, boxes=boxes), eye, empty_view(), 0.03)
    assert share == pytest.approx(float(box_mask(boxes[0], eye).mean())) and share > 0.03


def test_similarity_is_one_for_the_same_and_forgives_blur_more_than_streaks() -> None:
    truth = street.photo(3.0, 0.0, 0.8).rgb.astype(np.float32) / np.float32(255.0)
    np.testing.assert_allclose(ssim_map(truth, truth), 1.0, atol=1e-5)
    blurred = (truth + np.roll(truth, 1, 0) + np.roll(truth, 1, 1) + np.roll(truth, 1, (0, 1))) / np.float32(4.0)
    streaks = truth.copy()
    streaks[:, ::4] = np.roll(truth, 31, 1)[:, ::4]
    assert ssim_map(streaks, truth).mean() < ssim_map(blurred, truth).mean() - 0.1
    assert ssim_map(truth, np.flip(truth, 0)).mean() < 0.5


def test_a_photo_of_another_exposure_is_told_by_what_was_learned_of_it(street_asset: RenderAsset) -> None:
    photo, agents = street.photo(2.0, 0.0, 0.5), street.tracks()
    as_it_is = likeness_to_photo(street_asset, photo, agents, ["car"])["car"]
    dark = replace(photo, rgb=np.rint(photo.rgb * 0.4).astype(np.uint8))
    affine = np.column_stack([0.4 * np.eye(3), np.zeros(3)]).astype(np.float32)
    aligned = replace(street_asset, exposures=(Exposure("front", 0.5, affine), Exposure("front", 1.0, 3.0 * affine)))
    told = likeness_to_photo(aligned, dark, agents, ["car"])["car"]
    assert told == pytest.approx(as_it_is, abs=0.1)
    assert likeness_to_photo(street_asset, dark, agents, ["car"])["car"] < told - 0.1


def test_a_vehicle_outside_the_photo_has_no_likeness(street_asset: RenderAsset) -> None:
    there = agents_at_time(street.tracks(), 0.5)
    away = replace(street.photo(2.0, 0.0, 0.5), world_from_camera=street.ego_pose(60.0) @ street.EGO_FROM_CAMERA)
    assert likeness_to_photo(street_asset, away, street.tracks(), there.track_ids) == {"car": 0.0}
    eye = Pinhole(FRONT.intrinsics, away.world_from_camera, *SIZE)
    assert not box_mask(there.boxes[0], eye).any() and render(street_asset, [eye], there)
