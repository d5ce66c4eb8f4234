"""Two cameras of different exposure, fitted: what a simulated drive sees has each camera's own colours."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import street
from numpy.typing import NDArray

from factory.stages.scene_file import read_scene, write_scene
from tasks.render.fit.corrections import apply_exposure, mean_exposure
from tasks.render.fit.reconstruct import finish_scene, run_iterations
from tasks.render.fit.start import FitProblem, prepare_fit
from tasks.render.fit.state import FitState
from tasks.render.gate import check_drive_pictures
from tasks.render.scene.asset import RenderAsset
from tasks.render.scene.sensed import Photo
from tasks.render.settings import FitSettings, GateSettings, RenderSettings
from tasks.render.views import render_views
from tasks.world.arrays import Bools
from tasks.world.clip import AgentTracks, Camera

pytestmark = pytest.mark.slow
GAINS = {"left": (1.25, 1.2, 1.3), "right": (0.75, 0.8, 0.7)}
SIDE_M = {"left": 0.25, "right": -0.25}
SETTINGS = FitSettings(iterations=120, start_gaussians=6000, stereo_photos=1, hold_out_every=0)
ASIDE = {"left": 25.0, "right": -25.0}  # degrees that each looks to its side, before a white sky
NOBODY = AgentTracks(
    (), (), np.zeros((96, 0, 5)), np.zeros((96, 0, 2)), np.zeros((96, 0), bool), np.zeros((96, 0)), np.zeros(0)
)


def taken(camera: str, x: float, y: float, time_s: float) -> Photo:
    """What a camera shows of the street from there: darker than it is, or brighter, with grain."""
    photo = street.photo(x, y + SIDE_M[camera], time_s, with_car=False)
    row = np.concatenate([np.diag(GAINS[camera]).ravel() - np.eye(3).ravel(), np.full(3, -0.03)]).astype(np.float32)
    rgb = apply_exposure(photo.rgb.astype(np.float32) / 255.0, row)
    rgb = rgb + 0.03 * np.random.default_rng(round(100 * x)).standard_normal(rgb.shape)
    return replace(photo, camera=camera, rgb=np.rint(255.0 * np.clip(rgb, 0.0, 1.0)).astype(np.uint8))


@pytest.fixture(scope="module")
def fitted() -> tuple[FitProblem, FitState, RenderAsset]:
    photos = [taken(camera, 1.0 * k, 0.0, 0.25 * k) for k in range(5) for camera in GAINS]
    sweeps = [street.sweep(0.5 * k, 0.125 * k, with_car=False) for k in range(10)]
    problem, state = prepare_fit(photos, sweeps, None, SETTINGS, held_out=[])
    run_iterations(problem, state, SETTINGS, SETTINGS.iterations)
    return problem, state, finish_scene(problem, state)


@dataclass(frozen=True)
class WhiteSky:
    """A fit of two cameras whose photos are white wherever they show sky, and the scene as a worker reads it."""

    problem: FitProblem
    state: FitState
    finished: RenderAsset
    stored: RenderAsset
    skies: dict[str, Bools]  # (H, W) what of a camera's photos shows sky that the other camera's do not


@pytest.fixture(scope="module")
def white_sky(tmp_path_factory: pytest.TempPathFactory) -> WhiteSky:
    u, v = np.meshgrid(np.arange(street.WIDTH) + 0.5, np.arange(street.HEIGHT) + 0.5)
    through = np.stack([(u - 64.0) / 100.0, (v - 36.0) / 100.0, np.ones_like(u)], -1).reshape(-1, 3)
    photos, skies = [], {}
    with pytest.MonkeyPatch.context() as low_walls:
        low_walls.setattr(street, "WALL_TOP", 3.0)
        for k in range(4):
            for camera, gain in (("left", 1.25), ("right", 0.75)):
                pose = street.ego_pose(1.0 * k) @ turned(camera)
                distance, _, colour = street.hit(pose[:3, 3], through @ pose[:3, :3].T, None)
                shown = gain * np.where(np.isinf(distance)[:, None], 2.0, colour)
                rgb = np.rint(255.0 * np.clip(shown, 0.0, 1.0)).astype(np.uint8).reshape(*u.shape, 3)
                photos.append(Photo(camera, 0.5 * k, rgb, street.INTRINSICS, pose))
                alone = u < 64 if camera == "left" else u > 64
                skies[camera] = np.isinf(distance).reshape(u.shape) & alone
        sweeps = [street.sweep(0.5 * k, 0.25 * k, with_car=False) for k in range(8)]
        settings = replace(SETTINGS, iterations=60, start_gaussians=3000)
        problem, state = prepare_fit(photos, sweeps, None, settings, held_out=[])
        run_iterations(problem, state, settings, settings.iterations)
    finished, path = finish_scene(problem, state), tmp_path_factory.mktemp("white") / "block-0.safetensors"
    write_scene(path, finished, RenderSettings().scene_dtype)
    return WhiteSky(problem, state, finished, read_scene(path), skies)


def turned(camera: str) -> NDArray[np.float64]:
    """(4, 4) a camera of the ego that looks to its side."""
    angle, mount = np.radians(ASIDE[camera]), np.eye(4)
    mount[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    return mount @ street.EGO_FROM_CAMERA


def rig() -> list[Camera]:
    cameras = []
    for name, side_m in SIDE_M.items():
        mount = street.EGO_FROM_CAMERA.copy()
        mount[1, 3] += side_m
        cameras.append(Camera(name, street.WIDTH, street.HEIGHT, street.INTRINSICS, np.zeros(5), mount))
    return cameras


def drawn(asset: RenderAsset, poses: NDArray[np.float64]) -> NDArray[np.uint8]:
    steps = list(range(len(poses)))
    return np.stack([*render_views(asset, rig(), poses, NOBODY, steps, street.WIDTH, street.HEIGHT)])


def test_from_a_metre_aside_each_camera_shows_the_street_in_its_own_colours(
    fitted: tuple[FitProblem, FitState, RenderAsset],
) -> None:
    images = drawn(fitted[2], street.ego_pose(2.5, 1.0)[None])
    for c, camera in enumerate(GAINS):
        truth = taken(camera, 2.5, 1.0, 0.0).rgb[30:]
        apart = images[0, c][30:].astype(float).mean(axis=(0, 1)) - truth.mean(axis=(0, 1))
        assert np.abs(apart).max() < 6.0, camera
        contrast = images[0, c][30:].std() / truth.std()
        assert 0.9 < contrast < 1.1, camera


def test_the_gate_looks_at_pictures_as_they_are_stored(fitted: tuple[FitProblem, FitState, RenderAsset]) -> None:
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
        fault = check_drive_pictures(scene, rig(), poses, NOBODY, [0], size, GateSettings(width=128, vehicle_min=0.0))
        return None if fault is None else f"{fault.reason}: {fault.detail}"

    assert found(asset) is None
    for camera in GAINS:
        said = found(dull(camera))
        assert said is not None and said.startswith(f"blank: {camera} at step 0")


def test_a_sky_brighter_than_white_is_kept_as_it_was_learned(white_sky: WhiteSky) -> None:
    """In the colours of photos on average, and rounded to 16 bits; only below black nothing is kept."""
    rows, cameras = white_sky.state.learned["exposure"].values, [s.photo.camera for s in white_sky.problem.train]
    learned = apply_exposure(white_sky.state.learned["sky"].values, mean_exposure(cameras, rows)).reshape(-1, 3)
    assert learned.max() > 1.2, "the dark camera's white is brighter than white"
    for asset, error in ((white_sky.finished, 0.0), (white_sky.stored, 2.0**-10)):
        np.testing.assert_allclose(asset.sky.rgb.reshape(-1, 3), np.maximum(learned, 0.0), rtol=error, atol=error)


def test_both_cameras_draw_a_white_sky_white(white_sky: WhiteSky) -> None:
    cameras = [replace(camera, ego_from_camera=turned(camera.name)) for camera in rig()]
    poses = np.stack([street.ego_pose(1.0 * k) for k in range(4)])
    steps = [5 * k for k in range(4)]
    images = np.stack([*render_views(white_sky.stored, cameras, poses, NOBODY, steps, street.WIDTH, street.HEIGHT)])
    for c, camera in enumerate(cameras):
        of_sky = images[:, c][:, white_sky.skies[camera.name]]
        assert of_sky.shape[1] > 1000
        assert np.quantile(of_sky, 0.1) >= 250, camera.name  # the rest is at the walls' edges
