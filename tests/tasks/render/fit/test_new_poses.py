"""Two cameras of different exposure, fitted: what a simulated drive sees has each camera's own colours."""

from dataclasses import replace

import numpy as np
import pytest
import street
from numpy.typing import NDArray

from tasks.render.fit.corrections import exposed
from tasks.render.fit.reconstruct import advance, finish, picture_of
from tasks.render.fit.settings import FitSettings
from tasks.render.fit.start import Problem, prepare
from tasks.render.fit.state import FitState
from tasks.render.gate import unfit
from tasks.render.scene.asset import RenderAsset, psnr
from tasks.render.scene.sensed import Photo
from tasks.render.settings import GateSettings
from tasks.render.views import render_views
from tasks.world.agents import AgentTracks
from tasks.world.camera import Camera

pytestmark = pytest.mark.slow
GAINS = {"left": (1.25, 1.2, 1.3), "right": (0.75, 0.8, 0.7)}
SIDE_M = {"left": 0.25, "right": -0.25}
SETTINGS = FitSettings(iterations=120, start_gaussians=6000, stereo_photos=1, hold_out_every=0)
NOBODY = AgentTracks(
    (), (), np.zeros((96, 0, 5)), np.zeros((96, 0, 2)), np.zeros((96, 0), bool), np.zeros((96, 0)), np.zeros(0)
)


def taken(camera: str, x: float, y: float, time_s: float) -> Photo:
    """What a camera shows of the street from there: darker than it is, or brighter, with grain."""
    photo = street.photo(x, y + SIDE_M[camera], time_s, with_car=False)
    row = np.concatenate([np.diag(GAINS[camera]).ravel() - np.eye(3).ravel(), np.full(3, -0.03)]).astype(np.float32)
    rgb = exposed(photo.rgb.astype(np.float32) / 255.0, row)
    rgb = rgb + 0.03 * np.random.default_rng(round(100 * x)).standard_normal(rgb.shape)
    return replace(photo, camera=camera, rgb=np.rint(255.0 * np.clip(rgb, 0.0, 1.0)).astype(np.uint8))


@pytest.fixture(scope="module")
def fitted() -> tuple[Problem, FitState, RenderAsset]:
    photos = [taken(camera, 1.0 * k, 0.0, 0.25 * k) for k in range(5) for camera in GAINS]
    sweeps = [street.sweep(0.5 * k, 0.125 * k, with_car=False) for k in range(10)]
    problem, state = prepare(photos, sweeps, None, SETTINGS, held_out=[])
    advance(problem, state, SETTINGS, SETTINGS.iterations)
    return problem, state, finish(problem, state)


def rig() -> list[Camera]:
    cameras = []
    for name, side_m in SIDE_M.items():
        mount = street.EGO_FROM_CAMERA.copy()
        mount[1, 3] += side_m
        cameras.append(Camera(name, street.WIDTH, street.HEIGHT, street.INTRINSICS, np.zeros(5), mount))
    return cameras


def drawn(asset: RenderAsset, poses: NDArray[np.float64]) -> NDArray[np.uint8]:
    steps = list(range(len(poses)))
    return render_views(asset, rig(), poses, NOBODY, steps, street.WIDTH, street.HEIGHT)


def test_pictures_at_logged_poses_are_as_good_as_with_the_photos_own_exposures(
    fitted: tuple[Problem, FitState, RenderAsset],
) -> None:
    problem, state, asset = fitted
    images = drawn(asset, np.stack([street.ego_pose(1.0 * k) for k in range(5)]))
    for c, camera in enumerate(GAINS):
        own, new = [], []
        for shot in (shot for shot in problem.train if shot.photo.camera == camera):
            own.append(psnr(picture_of(problem, state, shot.photo), shot.compared.target.rgb))
            new.append(psnr(images[round(shot.photo.time_s / 0.25), c], shot.photo.rgb))
        assert np.mean(new) > np.mean(own) - 1.0, camera


def test_from_a_metre_aside_each_camera_shows_the_street_in_its_own_colours(
    fitted: tuple[Problem, FitState, RenderAsset],
) -> None:
    images = drawn(fitted[2], street.ego_pose(2.5, 1.0)[None])
    for c, camera in enumerate(GAINS):
        truth = taken(camera, 2.5, 1.0, 0.0).rgb[30:]
        apart = images[0, c][30:].astype(float).mean(axis=(0, 1)) - truth.mean(axis=(0, 1))
        assert np.abs(apart).max() < 6.0, camera
        contrast = images[0, c][30:].std() / truth.std()
        assert 0.9 < contrast < 1.1, camera


def test_the_gate_looks_at_pictures_as_they_are_stored(fitted: tuple[Problem, FitState, RenderAsset]) -> None:
    """A camera that makes hardly anything of the light gives blank pictures, though the scene itself has contrast."""
    asset = fitted[2]

    def dull(camera: str) -> RenderAsset:
        changed = [
            replace(of, affine=(0.02 * of.affine if of.camera == camera else of.affine)) for of in asset.exposures
        ]
        return replace(asset, exposures=tuple(changed))

    def found(scene: RenderAsset) -> str | None:
        poses = street.ego_pose(2.0)[None]
        size = street.WIDTH, street.HEIGHT
        fault = unfit(scene, rig(), poses, NOBODY, [0], size, GateSettings(width=128, vehicle_min=0.0))
        return None if fault is None else f"{fault.reason}: {fault.detail}"

    assert found(asset) is None
    for camera in GAINS:
        said = found(dull(camera))
        assert said is not None and said.startswith(f"blank: {camera} at step 0")
