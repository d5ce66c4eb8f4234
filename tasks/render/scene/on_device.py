"""Scenes that lie on a device of torch's and are drawn and finished there: boxes go there, pictures come back.

The same Gaussians, sky and colours as the kernels draw, within a step of 8 bits, by `gsplat.rasterization` (gsplat
1.5.3), all cameras of a size at once, small pictures of several instants too. Its conventions are those of the CPU
rasteriser: quaternions w first, world-to-camera matrices with z forward, the centre of pixel (0, 0) at (0.5, 0.5),
contributions cut off at 1/255 and capped at 0.999 (later versions cap at 0.99). What differs is passed on (near plane,
the screen's filter) or below 8 bits (no more than 1e-4 of the light is dropped instead of 1e-3). Pictures and
derivatives are held against gsplat's own reference by tests.bench.peer_gsplat. Nothing but render.backend=gsplat loads
torch.
"""

import weakref
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache
from itertools import groupby, islice, product
from math import inf, pi
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tasks.render.scene.asset import Instant, OwnBody, Reach, RenderAsset
from tasks.render.scene.movers import world_from_boxes
from tasks.render.scene.sky import COLUMNS, ROWS, SkyMap
from tasks.render.scene.surfels import box_gaussians
from tasks.render.splatting import sh
from tasks.render.splatting.gaussians import Gaussians, quats_of
from tasks.render.splatting.gsplat_backend import plain_arguments, take_gpu
from tasks.render.splatting.project import FITTED, ScreenFilter
from tasks.render.splatting.raster import View
from tasks.render.splatting.tensors import hamilton
from tasks.world.arrays import F32, Array, Bytes
from tasks.world.clip import Pinhole


def fetched(tensor: Tensor) -> NDArray[Any]:
    """A tensor as an array of this machine's memory."""
    return np.asarray(tensor.cpu().numpy())


@dataclass(frozen=True)
class Device:
    """Where scenes are drawn."""

    name: str  # torch's
    rasterization: Callable[..., tuple[Tensor, Tensor, Any]]  # gsplat's, or what stands for it
    packed: bool = True  # memory follows what is seen, not cameras x Gaussians
    fetch: Callable[[Tensor], NDArray[Any]] = fetched
    encode: Callable[[list[Tensor], int], list[bytes]] | None = None  # JPEGs of (3, H, W) uint8, by a quality

    def sent(self, array: Any) -> Tensor:
        """An array on the device, float32."""
        return torch.as_tensor(np.ascontiguousarray(array, np.float32), device=self.name)


@cache
def cuda(packed: bool) -> Device:
    """This process's GPU. Raises BackendMissing."""
    take_gpu()
    import gsplat

    return Device("cuda", gsplat.rasterization, packed, encode=nvjpeg())


def nvjpeg() -> Callable[[list[Tensor], int], list[bytes]] | None:
    """JPEGs made where pictures lie, by torchvision's `encode_jpeg`; None where it is not installed."""
    try:
        from torchvision.io import encode_jpeg
    except ImportError:
        return None

    def encode(pictures: list[Tensor], quality: int) -> list[bytes]:
        return [jpeg.cpu().numpy().tobytes() for jpeg in encode_jpeg(pictures, quality)]

    return encode


BATCH_PIXELS = 2**23  # drawn in one call, of all cameras of the instants that it takes: 1 GB on the device
BATCH_GAUSSIANS = 2**22  # of all instants in it, which have a scene each where something moves: some 2 GB, of degree 3
BATCH_PAIRS = 2**25  # of a Gaussian and a camera in it: some 2 GB


def batches(asset: RenderAsset, instants: Sequence[Instant]) -> Iterator[Sequence[Instant]]:
    """As many instants at once as the bounds let, one at least, whose cameras are of the same sizes."""
    for sizes, group in groupby(instants, lambda one: [(camera.width, camera.height) for camera in one.cameras]):
        alike, pixels = [*group], sum(width * height for width, height in sizes)
        crowd = max(sum(len(asset.nodes.get(name, ())) for name in one.vehicles.track_ids) for one in alike)
        each = max(1, len(asset.background) + crowd)
        most = min(BATCH_PIXELS // max(1, pixels), BATCH_PAIRS // (each * max(1, len(sizes))))
        most = max(1, most if _is_still(alike) else min(most, BATCH_GAUSSIANS // each))
        yield from (alike[i : i + most] for i in range(0, len(alike), most))


def _is_still(instants: Sequence[Instant]) -> bool:
    """All show the same: the background."""
    return all(not instant.vehicles.track_ids and instant.reach is None for instant in instants)


@torch.inference_mode()
def views(device: Device, asset: RenderAsset, instants: Sequence[Instant]) -> Iterator[list[View]]:
    """One finished view a camera, of one instant after the other; a batch is drawn when its first is asked for."""
    for batch in batches(asset, instants):
        yield from _views(device, asset, batch)


def _views(device: Device, asset: RenderAsset, instants: Sequence[Instant]) -> list[list[View]]:
    by_size: dict[tuple[int, int], list[int]] = defaultdict(list)
    for i, camera in enumerate(instants[0].cameras):
        by_size[camera.width, camera.height].append(i)
    found: dict[tuple[int, int], View] = {}
    scene = _composed(device, asset, instants)
    for rows in by_size.values():
        mine = [
            replace(n, cameras=[n.cameras[i] for i in rows], affines=[n.affines[i] for i in rows]) for n in instants
        ]
        seen = zip(*map(device.fetch, _lit(device, asset, scene, mine)), strict=True)
        found |= {place: View(*view) for place, view in zip(product(range(len(mine)), rows), seen, strict=True)}
    return [[found[f, i] for i in range(len(instant.cameras))] for f, instant in enumerate(instants)]


@torch.inference_mode()
def pictures(
    device: Device, asset: RenderAsset, instants: Sequence[Instant], bodies: Sequence[OwnBody | None]
) -> Iterator[Bytes]:
    """(C, H, W, 3) of each instant, whose cameras are of one size, with what each camera sees of its own car.

    Small pictures of several instants are drawn in one call. Nothing is waited for before the last one was asked for:
    the device is not idle between calls, and draws on while whoever asked is busy with the first.
    """
    drawn = [*_drawn(device, asset, instants, bodies)]
    return (np.asarray(device.fetch(of_instant)) for batch in drawn for of_instant in batch)


@torch.inference_mode()
def jpegs(
    device: Device,
    asset: RenderAsset,
    instants: Sequence[Instant],
    bodies: Sequence[OwnBody | None],
    quality: int,
) -> list[list[bytes]]:
    """The same as JPEGs, one a camera, of each instant: nothing else comes back."""
    assert device.encode is not None
    made: list[list[bytes]] = []
    for drawn in _drawn(device, asset, instants, bodies):
        jpegs = iter(device.encode([*drawn.flatten(0, 1).permute(0, 3, 1, 2).contiguous()], quality))
        made += [[*islice(jpegs, drawn.shape[1])] for _ in drawn]
    return made


def _drawn(
    device: Device, asset: RenderAsset, instants: Sequence[Instant], bodies: Sequence[OwnBody | None]
) -> Iterator[Tensor]:
    """Batches (F, C, H, W, 3) uint8."""
    return (_rounded(device, asset, batch, bodies) for batch in batches(asset, instants))


def _rounded(
    device: Device, asset: RenderAsset, instants: Sequence[Instant], bodies: Sequence[OwnBody | None]
) -> Tensor:
    """(F, C, H, W, 3) uint8."""
    scene = _composed(device, asset, instants)
    lit, _, _ = _lit(device, asset, scene, instants)
    rounded = (lit * 255.0).round_().unflatten(0, (len(instants), -1))
    for c, body in enumerate(bodies):
        if body is not None:
            over, share = _body(device, body, rounded.shape[3], rounded.shape[2])
            rounded[:, c].mul_(1.0 - share).add_(over * share).round_()
    return rounded.to(torch.uint8)


def _lit(
    device: Device, asset: RenderAsset, scene: "GaussianTensors", instants: Sequence[Instant]
) -> tuple[Tensor, Tensor, Tensor]:
    """Finished pictures, depth and alpha, (F x C, H, W, ...), of instants with as many cameras of one size each."""
    rgb, depth, alpha = rasterized(device, scene, [instant.cameras for instant in instants], asset.screen)
    cameras = [camera for instant in instants for camera in instant.cameras]
    affines = [affine for instant in instants for affine in instant.affines]
    return finished(rgb, alpha, _sky_cells(device, asset.sky), *_cameras(device, cameras, affines)), depth, alpha


# What lies there stays as long as the objects that it was made of, which nobody changes.

_HELD: dict[tuple[object, ...], Any] = {}


def _held(device: Device, owner: object, make: Callable[[], Any], *of: object) -> Any:
    key = (id(owner), device.name, *of)
    if key not in _HELD:
        _HELD[key] = make()
        weakref.finalize(owner, _HELD.pop, key, None)
    return _HELD[key]


@dataclass(frozen=True)
class GaussianTensors:
    """Gaussians, as `tasks.render.splatting.gaussians` has them."""

    means: Tensor
    quats: Tensor
    log_scales: Tensor
    opacities: Tensor
    colours: Tensor
    sh_rest: Tensor


def gaussians_on(device: Device, part: Gaussians) -> GaussianTensors:
    made: GaussianTensors = _held(
        device, part, lambda: GaussianTensors(*(device.sent(getattr(part, each.name)) for each in fields(Gaussians)))
    )
    return made


def _sky_cells(device: Device, sky: SkyMap) -> Tensor:
    made: Tensor = _held(device, sky, lambda: device.sent(sky.cells))
    return made


def _body(device: Device, body: OwnBody, width: int, height: int) -> tuple[Tensor, Tensor]:
    """Colours (H, W, 3) from 0 to 255 of what a picture of this size shows of the car, and how much (H, W, 1) it hides
    of what is behind."""

    def make() -> tuple[Tensor, Tensor]:
        over = device.sent(cv2.resize(body.rgba, (width, height), interpolation=cv2.INTER_AREA))
        return over[..., :3], over[..., 3:] / 255.0

    made: tuple[Tensor, Tensor] = _held(device, body, make, width, height)
    return made


UNLIT = Gaussians(
    means=np.zeros((1, 3), np.float32),
    quats=np.eye(1, 4, dtype=np.float32),
    log_scales=np.zeros((1, 3), np.float32),
    opacities=np.zeros(1, np.float32),
    colours=np.zeros((1, 3), np.float32),
)


def _composed(device: Device, asset: RenderAsset, instants: Sequence[Instant]) -> GaussianTensors:
    """As `tasks.render.scene.asset.compose_gaussians` has it, of several instants (F, N, ...), or (1, N, ...) where all
    are still. Without light is what is out of reach, and what stands for vehicles where there are fewer than at others.
    """
    background = gaussians_on(device, asset.background)
    if _is_still(instants):
        return repeated(background, 1)
    crowds, reaches = zip(*((instant.vehicles, instant.reach) for instant in instants))
    background = repeated(background, len(instants))
    if any(reaches):
        within = _within(device, background.means, reaches)
        background = replace(background, opacities=torch.where(within, background.opacities, 0.0))
    nodes = [
        asset.nodes.get(track_id) or box_gaussians(crowd.boxes[j, 4:7], crowd.kinds[j])
        for crowd in crowds
        for j, track_id in enumerate(crowd.track_ids)
    ]
    if not nodes:
        return background
    boxes = np.concatenate([crowd.boxes for crowd in crowds])
    poses = world_from_boxes(boxes - np.concatenate([asset.origin, np.zeros(4)]))
    vehicles = _joined([*_moved(device, nodes, poses), gaussians_on(device, UNLIT)], dim=0)
    ends = np.cumsum([0, *(len(crowd.track_ids) for crowd in crowds)])
    starts = np.cumsum([0, *(len(node) for node in nodes)])[ends]
    rows = starts[:-1, None] + np.arange(np.diff(starts).max())
    rows = torch.as_tensor(np.where(rows < starts[1:, None], rows, starts[-1]), device=device.name)
    taken = GaussianTensors(*(getattr(vehicles, each.name)[rows] for each in fields(GaussianTensors)))
    return _joined([background, taken], dim=1)


def _within(device: Device, means: Tensor, reaches: Sequence[Reach | None]) -> Tensor:
    """(F, N) which of the means (F, N, 3) are in reach at each instant: `tasks.render.scene.asset.near_part`."""
    known = [(0.0, 0.0, inf) if reach is None else (*reach.place[:2], reach.metres) for reach in reaches]
    east, north, metres = device.sent(known)[..., None].unbind(1)
    east, north = means[..., 0] - east, means[..., 1] - north
    return east * east + north * north < metres * metres


def repeated(part: GaussianTensors, times: int) -> GaussianTensors:
    """(F, N, ...), which takes no memory of its own."""
    whole = (getattr(part, each.name) for each in fields(GaussianTensors))
    return GaussianTensors(*(tensor.expand(times, *tensor.shape) for tensor in whole))


def _moved(device: Device, nodes: Sequence[Gaussians], poses: Array) -> list[GaussianTensors]:
    """Nodes at poses (V, 4, 4), as `gaussians.moved` has it; all are turned at once."""
    parts = [gaussians_on(device, node) for node in nodes]
    lengths = [len(node) for node in nodes]
    of = torch.as_tensor(np.repeat(np.arange(len(nodes)), lengths), device=device.name)
    where = torch.as_tensor(np.column_stack([poses[:, :3].reshape(-1, 12), quats_of(poses[:, :3, :3])]))
    mine = where.to(device.name)[of]
    turn, shift, quats = mine[:, :12].view(-1, 3, 4)[..., :3], mine[:, 3:12:4], mine[:, 12:]
    means = (turn * torch.cat([part.means for part in parts])[:, None]).sum(-1) + shift
    turned = hamilton(quats, torch.cat([part.quats for part in parts]))
    at = zip(parts, poses, means.float().split(lengths), turned.float().split(lengths))
    return [
        GaussianTensors(mean, quat, part.log_scales, part.opacities, part.colours, _turned_light(device, part, pose))
        for part, pose, mean, quat in at
    ]


def _turned_light(device: Device, part: GaussianTensors, pose: Array) -> Tensor:
    count = part.sh_rest.shape[1]
    if not count:
        return part.sh_rest
    turn = device.sent(sh.coefficient_turn(count, pose[:3, :3]))
    return (turn[None, :, :, None] * part.sh_rest[:, None]).sum(2)


def _joined(parts: Sequence[GaussianTensors], dim: int) -> GaussianTensors:
    """As `gaussians.concatenate` has it, along a dimension."""
    most = max(part.sh_rest.shape[-2] for part in parts)
    lacks = [most - part.sh_rest.shape[-2] for part in parts]
    light = [torch.nn.functional.pad(p.sh_rest, (0, 0, 0, n)) if n else p.sh_rest for p, n in zip(parts, lacks)]
    names = [each.name for each in fields(GaussianTensors) if each.name != "sh_rest"]
    joined = {name: torch.cat([getattr(part, name) for part in parts], dim) for name in names}
    return GaussianTensors(**joined, sh_rest=torch.cat(light, dim))


def rasterized(
    device: Device, scene: GaussianTensors, rigs: Sequence[Sequence[Pinhole]], screen: ScreenFilter
) -> tuple[Tensor, Tensor, Tensor]:
    """Colours (F x C, H, W, 3) before black, which may leave [0, 1], depth (F x C, H, W) [m], 0 where nothing is, and
    alpha, of a `scene` (F, N, ...), or one (1, N, ...) for all, and C cameras for each of F instants."""
    first = rigs[0][0]
    rigs = rigs if len(scene.means) > 1 else [[camera for rig in rigs for camera in rig]]
    if not scene.means.shape[1]:
        nothing = torch.zeros(len(rigs) * len(rigs[0]), first.height, first.width, 3, device=device.name)
        return nothing, nothing[..., 0], nothing[..., 0]
    seen, covered, _ = device.rasterization(**arguments(device, scene, rigs, screen))
    seen, alpha = seen.flatten(0, 1), covered[..., 0].flatten(0, 1)
    return seen[..., :3], torch.where(alpha > 0.0, seen[..., 3], 0.0), alpha


def arguments(
    device: Device, scene: GaussianTensors, rigs: Sequence[Sequence[Pinhole]], screen: ScreenFilter = FITTED
) -> dict[str, Any]:
    """What `gsplat.rasterization` is called with: tensors float32 by its names, and plain settings.

    means (F, N, 3), quats (F, N, 4), scales (F, N, 3), opacities (F, N), colors (F, N, 3) or, with sh_degree,
    coefficients (F, N, K, 3), viewmats (F, C, 4, 4) camera from scene, Ks (F, C, 3, 3). All cameras are of one size.
    """
    count = scene.sh_rest.shape[-2]
    colours = scene.colours.clamp(min=0.0)  # as the kernels do; gsplat does it for higher degrees alone
    if count:  # gsplat adds the half again
        colours = torch.cat([((scene.colours - 0.5) / sh.C0)[..., None, :], scene.sh_rest], dim=-2)
    return {
        "means": scene.means,
        "quats": scene.quats,
        "scales": scene.log_scales.exp(),
        "opacities": scene.opacities,
        "colors": colours,
        "viewmats": device.sent([[np.linalg.inv(camera.world_from_camera) for camera in rig] for rig in rigs]),
        "Ks": device.sent([[camera.intrinsics for camera in rig] for rig in rigs]),
    } | plain_arguments(rigs[0][0].width, rigs[0][0].height, count, screen, device.packed)


def _cameras(device: Device, cameras: Sequence[Pinhole], affines: Sequence[F32]) -> tuple[Tensor, Tensor, Tensor]:
    """Lenses (C, 3, 3), scene from camera (C, 3, 3) and colours (C, 3, 4)."""
    turns = [camera.world_from_camera[:3, :3] for camera in cameras]
    lenses = [camera.intrinsics for camera in cameras]
    return device.sent(np.stack(lenses)), device.sent(np.stack(turns)), device.sent(np.stack(affines))


def finished(rgb: Tensor, alpha: Tensor, cells: Tensor, lenses: Tensor, turns: Tensor, affines: Tensor) -> Tensor:
    """Pictures (C, H, W, 3) of a scene's own light with the sky behind them where `alpha` (C, H, W) lets it through,
    in the colours of cameras with `affines` (C, 3, 4), from 0 to 1: `SkyMap.finish`."""
    top_left, right, below = sky_places(lenses, turns, *alpha.shape[1:])
    top, left = top_left
    here, beside = top * COLUMNS + left, top * COLUMNS + (left + 1) % COLUMNS
    high = torch.lerp(cells[here], cells[beside], right[..., None])
    low = torch.lerp(cells[here + COLUMNS], cells[beside + COLUMNS], right[..., None])
    lit = rgb + (1.0 - alpha)[..., None] * torch.lerp(high, low, below[..., None])
    shown = affines[:, None, None, :, 3]
    for channel in range(3):
        shown = shown + lit[..., channel, None] * affines[:, None, None, :, channel]
    return shown.clamp(0.0, 1.0)


def sky_places(lenses: Tensor, turns: Tensor, height: int, width: int) -> tuple[tuple[Tensor, Tensor], Tensor, Tensor]:
    """Where pixels (C, H, W) of cameras look in the sky: row and column of the cell above and left of it, and how far
    it lies to the right and below of that; `sky.sky_cells`, of the tensors' own precision."""
    fx, fy, cx, cy = (lenses[:, i, j, None, None] for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    across = (torch.arange(width, device=lenses.device).to(lenses.dtype) + 0.5 - cx) / fx
    down = (torch.arange(height, device=lenses.device).to(lenses.dtype)[:, None] + 0.5 - cy) / fy
    x, y, z = (turns[:, i, 0, None, None] * across + turns[:, i, 1, None, None] * down + turns[:, i, 2, None, None]
               for i in range(3))  # fmt: skip
    row = (0.5 - torch.atan2(z, torch.hypot(x, y)) / pi) * ROWS - 0.5
    column = (torch.atan2(y, x) / (2.0 * pi) + 0.5) * COLUMNS - 0.5
    top, left = row.floor().clamp(0, ROWS - 2), column.floor()
    return (top.long(), left.long() % COLUMNS), column - left, (row - top).clamp(0.0, 1.0)
