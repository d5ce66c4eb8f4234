"""Compiles every kernel of the render package, on the smallest scene that reaches all of them."""

import numpy as np

from tasks.render.fit.reconstruct import advance, finish
from tasks.render.fit.start import prepare
from tasks.render.rig.adjust import N_CAMERA, Bundle, Matched, adjusted, given_rig
from tasks.render.scene.build import AssetSettings, RenderAsset, build_asset
from tasks.render.scene.depth import confirmed
from tasks.render.scene.sensed import Photo, Sweep
from tasks.render.scene.stereo import partners, wide_depth
from tasks.render.settings import FitSettings
from tasks.render.splatting.sh import turned
from tasks.world.clip import AgentKind, AgentTracks, Camera, SensorFile

FRONT = np.array([[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 1.5], [0.0, 0.0, 0.0, 1.0]])
POINTS = ((8.0, 1.0, 1.0), (9.0, -1.0, 2.0))  # that the rig is adjusted to


def compile_kernels() -> RenderAsset:
    """Builds and measures a scene of two 32 x 32 photos, some ground and one box that drives."""
    turned(np.zeros((1, 3, 3), np.float32), np.diag([1.0, -1.0, 1.0]))
    return build_asset(*_seen(), AssetSettings(hold_out_every=3))


def compile_fit_kernels() -> RenderAsset:
    """Fits such a scene, each step of the fit at least once."""
    settings = FitSettings(
        iterations=4, start_gaussians=200, most_gaussians=300, refine_every=2, refine_from=2, pose_from=0
    )
    problem, state = prepare(*_seen(), settings, held_out=[1])
    advance(problem, state, settings, settings.iterations)
    return finish(problem, state)


def compile_rig_kernels() -> Bundle:
    """Adjusts a rig of one camera at three places to two points that it sees, and looks for a photo's depth in others.

    What else a block without lidar enters, the other two compile.
    """
    photos, _, _ = _seen()
    photo, k = photos[1], photos[1].intrinsics
    rgb, nowhere, everywhere = (
        np.zeros((32, 32, 3), np.float32),
        np.zeros((32, 32), np.float32),
        np.ones((32, 32), bool),
    )
    wide_depth(rgb, nowhere, nowhere, partners(photo, photos, 2), k, photo.world_from_camera, everywhere)
    confirmed(photos, [nowhere] * len(photos))
    files = [SensorFile(p.camera, "", p.time_s, p.world_from_camera @ np.linalg.inv(FRONT)) for p in photos]
    rig, shots = given_rig([Camera(photo.camera, 32, 32, k, np.zeros(5), FRONT)], files)
    at = [[16.0 - 20.0 * y / (x - k), 16.0 + 20.0 * (1.5 - z) / (x - k)] for x, y, z in POINTS for k in range(3)]
    matched = Matched(np.array([0, 3, 6]), np.tile(np.arange(3), 2), np.array(at), np.ones(6))
    return adjusted(rig, shots, matched, np.ones(6 * len(files) + N_CAMERA))


def _seen() -> tuple[list[Photo], list[Sweep], AgentTracks]:
    x, y = np.meshgrid(np.linspace(2.0, 20.0, 40), np.linspace(-6.0, 6.0, 40))
    ground = np.stack([x, y, 0.0 * x], axis=-1).reshape(-1, 3).astype(np.float32)
    intrinsics = np.array([[20.0, 0.0, 16.0], [0.0, 20.0, 16.0], [0.0, 0.0, 1.0]])
    photos, sweeps = [], []
    for k in range(3):
        world_from_ego = np.eye(4)
        world_from_ego[0, 3] = k
        rgb = np.full((32, 32, 3), 90, np.uint8)
        photos.append(Photo("front", 0.1 * k, rgb, intrinsics, world_from_ego @ FRONT))
        sweeps.append(Sweep(0.1 * k, ground, world_from_ego))
    boxes = np.array([[[8.0 + 2.0 * k, 0.0, 0.0, 4.0, 2.0]] for k in range(3)])
    there, heights = np.ones((3, 1), bool), (np.full((3, 1), 0.8), np.array([1.6]))
    return photos, sweeps, AgentTracks(("a",), (AgentKind.VEHICLE,), boxes, np.zeros((3, 1, 2)), there, *heights)
