"""A bonnet in every photo: kept out of the street, and in front of whatever the camera shows."""

from dataclasses import replace

import numpy as np
import pytest
import street

from tasks.render.fit.start import prepare_fit
from tasks.render.scene.asset import RenderAsset, psnr
from tasks.render.scene.build import build_asset
from tasks.render.scene.sensed import Photo, median_own_bodies, resize_photo
from tasks.render.settings import AssetSettings, FitSettings
from tasks.render.views import render_views
from tasks.world.clip import AgentTracks, Camera

BONNET = np.zeros((street.HEIGHT, street.WIDTH), bool)
BONNET[58:, 24:104] = True
WHITE = np.array([236, 240, 242], np.uint8)
FRONT = Camera("front", street.WIDTH, street.HEIGHT, street.INTRINSICS, np.zeros(5), street.EGO_FROM_CAMERA)
SETTINGS = AssetSettings(hold_out_every=0)
NOBODY = AgentTracks(
    (), (), np.zeros((96, 0, 5)), np.zeros((96, 0, 2)), np.zeros((96, 0), bool), np.zeros((96, 0)), np.zeros(0)
)


def with_bonnet(photo: Photo, told: bool) -> Photo:
    rgb = np.where(BONNET[..., None], WHITE, photo.rgb)
    return replace(photo, rgb=rgb, own_body=BONNET if told else None)


def scene(told: bool) -> RenderAsset:
    photos, sweeps = street.drive(6, with_car=False)
    shown = [with_bonnet(photo, told) for photo in photos]
    return replace(build_asset(shown, sweeps, None, SETTINGS), bodies=median_own_bodies(shown))


@pytest.mark.slow
def test_a_new_place_has_the_street_and_the_bonnet_in_front() -> None:
    truth = street.photo(2.5, 0.6, 0.0, with_car=False).rgb
    pose = street.ego_pose(2.5, 0.6)[None]
    size = street.WIDTH, street.HEIGHT
    told, untold = (next(render_views(scene(t), [FRONT], pose, NOBODY, [0], *size))[0] for t in (True, False))
    assert (told[BONNET] == WHITE).all()
    beside = ~BONNET & (np.arange(street.HEIGHT) >= 44)[:, None]
    assert psnr(told[beside], truth[beside]) > psnr(untold[beside], truth[beside]) + 3.0
    half = next(render_views(scene(True), [FRONT], pose, NOBODY, [0], 64, 36))[0]
    assert np.abs(half[30:, 14:50].astype(int) - WHITE).max() <= 1, "at another size too"


def test_the_fit_neither_paints_nor_measures_it() -> None:
    photos, sweeps = street.drive(4, with_car=False)
    shown = [with_bonnet(photo, told=True) for photo in photos]
    problem, state = prepare_fit(shown, sweeps, None, FitSettings(start_gaussians=4000), held_out=[2])
    for shot in (*problem.train, *problem.held_out):
        assert (~shot.compared.target.counted == BONNET).all()
    assert state.learned["colours"].values.max() < 0.95, "white is the bonnet alone"


def test_a_photo_shrunk_keeps_its_mask() -> None:
    (photo, *_), _ = street.drive(1, with_car=False)
    small = resize_photo(with_bonnet(photo, told=True), 64)
    assert small.own_body is not None and small.own_body.shape == (36, 64)
    assert abs(small.own_body.mean() - BONNET.mean()) < 0.02
