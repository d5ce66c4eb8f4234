"""The Gaussian scene of a block of driving, built from its coloured points: lidar sweeps and photos with known poses.

Lidar gives each photo a sparse depth image, gaps are closed along surfaces, what lidar does not reach gets its depth
from neighbouring photos; every pixel becomes a disc, discs that others look through are dropped, the closest look at
each surface is kept, and the colours are refitted so that the photos come out. What lies in the box of a vehicle,
pedestrian or bicycle goes to that track's own Gaussians, in box coordinates.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tasks.render.boxes import box_gaussians
from tasks.render.choose import BACKGROUND, Look, choose, count_free_space, with_mirror_image
from tasks.render.depth import dense_depth, sparse_depth
from tasks.render.gaussians import EMPTY, F32, F64, Gaussians, concatenate, moved
from tasks.render.movers import GROUND_CLEARANCE_M, behind_boxes, boxes_at, driving, owners, world_from_boxes
from tasks.render.raster import rasterize
from tasks.render.refit import FitPhoto, refit_colours
from tasks.render.sky import SkyCollector, SkyMap, directions
from tasks.render.stereo import FAR_M, MAX_BASELINE_M, MIN_BASELINE_M, sweep_depth
from tasks.render.surfels import discs_of_photo, gaussians_of
from tasks.world.agents import MOVING_KINDS, AgentKind, AgentTracks
from tasks.world.vehicle import PACIFICA

MIN_NODE_DISCS = 40  # a track seen less is drawn as a plain box
EGO_MARGIN_M = 0.3
FUSED_VOXEL_M = 0.07
SHALLOW = -2  # label of a pixel without lidar


@dataclass(frozen=True)
class Photo:
    """An image without distortion and where it was taken."""

    camera: str
    time_s: float  # since the clip's first step
    rgb: NDArray[np.uint8]  # (H, W, 3)
    intrinsics: F64  # (3, 3) pixels, the centre of pixel (0, 0) at (0.5, 0.5)
    world_from_camera: F64  # (4, 4)


@dataclass(frozen=True)
class Sweep:
    """One turn of the lidar."""

    time_s: float
    points: F32  # (M, 3) ego frame [m]
    world_from_ego: F64  # (4, 4)


@dataclass(frozen=True)
class AssetSettings:
    """How a scene is built. Pixels are those of the photos handed in."""

    max_gap_px: tuple[int, int] = (12, 24)  # columns, rows that are interpolated between lidar returns
    refit_sweeps: int = 1  # a second one gains 0.02 .. 0.08 dB for a third of the time
    hold_out_every: int = 8  # photo i of a camera with i % n == n // 2 only measures; 0: none is held out
    stereo_photos: int = 4  # neighbours compared where lidar does not reach


@dataclass(frozen=True)
class RenderAsset:
    """A block's scene. World coordinates minus `origin` everywhere, so that float32 is exact to less than a mm."""

    origin: F64  # (3,) world [m]
    background: Gaussians
    nodes: Mapping[str, Gaussians]  # track id -> Gaussians in box coordinates (centre; x along the heading)
    sky: SkyMap
    psnr_db: float  # of the photos held out against their rendering; NaN when none was
    n_held_out: int = 0
    digest: str = ""  # of all of the above; filled by whoever stores the scene


def psnr(a: NDArray[np.generic], b: NDArray[np.generic]) -> float:
    """Peak signal-to-noise ratio [dB] of two images of the same type: uint8 (peak 255) or float (peak 1)."""
    peak = 255.0 if a.dtype == np.uint8 else 1.0
    error = float(np.mean((a.astype(np.float64) - b.astype(np.float64)) ** 2))
    return float("inf") if error == 0.0 else 10.0 * float(np.log10(peak**2 / error))


def scene_at(asset: RenderAsset, track_ids: Sequence[str], kinds: Sequence[AgentKind], boxes: F64) -> Gaussians:
    """Background and the named tracks at `boxes` (N, 7) x, y, z, heading, length, width, height in the world.

    A track without Gaussians of its own is a plain shaded box: nobody is invisible.
    """
    local = boxes - np.concatenate([asset.origin, np.zeros(4)])
    poses = world_from_boxes(local)
    parts = [asset.background]
    for j, track_id in enumerate(track_ids):
        node = asset.nodes.get(track_id)
        if node is None:
            node = box_gaussians(boxes[j, 4:7], kinds[j])
        parts.append(moved(node, poses[j]))
    return concatenate(parts)


def render_photo(
    asset: RenderAsset, scene: Gaussians, intrinsics: F64, world_from_camera: F64, size: tuple[int, int]
) -> F32:
    """(H, W, 3) rgb in [0, 1] of a composed scene; `size` width, height."""
    local = shifted(world_from_camera, -asset.origin)
    backdrop = asset.sky.seen_by(intrinsics, local, *size)
    return np.clip(rasterize(scene, intrinsics, local, *size, backdrop).rgb, 0.0, 1.0)


def shifted(pose: F64, by: F64) -> F64:
    """A pose (4, 4) moved by (3,)."""
    out = pose.copy()
    out[:3, 3] += by
    return out


def build_asset(
    photos: Sequence[Photo], sweeps: Sequence[Sweep], agents: AgentTracks | None, settings: AssetSettings
) -> RenderAsset:
    """The scene of one block. `agents`: 10 Hz tracks whose first step is time 0 of photos and sweeps.

    Raises ValueError without photos: there is nothing to take colours from.
    """
    if not photos:
        raise ValueError("build_asset: no photos")
    origin = np.round(photos[0].world_from_camera[:3, 3])
    photos = [replace(p, world_from_camera=shifted(p.world_from_camera, -origin)) for p in photos]
    sweeps = [replace(s, world_from_ego=shifted(s.world_from_ego, -origin)) for s in sweeps]
    held_out = _held_out(photos, settings.hold_out_every)
    train = [p for i, p in enumerate(photos) if i not in held_out]
    tracks = _Tracks(agents, origin)
    static, per_track = _fuse(sweeps, tracks)
    seen = [_see(p, train, static, per_track, tracks, settings) for p in train]
    background, nodes = _discs(train, seen, tracks)
    sky = _sky(train, seen)
    asset = RenderAsset(origin, background, nodes, sky, float("nan"))
    asset = _refit(asset, train, seen, tracks, settings.refit_sweeps)
    if not held_out:
        return asset
    scores = [
        psnr(photos[i].rgb.astype(np.float32) / 255.0, _picture(asset, photos[i], tracks)) for i in sorted(held_out)
    ]
    return replace(asset, psnr_db=float(np.mean(scores)), n_held_out=len(scores))


def _held_out(photos: Sequence[Photo], every: int) -> frozenset[int]:
    if every == 0:
        return frozenset()
    count: dict[str, int] = {}
    out = set()
    for i, photo in enumerate(photos):
        at = count.get(photo.camera, 0)
        count[photo.camera] = at + 1
        if at % every == every // 2:
            out.add(i)
    return frozenset(out)


class _Tracks:
    """The movable tracks of a block, in its local frame."""

    def __init__(self, agents: AgentTracks | None, origin: F64) -> None:
        self._agents, self._origin = agents, origin
        self.ids = agents.track_ids if agents is not None else ()
        self.kinds = agents.kinds if agents is not None else ()
        self.driving = driving(agents) if agents is not None else np.zeros(0, bool)
        self._movable = np.array([kind in MOVING_KINDS for kind in self.kinds], bool)

    def at(self, time_s: float) -> tuple[F64, NDArray[np.bool_]]:
        """Boxes (N, 7) local, and which of them are there and movable (N,)."""
        if self._agents is None:
            return np.zeros((0, 7)), np.zeros(0, bool)
        boxes, valid = boxes_at(self._agents, time_s)
        boxes[:, :3] -= self._origin
        return boxes, valid & self._movable


def _fuse(sweeps: Sequence[Sweep], tracks: _Tracks) -> tuple[F64, dict[int, F64]]:
    """Lidar points that stay (M, 3) local, and those of each track in its box's frame; both thinned by voxels."""
    static, moving = [np.zeros((0, 3))], dict[int, list[F64]]()
    for sweep in sweeps:
        outside = sweep.points[~_on_ego(sweep.points)]
        points = outside.astype(np.float64) @ sweep.world_from_ego[:3, :3].T + sweep.world_from_ego[:3, 3]
        boxes, valid = tracks.at(sweep.time_s)
        owner = owners(points, boxes, valid)
        static.append(_voxels(points[owner < 0]))
        poses = world_from_boxes(boxes)
        for j in np.unique(owner[owner >= 0]):
            mine = points[owner == j]
            moving.setdefault(int(j), []).append((mine - poses[j, :3, 3]) @ poses[j, :3, :3])
    return _voxels(np.concatenate(static)), {j: _voxels(np.concatenate(parts)) for j, parts in sorted(moving.items())}


def _on_ego(points: F32) -> NDArray[np.bool_]:
    """Returns from the ego's own body (M,): left in, they would hang over the road as a trail."""
    x, y = points[:, 0], points[:, 1]
    along = (x > -PACIFICA.rear_length - EGO_MARGIN_M) & (x < PACIFICA.front_length + EGO_MARGIN_M)
    return np.asarray(along & (np.abs(y) < PACIFICA.half_width + EGO_MARGIN_M) & (points[:, 2] > GROUND_CLEARANCE_M))


def _voxels(points: F64) -> F64:
    """The first point of every voxel."""
    if not len(points):
        return points
    cells = np.floor((points - points.min(axis=0)) / FUSED_VOXEL_M).astype(np.int64)
    _, first = np.unique((cells[:, 0] << 40) | (cells[:, 1] << 20) | cells[:, 2], return_index=True)
    return points[np.sort(first)]


@dataclass(frozen=True)
class _Seen:
    """What a photo shows, (H, W) each."""

    depth: F32  # [m]; 0: nothing known
    label: NDArray[np.int32]  # -1 background, row of a track, SHALLOW
    sky: NDArray[np.bool_]
    passing: NDArray[np.bool_]  # pixels at or behind something that drives: no witnesses of the street


def _see(
    photo: Photo,
    others: Sequence[Photo],
    static: F64,
    per_track: dict[int, F64],
    tracks: _Tracks,
    settings: AssetSettings,
) -> _Seen:
    height, width = photo.rgb.shape[:2]
    rgb = photo.rgb.astype(np.float32) / 255.0
    boxes, valid = tracks.at(photo.time_s)
    poses = world_from_boxes(boxes)
    points, labels = [static], [np.full(len(static), -1, np.int32)]
    for j, mine in per_track.items():
        if valid[j]:
            points.append(mine @ poses[j, :3, :3].T + poses[j, :3, 3])
            labels.append(np.full(len(mine), j, np.int32))
    sparse, label = sparse_depth(
        np.concatenate(points), np.concatenate(labels), photo.intrinsics, photo.world_from_camera, width, height
    )
    depth, label = dense_depth(sparse, label, rgb, settings.max_gap_px)
    unknown = depth == 0.0
    bright = _looks_like_sky(rgb)
    neighbours = _neighbours(photo, others, settings.stereo_photos)
    hints = _hints(depth)
    if neighbours:
        guess, cost, sky_cost = sweep_depth(rgb, hints, neighbours, photo.intrinsics, photo.world_from_camera, unknown)
        sky = unknown & ((bright & (sky_cost < 1.3 * cost + 0.03)) | (guess >= FAR_M))
    else:
        guess, sky = hints[0], unknown & (bright | (hints[0] == 0.0))
    depth = np.where(unknown & ~sky, guess, depth).astype(np.float32)
    seen_to = (
        directions(photo.intrinsics, photo.world_from_camera, width, height)
        * np.where(depth > 0, depth, FAR_M)[..., None]
    )
    eye = photo.world_from_camera[:3, 3]
    passing = behind_boxes(seen_to.reshape(-1, 3) + eye, eye, boxes[valid & tracks.driving]).reshape(height, width)
    return _Seen(depth, label, sky, passing)


def _looks_like_sky(rgb: F32) -> NDArray[np.bool_]:
    brightness = rgb.mean(axis=-1)
    return np.asarray((brightness > 0.6) | ((rgb[..., 2] > rgb[..., 0] + 0.04) & (brightness > 0.4)))


def _hints(depth: F32) -> F32:
    """(3, H, W) depths of the nearest known pixel below, to the left and to the right; 0 where there is none.

    A facade or a tree goes on above the last lidar return with the depth of that return.
    """
    height, width = depth.shape
    rows, columns = np.arange(height)[:, None], np.arange(width)[None, :]
    known = depth > 0
    below = np.minimum.accumulate(np.where(known, rows, height)[::-1], axis=0)[::-1]
    left = np.maximum.accumulate(np.where(known, columns, -1), axis=1)
    right = np.minimum.accumulate(np.where(known, columns, width)[:, ::-1], axis=1)[:, ::-1]
    return np.stack(
        [
            np.where(below < height, depth[np.minimum(below, height - 1), columns], 0.0),
            np.where(left >= 0, depth[rows, np.maximum(left, 0)], 0.0),
            np.where(right < width, depth[rows, np.minimum(right, width - 1)], 0.0),
        ]
    ).astype(np.float32)


def _neighbours(photo: Photo, others: Sequence[Photo], n: int) -> list[tuple[F32, F64, F64]]:
    """The n photos whose baseline is closest to 1 m and that look the same way."""
    candidates = []
    for i, other in enumerate(others):
        baseline = float(np.linalg.norm(other.world_from_camera[:3, 3] - photo.world_from_camera[:3, 3]))
        same_way = float(other.world_from_camera[:3, 2] @ photo.world_from_camera[:3, 2]) > 0.9
        if MIN_BASELINE_M <= baseline <= MAX_BASELINE_M and same_way and other.rgb.shape == photo.rgb.shape:
            candidates.append((abs(np.log(baseline)), i))
    best = [others[i] for _, i in sorted(candidates)[:n]]
    return [(o.rgb.astype(np.float32) / 255.0, o.intrinsics, o.world_from_camera) for o in best]


def _discs(photos: Sequence[Photo], seen: Sequence[_Seen], tracks: _Tracks) -> tuple[Gaussians, dict[str, Gaussians]]:
    """Discs of all photos, carved, dealt to background and tracks, the closest looks kept."""
    # Only what lidar or the sky says may carve: a guess must not drill holes.
    carvers = [np.where(s.sky, FAR_M, np.where(s.label == SHALLOW, 0.0, s.depth)).astype(np.float32) for s in seen]
    looks = []
    for photo, sight in zip(photos, seen):
        rgb = photo.rgb.astype(np.float32) / 255.0
        discs = discs_of_photo(rgb, sight.depth, sight.label, photo.intrinsics, photo.world_from_camera)
        boxes, valid = tracks.at(photo.time_s)
        poses = world_from_boxes(boxes)
        owner = owners(discs.points, boxes, valid)
        at = (discs.pixels[:, 0], discs.pixels[:, 1])
        label, guessed = sight.label[at], sight.label[at] == SHALLOW
        street = (owner < 0) & (label < 0) & ~sight.passing[at]
        street[street] = _witnessed(discs.points[street], guessed[street], photos, carvers)
        keep = np.flatnonzero(street | (owner >= 0))
        looks.append(
            Look(
                discs.take(keep),
                owner[keep],
                guessed[keep],
                sight.depth,
                photo.intrinsics,
                photo.world_from_camera,
                {int(j): poses[j] for j in np.flatnonzero(valid)},
            )
        )
    kept = choose(looks)
    nodes = {}
    for j, discs in kept.items():
        if j == BACKGROUND or len(discs.points) < MIN_NODE_DISCS:
            continue
        whole = with_mirror_image(discs) if tracks.kinds[j] == AgentKind.VEHICLE else discs
        nodes[tracks.ids[j]] = gaussians_of(whole, np.zeros(3))
    return gaussians_of(kept[BACKGROUND], np.zeros(3)) if BACKGROUND in kept else EMPTY, nodes


def _witnessed(
    points: F64, guessed: NDArray[np.bool_], photos: Sequence[Photo], carvers: Sequence[F32]
) -> NDArray[np.bool_]:
    """Which points (M, 3) not more photos look through than see; one that lidar saw is lost to two at least."""
    in_front, agreeing = np.zeros(len(points), np.int32), np.zeros(len(points), np.int32)
    for photo, depth in zip(photos, carvers):
        camera_from_world = np.ascontiguousarray(np.linalg.inv(photo.world_from_camera))
        count_free_space(points, camera_from_world, photo.intrinsics, depth, in_front, agreeing)
    return np.asarray((in_front <= agreeing) | ((in_front < 2) & ~guessed))


def _sky(photos: Sequence[Photo], seen: Sequence[_Seen]) -> SkyMap:
    collector = SkyCollector()
    for photo, sight in zip(photos, seen):
        height, width = sight.depth.shape
        rays = directions(photo.intrinsics, photo.world_from_camera, width, height)
        use = ~sight.passing
        collector.add(rays[use], photo.rgb[use].astype(np.float32) / 255.0, sight.sky[use])
    return collector.finish()


def _members(asset: RenderAsset, tracks: _Tracks, time_s: float) -> tuple[list[int], F64]:
    """Tracks that are there at a time, and all boxes in the world."""
    boxes, valid = tracks.at(time_s)
    boxes = boxes + np.concatenate([asset.origin, np.zeros(4)])
    return [int(j) for j in np.flatnonzero(valid)], boxes


def _picture(asset: RenderAsset, photo: Photo, tracks: _Tracks) -> F32:
    """The rendering of a photo (pose local) as the scene was at its time."""
    rows, boxes = _members(asset, tracks, photo.time_s)
    scene = scene_at(asset, [tracks.ids[j] for j in rows], [tracks.kinds[j] for j in rows], boxes[rows])
    height, width = photo.rgb.shape[:2]
    pose = shifted(photo.world_from_camera, asset.origin)
    return render_photo(asset, scene, photo.intrinsics, pose, (width, height))


def _refit(
    asset: RenderAsset, photos: Sequence[Photo], seen: Sequence[_Seen], tracks: _Tracks, sweeps: int
) -> RenderAsset:
    """The same scene with refitted colours."""
    names = list(asset.nodes)
    parts = [asset.background, *(asset.nodes[name] for name in names)]
    starts = np.concatenate([[0], np.cumsum([len(p) for p in parts])])
    place = {name: k + 1 for k, name in enumerate(names)}

    def present(i: int) -> tuple[list[str], F64]:
        rows, boxes = _members(asset, tracks, photos[i].time_s)
        rows = [j for j in rows if tracks.ids[j] in place]
        return [tracks.ids[j] for j in rows], boxes[rows]

    def scene_of(i: int) -> Gaussians:
        ids, boxes = present(i)
        return scene_at(asset, ids, [AgentKind.VEHICLE] * len(ids), boxes)

    def rows_of(i: int) -> NDArray[np.intp]:
        ids, _ = present(i)
        spans = [0, *(place[name] for name in ids)]
        return np.concatenate([np.arange(starts[k], starts[k + 1]) for k in spans])

    inputs = []
    for photo, sight in zip(photos, seen):
        height, width = photo.rgb.shape[:2]
        backdrop = asset.sky.seen_by(photo.intrinsics, photo.world_from_camera, width, height)
        rgb = photo.rgb.astype(np.float32) / 255.0
        inputs.append(FitPhoto(rgb, photo.intrinsics, photo.world_from_camera, backdrop, sight.passing))
    colours = refit_colours(
        scene_of, inputs, np.concatenate([p.colours for p in parts]), rows_of, len(asset.background), sweeps
    )
    fitted = [replace(p, colours=colours[starts[k] : starts[k + 1]]) for k, p in enumerate(parts)]
    return replace(asset, background=fitted[0], nodes=dict(zip(names, fitted[1:])))
