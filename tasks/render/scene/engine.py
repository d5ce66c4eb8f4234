"""The one function that draws a scene: `render(asset, cameras, vehicles, backend) -> rgb, depth, alpha` per camera.

Backends with one face. `cpu` is the compiled tile rasteriser of this package: the same input gives the same bytes.
`gsplat` draws the same Gaussians with CUDA, equal up to the last bits of 8-bit colours, all cameras of a size in one
call (`gsplat_dense` without packing what they see). All draw ideal pinholes: a camera's distortion is taken out of its
photos before they enter a scene (`views.undistorted`), so that images at new poses need none.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType

import numpy as np

from tasks.render.scene.asset import RenderAsset, compose_gaussians
from tasks.render.scene.movers import boxes_at
from tasks.render.scene.sensed import shift_pose
from tasks.render.settings import Backend
from tasks.render.splatting.gaussians import Gaussians
from tasks.render.splatting.project import ScreenFilter
from tasks.render.splatting.raster import View, forward
from tasks.world.arrays import F32, Array
from tasks.world.clip import AgentKind, AgentTracks, Pinhole


@dataclass(frozen=True)
class PlacedAgents:
    """Who is in the scene, and where: vehicles, pedestrians and bicycles."""

    track_ids: tuple[str, ...]
    kinds: tuple[AgentKind, ...]
    boxes: Array  # (N, 7) x, y, z of the centre, heading, length, width, height; world [m, rad]


NOBODY = PlacedAgents((), (), np.zeros((0, 7)))


def agents_at_time(
    agents: AgentTracks, time_s: float, around: Array | None = None, reach_m: float = np.inf
) -> PlacedAgents:
    """The tracks that are there at a time since their first step; given a place `around` (2,), those within reach."""
    boxes, valid = boxes_at(agents, time_s)
    if around is not None:
        valid = valid & (np.hypot(*(boxes[:, :2] - around).T) < reach_m)
    rows = np.flatnonzero(valid)
    return PlacedAgents(tuple(agents.track_ids[j] for j in rows), tuple(agents.kinds[j] for j in rows), boxes[rows])


def render(
    asset: RenderAsset,
    cameras: Sequence[Pinhole],
    vehicles: PlacedAgents = NOBODY,
    backend: Backend = Backend.CPU,
    threads: int = 1,
    affines: Sequence[F32] | None = None,
) -> list[View]:
    """What each of the `cameras` sees of the scene with `vehicles` in it: rgb in [0, 1], depth [m], alpha.

    `affines` (3, 4), one a camera, are what they make of the scene's light (`RenderAsset.affine_of`); without them
    pictures show the light itself, which is that of photos on average.

    Behind everything is the sky, so that a camera which sees no Gaussian gets a picture of the sky map with alpha 0,
    never a black one. `threads` are the CPU backend's and change no byte. Raises BackendMissing where the backend
    cannot work on this machine.
    """
    scene = compose_gaussians(asset, vehicles.track_ids, vehicles.kinds, vehicles.boxes)
    local = [
        replace(camera, world_from_camera=shift_pose(camera.world_from_camera, -asset.origin)) for camera in cameras
    ]
    views = RASTERISERS[backend](scene, local, threads, asset.screen)
    for view, camera, affine in zip(
        views, local, [SCENE_S_OWN] * len(views) if affines is None else affines, strict=True
    ):
        asset.sky.finish(view.rgb, view.alpha, affine, camera.intrinsics, camera.world_from_camera, threads)
    return views


SCENE_S_OWN = np.eye(3, 4, dtype=np.float32)  # colours


def require_backend(backend: Backend) -> None:
    """Raises BackendMissing where the backend cannot work on this machine, with how to fix it."""
    if backend.on_gpu:
        from tasks.render.splatting.gsplat_backend import require

        require()


Rasteriser = Callable[[Gaussians, Sequence[Pinhole], int, ScreenFilter], list[View]]
"""Gaussians and cameras in one frame, threads, what all is drawn through -> views before black, contiguous; colours
may leave [0, 1]."""


def _on_cpu(scene: Gaussians, cameras: Sequence[Pinhole], threads: int, screen: ScreenFilter) -> list[View]:
    return [
        forward(scene, c.intrinsics, c.world_from_camera, c.width, c.height, BLACK, threads, screen).view
        for c in cameras
    ]


BLACK = np.zeros(3, np.float32)


def _with_gsplat(
    scene: Gaussians, cameras: Sequence[Pinhole], threads: int, screen: ScreenFilter, packed: bool = True
) -> list[View]:
    from tasks.render.splatting.gsplat_backend import rasterize_all  # torch is loaded only where it is asked for

    return rasterize_all(scene, cameras, screen, packed)


RASTERISERS: Mapping[Backend, Rasteriser] = MappingProxyType(
    {Backend.CPU: _on_cpu, Backend.GSPLAT: _with_gsplat, Backend.GSPLAT_DENSE: partial(_with_gsplat, packed=False)}
)
