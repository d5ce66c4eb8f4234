"""The gate sees what no reward does: no street, something on the lens, nothing to see, nothing sharp; and lets be."""

from dataclasses import replace

import numpy as np
import pytest
import street
from scipy.ndimage import gaussian_filter

from tasks.render.gate import (
    DETAIL_MIN,
    GateSettings,
    PictureMeasures,
    check_drive_pictures,
    measure_rendered_view,
    measure_rendered_views,
    meets_road,
    picture_fault,
    rows_nearer,
)
from tasks.render.scene.asset import Instant, Reach, RenderAsset
from tasks.render.scene.engine import SCENE_S_OWN, render_instants
from tasks.render.scene.movers import NOBODY
from tasks.render.scene.sky import SkyMap, pixel_directions
from tasks.render.splatting.gaussians import EMPTY, Gaussians, concatenate
from tasks.render.splatting.raster import View
from tasks.stages import PICTURE_FAULTS, STAGES
from tasks.world.clip import Camera, Pinhole

SETTINGS = GateSettings(width=128)
FRONT = Camera("front", street.WIDTH, street.HEIGHT, street.INTRINSICS, np.zeros(5), street.EGO_FROM_CAMERA)
SIZE = (street.WIDTH, street.HEIGHT)


def reason_at(asset: RenderAsset, pose: np.ndarray, step: int = 8) -> str | None:
    found = check_drive_pictures(asset, [FRONT], pose[None], street.tracks(), [step], SIZE, SETTINGS)
    assert found is None or (found.stage == "render" and "front at step" in found.detail)
    return None if found is None else found.reason


def turned(x: float, y: float, degrees: float) -> np.ndarray:
    pose = street.ego_pose(x, y)
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    pose[:2, :2] = [[c, -s], [s, c]]
    return pose


def measured_at(asset: RenderAsset, pose: np.ndarray) -> PictureMeasures:
    eye = Pinhole(FRONT.intrinsics, pose @ FRONT.ego_from_camera, *SIZE)
    instant = Instant([eye], NOBODY, [SCENE_S_OWN], Reach(pose[:3, 3], SETTINGS.reach_m))
    return measure_rendered_views(asset, instant, next(render_instants(asset, [instant])), pose)[0]


def blob(x: float, y: float, z: float, sigma_m: float) -> Gaussians:
    return Gaussians(
        np.array([[x, y, z]], np.float32),
        np.array([[1.0, 0.0, 0.0, 0.0]], np.float32),
        np.full((1, 3), np.log(sigma_m), np.float32),
        np.array([0.95], np.float32),
        np.full((1, 3), 0.5, np.float32),
    )


def test_the_log_s_own_poses_and_near_ones_are_fit(street_asset: RenderAsset) -> None:
    for pose in (street.ego_pose(3.0), street.ego_pose(4.5, 1.5), street.ego_pose(3.0, -2.0), turned(3.0, 0.5, 15.0)):
        assert reason_at(street_asset, pose) is None


def test_a_camera_in_a_wall_is_covered_also_where_the_wall_is_nearer_than_the_picture_begins(
    street_asset: RenderAsset,
) -> None:
    # The lens is 1 m ahead of the axle; the rasteriser draws nothing nearer than 0.3 m.
    for short_of_the_wall in (0.5, 0.15, 0.05):
        pose = turned(16.0, street.WALL_Y - 1.0 - short_of_the_wall, 90.0)
        assert reason_at(street_asset, pose) == "lens_covered"


def test_where_nothing_was_seen_the_road_has_holes(street_asset: RenderAsset) -> None:
    assert reason_at(street_asset, street.ego_pose(4.0, 20.0)) == "holes"  # behind the facade
    assert reason_at(street_asset, turned(-40.0, 0.0, 180.0)) == "holes"  # before the log begins, looking back
    assert measured_at(street_asset, street.ego_pose(4.0, 20.0)).holes > 0.9


def test_a_car_over_the_lens_covers_it(street_asset: RenderAsset) -> None:
    box = street.car_box(0.8)
    assert reason_at(street_asset, street.ego_pose(box[0] - 1.0, box[1])) == "lens_covered"
    assert reason_at(street_asset, street.ego_pose(box[0] - 1.0, box[1]), step=80) is None  # it has driven on


@pytest.mark.parametrize("sigma_m", [0.3, 3.0])
def test_a_gaussian_over_the_lens_covers_it_whatever_its_size(street_asset: RenderAsset, sigma_m: float) -> None:
    at = np.array([4.0 + sigma_m * 1.2, 0.0, 1.5]) - street_asset.origin
    background = concatenate([street_asset.background, blob(*at, sigma_m)])
    covered = replace(street_asset, background=background)
    pose = street.ego_pose(3.0)
    assert reason_at(street_asset, pose) is None and reason_at(covered, pose) == "lens_covered"


def test_an_empty_scene_is_all_holes(street_asset: RenderAsset) -> None:
    empty = replace(street_asset, background=EMPTY, nodes={})
    assert measured_at(empty, street.ego_pose(3.0)).holes == 1.0
    assert reason_at(empty, street.ego_pose(3.0), step=80) == "holes"


def test_one_colour_is_blank(street_asset: RenderAsset) -> None:
    def painted(part: Gaussians) -> Gaussians:
        return replace(part, colours=np.full_like(part.colours, 0.4))

    fog = SkyMap(np.full_like(street_asset.sky.rgb, 0.4))
    plain = replace(street_asset, background=painted(street_asset.background), nodes={}, sky=fog)
    assert reason_at(plain, street.ego_pose(3.0), step=80) == "blank"


def test_a_blurred_picture_is_told_from_a_sharp_one() -> None:
    rgb = street.photo(3.0, 0.0, 0.8).rgb.astype(np.float32) / 255.0
    solid = np.ones(rgb.shape[:2], np.float32)
    road = np.ones(rgb.shape[:2], bool)
    assert picture_fault(measure_rendered_view(View(rgb, solid, solid), road), SETTINGS) is None
    soft = gaussian_filter(rgb, (2.0, 2.0, 0.0))
    found = picture_fault(measure_rendered_view(View(soft, solid, solid), road), SETTINGS)
    assert found is not None and found[0] == "blurred"


def test_a_scene_of_large_gaussians_is_blurred(street_asset: RenderAsset) -> None:
    background = street_asset.background
    wide = np.maximum(background.log_scales, np.float32(np.log(0.8)))
    blurred = replace(street_asset, background=replace(background, log_scales=wide), nodes={})
    found = measured_at(blurred, street.ego_pose(3.0))
    assert found.detail < DETAIL_MIN < measured_at(street_asset, street.ego_pose(3.0)).detail


def test_only_rays_that_come_down_on_the_road_in_reach_are_asked_for() -> None:
    ego = street.ego_pose(3.0)
    ego[:3, :3] = [[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]]
    eye = Pinhole(street.INTRINSICS, ego @ street.EGO_FROM_CAMERA, street.WIDTH, street.HEIGHT)
    rays = pixel_directions(eye.intrinsics, eye.world_from_camera, eye.width, eye.height)
    with np.errstate(divide="ignore"):
        along = (ego[2, 3] - eye.world_from_camera[2, 3]) / rays[..., 2]  # lengths of a ray to the road's plane
    away = along * np.linalg.norm(rays, axis=-1)
    np.testing.assert_array_equal(meets_road(eye, ego), (along > 0.0) & (away < 20.0))


def test_what_comes_near_is_told_by_its_middle_and_how_wide_it_is() -> None:
    rng = np.random.default_rng(8)
    blobs = concatenate([blob(*rng.uniform(-4.0, 4.0, 3), rng.choice([0.05, 0.5, 1.5])) for _ in range(400)])
    sides = np.exp(blobs.log_scales + rng.uniform(-2.0, 0.0, (400, 3)).astype(np.float32))
    blobs, place = replace(blobs, log_scales=np.log(sides)), np.array([0.5, -1.0, 0.25])
    near = np.linalg.norm(blobs.means - place, axis=1) < 1.2 + 2.0 * sides.max(axis=1)
    np.testing.assert_array_equal(rows_nearer(blobs, place, 1.2), np.flatnonzero(near))
    assert 20 < near.sum() < 380


def test_without_cameras_there_is_nothing_to_refuse(street_asset: RenderAsset) -> None:
    poses = np.stack([street.ego_pose(1.0)])
    assert check_drive_pictures(street_asset, [], poses, street.tracks(), [8], SIZE, SETTINGS) is None


def test_the_first_fault_in_time_is_told(street_asset: RenderAsset) -> None:
    poses = np.stack([street.ego_pose(3.0), street.ego_pose(4.0, 20.0), street.ego_pose(4.0, 30.0)])
    found = check_drive_pictures(street_asset, [FRONT], poses, street.tracks(), [8, 80, 85], SIZE, SETTINGS)
    assert found is not None and found.detail.startswith("front at step 80: ")


def test_every_fault_is_a_reason_of_the_render_stage() -> None:
    bad = PictureMeasures(holes=1.0, lens=1.0, contrast=0.0, detail=0.0)
    good = PictureMeasures(holes=0.0, lens=0.0, contrast=0.2, detail=0.2)
    told = {
        fault[0]
        for name in ("holes", "lens", "contrast", "detail")
        if (fault := picture_fault(replace(good, **{name: getattr(bad, name)}), SETTINGS)) is not None
    }
    assert told | {"unlike_photos", "guessed"} == set(PICTURE_FAULTS)
    assert set(PICTURE_FAULTS) <= set(next(stage.reasons for stage in STAGES if stage.name == "render"))


@pytest.mark.parametrize(
    ("name", "value"),
    [("contrast_min", 1.5), ("width", 8), ("reach_m", float("inf")), ("reach_m", -1.0), ("vehicle_min", 1.1)],
)
def test_settings_out_of_range_are_refused(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"render gate {name} must be"):
        GateSettings(**{name: value})
