"""A scene built from photos and sweeps, against the closed-form street it was built from."""

import numpy as np
import pytest
import street

from factory.stages.entries import enter_render
from tasks.render.scene import depth, movers, stereo, surfels
from tasks.render.scene.asset import RenderAsset, psnr
from tasks.render.scene.build import AssetSettings, build_asset
from tasks.render.scene.engine import render
from tasks.render.scene.movers import NOBODY, PlacedAgents
from tasks.render.scene.sensed import Photo
from tasks.render.splatting import project, raster
from tasks.world.clip import AgentKind, Pinhole


def car_at(box: np.ndarray, name: str = "car") -> PlacedAgents:
    return PlacedAgents((name,), (AgentKind.VEHICLE,), box[None])


def picture(asset: RenderAsset, pose: np.ndarray, vehicles: PlacedAgents) -> np.ndarray:
    camera = Pinhole(street.INTRINSICS, pose, street.WIDTH, street.HEIGHT)
    return np.rint(render(asset, [camera], vehicles)[0].rgb * 255).astype(np.uint8)


def rendered(asset: RenderAsset, truth: Photo, with_car: bool = True) -> np.ndarray:
    return picture(asset, truth.world_from_camera, car_at(street.car_box(truth.time_s)) if with_car else NOBODY)


@pytest.mark.parametrize(("y", "least_db"), [(0.0, 26.0), (1.0, 24.0), (-1.5, 23.0)])
def test_a_view_nobody_had_looks_like_the_street(street_asset: RenderAsset, y: float, least_db: float) -> None:
    truth = street.photo(4.5, y, 1.125)
    assert psnr(rendered(street_asset, truth), truth.rgb) > least_db


def red(image: np.ndarray) -> np.ndarray:
    rgb = image.astype(np.int64)
    return (rgb[..., 0] > 130) & (rgb[..., 1] < 80) & (rgb[..., 2] < 90)


def test_the_car_is_drawn_where_it_is_now_and_nowhere_else(street_asset: RenderAsset) -> None:
    truth = street.photo(2.0, 0.0, 0.9)
    drawn, wanted = red(rendered(street_asset, truth)), red(truth.rgb)
    assert (drawn & wanted).sum() > 0.8 * wanted.sum()
    assert (drawn & ~wanted).sum() < 0.15 * wanted.sum()


def test_without_its_box_the_car_leaves_no_trail(street_asset: RenderAsset) -> None:
    truth = street.photo(4.5, 0.0, 1.125, with_car=False)
    drawn = rendered(street_asset, truth, with_car=False)
    assert red(drawn).mean() < 0.005
    assert psnr(drawn, truth.rgb) > 26.0


def test_a_track_nobody_photographed_is_a_visible_box(street_asset: RenderAsset) -> None:
    box = np.array([14.0, -2.0, 0.8, 0.0, *street.CAR])
    view = street.photo(4.5, 0.0, 1.125, with_car=False)
    empty = rendered(street_asset, view, with_car=False).astype(np.int64)
    drawn = picture(street_asset, view.world_from_camera, car_at(box, "stranger"))
    changed = (np.abs(drawn - empty).max(axis=-1) > 20).mean()
    assert changed > 0.01


def test_held_out_photos_do_not_enter_the_scene() -> None:
    photos, sweeps = street.drive(6, with_car=False)
    settings = AssetSettings(hold_out_every=6)
    honest = build_asset(photos, sweeps, None, settings)
    spoiled = [*photos[:3], Photo("front", 0.75, 255 - photos[3].rgb, street.INTRINSICS, photos[3].world_from_camera)]
    other = build_asset([*spoiled, *photos[4:]], sweeps, None, settings)
    assert honest.n_held_out == 1
    assert honest.background.colours.tobytes() == other.background.colours.tobytes()
    assert honest.psnr_db > 22.0 > other.psnr_db


def test_the_same_input_gives_the_same_scene_and_the_world_may_lie_anywhere(street_asset: RenderAsset) -> None:
    photos, sweeps = street.drive(4, with_car=False)
    settings = AssetSettings(hold_out_every=0)
    here = build_asset(photos, sweeps, None, settings)
    again = build_asset(photos, sweeps, None, settings)
    assert here.background.means.tobytes() == again.background.means.tobytes()
    assert here.background.colours.tobytes() == again.background.colours.tobytes()
    far = np.array([600_000.0, 4_000_000.0, 30.0])  # a UTM frame: float32 has steps of 0.25 m there

    def moved(pose: np.ndarray) -> np.ndarray:
        out = pose.copy()
        out[:3, 3] += far
        return out

    there = build_asset(
        [Photo(p.camera, p.time_s, p.rgb, p.intrinsics, moved(p.world_from_camera)) for p in photos],
        [type(s)(s.time_s, s.points, moved(s.world_from_ego)) for s in sweeps],
        None,
        settings,
    )
    truth = street.photo(1.5, 0.5, 0.4, with_car=False)
    image = picture(there, moved(truth.world_from_camera), NOBODY)
    assert psnr(image, rendered(here, truth, with_car=False)) > 35.0


def test_psnr_in_closed_form() -> None:
    a = np.zeros((4, 4, 3), np.uint8)
    assert psnr(a, a + 10) == pytest.approx(20 * np.log10(255 / 10))
    assert psnr(a, a) == float("inf")
    assert psnr(np.zeros(8, np.float32), np.full(8, 0.1, np.float32)) == pytest.approx(20.0, abs=1e-5)


def test_no_photos_no_scene() -> None:
    with pytest.raises(ValueError, match="no photos"):
        build_asset([], [], None, AssetSettings())


def test_the_smallest_scene_reaches_every_kernel_of_the_room() -> None:
    enter_render()
    modules = (depth, movers, project, raster, stereo, surfels)
    kernels = [value for module in modules for value in vars(module).values() if hasattr(value, "signatures")]
    assert len(kernels) > 10
    parts = {"_nearer", "aligned_memory"}  # of their callers, like all that is inlined; no entry points
    parts |= {
        "_anchor",
        "_semi_global_matching",
        "_confirm",
        "_stand_on",
    }  # which fits alone call: factory.stages.entries has theirs
    entries = [kernel for kernel in kernels if not kernel.targetoptions.get("forceinline")]
    assert {kernel.__name__ for kernel in entries if not kernel.signatures} <= parts
