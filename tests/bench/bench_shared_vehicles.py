"""Would blocks gain by each other's vehicles? `python -m tests.bench.bench_shared_vehicles [logs=0,1]`

A log of the synthetic town is cut into two blocks, its first and its second half, each fitted to its own photos and
lidar. Vehicles that both know are then drawn in either block as it fitted them itself, as the other block did, as
itself with the sides that none of its photos shows taken from the other, and as one fit to the photos of both has
them, for which it has twice the iterations: no way to share can do better. The street is that of the block. All are
held against the painter inside those vehicles' boxes: from held-out photos' poses, from 2 m to either side, and with
every vehicle put 3 m ahead and 0.8 m to the left.
Other options: iterations=600 width=240 height=136 threads=2 out=out/bench_town and the settings of `FitSettings`.
"""

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np

from factory.readers.av2.reader import AV2Reader
from factory.readers.settings import TownSettings
from factory.readers.town.draw import Theatre
from factory.readers.town.town import log_name, plan_log
from factory.readers.town.write import write_log
from factory.stages.sensors import SensorData, block_of, load_sensors
from tasks.render.fit.reconstruct import reconstruct
from tasks.render.fit.settings import FitSettings
from tasks.render.scene.asset import RenderAsset, psnr
from tasks.render.scene.build import held_out_rows
from tasks.render.scene.engine import Vehicles, render, vehicles_at
from tasks.render.scene.movers import behind_boxes
from tasks.render.scene.sensed import Photo
from tasks.render.scene.sky import directions
from tasks.render.scene.stereo import FAR_M
from tasks.render.splatting.gaussians import Gaussians, concatenate
from tasks.world.agents import AgentKind, AgentTracks
from tasks.world.arrays import F32, Array, Bools, Indices
from tasks.world.camera import Pinhole
from tests.bench.bench_town import CENTRE, SETTINGS, painter, with_moved_vehicles
from tests.bench.stored_scene import kept
from tests.bench.town_truth import IN_THE_WAY_M, LEAST_PIXELS, NEAR_M, Painter, moved_on, sideways

FACES = ("front", "rear", "left", "right", "top", "bottom")
SHOWN = 3  # photos that a side has to be seen in
ASIDE_M = 2.0
WAYS = ("its own", "the other block's", "its own, unseen sides the other's", "of all photos")
Nodes = Mapping[str, Gaussians]


@dataclass(frozen=True)
class Look:
    """A view of shared vehicles."""

    photo: Photo  # camera, time, pose
    there: Vehicles
    inside: Bools  # (H, W) the vehicles' boxes
    truth: F32  # (H, W, 3)


def faces_seen(photos: Sequence[Photo], agents: AgentTracks, track_id: str) -> set[int]:
    """Sides of a track's box (FACES) that SHOWN photos or more have before them within NEAR_M; what hides them is not
    asked."""
    counts = np.zeros(len(FACES), int)
    for photo in photos:
        there = vehicles_at(agents, photo.time_s)
        if track_id not in there.track_ids:
            continue
        x, y, z, heading, length, width, height = there.boxes[there.track_ids.index(track_id)]
        place = np.linalg.inv(photo.world_from_camera) @ [x, y, z, 1.0]
        u, v = (photo.intrinsics @ place[:3])[:2] / max(place[2], 1e-6)
        rows, columns = photo.rgb.shape[:2]
        if not (0.0 < place[2] < NEAR_M and 0.0 <= u < columns and 0.0 <= v < rows):
            continue
        dx, dy, dz = photo.world_from_camera[:3, 3] - [x, y, z]
        c, s = np.cos(heading), np.sin(heading)
        along, across = (c * dx + s * dy) / (length / 2), (c * dy - s * dx) / (width / 2)
        counts += np.array([along, -along, across, -across, dz / (height / 2), -dz / (height / 2)]) > 1.0
    return {int(face) for face in np.flatnonzero(counts >= SHOWN)}


def face_of(node: Gaussians, size: Array) -> Indices:
    """(N,) the side of a box of `size` (3,) that each Gaussian lies towards."""
    share = node.means / (size / 2.0)
    return np.argmax(np.stack([share, -share], axis=2).reshape(-1, len(FACES)), axis=1)


def filled(own: Gaussians, other: Gaussians, size: Array, from_other: set[int]) -> Gaussians:
    """One's own vehicle, with the other's on these sides."""
    mine, theirs = (np.isin(face_of(node, size), sorted(from_other)) for node in (own, other))
    return concatenate([own.take(~mine), other.take(theirs)])


def part_of(data: SensorData, first_s: float, end_s: float) -> SensorData:
    """What was sensed between two times."""
    photos = tuple(photo for photo in data.photos if first_s <= photo.time_s < end_s)
    return replace(data, photos=photos, sweeps=tuple(sweep for sweep in data.sweeps if first_s <= sweep.time_s < end_s))


def looks(
    photos: Sequence[Photo], agents: AgentTracks, shared: Sequence[str], paint: Painter, moved: bool = False
) -> list[Look]:
    """Those of the photos' views that show enough of the shared vehicles, from nobody's inside."""
    found = []
    for photo in photos:
        there = vehicles_at(agents, photo.time_s)
        boxes = moved_on(there.boxes, there.kinds) if moved else there.boxes
        eye = photo.world_from_camera[:3, 3]
        off = eye - boxes[:, :3]
        along = np.abs(np.cos(boxes[:, 3]) * off[:, 0] + np.sin(boxes[:, 3]) * off[:, 1]) - boxes[:, 4] / 2
        across = np.abs(np.cos(boxes[:, 3]) * off[:, 1] - np.sin(boxes[:, 3]) * off[:, 0]) - boxes[:, 5] / 2
        if (np.maximum(along, across) < IN_THE_WAY_M).any():
            continue
        ours = np.array([name in shared for name in there.track_ids]) & (np.linalg.norm(off, axis=1) < NEAR_M)
        height, width = photo.rgb.shape[:2]
        rays = directions(photo.intrinsics, photo.world_from_camera, width, height).reshape(-1, 3)
        inside = np.asarray(behind_boxes(rays * FAR_M + eye, eye, boxes[ours])).reshape(height, width)
        if inside.sum() >= LEAST_PIXELS:
            truth = paint(photo.time_s, photo).astype(np.float32) / np.float32(255.0)
            found.append(Look(photo, replace(there, boxes=boxes), inside, truth))
    return found


def score(asset: RenderAsset, views: Sequence[Look], threads: int) -> float:
    """Mean PSNR [dB] inside the boxes."""
    found = []
    for view in views:
        photo, (height, width) = view.photo, view.inside.shape
        eye = Pinhole(photo.intrinsics, photo.world_from_camera, width, height)
        affines = [asset.affine_of(photo.camera, photo.time_s)]
        picture = render(asset, [eye], view.there, threads=threads, affines=affines)[0].rgb
        found.append(psnr(picture[view.inside], view.truth[view.inside]))
    return float(np.mean(found)) if found else float("nan")


def of_log(log: int, width: int, height: int, threads: int, out: Path, settings: FitSettings) -> list[list[float]]:
    """Prints a log's table; its numbers, way by view, one after the other block."""
    town, drive = plan_log(0, log)
    root = out / f"log{log}-{width}x{height}"
    if not root.exists():
        sensors = TownSettings(width=width, height=height, steps_per_photo=1)
        write_log(root / log_name(0, log), town, drive, sensors, log)
    reader = AV2Reader(root, name="synthetic")
    clip = reader.read(reader.index().refs[0])
    block = block_of(clip)
    agents, data = block.agents, load_sensors(block, clip.cameras, width, height)
    middle = max(photo.time_s for photo in data.photos) / 2.0
    parts = [part_of(data, -1.0, middle), part_of(data, middle, np.inf)]
    halves = [kept(reconstruct(part.photos, part.sweeps, agents, settings, threads=threads)) for part in parts]
    twice = replace(settings, iterations=2 * settings.iterations)
    kept_out = [held_out(part, settings) for part in parts]
    taken = {(photo.camera, photo.time_s) for photos in kept_out for photo in photos}
    rows = [i for i, photo in enumerate(data.photos) if (photo.camera, photo.time_s) in taken]
    whole = kept(reconstruct(data.photos, data.sweeps, agents, twice, held_out=rows, threads=threads))
    kinds = dict(zip(agents.track_ids, agents.kinds))
    shared = [n for n in halves[0].nodes if n in halves[1].nodes and kinds[n] is AgentKind.VEHICLE]
    seen = [{name: faces_seen(part.photos, agents, name) for name in shared} for part in parts]
    sizes = {name: size_of(agents, name) for name in shared}
    sun = (town.sun_azimuth, town.sun_elevation, town.sky_seed)
    still = painter(Theatre(town.scenery, drive, *sun))
    put = painter(Theatre(town.scenery, with_moved_vehicles(drive), *sun))

    tables = []
    for k, (half, other) in enumerate(zip(halves, halves[::-1])):
        new = {name: seen[1 - k][name] - seen[k][name] for name in shared}
        sides = f"{sum(map(len, new.values()))} sides of {sum(map(bool, new.values()))}"
        told = f"{len(shared)} shared vehicles, {sides} seen in the other half alone"
        print(f"\nlog {log}, half {k + 1}: {told}", flush=True)
        mixed = {name: filled(half.nodes[name], other.nodes[name], sizes[name], new[name]) for name in shared}
        nodes: list[Nodes] = [{}, {n: other.nodes[n] for n in shared}, mixed, {n: whole.nodes[n] for n in shared}]
        photos = kept_out[k]
        ahead = {photo.time_s: photo for photo in photos if photo.camera == CENTRE}
        views = [looks(photos, agents, shared, still)]
        for left_m in (ASIDE_M, -ASIDE_M):
            views.append(looks([sideways(p, ahead[p.time_s], left_m) for p in photos], agents, shared, still))
        views.append(looks(photos, agents, shared, put, True))
        scores = [[score(replace(half, nodes={**half.nodes, **n}), v, threads) for v in views] for n in nodes]
        print_table(scores, [len(v) for v in views])
        tables.append(scores)
    return tables


def held_out(data: SensorData, settings: FitSettings) -> list[Photo]:
    """The photos that a fit of all of it only measures."""
    return [data.photos[i] for i in sorted(held_out_rows(data.photos, settings.hold_out_every))]


def size_of(agents: AgentTracks, track_id: str) -> Array:
    """(3,) of its box [m]."""
    j = agents.track_ids.index(track_id)
    return np.append(agents.boxes[np.argmax(agents.valid[:, j]), j, 3:5], agents.heights[j])


def print_table(rows: Sequence[Sequence[float]], counts: Sequence[int] = ()) -> None:
    """A line for each way."""
    print("| vehicles | held out [dB] | 2 m to the left | 2 m to the right | moved |\n|---|---|---|---|---|")
    for way, row in zip(WAYS, rows):
        print(f"| {way} | " + " | ".join(f"{value:.2f}" for value in row) + " |")
    if counts:
        print("| views | " + " | ".join(map(str, counts)) + " |", flush=True)


def main() -> None:
    """Prints a table for each half of each log, and their mean."""
    options = dict(option.split("=", 1) for option in sys.argv[1:])
    logs = [int(log) for log in options.pop("logs", "0,1").split(",")]
    width, height = int(options.pop("width", "240")), int(options.pop("height", "136"))
    threads, out = int(options.pop("threads", "2")), Path(options.pop("out", "out/bench_town"))
    given = {"iterations": "600", "start_node_gaussians": "3000", "opaque_weight": "0"} | options
    kinds = {field.name: type(getattr(SETTINGS, field.name)) for field in fields(FitSettings)}
    settings = replace(SETTINGS, **{k: kinds[k](float(v)) for k, v in given.items()})
    tables = [table for log in logs for table in of_log(log, width, height, threads, out, settings)]
    print(f"\nmean of {len(tables)} halves")
    print_table(np.nanmean(tables, axis=0).tolist())


if __name__ == "__main__":
    main()
