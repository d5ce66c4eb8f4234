"""Compiles every kernel of the render package, on the smallest scene that reaches all of them."""

import numpy as np

from tasks.render.fit.reconstruct import reconstruct
from tasks.render.fit.settings import FitSettings
from tasks.render.scene.build import AssetSettings, RenderAsset, build_asset
from tasks.render.scene.sensed import Photo, Sweep
from tasks.render.splatting.sh import turned
from tasks.world.agents import AgentKind, AgentTracks

FRONT = np.array([[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 1.5], [0.0, 0.0, 0.0, 1.0]])


def compile_kernels() -> RenderAsset:
    """Builds and measures a scene of two 32 x 32 photos, some ground and one box that drives."""
    turned(np.zeros((1, 3, 3), np.float32), np.diag([1.0, -1.0, 1.0]))
    return build_asset(*_seen(), AssetSettings(hold_out_every=3))


def compile_fit_kernels() -> RenderAsset:
    """Fits such a scene, each step of the fit at least once."""
    settings = FitSettings(
        iterations=4, start_gaussians=200, most_gaussians=300, refine_every=2, refine_from=2, pose_from=0
    )
    return reconstruct(*_seen(), settings, held_out=[1])


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
