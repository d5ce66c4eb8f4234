"""What a GPU makes of render.backend=gsplat, in five minutes and without data: `make gpu-check`, or

    python -m tests.bench.gpu_check [gaussians=100000] [iterations=200] [width=480] [height=270] [threads=] [seconds=2]
        [on=cuda] [page=gpu-check.txt]

It prints whether pictures, derivatives and a fit agree with the CPU's, then iterations and views per second and memory,
each beside plain gsplat on the same scene. Exit code 0: all agree; 1: something does not; 2: there is no CUDA device,
or no gsplat. `on=cpu` runs all of it through this package's kernels, to try the script itself.
"""

import io
import os
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass, replace
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any, TextIO

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tasks.render.fit.backend import CpuBackend, FitBackend
from tasks.render.fit.corrections import EXPOSURE_SIZE, POSE_SIZE
from tasks.render.fit.losses import photo_target
from tasks.render.fit.on_torch import TorchBackend, photo_loss
from tasks.render.fit.reconstruct import finish_scene, run_iterations
from tasks.render.fit.start import FitPhoto, FitProblem, PhotoTarget
from tasks.render.fit.state import BACKGROUND, AdamArray, FitState, logits_of
from tasks.render.scene.asset import Instant, OwnBody, RenderAsset, psnr
from tasks.render.scene.engine import SCENE_S_OWN, encode_jpeg, render, render_pictures
from tasks.render.scene.movers import NOBODY, SHIFT_SIZE, PlacedAgents
from tasks.render.scene.on_device import Device, batches, jpegs, nvjpeg, pictures
from tasks.render.scene.sensed import Photo, Tracks
from tasks.render.scene.sky import COLUMNS, ROWS, plain_sky
from tasks.render.settings import FitSettings
from tasks.render.splatting.gaussians import Gaussians
from tasks.render.splatting.gsplat_backend import BackendMissing, require
from tasks.render.splatting.raster import forward
from tasks.render.splatting.tensors import Draw, Eye, SceneTensors, by_gsplat, learned_arguments
from tasks.world.arrays import Bytes
from tasks.world.clip import AgentKind, Pinhole
from tests.bench.bench_render import cloud
from tests.bench.by_kernels import by_kernels
from tests.bench.by_kernels import rasterization as of_kernel_calls
from tests.bench.peer_gsplat import SCENES, answers, apart, drawn_on, of_kernels, pictures_of

CLOSE = 1e-3  # of an array's length: CUDA's exponential is good to 2e-6, and sums come in any order
BEHIND_A_WALL = 5e-3  # light that a tile drops and gsplat does not
ALIKE_DB = 55.0  # of two pictures of a scene
JPEGS_ALIKE_DB = 30.0  # of what is decoded: colours are halved by one encoder and may not be by the other
QUALITY = 90
ALIKE = 1  # of 8 bits, two pictures drawn in one call or in several
RIG, INSTANTS = 8, 4  # cameras, and of a sample's history
WAYS = ((1, 1, True), (1, 1, False), *((RIG, n, packed) for n in (RIG, 1) for packed in (True, False)))
APART_DB = 0.1  # of two fits, on photos held out
PHOTOS, HELD_OUT = 24, (5, 17)
BEFORE_TIMED = 10  # iterations
LESS = "its defaults, no sky, exposure, poses or density, torch's Adam"
CALLS = 4  # between two waits for the device
SKY = 0.6


@dataclass(frozen=True)
class Place:
    """Where all of it runs."""

    name: str
    drawing: Device
    draw: Draw
    plain: Callable[[SceneTensors, Sequence[Eye], bool], Tensor]  # rgb (C, H, W, 3), packed or not, by nothing of ours
    least_s: float = 2.0  # that something is timed

    @property
    def device(self) -> str:
        return self.drawing.name

    def engine(self, asset: RenderAsset, cameras: Sequence[Pinhole], packed: bool) -> Bytes:
        """Finished pictures (C, H, W, 3) as the render stage has them."""
        instant, bodies = Instant(cameras, NOBODY, [SCENE_S_OWN] * len(cameras)), [None] * len(cameras)
        return next(pictures(replace(self.drawing, packed=packed), asset, [instant], bodies))

    def done(self) -> None:
        """Waits for what was asked of the device."""
        if self.device == "cuda":
            torch.cuda.synchronize()

    def timed(self, call: Callable[[], object]) -> float:
        """Calls per second, after one that warms up."""
        call()
        self.done()
        began, n, at_once = time.perf_counter(), 0, CALLS if self.device == "cuda" else 1
        while time.perf_counter() - began < self.least_s:
            for _ in range(at_once):
                call()
            self.done()
            n += at_once
        return n / (time.perf_counter() - began)

    def peak_mb(self) -> str:
        """Of the device's memory since the last call."""
        if self.device != "cuda":
            return ""
        peak = torch.cuda.max_memory_allocated() / 2**20
        torch.cuda.reset_peak_memory_stats()
        return f"{peak:.0f}"


def on_cuda(rasterization: Callable[..., Any]) -> Place:
    """gsplat as this project calls it, and with its own defaults."""

    def plain(scene: SceneTensors, eyes: Sequence[Eye], packed: bool) -> Tensor:
        each = [learned_arguments(scene, eye) for eye in eyes]
        cameras = {name: torch.cat([given[name] for given in each]) for name in ("viewmats", "Ks")}
        rgb: Tensor = rasterization(**each[0] | cameras | {"packed": packed, "render_mode": "RGB"})[0]
        return rgb

    return Place("render.backend=gsplat", Device("cuda", rasterization), by_gsplat, plain)


def _of_tensors(scene: SceneTensors, eyes: Sequence[Eye], packed: bool) -> Tensor:
    return torch.stack([by_kernels(scene, eye).rgb for eye in eyes])


ON_CPU = Place("tensors through the kernels", Device("cpu", of_kernel_calls), by_kernels, _of_tensors)


def parity(place: Place) -> bool:
    """Prints by how much pictures and derivatives differ; whether by no more than they may."""
    print(f"\nLargest difference from the CPU's kernels, as a share of an array's length (at most {CLOSE:g}):\n")
    print("| scene | pictures | derivatives | |\n|---|---|---|---|")
    well = True
    for name, (scene, intrinsics) in SCENES.items():
        ours = of_kernels(scene, intrinsics)
        if "d means" in ours:
            theirs = answers(place.draw, scene, intrinsics, torch.float32, place.device)
        else:  # light that depends on the side: drawn, not learned
            theirs = pictures_of(drawn_on(place.drawing, scene, intrinsics), ours["index"])
        found = apart(ours, theirs)
        most = [
            max((v for what, v in found.items() if what.startswith("d ") is by), default=0.0) for by in (False, True)
        ]
        close = max(most) < (BEHIND_A_WALL if "wall" in name else CLOSE)
        well &= close
        print(f"| {name} | {most[0]:.1e} | {most[1]:.1e} | {'well' if close else 'NOT WELL'} |", flush=True)
    return well


def problem_of(n: int, width: int, height: int, threads: int) -> tuple[FitProblem, FitState]:
    """Photos of a seeded cloud of n Gaussians from a short drive, and a start that has been shaken; no road, nobody."""
    truth, rng = cloud(n), np.random.default_rng(1)
    k = np.array([[0.6 * width, 0.0, width / 2], [0.0, 0.6 * width, height / 2], [0.0, 0.0, 1.0]])
    shots = []
    for i in range(PHOTOS):
        pose = np.eye(4)
        pose[:3, 3] = rng.uniform(-0.5, 0.5, 3)
        picture = forward(truth, k, pose, width, height, np.full(3, SKY, np.float32), threads).view.rgb
        rgb = np.rint(255.0 * np.clip(picture, 0.0, 1.0)).astype(np.uint8)
        photo = Photo("front", 0.1 * i, rgb, k, pose)
        shots.append(FitPhoto(photo, None, PhotoTarget(photo_target(rgb), np.zeros((height, width), bool))))
    held_out = tuple(shots[i] for i in HELD_OUT)
    train = tuple(shot for i, shot in enumerate(shots) if i not in HELD_OUT)
    return FitProblem(np.zeros(3), train, held_out, Tracks(None, np.zeros(3)), None), shaken(truth, len(train))


def shaken(truth: Gaussians, n_photos: int) -> FitState:
    """A state near the truth, grey."""
    rng, n = np.random.default_rng(2), len(truth)
    sizes = np.exp(truth.log_scales)
    learned = {
        "means": truth.means + rng.normal(size=(n, 3)) * sizes,
        "quats": truth.quats,
        "log_scales": truth.log_scales + rng.normal(0.0, 0.2, (n, 3)),
        "logits": logits_of(np.full((n, 1), 0.5)),
        "colours": np.full((n, 3), 0.5),
        "sky": np.full((ROWS * COLUMNS, 3), 0.5),
        "exposure": np.zeros((n_photos, EXPOSURE_SIZE)),
        "poses": np.zeros((n_photos, POSE_SIZE)),
        "boxes": np.zeros((0, SHIFT_SIZE)),
    }
    nothing, far = np.zeros(n, np.float32), np.full(n, np.inf, np.float32)
    owner = np.full(n, BACKGROUND, np.int32)
    arrays = {name: AdamArray.unstepped(values) for name, values in learned.items()}
    return FitState(0, arrays, owner, np.zeros(n, bool), far, nothing)


def fits(place: Place, problem: FitProblem, start: FitState, settings: FitSettings, threads: int) -> bool:
    """The same fit on the CPU and there; whether both come out alike."""
    print(f"\nThe same {settings.iterations} iterations, density control every {settings.refine_every} included:\n")
    print("| fit by | iterations/s | held out [dB] | Gaussians | device memory [MB] |\n|---|---|---|---|---|")
    scores = []
    backends: tuple[tuple[str, FitBackend], ...] = (
        (f"CPU, {threads} threads", CpuBackend(threads)),
        (place.name, TorchBackend(place.draw, place.device)),
    )
    for name, backend in backends:
        state = FitState.from_arrays(start.arrays())
        run_iterations(problem, state, settings, BEFORE_TIMED, backend=backend)
        place.peak_mb()
        began = time.perf_counter()
        run_iterations(problem, state, settings, settings.iterations, backend=backend)
        place.done()
        per_s = (settings.iterations - BEFORE_TIMED) / (time.perf_counter() - began)
        scores.append(finish_scene(problem, state, threads).psnr_db)
        print(f"| {name} | {per_s:.1f} | {scores[-1]:.2f} | {len(state):,} | {place.peak_mb()} |", flush=True)
    per_s = plain(place, problem, start, settings)
    print(f"| plain gsplat: {LESS} | {per_s:.1f} | | {len(start):,} | {place.peak_mb()} |", flush=True)
    return abs(scores[0] - scores[1]) <= APART_DB


def plain(place: Place, problem: FitProblem, start: FitState, settings: FitSettings) -> float:
    """Iterations per second of the shortest loop that fits the same photos by the same loss."""
    names = ("means", "quats", "log_scales", "logits", "colours")
    leaves = [torch.tensor(start.learned[name].values, device=place.device, requires_grad=True) for name in names]
    adam = torch.optim.Adam([{"params": [leaf], "lr": 1e-3} for leaf in leaves])
    motion = torch.zeros(6, device=place.device)
    photos = [torch.tensor(shot.compared.target.rgb, device=place.device) for shot in problem.train]
    everywhere = torch.ones(problem.train[0].photo.rgb.shape[:2], device=place.device)
    turn = count()

    def iterate() -> None:
        i = next(turn) % len(photos)
        shot, (means, quats, log_scales, logits, colours) = problem.train[i].photo, leaves
        scene = SceneTensors(means, quats, log_scales, logits[:, 0], colours)
        height, width = shot.rgb.shape[:2]
        eye = Eye(shot.intrinsics, shot.world_from_camera, width, height, motion)
        (rgb,) = place.plain(scene, [eye], False)
        loss = photo_loss(rgb, photos[i], everywhere, settings.ssim_weight)
        adam.zero_grad()
        loss.backward()
        adam.step()

    return place.timed(iterate)


def views(place: Place, n: int, sizes: Sequence[tuple[int, int]], threads: int) -> bool:
    """Pictures per second of one scene, cameras together in one call and one by one, packed and dense: by the engine,
    finished and 8 bits, and by gsplat alone. Whether pictures are the CPU's, and those of every way alike."""
    print("\nDrawing a scene; the worst picture against the CPU's, and against the same cameras one by one, packed:\n")
    print(
        "| size | cameras | in one call | | PSNR [dB] | apart | CPU views/s | engine views/s | plain gsplat views/s | "
        "device memory [MB] |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|")
    scene, well, samples = cloud(n), True, list[str]()
    asset = RenderAsset(np.zeros(3), scene, {}, plain_sky(), float("nan"))
    leaves = [torch.tensor(a, device=place.device) for a in (scene.means, scene.quats, scene.log_scales)]
    logits = torch.logit(torch.tensor(scene.opacities, device=place.device))
    colours, still = torch.tensor(scene.colours, device=place.device), torch.zeros(6, device=place.device)
    on_device = SceneTensors(*leaves, logits, colours)
    for width, height in sizes:
        most, k = 0.0, np.array([[0.6 * width, 0.0, width / 2], [0.0, 0.6 * width, height / 2], [0.0, 0.0, 1.0]])
        cameras = [Pinhole(k, _shifted(0.1 * i), width, height) for i in range(RIG)]
        eyes = [Eye(k, c.world_from_camera, width, height, still) for c in cameras]
        expected = next(render_pictures(asset, [Instant(cameras, NOBODY, [SCENE_S_OWN] * RIG)], [None] * RIG))
        on_cpu = place.timed(partial(render, asset, cameras[:1], threads=threads))
        single = np.concatenate([place.engine(asset, [c], True) for c in cameras])
        for many, at_once, packed in WAYS:
            engine = partial(_by_engine, place, asset, cameras[:many], at_once, packed)
            alone = partial(_alone, place, on_device, eyes[:many], at_once, packed)
            drawn = engine()
            score = min(psnr(picture, right) for picture, right in zip(drawn, expected))
            apart_by = int(np.abs(drawn.astype(int) - single[:many]).max())
            well &= score > ALIKE_DB and apart_by <= ALIKE
            place.peak_mb()
            by_engine = many * place.timed(engine)
            most = max(most, by_engine if many == RIG else 0.0)
            rates = f"{on_cpu:.1f} | {by_engine:.1f} | {many * place.timed(alone):.1f}"
            how = f"{at_once} | {'packed' if packed else 'dense'} | {score:.1f} | {apart_by}"
            print(f"| {width}x{height} | {many} | {how} | {rates} | {place.peak_mb()} |", flush=True)
        samples.append(f"{3600.0 * most / RIG / INSTANTS:,.0f} of {width}x{height}")
    print(f"\nSamples of {RIG} cameras at {INSTANTS} instants an hour, drawn by one worker: {', '.join(samples)}")
    return well


def samples(place: Place, n: int, sizes: Sequence[tuple[int, int]]) -> bool:
    """A sample's instants in as few calls as the engine makes and in one each, and its JPEGs, by the device where it
    makes them and by one thread of the host. Whether pictures are alike, and JPEGs those of the pictures."""
    print(
        "\nA sample of as many instants, with a vehicle that others lack at each second one; JPEGs of its pictures:\n"
    )
    print(
        "| size | calls | apart | samples/s | instant by instant | JPEGs by the host/s | by the device/s | PSNR [dB] |"
    )
    print("|---|---|---|---|---|---|---|---|")
    node = cloud(n // 50)
    asset, well = RenderAsset(np.zeros(3), cloud(n), {"a": node}, plain_sky(), float("nan")), True
    device = replace(place.drawing, encode=place.drawing.encode or (nvjpeg() if place.device == "cuda" else None))
    somebody = PlacedAgents(("a",), (AgentKind.VEHICLE,), np.array([[6.0, 0.0, 0.0, 0.0, 4.0, 2.0, 1.5]]))
    for width, height in sizes:
        k = np.array([[0.6 * width, 0.0, width / 2], [0.0, 0.6 * width, height / 2], [0.0, 0.0, 1.0]])
        cameras = [Pinhole(k, _shifted(0.1 * i), width, height) for i in range(RIG)]
        own = [SCENE_S_OWN] * RIG
        sample = [Instant(cameras, somebody if i % 2 else NOBODY, own) for i in range(INSTANTS)]
        nothing: list[OwnBody | None] = [None] * RIG
        together = partial(_sample, device, asset, [sample], nothing)
        apart = partial(_sample, device, asset, [[instant] for instant in sample], nothing)
        calls = len([*batches(asset, sample)])
        off = int(np.abs(together().astype(int) - apart()).max())
        shown = [*together().reshape(-1, height, width, 3)]
        host = [encode_jpeg(picture, QUALITY) for picture in shown]
        row = f"| {width}x{height} | {calls} | {off} | {place.timed(together):.1f} | {place.timed(apart):.1f}"
        row += f" | {len(shown) * place.timed(partial(_by_host, shown)):.0f}"
        well &= off <= ALIKE
        if device.encode is None:
            print(f"{row} | no torchvision | |", flush=True)
            continue
        made = partial(jpegs, device, asset, sample, nothing, QUALITY)
        there = [jpeg for of_instant in made() for jpeg in of_instant]
        score = min(psnr(_decoded(a), _decoded(b)) for a, b in zip(there, host, strict=True))
        well &= score > JPEGS_ALIKE_DB
        print(f"{row} | {len(shown) * place.timed(made):.0f}, drawn as well | {score:.1f} |", flush=True)
    return well


def _sample(
    device: Device, asset: RenderAsset, calls: Sequence[Sequence[Instant]], bodies: Sequence[OwnBody | None]
) -> Bytes:
    return np.stack([each for call in calls for each in pictures(device, asset, call, bodies)])


def _by_host(shown: Sequence[Bytes]) -> None:
    for picture in shown:
        encode_jpeg(picture, QUALITY)


def _decoded(jpeg: bytes) -> Bytes:
    return np.asarray(cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR), np.uint8)


def _by_engine(place: Place, asset: RenderAsset, cameras: Sequence[Pinhole], at_once: int, packed: bool) -> Bytes:
    return np.concatenate(
        [place.engine(asset, cameras[i : i + at_once], packed) for i in range(0, len(cameras), at_once)]
    )


def _alone(place: Place, scene: SceneTensors, eyes: Sequence[Eye], at_once: int, packed: bool) -> None:
    with torch.inference_mode():
        for i in range(0, len(eyes), at_once):
            place.plain(scene, eyes[i : i + at_once], packed)


def _shifted(x: float) -> NDArray[np.float64]:
    pose = np.eye(4)
    pose[0, 3] = x
    return pose


class Tee(io.TextIOBase):
    """Writes to the screen and to a page."""

    def __init__(self, *places: TextIO) -> None:
        self._places = places

    def write(self, text: str) -> int:
        """To both at once: what is long under way is seen."""
        for place in self._places:
            place.write(text)
            place.flush()
        return len(text)


def main(options: dict[str, str]) -> int:
    """The exit code; what is printed is written to a page as well."""
    page = Path(options.get("page", "gpu-check.txt"))
    with page.open("w") as kept, redirect_stdout(Tee(sys.stdout, kept)):
        code = checked(options)
    if code == 2:
        page.unlink()
    return code


def checked(options: dict[str, str]) -> int:
    """The exit code."""
    place, threads = ON_CPU, int(options.get("threads", os.cpu_count() or 1))
    n, iterations = int(options.get("gaussians", "100000")), int(options.get("iterations", "200"))
    width, height = int(options.get("width", "480")), int(options.get("height", "270"))
    if options.get("on", "cuda") == "cuda":
        try:
            _, gsplat = require()
        except BackendMissing as error:
            print(error, file=sys.stderr)
            return 2
        place, card = on_cuda(gsplat.rasterization), torch.cuda.get_device_properties(0)
        versions = f"torch {torch.__version__}, gsplat {gsplat.__version__}"
        print(f"{card.name}, {card.total_memory / 2**30:.0f} GB; {versions}")
    place = replace(place, least_s=float(options.get("seconds", "2")))
    began = time.perf_counter()
    settings = FitSettings(iterations=iterations, most_gaussians=int(1.2 * n), refine_every=50, refine_from=50)
    well = parity(place)
    well &= fits(place, *problem_of(n, width, height, threads), settings, threads)
    well &= views(place, n, ((width, height), (4 * width, 4 * height)), threads)
    well &= samples(place, n, ((width, height), (4 * width, 4 * height)))
    print(f"\n{'all agree' if well else 'NOT ALL AGREE'}; {time.perf_counter() - began:.0f} s")
    return 0 if well else 1


if __name__ == "__main__":
    sys.exit(main(dict(option.split("=", 1) for option in sys.argv[1:])))
