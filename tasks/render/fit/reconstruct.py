"""A block's scene fitted to its photos: one photo an iteration, all of it a function of the inputs and the seed."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tasks.render.fit.backdrop import SkyCells, backdrop, backdrop_gradient, sky_cells
from tasks.render.fit.corrections import between, corrected, exposed, exposed_gradient, matrix_of
from tasks.render.fit.density import refine
from tasks.render.fit.losses import opaque_loss, photo_loss, ssim
from tasks.render.fit.road import lay_flat
from tasks.render.fit.settings import FitSettings
from tasks.render.fit.start import Problem, prepare
from tasks.render.fit.state import BACKGROUND, FitState
from tasks.render.scene.asset import Exposure, RenderAsset, ViewQuality, psnr
from tasks.render.scene.movers import world_from_boxes
from tasks.render.scene.sensed import Photo, Sweep
from tasks.render.scene.sky import COLUMNS, ROWS, SkyMap
from tasks.render.splatting.gaussians import Gaussians, concatenate, moved
from tasks.render.splatting.gradient import Gradients, backward, unmoved
from tasks.render.splatting.project import DEPTH
from tasks.render.splatting.raster import ForwardPass, forward
from tasks.world.agents import AgentTracks
from tasks.world.arrays import F32, Array, Bools, Ints

REPORT_EVERY = 100
RATE_END = 0.1  # what every rate but that of the means falls to, as a share of itself
SH_RATE = 6e-4  # step size of what depends on the direction
REFINE_UNTIL = 0.8  # share of the iterations
VIEW_MARGIN_M = 0.5  # how far Gaussians of a track may reach beyond its box
Progress = Callable[[int, float, float], None]  # iteration, mean loss and mean PSNR [dB] of the last REPORT_EVERY


@dataclass(frozen=True)
class OwnedGaussians:
    """Consecutive Gaussians of a composed scene that share an owner."""

    first: int
    rows: Ints  # (M,) in the state
    scene_from_owner: Array | None  # (4, 4); None: the background's, which is the scene's


def reconstruct(
    photos: Sequence[Photo],
    sweeps: Sequence[Sweep],
    agents: AgentTracks | None,
    settings: FitSettings,
    progress: Progress | None = None,
    held_out: Collection[int] | None = None,
    threads: int = 2,
) -> RenderAsset:
    """The scene of one block. `agents`: 10 Hz tracks whose first step is time 0 of photos and sweeps.

    Whoever wants to stop and go on calls `prepare`, `advance` and `finish`, which this is made of.
    Raises ValueError without photos to train on.
    """
    problem, state = prepare(photos, sweeps, agents, settings, held_out, threads)
    advance(problem, state, settings, settings.iterations, progress, threads)
    return finish(problem, state, threads)


def advance(
    problem: Problem,
    state: FitState,
    settings: FitSettings,
    until: int,
    progress: Progress | None = None,
    threads: int = 2,
    stopped: Callable[[], bool] = lambda: False,
) -> None:
    """Fits on, in place, to iteration `until`, or until `stopped`, which is asked before each iteration.

    In how many calls the iterations are done makes no difference.
    """
    losses, scores = [], []
    while state.iteration < min(until, settings.iterations) and not stopped():
        loss, score = _iterate(problem, state, settings, threads)
        losses.append(loss)
        scores.append(score)
        state.iteration += 1
        at, last = state.iteration, REFINE_UNTIL * settings.iterations
        if at % settings.refine_every == 0 and settings.refine_from <= at <= last:
            refine(state, settings)
        if progress is not None and at % REPORT_EVERY == 0:
            progress(at, float(np.mean(losses)), float(np.mean(scores)))
            losses, scores = [], []


def decayed(end: float, progress: float) -> float:
    """What is left of a step size: 1 at progress 0, falling exponentially to `end` at 1 (Kerbl et al. 2023)."""
    return float(end**progress)


def photo_at(iteration: int, n: int, seed: int) -> int:
    """Which of n photos an iteration looks at: each once per round, shuffled by seed and round alone."""
    order = np.random.Generator(np.random.Philox(key=[seed, iteration // n])).permutation(n)
    return int(order[iteration % n])


def _iterate(problem: Problem, state: FitState, settings: FitSettings, threads: int) -> tuple[float, float]:
    row = photo_at(state.iteration, len(problem.train), settings.seed)
    shot = problem.train[row]
    camera = corrected(shot.photo.world_from_camera, state.learned["poses"].values[row])
    scene, parts = compose(problem, state, shot.photo)
    seen, sky = _look(state, scene, shot.photo, camera, threads)
    colours = state.learned["exposure"].values[row]
    picture = exposed(seen.view.rgb, colours)
    loss, d_picture = photo_loss(picture, shot.target, settings.ssim_weight)
    d_rgb, d_colours = exposed_gradient(seen.view.rgb, colours, d_picture)
    d_alpha = None
    if settings.opaque_weight > 0.0:
        through, d_alpha = opaque_loss(seen.view.alpha, shot.ground, settings.opaque_weight)
        loss += through
    back = backward(seen, scene, d_rgb, d_alpha=d_alpha, threads=threads)
    _step_world(state, settings, row, back, d_colours)
    cells, d_cells = backdrop_gradient(d_rgb, seen.view.alpha, sky)
    fall = decayed(RATE_END, state.iteration / settings.iterations)
    state.learned["sky"].step(cells, d_cells, fall * settings.sky_rate)
    depths = seen.splats.projected[:, DEPTH]
    _step_gaussians(state, settings, *_of_owners(back, parts), depths)
    if problem.road is not None:
        rows = back.index[: np.searchsorted(back.index, len(parts[0].rows))]  # the background's are their own rows
        means, quats, log_scales = (state.learned[name].values for name in ("means", "quats", "log_scales"))
        lay_flat(means, quats, log_scales, rows[state.road[rows]], problem.road)
    return loss, psnr(np.clip(picture, 0.0, 1.0), shot.target.rgb)


def compose(problem: Problem, state: FitState, photo: Photo) -> tuple[Gaussians, list[OwnedGaussians]]:
    """All Gaussians that a photo (pose local) may show, in the scene, and whose they are; the background's first."""
    every = state.gaussians()
    n = int(np.searchsorted(state.owner, 0))
    scenes, parts = [every.take(slice(n))], [OwnedGaussians(0, np.arange(n), None)]
    boxes, valid = problem.tracks.at(photo.time_s)
    frames = world_from_boxes(boxes)
    for j in np.flatnonzero(valid & _in_view(boxes, photo)):
        mine = slice(*np.searchsorted(state.owner, [j, j + 1]))
        if mine.start < mine.stop:
            parts.append(OwnedGaussians(n, np.arange(mine.start, mine.stop), frames[j]))
            scenes.append(moved(every.take(mine), frames[j]))
            n += mine.stop - mine.start
    return (scenes[0] if len(scenes) == 1 else concatenate(scenes)), parts


def _in_view(boxes: Array, photo: Photo) -> Bools:
    """Whether a ball around each box (N, 7) reaches into the photo's pyramid: (N,)."""
    radius = 0.5 * np.linalg.norm(boxes[:, 4:], axis=1) + VIEW_MARGIN_M
    height, width = photo.rgb.shape[:2]
    camera_from_scene = np.linalg.inv(photo.world_from_camera)
    at = boxes[:, :3] @ camera_from_scene[:3, :3].T + camera_from_scene[:3, 3]
    seen = at[:, 2] > -radius
    for axis, size in enumerate((width, height)):
        focal, middle = photo.intrinsics[axis, axis], photo.intrinsics[axis, 2]
        slope = max(middle, size - middle) / focal
        seen &= np.abs(at[:, axis]) < slope * at[:, 2] + radius * np.hypot(1.0, slope)
    return np.asarray(seen)


def _look(state: FitState, scene: Gaussians, photo: Photo, camera: Array, threads: int) -> tuple[ForwardPass, SkyCells]:
    """The photo's picture from `camera` (4, 4), and where its sky comes from."""
    height, width = photo.rgb.shape[:2]
    sky = sky_cells(photo.intrinsics, camera, width, height, threads)
    behind = backdrop(state.learned["sky"].values, sky, threads)
    return forward(scene, photo.intrinsics, camera, width, height, behind, threads), sky


def _step_world(state: FitState, settings: FitSettings, row: int, back: Gradients, d_colours: F32) -> None:
    """Exposure and pose of the photo."""
    at, fall = np.array([row]), decayed(RATE_END, state.iteration / settings.iterations)
    state.learned["exposure"].step(at, d_colours[None], fall * settings.exposure_rate)
    if state.iteration >= settings.pose_from:
        poses = state.learned["poses"]
        # Shift and turn step by different rates: the gradient's own size does not matter to Adam.
        before = poses.values[row].copy()
        poses.step(at, back.camera[None].astype(np.float32), fall)
        rates = np.repeat([settings.shift_rate, settings.turn_rate], 3).astype(np.float32)
        poses.values[row] = before + rates * (poses.values[row] - before)


def _of_owners(back: Gradients, parts: Sequence[OwnedGaussians]) -> tuple[Ints, Gradients]:
    """The gradients in the frames that the Gaussians are learned in, and their rows in the state."""
    rows, pieces = [], []
    for part in parts:
        span = slice(*np.searchsorted(back.index, [part.first, part.first + len(part.rows)]))
        piece = Gradients(**{name: getattr(back, name)[span] for name in _PER_GAUSSIAN}, camera=back.camera)
        pieces.append(piece if part.scene_from_owner is None else unmoved(piece, part.scene_from_owner))
        rows.append(part.rows[piece.index - part.first])
    together = {name: np.concatenate([getattr(piece, name) for piece in pieces]) for name in _PER_GAUSSIAN}
    return np.concatenate(rows), Gradients(**together, camera=back.camera)


def _step_gaussians(state: FitState, settings: FitSettings, rows: Ints, mine: Gradients, depths: F32) -> None:
    """Steps `rows` (M,), at `depths` (M,) in the photo."""
    learned = state.learned
    state.nearest[rows] = np.minimum(state.nearest[rows], depths)
    state.wanted[rows] += np.hypot(mine.screen[:, 0], mine.screen[:, 1])
    fall = decayed(RATE_END, state.iteration / settings.iterations)
    mean_rate = settings.mean_rate * decayed(settings.mean_rate_end, state.iteration / settings.iterations)
    learned["means"].step(rows, mine.means, mean_rate, state.nearest[rows])
    learned["quats"].step(rows, mine.quats, fall * settings.quat_rate)
    learned["log_scales"].step(rows, mine.log_scales, fall * settings.scale_rate)
    learned["logits"].step(rows, mine.logits[:, None], fall * settings.opacity_rate)
    learned["colours"].step(rows, mine.colours, fall * settings.colour_rate)
    if mine.sh_rest.shape[1]:
        learned["sh_rest"].step(rows, mine.sh_rest.reshape(len(rows), -1), fall * SH_RATE)


_PER_GAUSSIAN = ("index", "means", "quats", "log_scales", "logits", "colours", "sh_rest", "screen")


def picture_of(problem: Problem, state: FitState, photo: Photo, threads: int = 1) -> F32:
    """What the fit makes of a photo of the block that it need not have seen (H, W, 3).

    Pose correction and exposure are those learned from the same camera, between the photos before and after.
    `photo.world_from_camera` is local (minus `problem.origin`).
    """
    row_pose, row_colour = corrections_at(problem, state, photo.camera, photo.time_s)
    camera = corrected(photo.world_from_camera, row_pose)
    scene, _ = compose(problem, state, photo)
    seen, _ = _look(state, scene, photo, camera, threads)
    return np.clip(exposed(seen.view.rgb, row_colour), 0.0, 1.0)


def corrections_at(problem: Problem, state: FitState, camera: str, time_s: float) -> tuple[F32, F32]:
    """Pose correction (6,) and exposure (12,) of a camera at a time; zeros for one that no photo was learned from."""
    rows = [i for i, shot in enumerate(problem.train) if shot.photo.camera == camera]
    poses, colours = state.learned["poses"].values, state.learned["exposure"].values
    if not rows:
        return np.zeros(poses.shape[1], np.float32), np.zeros(colours.shape[1], np.float32)
    times = np.array([problem.train[i].photo.time_s for i in rows])
    return between(times, poses[rows], time_s), between(times, colours[rows], time_s)


def finish(problem: Problem, state: FitState, threads: int = 2) -> RenderAsset:
    """The scene as it is rendered, with the PSNR of the photos held out."""
    every = state.gaussians()
    every = replace(every, quats=every.quats / np.linalg.norm(every.quats, axis=1, keepdims=True))
    nodes = {problem.tracks.ids[j]: every.take(state.owner == j) for j in np.unique(state.owner[state.owner >= 0])}
    views = []
    for shot in problem.held_out:
        picture, photo = picture_of(problem, state, shot.photo, threads), shot.photo
        quality = psnr(picture, shot.target.rgb), ssim(picture, shot.target)[0]
        views.append(ViewQuality(photo.camera, photo.time_s, *quality, held_out=True))
    return RenderAsset(
        problem.origin,
        every.take(state.owner == BACKGROUND),
        nodes,
        SkyMap(np.clip(state.learned["sky"].values, 0.0, 1.0).reshape(ROWS, COLUMNS, 3)),
        float(np.mean([view.psnr_db for view in views])) if views else float("nan"),
        len(views),
        views=tuple(views),
        exposures=tuple(
            Exposure(shot.photo.camera, shot.photo.time_s, np.column_stack(matrix_of(row)))
            for shot, row in zip(problem.train, state.learned["exposure"].values)
        ),
    )
