"""The functions that draw a scene: `render` and `render_instants` give views, `render_pictures` 8-bit pictures.

Backends with one face. `cpu` is the compiled tile rasteriser of this package: the same input gives the same bytes.
`gsplat` draws the same Gaussians with CUDA, equal up to the last bits of 8-bit colours, all cameras of several instants
in one call (`gsplat_dense` without packing what they see). All draw ideal pinholes: a camera's distortion is taken out
of its photos before they enter a scene (`views.undistorted`), so that images at new poses need none.
"""

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import TYPE_CHECKING

import cv2
import numpy as np

from tasks.render.scene.asset import Instant, OwnBody, RenderAsset, compose_gaussians, near_part
from tasks.render.scene.movers import NOBODY, PlacedAgents
from tasks.render.scene.sensed import shift_pose
from tasks.render.settings import Backend
from tasks.render.splatting.raster import View, forward
from tasks.world.arrays import F32, Bytes
from tasks.world.clip import Pinhole

if TYPE_CHECKING:
    from tasks.render.scene.on_device import Device

BLACK = np.zeros(3, np.float32)
SCENE_S_OWN = np.eye(3, 4, dtype=np.float32)  # colours


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
    instant = Instant(cameras, vehicles, [SCENE_S_OWN] * len(cameras) if affines is None else affines)
    return next(render_instants(asset, [instant], backend, threads))


def render_instants(
    asset: RenderAsset, instants: Sequence[Instant], backend: Backend = Backend.CPU, threads: int = 1
) -> Iterator[list[View]]:
    """What `render` gives, of one instant after the other: drawn by the CPU when it is asked for, by a GPU with others.

    Raises BackendMissing where the backend cannot work on this machine.
    """
    if not backend.on_gpu:
        return (_render_on_cpu(asset, instant, threads) for instant in instants)
    from tasks.render.scene import on_device  # torch is loaded only where it is asked for

    return on_device.views(gpu(backend), asset, [_in_scene(asset, instant) for instant in instants])


def render_pictures(
    asset: RenderAsset,
    instants: Sequence[Instant],
    bodies: Sequence[OwnBody | None],
    backend: Backend = Backend.CPU,
) -> Iterator[Bytes]:
    """Pictures (C, H, W, 3) of one instant after the other, whose cameras are of one size, with the `bodies` that these
    see of their own car; from a GPU nothing else comes back.

    Raises BackendMissing where the backend cannot work on this machine.
    """
    if backend.on_gpu:
        from tasks.render.scene import on_device  # torch is loaded only where it is asked for

        return on_device.pictures(gpu(backend), asset, [_in_scene(asset, instant) for instant in instants], bodies)
    return (_pictures_on_cpu(asset, instant, bodies) for instant in instants)


JPEG_THREADS = 4


def render_jpegs(
    asset: RenderAsset,
    instants: Sequence[Instant],
    bodies: Sequence[OwnBody | None],
    quality: int,
    backend: Backend = Backend.CPU,
) -> list[list[bytes]]:
    """The pictures of `render_pictures` as JPEGs of a quality from 1 to 100, one a camera, of each instant.

    A GPU makes them where torchvision is installed with nvJPEG, threads do elsewhere, beside the drawing of the next
    instant. Raises BackendMissing where the backend cannot work on this machine.
    """
    if backend.on_gpu and gpu(backend).encode is not None:
        from tasks.render.scene import on_device

        return on_device.jpegs(gpu(backend), asset, [_in_scene(asset, each) for each in instants], bodies, quality)
    with ThreadPoolExecutor(JPEG_THREADS) as beside:
        asked = [
            [beside.submit(encode_jpeg, picture, quality) for picture in pictures]
            for pictures in render_pictures(asset, instants, bodies, backend)
        ]
    return [[jpeg.result() for jpeg in of_instant] for of_instant in asked]


def encode_jpeg(image: Bytes, quality: int) -> bytes:
    """An rgb image (H, W, 3) as JPEG bytes; quality 1..100, colour at half the size each way."""
    how = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420]
    done, data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), how)
    if not done:
        raise ValueError(f"no JPEG of an image of shape {image.shape}")
    return data.tobytes()


def _pictures_on_cpu(asset: RenderAsset, instant: Instant, bodies: Sequence[OwnBody | None]) -> Bytes:
    first = instant.cameras[0]
    out = np.empty((len(bodies), first.height, first.width, 3), np.uint8)
    for picture, view, body in zip(out, _render_on_cpu(asset, instant, 1, with_depth=False), bodies, strict=True):
        cv2.convertScaleAbs(view.rgb, picture, 255.0)
        if body is not None:
            body.draw_on(picture)
    return out


def _render_on_cpu(asset: RenderAsset, instant: Instant, threads: int, with_depth: bool = True) -> list[View]:
    agents, local, seen = instant.vehicles, _in_scene(asset, instant), []
    near = replace(asset, background=near_part(asset.background, local.reach))
    scene = compose_gaussians(near, agents.track_ids, agents.kinds, agents.boxes)
    for eye, affine in zip(local.cameras, instant.affines, strict=True):
        k, pose = eye.intrinsics, eye.world_from_camera
        view = forward(scene, k, pose, eye.width, eye.height, BLACK, threads, asset.screen, with_depth).view
        asset.sky.finish(view.rgb, view.alpha, affine, k, pose, threads)
        seen.append(view)
    return seen


def _in_scene(asset: RenderAsset, instant: Instant) -> Instant:
    """The instant with its cameras and its reach in the scene's own frame."""
    local = [replace(c, world_from_camera=shift_pose(c.world_from_camera, -asset.origin)) for c in instant.cameras]
    reach = instant.reach and replace(instant.reach, place=instant.reach.place - asset.origin)
    return replace(instant, cameras=local, reach=reach)


def gpu(backend: Backend) -> "Device":
    """Where a backend that is not the CPU draws. Raises BackendMissing."""
    from tasks.render.scene.on_device import cuda  # torch is loaded only where it is asked for

    return cuda(packed=backend is Backend.GSPLAT)


def require_backend(backend: Backend) -> None:
    """Raises BackendMissing where the backend cannot work on this machine, with how to fix it."""
    if backend.on_gpu:
        from tasks.render.splatting.gsplat_backend import require

        require()
