"""The Gaussian scene of a block of driving, built from its coloured points: lidar sweeps and photos with known poses.

Lidar gives each photo a sparse depth image, gaps are closed along surfaces, what lidar does not reach gets its depth
from neighbouring photos; every pixel becomes a disc, discs that others look through are dropped, the closest look at
each surface is kept, and the colours are refitted so that the photos come out. What lies in the box of a vehicle,
pedestrian or bicycle goes to that track's own Gaussians, in box coordinates.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from tasks.render.scene.asset import RenderAsset, ViewQuality, compose_gaussians, mean_psnr_db, psnr
from tasks.render.scene.body import with_body_depths
from tasks.render.scene.depth import SHALLOW, PhotoDepth, estimate_photo_depth, label_confirmed
from tasks.render.scene.engine import render
from tasks.render.scene.features import NOTHING_KNOWN, KnownPoints, SurfacePoints, points_without_lidar
from tasks.render.scene.movers import PlacedAgents, box_of_points, world_from_boxes
from tasks.render.scene.sensed import Photo, Sweep, Tracks, fuse_sweeps, shift_pose
from tasks.render.scene.sky import SkyMap, look_up_sky, pixel_directions, sky_cells, sky_of_views
from tasks.render.scene.stereo import FAR_M
from tasks.render.scene.surfels import (
    BACKGROUND,
    PhotoDiscs,
    choose_discs,
    count_free_space,
    discs_of_photo,
    discs_to_gaussians,
    with_mirror_image,
)
from tasks.render.settings import AssetSettings
from tasks.render.splatting.gaussians import EMPTY, Gaussians
from tasks.render.splatting.project import OF_DISCS
from tasks.render.splatting.raster import backproject, project_and_sort, shade
from tasks.world.arrays import F32, Array, Bools
from tasks.world.clip import AgentKind, AgentTracks, Pinhole, is_of_other_log

MIN_NODE_DISCS = 40  # a track seen less is drawn as a plain box
RELAXATION = 0.6
PRIOR_WEIGHT = 0.3  # weight (in pixels) that keeps barely visible Gaussians near their colour


def build_asset(
    photos: Sequence[Photo],
    sweeps: Sequence[Sweep],
    agents: AgentTracks | None,
    settings: AssetSettings,
    known: KnownPoints = NOTHING_KNOWN,
) -> RenderAsset:
    """The scene of one block. `agents`: 10 Hz tracks whose first step is time 0 of photos and sweeps.

    known: what is known without lidar; where there are sweeps these know better.
    Raises ValueError without photos: there is nothing to take colours from.
    """
    if not photos:
        raise ValueError("build_asset: no photos")
    origin = np.round(photos[0].world_from_camera[:3, 3])
    photos = [replace(p, world_from_camera=shift_pose(p.world_from_camera, -origin)) for p in photos]
    sweeps = [replace(s, world_from_ego=shift_pose(s.world_from_ego, -origin)) for s in sweeps]
    held_out = held_out_rows(photos, settings.hold_out_every)
    train = [p for i, p in enumerate(photos) if i not in held_out]
    tracks = Tracks(agents, origin)
    static, per_track = fuse_sweeps(sweeps, tracks)
    points = SurfacePoints(static) if sweeps else points_without_lidar(train, tracks, known.shifted(-origin))
    seen = [estimate_photo_depth(p, train, points, per_track, tracks, settings.stereo_photos) for p in train]
    if points.corners is not None:
        seen = label_confirmed(train, seen)
    if not sweeps:
        seen = with_body_depths(train, seen, tracks)
    background, nodes = build_surfaces(train, seen, tracks)
    sky = build_sky(train, seen)
    asset = RenderAsset(origin, background, nodes, sky, float("nan"), screen=OF_DISCS)
    asset = _refit_colours(asset, train, seen, tracks)
    if not held_out:
        return asset
    views = tuple(_measured(asset, photos[i], tracks) for i in sorted(held_out))
    return replace(asset, psnr_db=mean_psnr_db(views), n_held_out=len(views), views=views)


def held_out_rows(photos: Sequence[Photo], every: int) -> frozenset[int]:
    """Indices of the photos that only measure: of each camera every `every`-th, from the middle of the first on.

    Those of other logs' drives through the place all help: what is measured is the same with and without them.
    """
    if every == 0:
        return frozenset()
    count: dict[str, int] = {}
    out = set()
    for i, photo in enumerate(photos):
        at = count.get(photo.camera, 0)
        count[photo.camera] = at + 1
        if at % every == every // 2 and not is_of_other_log(photo.camera):
            out.add(i)
    return frozenset(out)


def build_surfaces(
    photos: Sequence[Photo], seen: Sequence[PhotoDepth], tracks: Tracks
) -> tuple[Gaussians, dict[str, Gaussians]]:
    """Discs of all photos, carved, dealt to background and tracks, the closest looks kept."""
    # Only what lidar or the sky says may carve: a guess must not drill holes.
    carvers = [np.where(s.sky, FAR_M, np.where(s.label == SHALLOW, 0.0, s.depth)).astype(np.float32) for s in seen]
    looks = []
    for photo, sight in zip(photos, seen):
        discs = discs_of_photo(photo.light, sight.depth, sight.label, photo.intrinsics, photo.world_from_camera)
        boxes, valid = tracks.at(photo.time_s)
        poses = world_from_boxes(boxes)
        owner = box_of_points(discs.points, boxes, valid)
        at = (discs.pixels[:, 0], discs.pixels[:, 1])
        label, guessed = sight.label[at], sight.label[at] == SHALLOW
        street = (owner < 0) & (label < 0) & ~sight.passing[at]
        street[street] = _confirmed_by_photos(discs.points[street], guessed[street], photos, carvers)
        keep = np.flatnonzero(street | (owner >= 0))
        looks.append(
            PhotoDiscs(
                discs.take(keep),
                owner[keep],
                guessed[keep],
                sight.depth,
                photo.intrinsics,
                photo.world_from_camera,
                {int(j): poses[j] for j in np.flatnonzero(valid)},
            )
        )
    kept = choose_discs(looks)
    nodes = {}
    for j, discs in kept.items():
        if j == BACKGROUND or len(discs.points) < MIN_NODE_DISCS:
            continue
        whole = with_mirror_image(discs) if tracks.kinds[j] == AgentKind.VEHICLE else discs
        nodes[tracks.ids[j]] = discs_to_gaussians(whole)
    return discs_to_gaussians(kept[BACKGROUND]) if BACKGROUND in kept else EMPTY, nodes


def _confirmed_by_photos(points: Array, guessed: Bools, photos: Sequence[Photo], carvers: Sequence[F32]) -> Bools:
    """Which points (M, 3) not more photos look through than see; one that lidar saw is lost to two at least."""
    in_front, agreeing = np.zeros(len(points), np.int32), np.zeros(len(points), np.int32)
    for photo, depth in zip(photos, carvers):
        camera_from_world = np.ascontiguousarray(np.linalg.inv(photo.world_from_camera))
        count_free_space(points, camera_from_world, photo.intrinsics, depth, in_front, agreeing)
    return np.asarray((in_front <= agreeing) | ((in_front < 2) & ~guessed))


def build_sky(photos: Sequence[Photo], seen: Sequence[PhotoDepth]) -> SkyMap:
    """What the photos show of the sky."""

    def views() -> Iterator[tuple[Array, F32, Bools]]:  # one at a time: together they are 0.1 GB and more
        for photo, sight in zip(photos, seen):
            height, width = sight.depth.shape
            use = ~sight.passing
            rays = pixel_directions(photo.intrinsics, photo.world_from_camera, width, height)[use]
            yield rays, photo.light[use], sight.sky[use]

    return sky_of_views(views())


def _present_tracks(asset: RenderAsset, tracks: Tracks, time_s: float) -> tuple[list[int], Array]:
    """Tracks that are there at a time, and all boxes in the world."""
    boxes, valid = tracks.at(time_s)
    boxes = boxes + np.concatenate([asset.origin, np.zeros(4)])
    return [int(j) for j in np.flatnonzero(valid)], boxes


def _picture(asset: RenderAsset, photo: Photo, tracks: Tracks) -> F32:
    """The rendering of a photo (pose local) as the scene was at its time."""
    rows, boxes = _present_tracks(asset, tracks, photo.time_s)
    present = PlacedAgents(tuple(tracks.ids[j] for j in rows), tuple(tracks.kinds[j] for j in rows), boxes[rows])
    height, width = photo.rgb.shape[:2]
    camera = Pinhole(photo.intrinsics, shift_pose(photo.world_from_camera, asset.origin), width, height)
    return render(asset, [camera], present)[0].rgb


def _measured(asset: RenderAsset, photo: Photo, tracks: Tracks) -> ViewQuality:
    of = psnr(photo.rgb.astype(np.float32) / np.float32(255.0), _picture(asset, photo, tracks))
    return ViewQuality(photo.camera, photo.time_s, of, float("nan"), held_out=True)


def _refit_colours(
    asset: RenderAsset, photos: Sequence[Photo], seen: Sequence[PhotoDepth], tracks: Tracks
) -> RenderAsset:
    """The same scene with colours that make the photos come out: one sweep of SART over the blending weights.

    With fixed geometry a picture is linear in the Gaussians' colours. Each photo's residual is carried back with the
    weights it was blended with and divided by their sum (Andersen and Kak 1984), photo after photo in a fixed order.
    A second sweep gains 0.02 to 0.08 dB for a third of the time.
    """
    parts = [asset.background, *asset.nodes.values()]
    starts = np.concatenate([[0], np.cumsum([len(p) for p in parts])])
    place = {name: k + 1 for k, name in enumerate(asset.nodes)}
    colours = np.concatenate([p.colours for p in parts])
    for photo, sight in zip(photos, seen):
        height, width = photo.rgb.shape[:2]
        camera = photo.intrinsics, photo.world_from_camera, width, height
        there, boxes = _present_tracks(asset, tracks, photo.time_s)
        there = [j for j in there if tracks.ids[j] in place]
        ids = [tracks.ids[j] for j in there]
        splats = project_and_sort(
            compose_gaussians(asset, ids, [AgentKind.VEHICLE] * len(ids), boxes[there]), *camera, screen=asset.screen
        )
        spans = [0, *(place[name] for name in ids)]
        rows = np.concatenate([np.arange(starts[k], starts[k + 1]) for k in spans])[splats.index]
        drawn = shade(splats, colours[rows], look_up_sky(asset.sky.cells, sky_cells(*camera))).rgb
        # The background must not learn the colour of a car that drives by.
        residual = photo.rgb.astype(np.float32) / 255.0 - drawn
        sums, weights = backproject(splats, residual, sight.passing, len(asset.background))
        step = RELAXATION * sums / (weights + PRIOR_WEIGHT)[:, None]
        colours[rows] = np.clip(colours[rows] + step, 0.0, 1.0)
    fitted = [replace(p, colours=colours[starts[k] : starts[k + 1]]) for k, p in enumerate(parts)]
    return replace(asset, background=fitted[0], nodes=dict(zip(asset.nodes, fitted[1:])))
