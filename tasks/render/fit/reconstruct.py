"""A block's scene fitted to its photos: one photo an iteration, all of it a function of the inputs and the seed."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache

import numpy as np

from tasks.render.fit.backend import CpuBackend, Derivatives, FitBackend
from tasks.render.fit.corrections import (
    apply_exposure,
    chain_exposures,
    corrected_pose,
    exposure_matrix,
    interpolate_in_time,
    invert_exposure,
    mean_exposure,
)
from tasks.render.fit.losses import Target, similarity
from tasks.render.fit.start import FitPhoto, FitProblem
from tasks.render.fit.state import (
    BACKGROUND,
    FitState,
    LearnedState,
    Road,
    add_to_average,
    rays_meet_road,
    relocate_and_grow,
)
from tasks.render.scene.asset import ClassQuality, Exposure, RenderAsset, ViewQuality, mean_psnr_db, psnr
from tasks.render.scene.body import BEFORE_M, BodyView, bodies_near, distance_before_bodies, project_points
from tasks.render.scene.engine import render
from tasks.render.scene.movers import (
    SHIFT_SIZE,
    BoxShifts,
    PlacedAgents,
    behind_boxes,
    interpolate_knots,
    knots_at,
    shift_boxes,
    world_from_boxes,
)
from tasks.render.scene.sensed import Photo, boxes_in_view, shift_pose
from tasks.render.scene.sky import COLUMNS, ROWS, SkyMap, pixel_directions
from tasks.render.scene.stereo import FAR_M
from tasks.render.settings import Backend, FitSettings
from tasks.render.splatting.gaussians import moved
from tasks.render.splatting.gsplat_backend import fit_turn, take_gpu
from tasks.world.arrays import F32, Array, Bools, Ints
from tasks.world.clip import AgentKind, Pinhole

# How well a scene shows photos that it was not made of: drawn as pictures at new poses are, and held against them.
#
# The classes are told by geometry alone, so that they are the same pixels whatever a scene makes of them: vehicles
# are what looks at a vehicle's box, road what meets the road's surface within ROAD_M, rest is all else.

ROAD_M = 30.0  # from the camera; farther a pixel is too long a piece of road
LEAST_PIXELS = 40  # of a class in a photo, that it is measured
SAME_WAY = 0.87  # cosine: photos that look within 30 degrees of each other


def measure_photo(
    asset: RenderAsset, problem: FitProblem, shot: FitPhoto, scene_from_camera: Array, threads: int = 1
) -> ViewQuality:
    """Of a photo that was held out, as `asset` shows it from a pose (4, 4) in the problem's frame.

    The camera has the colours that it has at any new pose then, and tracks are where photos say that they were. Pixels
    without weight say nothing.
    """
    photo, target = shot.photo, shot.compared.target
    picture = draw_photo(asset, problem, photo, scene_from_camera, threads)
    boxes, valid = boxes_at_photo(asset, problem, photo)
    vehicles = boxes[[j for j in np.flatnonzero(valid) if problem.tracks.kinds[j] == AgentKind.VEHICLE]]
    classes = pixel_classes(photo, vehicles, problem.road)
    alike, counted = similarity(picture, target), target.counted
    found = [_class_quality(name, picture, target, alike, inside & counted) for name, inside in classes.items()]
    return ViewQuality(
        photo.camera,
        photo.time_s,
        psnr(picture[counted], target.rgb[counted]) if counted.any() else float("nan"),
        float(alike[counted].mean()) if counted.any() else 0.0,
        held_out=True,
        away_m=distance_to_nearest_m(photo, [other.photo for other in problem.train]),
        classes=tuple(of for of in found if of is not None),
    )


def draw_photo(
    asset: RenderAsset, problem: FitProblem, photo: Photo, scene_from_camera: Array, threads: int = 1
) -> F32:
    """What `asset` shows (H, W, 3) in place of a photo from a pose (4, 4) in the problem's frame: as pictures of
    samples are drawn, in the colours of its camera then, its tracks where photos say that they were."""
    boxes, valid = boxes_at_photo(asset, problem, photo)
    rows = np.flatnonzero(valid)
    there = PlacedAgents(
        tuple(problem.tracks.ids[j] for j in rows),
        tuple(problem.tracks.kinds[j] for j in rows),
        boxes[rows] + np.concatenate([problem.origin, np.zeros(4)]),
    )
    height, width = photo.rgb.shape[:2]
    eye = Pinhole(photo.intrinsics, shift_pose(scene_from_camera, problem.origin), width, height)
    affines = [asset.affine_of(photo.camera, photo.time_s)]
    return render(asset, [eye], there, threads=threads, affines=affines)[0].rgb


def boxes_at_photo(asset: RenderAsset, problem: FitProblem, photo: Photo) -> tuple[Array, Bools]:
    """Boxes (N, 7) of the problem's tracks when a photo was taken, in its frame, and which of them are there (N,)."""
    boxes, valid = problem.tracks.at(photo.time_s)
    return shift_boxes(boxes, asset.shifts.at(photo.time_s, problem.tracks.ids)), valid


def pixel_classes(photo: Photo, vehicles: Array, road: Road | None) -> dict[str, Bools]:
    """Pixels (H, W) of a photo by class; `vehicles` (N, 7) boxes in its frame."""
    height, width = photo.rgb.shape[:2]
    rays = pixel_directions(photo.intrinsics, photo.world_from_camera, width, height).reshape(-1, 3)
    eye = np.ascontiguousarray(photo.world_from_camera[:3, 3])
    on_vehicle = np.asarray(behind_boxes(eye + FAR_M * rays, eye, np.ascontiguousarray(vehicles)), bool)
    on_road = np.zeros(len(rays), bool) if road is None else rays_meet_road(road, eye, rays, ROAD_M) & ~on_vehicle
    classes = {"road": on_road, "vehicles": on_vehicle, "rest": ~(on_road | on_vehicle)}
    return {name: inside.reshape(height, width) for name, inside in classes.items()}


def distance_to_nearest_m(photo: Photo, others: Sequence[Photo]) -> float:
    """How far [m] a photo was taken from the nearest of `others` that look the same way; inf where none does."""
    poses = np.stack([other.world_from_camera for other in others])
    same = poses[:, :3, 2] @ photo.world_from_camera[:3, 2] > SAME_WAY
    places = poses[same, :3, 3] - photo.world_from_camera[:3, 3]
    return float(np.linalg.norm(places, axis=1).min(initial=np.inf))


def _class_quality(name: str, picture: F32, target: Target, alike: F32, counted: Bools) -> ClassQuality | None:
    if counted.sum() < LEAST_PIXELS:
        return None
    return ClassQuality(
        name, float(counted.mean()), psnr(picture[counted], target.rgb[counted]), float(alike[counted].mean())
    )


# Gaussians of the street that hang before a vehicle which drives: they explain a photo or two, and hide it elsewhere.
#
# A vehicle that drives past is seen for a few instants, each time against another part of the street. Where its own
# Gaussians do not match a photo yet, some of the street come to stand between; from the photo's own place the picture
# is right, from a metre aside there is rubble before the vehicle. What really stands there, other photos show as
# well.

LEAST_OPACITY = 0.02  # what hides less may stay
ALIKE = 0.08  # of every colour channel: a photo that differs by less shows the Gaussian
FARTHER = 2.0  # times the depth at which it hides: photos from farther off see too little of it
SHOWN_BY = 0.5  # of the photos that look at its place: no more, and it is a floater
GONE_LOGIT = -8.0  # of its opacity


def fade_floaters(problem: FitProblem, held: LearnedState) -> int:
    """Makes floaters transparent, in place, for `relocate_and_grow` to move them. Returns how many there were."""
    rows = find_floaters(problem, held)
    held.learned["logits"].values[rows] = GONE_LOGIT
    held.learned["logits"].forget(rows)
    if held.noted:
        held.averages["logits"][rows] = GONE_LOGIT
    return len(rows)


def find_floaters(problem: FitProblem, held: LearnedState) -> Ints:
    """Rows (M,) of Gaussians of the street, not of its road, that hide the body of a vehicle which drives in some photo
    by BEFORE_M or more, and that at most SHOWN_BY of the other photos which look there show in their own colour.

    No other photo looks there: it goes too. A photo in which such a body hides the place says nothing of it.
    """
    views = _body_views(problem, held)
    rows, means, colours, least_m = held.street_before_bodies(list(views.values()), LEAST_OPACITY)
    looked, shown = np.zeros(len(rows), np.int64), np.zeros(len(rows), np.int64)
    for i, shot in enumerate(problem.train):
        camera_from_scene = np.linalg.inv(_learned_pose(shot, held, i))
        size = shot.photo.rgb.shape[:2]
        pixel, depth_m = project_points(means, camera_from_scene, shot.photo.intrinsics, *size)
        looking = (pixel >= 0) & (depth_m < FARTHER * least_m)
        if i in views:
            before_m, _ = distance_before_bodies(means, views[i])
            looking &= ~((before_m > BEFORE_M) | (before_m < 0.0))
        if shot.hidden is not None:
            looking &= ~shot.hidden.ravel()[pixel]
        mine = apply_exposure(colours[looking], held.learned["exposure"].values[i])
        theirs = shot.photo.rgb.reshape(-1, 3)[pixel[looking]] / np.float32(255.0)
        looked += looking
        shown[looking] += np.abs(np.clip(mine, 0.0, 1.0) - theirs).max(axis=1) < ALIKE
    return rows[shown <= SHOWN_BY * looked]


def _body_views(problem: FitProblem, held: LearnedState) -> dict[int, BodyView]:
    """Of those photos that may show a vehicle which drives, by their rows."""
    tracks, views = problem.tracks, dict[int, BodyView]()
    off = held.learned["boxes"].values.reshape(len(tracks.ids), tracks.n_knots, SHIFT_SIZE)
    for i, shot in enumerate(problem.train):
        boxes, valid = tracks.at(shot.photo.time_s)
        boxes = shift_boxes(boxes, interpolate_knots(off, shot.photo.time_s))
        pose = _learned_pose(shot, held, i)
        bodies, drives = bodies_near(boxes, valid, tracks, pose[:3, 3])
        drives = drives & boxes_in_view(bodies, shot.photo)
        if drives.any():
            height, width = shot.photo.rgb.shape[:2]
            views[i] = BodyView(pose, shot.photo.intrinsics, height, width, bodies, drives)
    return views


def _learned_pose(shot: FitPhoto, held: LearnedState, i: int) -> Array:
    """Where the photo of row `i` was taken (4, 4)."""
    return corrected_pose(shot.photo.world_from_camera, held.learned["poses"].values[i])


REPORT_EVERY = 100
REFINE_UNTIL = 0.8  # share of the iterations after which nothing is relocated, and what is learned is averaged
NOTED_EVERY = 0.01  # share of the iterations between two instants of that average
LEAST_SHARE = 1e-3  # of a photo in a knot, for it to say anything there
Progress = Callable[[int, float, float], None]  # iteration, mean loss and mean PSNR [dB] of the last REPORT_EVERY


def run_iterations(
    problem: FitProblem,
    state: FitState,
    settings: FitSettings,
    until: int,
    progress: Progress | None = None,
    threads: int = 2,
    stopped: Callable[[], bool] = lambda: False,
    backend: FitBackend | None = None,
) -> None:
    """Fits on, in place, to iteration `until`, or until `stopped`, which is asked before each iteration.

    In how many calls the iterations are done makes no difference. `backend`: the compiled kernels where None is given.
    """
    drawing: FitBackend = CpuBackend(threads) if backend is None else backend
    held: LearnedState = drawing.load(state)
    losses, scores = [], []
    while held.iteration < min(until, settings.iterations) and not stopped():
        loss, score = _iterate(problem, held, settings, drawing)
        losses.append(loss)
        scores.append(score)
        held.iteration += 1
        at = held.iteration
        due = at % settings.refine_every == 0 and settings.refine_from <= at < settings.iterations
        relocates = at <= REFINE_UNTIL * settings.iterations
        if due and (relocates or problem.tracks.driving.any()):
            fade_floaters(problem, held)
            if relocates:
                relocate_and_grow(held, settings)
        if not relocates and (at % max(1, round(NOTED_EVERY * settings.iterations)) == 0 or at == settings.iterations):
            add_to_average(held)
        if progress is not None and at % REPORT_EVERY == 0:
            progress(at, float(np.mean(losses)), float(np.mean(scores)))
            losses, scores = [], []
    drawing.store(held, state)
    if state.iteration >= settings.iterations:
        state.apply_average(problem.road)


@contextmanager
def fit_backend(backend: Backend, threads: int, stopped: Callable[[], bool] = lambda: False) -> Iterator[FitBackend]:
    """Who draws for the fit, which has its turn on a GPU meanwhile. Raises BackendMissing where it cannot work here."""
    if not backend.on_gpu:
        yield CpuBackend(threads)
        return
    with fit_turn(take_gpu(), stopped):
        from tasks.render.fit.on_torch import TorchBackend  # torch is loaded only where it is asked for
        from tasks.render.splatting.tensors import by_gsplat

        drawing = TorchBackend(by_gsplat, "cuda")
        try:
            yield drawing
        finally:
            drawing.release()


def decay(end: float, progress: float) -> float:
    """What is left of a step size: 1 at progress 0, falling exponentially to `end` at 1 (Kerbl et al. 2023)."""
    return float(end**progress)


def photo_of_iteration(iteration: int, n: int, seed: int) -> int:
    """Which of n photos an iteration looks at: each once per round, shuffled by seed and round alone."""
    return int(_round_order(iteration // n, n, seed)[iteration % n])


@lru_cache(maxsize=4)
def _round_order(turn: int, n: int, seed: int) -> Ints:
    return np.random.Generator(np.random.Philox(key=[seed, turn])).permutation(n)


def _iterate(
    problem: FitProblem, held: LearnedState, settings: FitSettings, backend: FitBackend
) -> tuple[float, float]:
    row = photo_of_iteration(held.iteration, len(problem.train), settings.seed)
    found = backend.derivatives(problem, held, row, settings)
    _step_world(problem, held, settings, row, found)
    _step_gaussians(held, settings, found)
    held.keep_round(found.rows, settings.stretch, settings.box_stretch)
    if problem.road is not None:
        held.lay_flat(found.rows, problem.road)
    return found.loss, found.psnr_db


def _step_world(problem: FitProblem, held: LearnedState, settings: FitSettings, row: int, found: Derivatives) -> None:
    """Exposure and pose of the photo, the boxes that it shows, and the sky behind it."""
    at, fall = np.array([row]), decay(settings.rate_end, held.iteration / settings.iterations)
    held.learned["exposure"].step(at, found.exposure[None], fall * settings.exposure_rate)
    if held.iteration >= settings.pose_from:
        poses = held.learned["poses"]
        # Shift and turn step by different rates: the gradient's own size does not matter to Adam.
        before = poses.values[row].copy()
        poses.step(at, found.camera[None].astype(np.float32), fall)
        rates = np.repeat([settings.shift_rate, settings.turn_rate], 3).astype(np.float32)
        poses.values[row] = before + rates * (poses.values[row] - before)
        _step_boxes(problem, held, settings, row, found)
    held.learned["sky"].step(found.cells, found.sky, fall * settings.sky_rate)


def _step_boxes(problem: FitProblem, held: LearnedState, settings: FitSettings, row: int, found: Derivatives) -> None:
    """Those that the photo may show, at the knots before and behind it."""
    shown = found.boxes.any(axis=1)
    if settings.box_shift_rate == settings.box_turn_rate == 0.0 or not shown.any():
        return
    boxes, n_knots = held.learned["boxes"], problem.tracks.n_knots
    before, share = knots_at(problem.train[row].photo.time_s, n_knots)
    rates = np.array([settings.box_shift_rate] * 3 + [settings.box_turn_rate], np.float32)
    fall = decay(settings.rate_end, held.iteration / settings.iterations)
    for knot, weight in ((before, 1.0 - share), (before + 1, share)):
        if weight > LEAST_SHARE:
            at = found.tracks[shown] * n_knots + knot
            values = boxes.values[at].copy()
            boxes.step(at, np.float32(weight) * found.boxes[shown], fall)
            boxes.values[at] = values + np.float32(weight) * rates * (boxes.values[at] - values)


FULL_ITERATIONS, MOST_TIMES = 8000, 4.0  # from which on sizes step by scale_rate, and how many times as far at most


def _size_step_factor(iterations: int) -> float:
    """How many times as far sizes step in a shorter fit.

    The root lies among what came out best at 550, 1,200, 2,000 and 6,000 iterations (experiments/reconstruction).
    """
    return min(max(FULL_ITERATIONS / iterations, 1.0) ** 0.5, MOST_TIMES)


def _step_gaussians(held: LearnedState, settings: FitSettings, found: Derivatives) -> None:
    """Those that the photo shows."""
    nearest = held.record_view(found.rows, found.depths, found.gaussians.screen)
    fall = decay(settings.rate_end, held.iteration / settings.iterations)
    rates = {
        "means": settings.mean_rate * decay(settings.mean_rate_end, held.iteration / settings.iterations),
        "quats": fall * settings.quat_rate,
        "log_scales": fall * settings.scale_rate * _size_step_factor(settings.iterations),
        "logits": fall * settings.opacity_rate,
        "colours": fall * settings.colour_rate,
    }
    held.step_gaussians(found.rows, found.gaussians, rates, nearest)


def refined_pose(problem: FitProblem, state: FitState, photo: Photo) -> Array:
    """Where a photo (pose local) was taken (4, 4), as the corrections of its camera's before and after have it."""
    return corrected_pose(
        photo.world_from_camera, interpolated_corrections(problem, state, photo.camera, photo.time_s)[0]
    )


def interpolated_corrections(problem: FitProblem, state: FitState, camera: str, time_s: float) -> tuple[F32, F32]:
    """Pose correction (6,) and exposure (12,) of a camera at a time; zeros for one that no photo was learned from."""
    rows = [i for i, shot in enumerate(problem.train) if shot.photo.camera == camera]
    poses, colours = state.learned["poses"].values, state.learned["exposure"].values
    if not rows:
        return np.zeros(poses.shape[1], np.float32), np.zeros(colours.shape[1], np.float32)
    times = np.array([problem.train[i].photo.time_s for i in rows])
    return interpolate_in_time(times, poses[rows], time_s), interpolate_in_time(times, colours[rows], time_s)


def learned_box_shifts(problem: FitProblem, state: FitState) -> F32:
    """What boxes are off by (tracks * knots, SHIFT_SIZE); a knot that no photo says anything of lies between those that
    do, or has what the nearest has."""
    learned, n_knots = state.learned["boxes"], problem.tracks.n_knots
    out = learned.values.reshape(-1, n_knots, SHIFT_SIZE).copy()
    for mine, stepped in zip(out, learned.steps.reshape(-1, n_knots) > 0):
        if stepped.any():
            there = np.flatnonzero(stepped)
            for column in mine.T:
                column[:] = np.interp(np.arange(n_knots), there, column[there])
    return out.reshape(-1, SHIFT_SIZE)


def split_box_shifts(problem: FitProblem, state: FitState) -> tuple[Array, BoxShifts]:
    """What tracks' boxes are off by, less what each is off by on average: that is how its Gaussians lie in its box.

    Returns as well where those go by that, poses (tracks, 4, 4).
    """
    n = len(problem.tracks.ids)
    rows = learned_box_shifts(problem, state).reshape(n, problem.tracks.n_knots, SHIFT_SIZE).astype(np.float64)
    stepped = state.learned["boxes"].steps.reshape(n, problem.tracks.n_knots) > 0
    moved_by = np.tile(np.eye(4), (n, 1, 1))
    known = np.flatnonzero(stepped.any(axis=1))
    for j in known:
        mean = rows[j, stepped[j]].mean(axis=0)
        box = np.zeros((1, 7))
        moved_by[j] = world_from_boxes(shift_boxes(box, mean[None]))[0]
        turn = moved_by[j, :3, :3]
        rows[j] = np.column_stack([(rows[j, :, :3] - mean[:3]) @ turn.T, rows[j, :, 3] - mean[3]])
    return moved_by, BoxShifts(tuple(problem.tracks.ids[j] for j in known), rows[known].astype(np.float32))


def finish_scene(problem: FitProblem, state: FitState, threads: int = 2) -> RenderAsset:
    """The scene as it is rendered, with what it makes of the photos held out.

    What all cameras make of the scene's light on average is folded into it: its own colours are those of photos.
    """
    rows, cameras = state.learned["exposure"].values, [shot.photo.camera for shot in problem.train]
    common = mean_exposure(cameras, rows)
    moved_by, shifts = split_box_shifts(problem, state)
    every = state.gaussians()
    every = replace(
        every,
        quats=every.quats / np.linalg.norm(every.quats, axis=1, keepdims=True),
        colours=apply_exposure(every.colours, common),
    )
    sky = apply_exposure(state.learned["sky"].values, common)
    nodes = {
        problem.tracks.ids[j]: moved(every.take(state.owner == j), moved_by[j])
        for j in np.unique(state.owner[state.owner >= 0])
    }
    asset = RenderAsset(
        problem.origin,
        every.take(state.owner == BACKGROUND),
        nodes,
        SkyMap(np.maximum(sky, np.float32(0.0)).reshape(ROWS, COLUMNS, 3)),
        float("nan"),
        exposures=tuple(
            Exposure(
                shot.photo.camera,
                shot.photo.time_s,
                np.column_stack(exposure_matrix(chain_exposures(row, invert_exposure(common)))),
            )
            for shot, row in zip(problem.train, rows)
        ),
        shifts=shifts,
    )
    views = []
    for shot in problem.held_out:
        views.append(measure_photo(asset, problem, shot, refined_pose(problem, state, shot.photo), threads))
    return replace(asset, views=tuple(views), psnr_db=mean_psnr_db(views), n_held_out=len(views))
