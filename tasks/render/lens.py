"""Pictures as a lens takes them, of a scene that ideal pinholes are drawn of."""

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tasks.kernels.compiled import kernel
from tasks.render.scene.asset import RenderAsset
from tasks.render.settings import Backend
from tasks.render.views import render_views
from tasks.world.arrays import Array, Bytes
from tasks.world.clip import AgentTracks, Camera

WIDEST = 4.0  # times the picture's pixels that its pinhole may have
SEEN_PX = 1e-3  # how exactly a lens is undone
NEWTON_STEPS = 20


@dataclass(frozen=True)
class Lens:
    """How the picture of an ideal pinhole of the same focal lengths, which reaches further, becomes that of a camera
    with distortion: the inverse of `tasks.render.views.undistorted`."""

    intrinsics: Array  # (3, 3) of that pinhole, in pixels,
    width: int  # and the size of its picture,
    height: int
    left: int  # in which the camera's own would begin
    top: int
    maps: tuple[NDArray[Any], NDArray[Any]]  # of cv2.remap, from the pinhole's picture to the camera's


def lens_of(width: int, height: int, k: Array, distortion: Array) -> Lens:
    """Of a camera's size, intrinsics (3, 3) and `Camera.distortion` (5,).

    Raises ValueError for a distortion that does not show each pixel one ray, or rays that no pinhole takes.
    """
    straight = _straight_rays(width, height, k[0, 0], k[1, 1], k[0, 2], k[1, 2], distortion)
    straight = straight * [k[0, 0], k[1, 1]] + k[:2, 2]
    if not np.isfinite(straight).all():
        raise ValueError("the distortion shows a pixel several rays, or none")
    low = np.minimum(np.floor(straight.min(axis=(0, 1))) - 1.0, 0.0)
    high = np.maximum(np.ceil(straight.max(axis=(0, 1))) + 1.0, [width, height])
    if np.prod(high - low) > WIDEST * width * height:
        raise ValueError(f"the distortion sees more than {WIDEST:g} times what a pinhole does")
    wider, where = k.copy(), (straight - low - 0.5).astype(np.float32)
    wider[:2, 2] -= low
    left, top, right, bottom = (int(value) for value in (*-low, *high))
    return Lens(wider, left + right, top + bottom, left, top, (where[..., 0].copy(), where[..., 1].copy()))


@kernel
def _straight_rays(
    width: int, height: int, fx: float, fy: float, cx: float, cy: float, distortion: Array
) -> NDArray[Any]:
    """(height, width, 2) x, y over depth of what a lens shows at each pixel, by Newton's method; NaN where it does not
    come to rest, or has passed a fold of the lens."""
    k1, k2, p1, p2, k3 = distortion
    out = np.empty((height, width, 2))
    for row in range(height):
        for column in range(width):
            seen_x, seen_y = (column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy
            x, y, off = seen_x, seen_y, np.inf
            for _ in range(NEWTON_STEPS):
                r2 = x * x + y * y
                stretch = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
                slope = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3))
                off_x = x * stretch + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) - seen_x
                off_y = y * stretch + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y - seen_y
                off = max(abs(off_x) * fx, abs(off_y) * fy)
                xx = stretch + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
                yy = stretch + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
                xy = x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
                area = xx * yy - xy * xy
                if not (area > 0.0 and xx > 0.0):  # folded
                    off = np.inf
                    break
                if off <= SEEN_PX:
                    break
                x, y = x - (yy * off_x - xy * off_y) / area, y - (xx * off_y - xy * off_x) / area
            out[row, column, 0] = x if off <= SEEN_PX else np.nan
            out[row, column, 1] = y if off <= SEEN_PX else np.nan
    return out


def render_through_lens(
    asset: RenderAsset,
    camera: Camera,
    lens: Lens,
    world_from_ego: Array,
    agents: AgentTracks,
    step: float,
    backend: Backend = Backend.CPU,
) -> Bytes:
    """The picture (H, W, 3) that a camera takes from a pose (4, 4) through its lens; all else is as in `render_views`.

    The own body is known as far as an ideal pinhole's picture of the camera's size reaches; beyond, what is at that
    picture's edge goes on.
    """
    if (body := asset.own_body(camera.name)) is not None:
        rgba = cv2.resize(body.rgba, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        beyond = (lens.top, lens.height - lens.top - camera.height)
        beside = (lens.left, lens.width - lens.left - camera.width)
        rgba = cv2.copyMakeBorder(rgba, *beyond, *beside, cv2.BORDER_REPLICATE)
        asset = replace(asset, bodies=(replace(body, rgba=np.asarray(rgba, np.uint8)),))
    wide = Camera(camera.name, lens.width, lens.height, lens.intrinsics, np.zeros(5), camera.ego_from_camera)
    seen = next(render_views(asset, [wide], world_from_ego[None], agents, [step], lens.width, lens.height, backend))[0]
    return np.asarray(cv2.remap(seen, *lens.maps, cv2.INTER_LINEAR), np.uint8)
