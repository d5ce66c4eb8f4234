"""A block's scene in words, and its parts as the files of other programs."""

import json
import re
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from factory.stages.scene_file import BadScene, described_by, read_scene, stored_dtype
from factory.views.scene_quality import camera_rows
from factory.views.splat_files import background_bytes, node_bytes
from tasks.render.scene.asset import RenderAsset
from tasks.render.scene.build import plain_sky
from tasks.render.splatting import sh
from tasks.render.splatting.formats import LoggedVehicle, SplatCheckpoint
from tasks.render.splatting.gaussians import Gaussians
from tasks.render.splatting.project import ANTIALIASED, CLASSIC, ScreenFilter


def info_text(path: Path, asset: RenderAsset) -> str:
    """What a scene holds, a few lines."""
    lines = [str(path), f"file        {stored_dtype(path)}, {path.stat().st_size / 1e6:.1f} MB"]
    lines += [f"digest      {asset.digest}", f"origin      {', '.join(f'{v:.2f}' for v in asset.origin)} m"]
    if (block := asset.block) is not None:
        x, y = (f"{low:.1f} .. {high:.1f}" for low, high in zip(block.low, block.high))
        lines.append(f"block       {block.dataset} {block.log_id}, {block.start_s:.1f} to {block.end_s:.1f} s")
        lines.append(f"sensors at  x {x}, y {y} m")
    lines.append(f"drawn       {_drawn(asset.screen)}")
    lines.append(f"background  {_counted(asset.background)}")
    lines += [f"node        {name}: {_counted(node)}" for name, node in asset.nodes.items()]
    held_out = f"{asset.psnr_db:.2f} dB over {asset.n_held_out} held-out photos"
    lines.append(f"psnr        {held_out if np.isfinite(asset.psnr_db) else 'not measured'}")
    lines += [f"camera      {row.camera}: {row.text}" for row in camera_rows(asset.views)]
    lines += [
        f"view        {view.camera} at {view.time_s:.2f} s: {view.psnr_db:.2f} dB, SSIM {view.ssim:.3f}"
        f"{', held out' if view.held_out else ''}"
        for view in asset.views
    ]
    return "\n".join([*lines, f"exposures   {len(asset.exposures)}"])


def export(
    asset: RenderAsset, folder: Path, suffix: str = ".ply", vehicles: Sequence[LoggedVehicle] = ()
) -> list[Path]:
    """Writes the parts into a folder, Gaussians as `suffix` says; returns their paths.

    vehicles: those that stand in the background's checkpoint as well, with their poses.
    Raises BadScene where a part cannot be written so.
    """
    folder.mkdir(parents=True, exist_ok=True)
    nodes = {f"node-{re.sub(r'[^A-Za-z0-9._-]', '_', name)}{suffix}": node for name, node in asset.nodes.items()}
    if len(nodes) < len(asset.nodes):
        raise BadScene(f"track ids {', '.join(asset.nodes)}: two of them make the same file name")
    street = partial(background_bytes, asset.background, suffix, asset.origin, asset.screen, vehicles)
    files = {f"background{suffix}": street}
    files |= {name: partial(node_bytes, node, suffix, asset.screen) for name, node in nodes.items()}
    for name, written in files.items():
        try:
            (folder / name).write_bytes(written())
        except ValueError as error:
            raise BadScene(f"{name}: {error}") from error
    sky = np.rint(np.clip(asset.sky.rgb, 0.0, 1.0) * 255.0).astype(np.uint8)
    (folder / "sky.png").write_bytes(cv2.imencode(".png", cv2.cvtColor(sky, cv2.COLOR_RGB2BGR))[1].tobytes())
    described = described_by(asset) | {"origin": asset.origin.tolist(), "digest": asset.digest, "files": list(files)}
    (folder / "scene.json").write_text(json.dumps(described, indent=1))
    return [folder / name for name in (*files, "sky.png", "scene.json")]


def imported(
    found: SplatCheckpoint, like: str | None = None, origin: str | None = None, antialiased: bool | None = None
) -> RenderAsset:
    """What a file holds as a scene of unknown quality. Raises BadScene or ValueError.

    like: the scene that origin, sky, range and, where the file has none, vehicles are of. origin: x,y,z [m] of the
    file's zero in the world; where the file says it, that must not be given. antialiased: how it was made to be drawn;
    None: as the file says, else as the other scene, else not so.
    """
    screen = found.screen if antialiased is None else (ANTIALIASED if antialiased else CLASSIC)
    if found.origin is not None and origin is not None:
        raise ValueError("origin=: the file itself says where it lies in the world")
    place = _place(origin or "0,0,0") if found.origin is None else found.origin
    if like is None:
        return RenderAsset(place, found.background, found.nodes, plain_sky(), float("nan"), screen=screen or CLASSIC)
    other = read_scene(Path(like))
    return replace(
        other,
        origin=other.origin if found.origin is None else found.origin,
        background=found.background,
        screen=screen or other.screen,
        nodes=found.nodes or other.nodes,
        psnr_db=float("nan"),
        n_held_out=0,
        digest="",
        views=(),
    )


def _place(text: str) -> np.ndarray:
    try:
        place = np.array([float(number) for number in text.split(",")])
    except ValueError as error:
        raise ValueError(f"origin={text}: {error}") from error
    if place.shape != (3,) or not np.isfinite(place).all():
        raise ValueError(f"origin={text}: expected x,y,z in metres")
    return place


def _drawn(screen: ScreenFilter) -> str:
    return f"{'antialiased' if screen.keeps_light else 'classic'}, {screen.dilation_px2:g} px2 wider"


def _counted(part: Gaussians) -> str:
    return f"{len(part)} Gaussians, SH degree {sh.COUNTS.index(part.sh_rest.shape[1])}"
