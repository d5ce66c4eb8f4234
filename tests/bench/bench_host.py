"""What a GPU would leave to the host of an instant of eight cameras.

    python -m tests.bench.bench_host [gaussians=250000] [vehicles=20] [instants=3] [repeats=5]

It draws as the render stage does with render.backend=gsplat, on a device of torch's that costs nothing ("meta": every
call is made, nothing is computed); what comes back is copied from pictures that the kernels drew before. The CPU path
stands beside it. CPU time, from a few samples of an instant alone and of several drawn together, as a walk's are, after
one that sends the scene. Then the gate on a drive's pictures, in as few calls as memory lets and instant by instant.
"""

import sys
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch

from tasks.render.gate import check_drive_pictures
from tasks.render.scene import on_device
from tasks.render.scene.asset import Exposure, OwnBody, RenderAsset
from tasks.render.scene.engine import encode_jpeg
from tasks.render.scene.on_device import Device
from tasks.render.scene.sky import plain_sky
from tasks.render.settings import Backend, GateSettings, RenderSettings
from tasks.render.views import render_views
from tasks.world.arrays import F32, Array, Bytes
from tasks.world.clip import AgentKind, AgentTracks, Camera
from tests.bench.bench_render import cloud
from tests.bench.timing import cpu_milliseconds

SIZES = ((480, 270), (1920, 1080))
RIG = 8
FORWARD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # ego from camera
NODE = 2000  # Gaussians of a vehicle
LOOKS = 18  # of the gate at a drive: 2 Hz from T to T+2H


def ring(width: int, height: int) -> list[Camera]:
    """Eight cameras around the ego, each of which sees its own car at the lower edge."""
    k = np.array([[0.6 * width, 0.0, width / 2], [0.0, 0.6 * width, height / 2], [0.0, 0.0, 1.0]])
    rig = []
    for i in range(RIG):
        yaw, mount = 2.0 * np.pi * i / RIG, np.eye(4)
        c, s = np.cos(yaw), np.sin(yaw)
        mount[:3, :3] = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ FORWARD
        mount[2, 3] = 1.6
        rig.append(Camera(f"camera {i}", width, height, k, np.zeros(5), mount))
    return rig


def street(gaussians: int, vehicles: int, rig: Sequence[Camera]) -> tuple[RenderAsset, AgentTracks]:
    """A seeded cloud all around, vehicles with Gaussians of their own, cameras with colours and a body."""
    part = cloud(gaussians)
    part.means[:] = part.means @ FORWARD.T.astype(np.float32) * np.random.default_rng(1).choice([-1, 1], (gaussians, 3))
    names, body = tuple(f"car {i}" for i in range(vehicles)), np.full((270, 480, 4), 90, np.uint8)
    body[:240, :, 3] = 0
    scene = RenderAsset(
        np.zeros(3), part, {name: cloud(NODE).take(slice(NODE)) for name in names}, plain_sky(), float("nan"),
        exposures=tuple(Exposure(camera.name, 0.0, np.eye(3, 4, dtype=np.float32)) for camera in rig),
        bodies=tuple(OwnBody(camera.name, body) for camera in rig),
    )  # fmt: skip
    boxes = np.zeros((96, vehicles, 5))
    boxes[..., 0], boxes[..., 1], boxes[..., 3:] = np.arange(vehicles) * 4.0 - 40.0, 6.0, (4.5, 1.9)
    boxes[..., 0] += np.arange(96)[:, None] * 0.5
    there, heights = np.ones((96, vehicles), bool), np.full(vehicles, 1.5)
    kinds, still = (AgentKind.VEHICLE,) * vehicles, np.zeros((96, vehicles, 2))
    return scene, AgentTracks(names, kinds, boxes, still, there, np.full((96, vehicles), 0.75), heights)


def nothing_is_drawn(**given: Any) -> Any:
    """`gsplat.rasterization`, of tensors without contents."""
    like = {"device": given["means"].device, "dtype": torch.float32}
    shape = *given["Ks"].shape[:-2], given["height"], given["width"]
    return torch.empty(*shape, 4, **like), torch.empty(*shape, 1, **like), None


def drawn(*asked: Any, **how: Any) -> list[Bytes]:
    """The pictures of all instants, as a sample's are asked for."""
    return list(render_views(*asked, **how))


def row(width: int, height: int, gaussians: int, vehicles: int, instants: int, repeats: int) -> None:
    """One size."""
    rig = ring(width, height)
    asset, agents = street(gaussians, vehicles, rig)
    poses: Array = np.tile(np.eye(4), (instants, 1, 1))
    draw = partial(drawn, asset, rig, poses, agents, [float(5 * i) for i in range(instants)], width, height)
    each = 1.0 / instants
    by_kernels = cpu_milliseconds(draw, 1) * each
    seen: list[Bytes] = draw()
    on_device.cuda = lambda packed: Device("meta", nothing_is_drawn, packed, lambda tensor: seen[0].copy())  # type: ignore[assignment]
    draws: Callable[[], list[Bytes]] = partial(draw, backend=Backend.GSPLAT)
    left = cpu_milliseconds(draws, repeats) * each
    one = partial(drawn, asset, rig, poses[:1], agents, [0.0], width, height, backend=Backend.GSPLAT)
    alone = cpu_milliseconds(one, repeats)
    copied = cpu_milliseconds(lambda: [pictures.copy() for pictures in seen], repeats) * each
    quality = RenderSettings().jpeg_quality
    jpeg = cpu_milliseconds(lambda: [encode_jpeg(p, quality) for pictures in seen for p in pictures], repeats) * each
    total = (left + jpeg) / 1e3
    asked = f"{by_kernels:.0f} | {alone:.1f} | {left:.1f} | {copied:.1f}"
    print(f"| {width}x{height} | {asked} | {jpeg:.1f} | {total:.3f} |", flush=True)


def gate_row(width: int, height: int, gaussians: int, vehicles: int, pixels: int, repeats: int) -> None:
    """The gate on a drive whose every picture passes, with so many `pixels` in a call at most."""
    rig, counts, rng = ring(width, height), Counter[str](), np.random.default_rng(0)
    asset, agents = street(gaussians, vehicles, rig)

    def called(**given: Any) -> Any:
        counts["calls"] += 1
        return nothing_is_drawn(**given)

    def noise(tensor: torch.Tensor) -> F32:
        """Neither blank nor with holes."""
        counts["fetched"] += 1
        return rng.uniform(0.6, 1.0, tuple(tensor.shape)).astype(np.float32)

    on_device.cuda = lambda packed: Device("meta", called, packed, noise)  # type: ignore[assignment]
    on_device.BATCH_PIXELS = pixels
    steps, poses = [5 * i for i in range(LOOKS)], np.tile(np.eye(4), (LOOKS, 1, 1))
    asked = (asset, rig, poses, agents, steps, (width, height), GateSettings(), Backend.GSPLAT)
    if (fault := check_drive_pictures(*asked)) is not None:
        raise RuntimeError(f"the gate ended early: {fault}")
    each = dict(counts)
    ms = cpu_milliseconds(lambda: check_drive_pictures(*asked), repeats)
    print(f"| the gate, {width}x{height} | {each['calls']} | {each['fetched']} | {ms:.0f} |", flush=True)


def main(options: dict[str, str]) -> None:
    """Prints the table."""
    n, vehicles = int(options.get("gaussians", "250000")), int(options.get("vehicles", "20"))
    instants, repeats = int(options.get("instants", "3")), int(options.get("repeats", "5"))
    torch.set_num_threads(1)
    print(f"{n:,} Gaussians, {vehicles} vehicles, an instant of {RIG} cameras, CPU ms:\n")
    print("| size | the kernels | asked of a GPU alone | together | of that, pictures copied | JPEGs ", end="")
    print("| left to the host [CPU s] |\n|---|---|---|---|---|---|---|")
    for width, height in SIZES:
        row(width, height, n, vehicles, instants, repeats)
    print(f"\nA drive's {LOOKS} instants by the gate, together and one by one:\n")
    print("| | calls | arrays fetched | left to the host [CPU ms] |\n|---|---|---|---|")
    for pixels in (on_device.BATCH_PIXELS, 1):
        gate_row(*SIZES[0], n, vehicles, pixels, repeats)


if __name__ == "__main__":
    main(dict(option.split("=", 1) for option in sys.argv[1:]))
