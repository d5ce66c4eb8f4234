"""A block's scene fitted to its photos: one photo an iteration, all of it a function of the inputs and the seed."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace

import numpy as np

from tasks.render.fit.backend import Derivatives, FitBackend, Held
from tasks.render.fit.corrections import after, between, corrected, exposed, inverse, matrix_of, reference
from tasks.render.fit.density import refine
from tasks.render.fit.floaters import clear_floaters
from tasks.render.fit.lpips import Lpips
from tasks.render.fit.on_cpu import OnCpu, compose, look
from tasks.render.fit.quality import measured
from tasks.render.fit.settings import FitSettings
from tasks.render.fit.start import Problem, prepare
from tasks.render.fit.state import BACKGROUND, FitState
from tasks.render.scene.asset import Exposure, RenderAsset, mean_psnr_db
from tasks.render.scene.movers import SHIFT_SIZE, BoxShifts, knots_at, shifted_boxes, world_from_boxes
from tasks.render.scene.sensed import Photo, Sweep
from tasks.render.scene.settings import Backend
from tasks.render.scene.sky import COLUMNS, ROWS, SkyMap
from tasks.render.splatting.gaussians import moved
from tasks.render.splatting.gsplat_backend import require
from tasks.world.agents import AgentTracks
from tasks.world.arrays import F32, Array

REPORT_EVERY = 100
SH_RATE = 6e-4  # step size of what depends on the direction
REFINE_UNTIL = 0.8  # share of the iterations after which nothing is relocated, and what is learned is averaged
NOTED_EVERY = 0.01  # share of the iterations between two instants of that average
LEAST_SHARE = 1e-3  # of a photo in a knot, for it to say anything there
Progress = Callable[[int, float, float], None]  # iteration, mean loss and mean PSNR [dB] of the last REPORT_EVERY


def reconstruct(
    photos: Sequence[Photo],
    sweeps: Sequence[Sweep],
    agents: AgentTracks | None,
    settings: FitSettings,
    progress: Progress | None = None,
    held_out: Collection[int] | None = None,
    threads: int = 2,
    backend: FitBackend | None = None,
) -> RenderAsset:
    """The scene of one block. `agents`: 10 Hz tracks whose first step is time 0 of photos and sweeps.

    Whoever wants to stop and go on calls `prepare`, `advance` and `finish`, which this is made of.
    Raises ValueError without photos to train on.
    """
    problem, state = prepare(photos, sweeps, agents, settings, held_out, threads)
    advance(problem, state, settings, settings.iterations, progress, threads, backend=backend)
    return finish(problem, state, threads)


def advance(
    problem: Problem,
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
    drawing: FitBackend = OnCpu(threads) if backend is None else backend
    held: Held = drawing.take(state)
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
            drawing.give_back(held, state)
            clear_floaters(problem, state)
            if relocates:
                refine(state, settings)
            held = drawing.take(state)
        if not relocates and (at % max(1, round(NOTED_EVERY * settings.iterations)) == 0 or at == settings.iterations):
            drawing.give_back(held, state)
            state.note()
            held = drawing.take(state)
        if progress is not None and at % REPORT_EVERY == 0:
            progress(at, float(np.mean(losses)), float(np.mean(scores)))
            losses, scores = [], []
    drawing.give_back(held, state)
    if state.iteration >= settings.iterations:
        state.settle(problem.road)


def backend_of(backend: Backend, threads: int) -> FitBackend:
    """Who draws for the fit. Raises BackendMissing where it cannot work on this machine."""
    if not backend.on_gpu:
        return OnCpu(threads)
    require()
    from tasks.render.fit.on_torch import OnTorch  # torch is loaded only where it is asked for
    from tasks.render.splatting.tensors import by_gsplat

    return OnTorch(by_gsplat, "cuda")


def decayed(end: float, progress: float) -> float:
    """What is left of a step size: 1 at progress 0, falling exponentially to `end` at 1 (Kerbl et al. 2023)."""
    return float(end**progress)


def photo_at(iteration: int, n: int, seed: int) -> int:
    """Which of n photos an iteration looks at: each once per round, shuffled by seed and round alone."""
    order = np.random.Generator(np.random.Philox(key=[seed, iteration // n])).permutation(n)
    return int(order[iteration % n])


def _iterate(problem: Problem, held: Held, settings: FitSettings, backend: FitBackend) -> tuple[float, float]:
    row = photo_at(held.iteration, len(problem.train), settings.seed)
    found = backend.derivatives(problem, held, row, settings)
    _step_world(problem, held, settings, row, found)
    _step_gaussians(held, settings, found)
    held.keep_round(found.rows, settings.stretch, settings.box_stretch)
    if problem.road is not None:
        held.lay_flat(found.rows, problem.road)
    return found.loss, found.psnr_db


def _step_world(problem: Problem, held: Held, settings: FitSettings, row: int, found: Derivatives) -> None:
    """Exposure and pose of the photo, the boxes that it shows, and the sky behind it."""
    at, fall = np.array([row]), decayed(settings.rate_end, held.iteration / settings.iterations)
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


def _step_boxes(problem: Problem, held: Held, settings: FitSettings, row: int, found: Derivatives) -> None:
    """Those that the photo may show, at the knots before and behind it."""
    shown = found.boxes.any(axis=1)
    if settings.box_shift_rate == settings.box_turn_rate == 0.0 or not shown.any():
        return
    boxes, n_knots = held.learned["boxes"], problem.tracks.n_knots
    before, share = knots_at(problem.train[row].photo.taken_s, n_knots)
    rates = np.array([settings.box_shift_rate] * 3 + [settings.box_turn_rate], np.float32)
    fall = decayed(settings.rate_end, held.iteration / settings.iterations)
    for knot, weight in ((before, 1.0 - share), (before + 1, share)):
        if weight > LEAST_SHARE:
            at = found.tracks[shown] * n_knots + knot
            values = boxes.values[at].copy()
            boxes.step(at, np.float32(weight) * found.boxes[shown], fall)
            boxes.values[at] = values + np.float32(weight) * rates * (boxes.values[at] - values)


def _step_gaussians(held: Held, settings: FitSettings, found: Derivatives) -> None:
    """Those that the photo shows."""
    learned, rows, mine = held.learned, found.rows, found.gaussians
    nearest = held.seen(rows, found.depths, mine.screen)
    fall = decayed(settings.rate_end, held.iteration / settings.iterations)
    mean_rate = settings.mean_rate * decayed(settings.mean_rate_end, held.iteration / settings.iterations)
    learned["means"].step(rows, mine.means, mean_rate, nearest)
    learned["quats"].step(rows, mine.quats, fall * settings.quat_rate)
    learned["log_scales"].step(rows, mine.log_scales, fall * settings.scale_rate)
    learned["logits"].step(rows, mine.logits[:, None], fall * settings.opacity_rate)
    learned["colours"].step(rows, mine.colours, fall * settings.colour_rate)
    if mine.sh_rest.shape[1]:
        learned["sh_rest"].step(rows, mine.sh_rest.reshape(len(rows), -1), fall * SH_RATE)


def picture_of(problem: Problem, state: FitState, photo: Photo, threads: int = 1) -> F32:
    """What the fit makes of a photo of the block that it need not have seen (H, W, 3); samples are drawn of what
    `finish` keeps of it.

    Pose correction and exposure are those learned from the same camera, between the photos before and after.
    `photo.world_from_camera` is local (minus `problem.origin`).
    """
    row_pose, row_colour = corrections_at(problem, state, photo.camera, photo.time_s)
    camera = corrected(photo.world_from_camera, row_pose)
    scene, _ = compose(problem, state, boxes_off(problem, state), photo)
    seen, _ = look(state, scene, photo, camera, threads)
    return np.clip(exposed(seen.view.rgb, row_colour), 0.0, 1.0)


def pose_of(problem: Problem, state: FitState, photo: Photo) -> Array:
    """Where a photo (pose local) was taken (4, 4), as the corrections of its camera's before and after have it."""
    return corrected(photo.world_from_camera, corrections_at(problem, state, photo.camera, photo.time_s)[0])


def corrections_at(problem: Problem, state: FitState, camera: str, time_s: float) -> tuple[F32, F32]:
    """Pose correction (6,) and exposure (12,) of a camera at a time; zeros for one that no photo was learned from."""
    rows = [i for i, shot in enumerate(problem.train) if shot.photo.camera == camera]
    poses, colours = state.learned["poses"].values, state.learned["exposure"].values
    if not rows:
        return np.zeros(poses.shape[1], np.float32), np.zeros(colours.shape[1], np.float32)
    times = np.array([problem.train[i].photo.time_s for i in rows])
    return between(times, poses[rows], time_s), between(times, colours[rows], time_s)


def boxes_off(problem: Problem, state: FitState) -> F32:
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


def box_shifts(problem: Problem, state: FitState) -> tuple[Array, BoxShifts]:
    """What tracks' boxes are off by, less what each is off by on average: that is how its Gaussians lie in its box.

    Returns as well where those go by that, poses (tracks, 4, 4).
    """
    n = len(problem.tracks.ids)
    rows = boxes_off(problem, state).reshape(n, problem.tracks.n_knots, SHIFT_SIZE).astype(np.float64)
    stepped = state.learned["boxes"].steps.reshape(n, problem.tracks.n_knots) > 0
    moved_by = np.tile(np.eye(4), (n, 1, 1))
    known = np.flatnonzero(stepped.any(axis=1))
    for j in known:
        mean = rows[j, stepped[j]].mean(axis=0)
        box = np.zeros((1, 7))
        moved_by[j] = world_from_boxes(shifted_boxes(box, mean[None]))[0]
        turn = moved_by[j, :3, :3]
        rows[j] = np.column_stack([(rows[j, :, :3] - mean[:3]) @ turn.T, rows[j, :, 3] - mean[3]])
    return moved_by, BoxShifts(tuple(problem.tracks.ids[j] for j in known), rows[known].astype(np.float32))


def finish(problem: Problem, state: FitState, threads: int = 2, lpips: Lpips | None = None) -> RenderAsset:
    """The scene as it is rendered, with what it makes of the photos held out; `lpips` measures them as well.

    What all cameras make of the scene's light on average is folded into it: its own colours are those of photos.
    """
    rows, cameras = state.learned["exposure"].values, [shot.photo.camera for shot in problem.train]
    common = reference(cameras, rows)
    matrix, _ = matrix_of(common)
    moved_by, shifts = box_shifts(problem, state)
    every = state.gaussians()
    every = replace(
        every,
        quats=every.quats / np.linalg.norm(every.quats, axis=1, keepdims=True),
        colours=exposed(every.colours, common),
        sh_rest=every.sh_rest @ matrix.T,
    )
    sky = exposed(state.learned["sky"].values, common)
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
            Exposure(shot.photo.camera, shot.photo.time_s, np.column_stack(matrix_of(after(row, inverse(common)))))
            for shot, row in zip(problem.train, rows)
        ),
        shifts=shifts,
    )
    views = []
    for shot in problem.held_out:
        views.append(measured(asset, problem, shot, pose_of(problem, state, shot.photo), threads, lpips))
    return replace(asset, views=tuple(views), psnr_db=mean_psnr_db(views), n_held_out=len(views))
