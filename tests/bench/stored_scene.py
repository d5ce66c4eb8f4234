"""What it costs to keep a scene in 16 bits: file, time to read it, and pictures beside those of the scene in 32.

Printed by the benches that fit a scene (`bench_town`, `bench_kitti`), on the photos held out.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from factory.stages.scene_file import read_scene, write_scene
from tasks.render.scene.asset import RenderAsset, psnr
from tasks.render.scene.engine import render
from tasks.render.scene.movers import NOBODY, PlacedAgents
from tasks.render.settings import RenderSettings, SceneDtype
from tasks.world.arrays import F32, Bytes
from tasks.world.clip import Pinhole
from tests.bench.timing import cpu_milliseconds

READS = 5


@dataclass(frozen=True)
class Look:
    """A photo, and how the scene is drawn beside it."""

    camera: str
    time_s: float
    eye: Pinhole  # world
    photo: Bytes  # (H, W, 3)
    there: PlacedAgents = NOBODY


def kept(asset: RenderAsset) -> RenderAsset:
    """The scene as a run's workers read it."""
    with TemporaryDirectory() as folder:
        path = Path(folder, "block.safetensors")
        write_scene(path, asset, RenderSettings().scene_dtype)
        return read_scene(path)


def affine_between(source: F32, target: F32) -> F32:
    """An exposure's row (12,) that takes colours `source` (M, 3) closest to `target` (M, 3).

    Least squares with a small pull towards the identity.
    """
    padded = np.column_stack([source, np.ones(len(source))]).astype(np.float64)
    keep = 1e-3 * len(source) * np.eye(4)
    off = np.linalg.solve(padded.T @ padded + keep, padded.T @ (np.asarray(target, np.float64) - source))
    return np.concatenate([off[:3].T.ravel(), off[3]]).astype(np.float32)


def storage_table(asset: RenderAsset, looks: Sequence[Look], threads: int) -> str:
    """A row for each dtype of a scene's file: MB, CPU ms to read it, pictures against those of the scene in memory (of
    floats, the mean and the worst, and of 8 bits), and against the photos [dB]."""
    lines = [
        "| scene in | MB | CPU ms to read | apart [dB] | worst | apart in 8 bits [dB] | against photos [dB] |",
        "|---|---|---|---|---|---|---|",
    ]
    whole = _pictures(asset, looks, threads)
    with TemporaryDirectory() as folder:
        for dtype in SceneDtype:
            path = Path(folder, dtype)
            write_scene(path, asset, dtype)
            drawn = _pictures(read_scene(path), looks, threads)
            apart = [psnr(a, b) for a, b in zip(drawn, whole)]
            in_bytes = [psnr(_in_bytes(a), _in_bytes(b)) for a, b in zip(drawn, whole)]
            photos = [psnr(a, look.photo.astype(np.float32) / 255.0) for a, look in zip(drawn, looks)]
            took = cpu_milliseconds(lambda path=path: read_scene(path), READS)  # type: ignore[misc]
            lines.append(
                f"| {dtype} | {path.stat().st_size / 1e6:.2f} | {took:.0f} | {np.mean(apart):.1f} | {min(apart):.1f} | "
                f"{np.mean(in_bytes):.1f} | {np.mean(photos):.3f} |"
            )
    return "\n".join(lines)


def _pictures(asset: RenderAsset, looks: Sequence[Look], threads: int) -> list[F32]:
    return [
        render(asset, [at.eye], at.there, threads=threads, affines=[asset.affine_of(at.camera, at.time_s)])[0].rgb
        for at in looks
    ]


def _in_bytes(picture: F32) -> Bytes:
    return np.rint(255.0 * picture).astype(np.uint8)
