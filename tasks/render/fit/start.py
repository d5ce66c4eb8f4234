"""From photos and lidar to where the fit begins."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tasks.kernels.threads import run_in_chunks
from tasks.render.fit.corrections import (
    EXPOSURE_SIZE,
    POSE_SIZE,
    estimate_exposures,
    group_by_instant,
    interpolate_in_time,
    with_common_exposure,
)
from tasks.render.fit.losses import Target, photo_target
from tasks.render.fit.state import (
    BACKGROUND,
    AdamArray,
    FitState,
    Road,
    fit_road,
    height_above_road,
    lay_flat,
    logits_of,
)
from tasks.render.scene.body import unseen_body_gaussians, with_body_depths
from tasks.render.scene.build import build_sky, build_surfaces, held_out_rows
from tasks.render.scene.depth import PhotoDepth, estimate_photo_depth, label_confirmed
from tasks.render.scene.features import NOTHING_KNOWN, KnownPoints, SurfacePoints, points_without_lidar
from tasks.render.scene.movers import SHIFT_SIZE, behind_boxes
from tasks.render.scene.sensed import Photo, Sweep, Tracks, boxes_in_view, fuse_sweeps, resize_photo, shift_pose
from tasks.render.scene.sky import pixel_directions, rises
from tasks.render.scene.stereo import FAR_M
from tasks.render.settings import FitSettings
from tasks.render.splatting.gaussians import Gaussians, concatenate, rotations_of
from tasks.world.arrays import F32, Array, Bools
from tasks.world.clip import AgentKind, AgentTracks

ROAD_TOP_M = 0.08  # a Gaussian that starts no further from the road's surface belongs to it
START_WIDTH = 640  # pixels of a photo across, more of which say no better where surfaces are
COMPARED_BYTES, KEPT_BYTES = 50, 10**9  # of a pixel in `PhotoTarget`, and of all that are kept
LOOKS_DOWN = 0.05  # sine of the angle below the horizon from which on a ray meets the ground
UPRIGHT = 0.5  # unless it stands: the least vertical part of its normal


@dataclass(frozen=True)
class PhotoTarget:
    """What a picture is compared with: sixteen times its own bytes."""

    target: Target
    ground: Bools  # (H, W) looks down, so that no sky can be behind


@dataclass(frozen=True)
class FitPhoto:
    """A photo as the fit uses it, in the block's local frame."""

    photo: Photo
    hidden: Bools | None  # (H, W) pixels that are left out
    kept: PhotoTarget | None = None  # made anew each time where the block's do not fit into KEPT_BYTES

    @property
    def compared(self) -> PhotoTarget:
        """What is kept, or the same once more."""
        return _photo_target(self.photo, self.hidden) if self.kept is None else self.kept


@dataclass(frozen=True)
class FitProblem:
    """What is to be fitted. The same photos, sweeps, agents and settings give the same problem."""

    origin: Array  # (3,) world [m]
    train: tuple[FitPhoto, ...]
    held_out: tuple[FitPhoto, ...]
    tracks: Tracks
    road: Road | None


def prepare_fit(
    photos: Sequence[Photo],
    sweeps: Sequence[Sweep],
    agents: AgentTracks | None,
    settings: FitSettings,
    held_out: Collection[int] | None = None,
    threads: int = 2,
    known: KnownPoints = NOTHING_KNOWN,
) -> tuple[FitProblem, FitState]:
    """The problem and its first state. `held_out`: indices of photos that only measure, else as `settings` says.
    The number of `threads` changes no bit, here and in all of the fit. `known`: as of `build_asset`.

    Raises ValueError without photos to train on.
    """
    out = held_out_rows(photos, settings.hold_out_every) if held_out is None else frozenset(held_out)
    if len(photos) <= len(out):
        raise ValueError(f"reconstruct: {len(photos)} photos, of which {len(out)} are held out: none to learn from")
    origin = np.round(photos[0].world_from_camera[:3, 3])
    local = [replace(p, world_from_camera=shift_pose(p.world_from_camera, -origin)) for p in photos]
    tracks = Tracks(agents, origin)
    train = [p for i, p in enumerate(local) if i not in out]
    static, per_track = fuse_sweeps(
        [replace(s, world_from_ego=shift_pose(s.world_from_ego, -origin)) for s in sweeps], tracks
    )
    points = SurfacePoints(static) if sweeps else points_without_lidar(train, tracks, known.shifted(-origin))

    first_seen = [i for k, group in enumerate(group_by_instant(train)) if k % settings.start_every == 0 for i in group]
    small = [resize_photo(p, START_WIDTH) for p in train]
    looked_at = [small[i] for i in sorted(first_seen)]

    def look(first: int, last: int) -> list[PhotoDepth]:
        n = settings.stereo_photos
        return [estimate_photo_depth(p, small, points, per_track, tracks, n) for p in looked_at[first:last]]

    seen = [s for part in run_in_chunks(look, len(looked_at), 1, threads) for s in part]
    if points.corners is not None:
        seen = label_confirmed(looked_at, seen)
    if not sweeps:
        seen = with_body_depths(looked_at, seen, tracks)
    exposures = np.zeros((len(train), EXPOSURE_SIZE), np.float32)
    if settings.exposure_rate > 0.0:
        exposures = _exposures(train, looked_at, estimate_exposures(looked_at, seen, points.every))
    alike = with_common_exposure(looked_at, exposures[sorted(first_seen)])
    background, nodes = build_surfaces(alike, seen, tracks)
    eyes = np.stack([p.world_from_camera[:3, 3] for p in train])
    surface = fit_road(points.every, eyes)
    cars = [nodes.get(i) for i in tracks.ids]
    bodies = _unseen_bodies(cars, tracks, [p.time_s for p in train])
    state = _first_state(
        background, cars, bodies, build_sky(alike, seen).rgb, exposures, surface, tracks.n_knots, settings
    )
    unknown = [track_id not in nodes for track_id in tracks.ids]
    hidden = [_hidden_pixels(p, tracks, np.array(unknown, bool)) for p in local]
    sizes = np.cumsum([COMPARED_BYTES * p.rgb[..., 0].size for p in local])
    shots = [
        FitPhoto(p, h, _photo_target(p, h) if size <= KEPT_BYTES else None)
        for p, h, size in zip(local, hidden, sizes.tolist())
    ]
    problem = FitProblem(
        origin,
        tuple(shot for i, shot in enumerate(shots) if i not in out),
        tuple(shot for i, shot in enumerate(shots) if i in out),
        tracks,
        surface,
    )
    return problem, state


def _exposures(photos: Sequence[Photo], known: Sequence[Photo], rows: F32) -> F32:
    """Rows (N, 12) of all photos from those (M, 12) of some: of the same camera, between the times before and after."""
    out = np.zeros((len(photos), EXPOSURE_SIZE), np.float32)
    for i, photo in enumerate(photos):
        mine = [k for k, other in enumerate(known) if other.camera == photo.camera]
        if mine:
            out[i] = interpolate_in_time(np.array([known[k].time_s for k in mine]), rows[mine], photo.time_s)
    return out


def _unseen_bodies(
    nodes: Sequence[Gaussians | None], tracks: Tracks, times_s: Sequence[float]
) -> list[Gaussians | None]:
    """Of each track that is a vehicle with Gaussians what no photo shows."""
    sizes = np.zeros((len(nodes), 3))
    for time_s in times_s:
        boxes, valid = tracks.at(time_s)
        sizes[valid] = boxes[valid, 4:]
    return [
        unseen_body_gaussians(node, size) if node is not None and kind == AgentKind.VEHICLE else None
        for node, size, kind in zip(nodes, sizes, tracks.kinds)
    ]


def _hidden_pixels(photo: Photo, tracks: Tracks, unknown: Bools) -> Bools | None:
    """Pixels of what moves and has no Gaussians of its own, the own body too: it would be painted on the street."""
    boxes, valid = tracks.at(photo.time_s)
    unknown = valid & unknown
    unknown[unknown] = boxes_in_view(boxes[unknown], photo)
    if not unknown.any():
        return photo.own_body
    height, width = photo.rgb.shape[:2]
    rays = pixel_directions(photo.intrinsics, photo.world_from_camera, width, height)
    eye = np.ascontiguousarray(photo.world_from_camera[:3, 3])
    far = rays.reshape(-1, 3) * FAR_M + eye
    hidden = np.asarray(behind_boxes(far, eye, boxes[unknown]), bool).reshape(height, width)
    return hidden if photo.own_body is None else hidden | photo.own_body


def _photo_target(photo: Photo, hidden: Bools | None) -> PhotoTarget:
    height, width = photo.rgb.shape[:2]
    rise, length = rises(photo.intrinsics, photo.world_from_camera[2, :3], width, height)
    return PhotoTarget(photo_target(photo.rgb, hidden), rise < -LOOKS_DOWN * length)


def _first_state(
    background: Gaussians,
    nodes: Sequence[Gaussians | None],
    bodies: Sequence[Gaussians | None],
    sky: F32,
    exposures: F32,
    road: Road | None,
    n_knots: int,
    settings: FitSettings,
) -> FitState:
    """Of the background's and of each track's discs as many as are wanted, each as much larger."""
    rng = np.random.Generator(np.random.Philox(key=[settings.seed, 2**33]))
    weight = np.where(_is_on_road(background, road), settings.road_share, 1.0)
    parts, owner = [_sample_gaussians(background, settings.start_gaussians, weight, rng)], [BACKGROUND]
    for j, (node, body) in enumerate(zip(nodes, bodies)):
        if node is not None:
            parts.append(_sample_gaussians(node, settings.start_node_gaussians, np.ones(len(node)), rng))
            owner.append(j)
        if body is not None:
            parts.append(body)
            owner.append(j)
    start = concatenate(parts)
    owners = np.repeat(owner, [len(part) for part in parts]).astype(np.int32)
    on_road = _is_on_road(start, road) & (owners == BACKGROUND)
    if road is not None:
        lay_flat(start.means, start.quats, start.log_scales, np.flatnonzero(on_road), road)
    bodily = np.repeat([any(part is body for body in bodies) for part in parts], [len(part) for part in parts])
    opacities = np.where(bodily, start.opacities, np.float32(settings.start_opacity))[:, None]
    learned = {
        "means": AdamArray.unstepped(start.means),
        "quats": AdamArray.unstepped(start.quats),
        "log_scales": AdamArray.unstepped(start.log_scales),
        "logits": AdamArray.unstepped(logits_of(opacities)),
        "colours": AdamArray.unstepped(start.colours),
        "sky": AdamArray.unstepped(sky.reshape(-1, 3)),
        "exposure": AdamArray.unstepped(exposures),
        "poses": AdamArray.unstepped(np.zeros((len(exposures), POSE_SIZE))),
        "boxes": AdamArray.unstepped(np.zeros((len(nodes) * n_knots, SHIFT_SIZE))),
    }
    nearest = np.full(len(start), np.inf, np.float32)
    return FitState(0, learned, owners, on_road, nearest, np.zeros(len(start), np.float32))


def _is_on_road(gaussians: Gaussians, road: Road | None) -> Bools:
    if road is None:
        return np.zeros(len(gaussians), bool)
    flat = np.abs(rotations_of(gaussians.quats)[:, 2, 2]) > UPRIGHT
    with np.errstate(invalid="ignore"):
        return np.asarray((np.abs(height_above_road(gaussians.means, road)) < ROAD_TOP_M) & flat)


def _sample_gaussians(gaussians: Gaussians, n: int, weight: Array, rng: np.random.Generator) -> Gaussians:
    """`n` of them by `weight`, each as much larger as there are fewer of its kind."""
    if len(gaussians) <= n:
        return gaussians
    rows = np.sort(rng.choice(len(gaussians), n, replace=False, p=weight / weight.sum()))
    kept = gaussians.take(rows)
    fewer = np.maximum(weight.sum() / (n * weight[rows]), 1.0)
    larger = np.array([0.5, 0.5, 0.0]) * np.log(fewer)[:, None]
    return replace(kept, log_scales=(kept.log_scales + larger).astype(np.float32))
