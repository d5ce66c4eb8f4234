"""What the fit asks of whoever draws: the loop of `reconstruct` is written once, over this.

A backend says of one photo how its loss changes with all that is learned, and keeps the arrays where it works
meanwhile: in place on the CPU, on a device elsewhere. Which photo, which step sizes, when Gaussians are moved and when
poses are is the loop's, and the same with every backend.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from tasks.kernels.compiled import kernel
from tasks.render.fit.corrections import apply_exposure, apply_exposure_gradient, corrected_pose
from tasks.render.fit.losses import opaque_loss, photo_loss
from tasks.render.fit.start import FitProblem
from tasks.render.fit.state import FitState
from tasks.render.scene.asset import decibels
from tasks.render.scene.movers import SHIFT_SIZE, interpolate_knots, shift_boxes, world_from_boxes
from tasks.render.scene.sensed import Photo, boxes_in_view
from tasks.render.scene.sky import COLUMNS, ROWS, SkyCells, put_sky_behind, sky_cells, upper_cells
from tasks.render.settings import FitSettings
from tasks.render.splatting.gaussians import Gaussians, concatenate, moved
from tasks.render.splatting.gradient import Gradients, backward, untransformed_gradients
from tasks.render.splatting.project import DEPTH
from tasks.render.splatting.raster import ForwardPass, forward
from tasks.world.arrays import F32, Array, Ints, ShortInts


@dataclass(frozen=True)
class Derivatives:
    """What one photo says of all that is learned; arrays of Gaussians and sky are of the kind that a backend holds."""

    loss: float
    psnr_db: float
    exposure: F32  # (12,) by the photo's row
    camera: Array  # (6,) as of `Gradients`
    cells: Any  # (K,) of the sky, that shine into the photo
    sky: Any  # (K, 3) by them
    rows: Any  # (M,) of the state, ascending, that are in view
    gaussians: Gradients  # by those, in the frames of their owners
    depths: Any  # (M,) [m] of those
    tracks: Ints  # (B,) of which the photo may show some
    boxes: F32  # (B, SHIFT_SIZE) by what their boxes are off by at its time


class FitBackend(Protocol):
    """Draws and differentiates."""

    def load(self, state: FitState) -> Any:
        """The state as a `LearnedState`, where this backend works."""

    def store(self, held: Any, state: FitState) -> None:
        """What became of a taken state, into `state`."""

    def derivatives(self, problem: FitProblem, held: Any, row: int, settings: FitSettings) -> Derivatives:
        """Of the photo `row` of those trained on, as `held` is now."""


# Which Gaussians a photo of the fit may show, and where their owners were at its time.


@dataclass(frozen=True)
class OwnedGaussians:
    """Consecutive Gaussians of a composed scene that share an owner."""

    first: int
    rows: Ints  # (M,) in the state
    scene_from_owner: Array | None  # (4, 4); None: the background's, which is the scene's
    track: int | None = None  # its row; None: the background's
    shift: F32 | None = None  # (SHIFT_SIZE,) by which its box is off then


def visible_parts(problem: FitProblem, owner: ShortInts, off: F32, photo: Photo) -> list[OwnedGaussians]:
    """The parts of the scene that a photo (pose local) may show, the background first; `owner` (N,) and `off`, what
    boxes are off by, (tracks * knots, SHIFT_SIZE), as of the state."""
    boxes, valid = problem.tracks.at(photo.time_s)
    starts = np.searchsorted(owner, np.arange(len(boxes) + 1, dtype=owner.dtype))  # else all owners are converted
    n = int(starts[0])
    parts = [OwnedGaussians(0, np.arange(n), None)]
    shifts = interpolate_knots(off.reshape(len(boxes), problem.tracks.n_knots, SHIFT_SIZE), photo.time_s)
    boxes = shift_boxes(boxes, shifts)
    frames = world_from_boxes(boxes)
    for j in np.flatnonzero(valid & boxes_in_view(boxes, photo)):
        first, last = starts[j], starts[j + 1]
        if first < last:
            parts.append(OwnedGaussians(n, np.arange(first, last), frames[j], int(j), shifts[j]))
            n += int(last - first)
    return parts


def box_gradient(part: OwnedGaussians, means: Any, quats: Any, d_means: Any, d_quats: Any) -> tuple[Any, Any]:
    """Derivatives by what a part's box is off by: (3,) by the shift, and by the turn.

    Of those of the part's Gaussians that are in view: `means` (M, 3) and `quats` (M, 4) in their owner's frame, and the
    derivatives by them; arrays, or tensors. What the turn does to light that depends on the side is left out.
    """
    assert part.shift is not None
    x, y = means[:, 0] + float(part.shift[0]), means[:, 1] + float(part.shift[1])
    turn = (d_means[:, 1] * x - d_means[:, 0] * y).sum()
    w, i, j, k = (quats[:, n] for n in range(4))  # turned by a little: half of (0, 0, 0, 1) times it more
    turn = turn + 0.5 * (d_quats[:, 3] * w + d_quats[:, 2] * i - d_quats[:, 1] * j - d_quats[:, 0] * k).sum()
    return d_means.sum(0), turn


# The backward pass of looking up the sky, which is learned.

HIDDEN = 0.99


@kernel
def _scatter(d_rgb: Any, alpha: Any, corners: Any, shares: Any, sums: Any, touched: Any) -> None:
    for row in range(alpha.shape[0]):
        for column in range(alpha.shape[1]):
            if alpha[row, column] > HIDDEN:
                continue
            light = np.float32(1.0) - alpha[row, column]
            fu, fv = shares[row, column, 0], shares[row, column, 1]
            upper = upper_cells(corners[row, column])
            for side in range(4):
                cell = upper[side % 2] + side // 2 * COLUMNS
                share = light * (fu if side % 2 else np.float32(1.0) - fu) * (fv if side // 2 else np.float32(1.0) - fv)
                touched[cell] = True
                for c in range(3):
                    sums[cell, c] += share * d_rgb[row, column, c]


def backdrop_gradient(d_rgb: F32, alpha: F32, where: SkyCells) -> tuple[Ints, F32]:
    """The cells (M,) that a photo's background came from, and the gradient by them (M, 3).

    `d_rgb` (H, W, 3) by the picture, `alpha` (H, W) of what stands before the background; where it hides more than
    HIDDEN the background is asked for nothing.
    """
    sums, touched = np.zeros((ROWS * COLUMNS, 3), np.float32), np.zeros(ROWS * COLUMNS, np.bool_)
    _scatter(d_rgb, alpha, where.corners, where.shares, sums, touched)
    rows = np.flatnonzero(touched)
    return rows, sums[rows]


# The fit on the CPU: photos drawn and differentiated by the compiled kernels, to the same bytes on any machine's
# number of threads.

_PER_GAUSSIAN = ("index", "means", "quats", "log_scales", "logits", "colours", "screen")
SKY_KEPT = 5_000_000  # pixels, of 12 bytes, of which is kept where they look: it stays until poses are corrected


@dataclass(frozen=True)
class CpuBackend:
    """The state is worked on where it is. Of one fit."""

    threads: int = 1
    _skies: dict[int, tuple[Array, SkyCells]] = field(default_factory=dict, repr=False)

    def load(self, state: FitState) -> FitState:
        """The state itself."""
        return state

    def store(self, held: FitState, state: FitState) -> None:
        """It was never away."""

    def derivatives(self, problem: FitProblem, held: FitState, row: int, settings: FitSettings) -> Derivatives:
        """As `FitBackend` has it."""
        shot, state = problem.train[row], held
        compared = shot.compared
        camera = corrected_pose(shot.photo.world_from_camera, state.learned["poses"].values[row])
        scene, parts = compose_scene(problem, state, state.learned["boxes"].values, shot.photo)
        seen, sky = draw_with_sky(state, scene, shot.photo, camera, self.threads, self._sky_of(row, shot.photo, camera))
        colours = state.learned["exposure"].values[row]
        aligned = settings.exposure_rate > 0.0  # else all rows are zero, and stay so
        picture = apply_exposure(seen.view.rgb, colours) if aligned else seen.view.rgb
        loss, d_picture, off_by = photo_loss(picture, compared.target, settings.ssim_weight)
        d_rgb, d_colours = d_picture, np.zeros_like(colours)
        if aligned:
            d_rgb, d_colours = apply_exposure_gradient(seen.view.rgb, colours, d_picture)
        d_alpha = None
        if settings.opaque_weight > 0.0:
            through, d_alpha = opaque_loss(seen.view.alpha, compared.ground, settings.opaque_weight)
            loss += through
        back = backward(seen, scene, d_rgb, d_alpha=d_alpha, threads=self.threads)
        cells, d_cells = backdrop_gradient(d_rgb, seen.view.alpha, sky)
        rows, mine = _gradients_in_owner_frames(back, parts)
        moving = parts if held.iteration >= settings.pose_from else []  # before it no box is asked
        tracks, boxes = _box_gradients(state, moving, rows, mine)
        depths = seen.splats.projected[:, DEPTH]
        score = decibels(off_by)
        return Derivatives(loss, score, d_colours, back.camera, cells, d_cells, rows, mine, depths, tracks, boxes)

    def _sky_of(self, row: int, photo: Photo, camera: Array) -> SkyCells | None:
        """Where all pixels of a photo look, while it is taken from where it was and there is room; else None."""
        if row not in self._skies:
            height, width = photo.rgb.shape[:2]
            if height * width * (len(self._skies) + 1) > SKY_KEPT:
                return None
            self._skies[row] = camera, sky_cells(photo.intrinsics, camera, width, height, self.threads)
        at, kept = self._skies[row]
        return kept if np.array_equal(at, camera) else None


def compose_scene(
    problem: FitProblem, state: FitState, off: F32, photo: Photo
) -> tuple[Gaussians, list[OwnedGaussians]]:
    """All Gaussians that a photo (pose local) may show, in the scene, and whose they are; the background's first.

    `off` (tracks * knots, SHIFT_SIZE): what boxes are off by.
    """
    every = state.gaussians()
    parts = visible_parts(problem, state.owner, off, photo)
    scenes = []
    for part in parts:
        mine = every.take(slice(part.rows[0], part.rows[-1] + 1) if len(part.rows) else slice(0))
        scenes.append(mine if part.scene_from_owner is None else moved(mine, part.scene_from_owner))
    return (scenes[0] if len(scenes) == 1 else concatenate(scenes)), parts


def draw_with_sky(
    state: FitState, scene: Gaussians, photo: Photo, camera: Array, threads: int, sky: SkyCells | None = None
) -> tuple[ForwardPass, SkyCells]:
    """The photo's picture from `camera` (4, 4), and where its sky comes from; `sky`: that, where it is known."""
    height, width = photo.rgb.shape[:2]
    black = np.zeros(3, np.float32)
    seen = forward(scene, photo.intrinsics, camera, width, height, black, threads, with_depth=False)
    if sky is None:
        sky = sky_cells(photo.intrinsics, camera, width, height, threads, seen.view.alpha)
    put_sky_behind(seen.view.rgb, seen.view.alpha, state.learned["sky"].values, sky, threads)
    return seen, sky


def _gradients_in_owner_frames(back: Gradients, parts: Sequence[OwnedGaussians]) -> tuple[Ints, Gradients]:
    """The gradients in the frames that the Gaussians are learned in, and their rows in the state."""
    rows, pieces = [], []
    for part in parts:
        span = slice(*np.searchsorted(back.index, [part.first, part.first + len(part.rows)]))
        piece = Gradients(**{name: getattr(back, name)[span] for name in _PER_GAUSSIAN}, camera=back.camera)
        pieces.append(piece if part.scene_from_owner is None else untransformed_gradients(piece, part.scene_from_owner))
        rows.append(part.rows[piece.index - part.first])
    together = {name: np.concatenate([getattr(piece, name) for piece in pieces]) for name in _PER_GAUSSIAN}
    return np.concatenate(rows), Gradients(**together, camera=back.camera)


def _box_gradients(state: FitState, parts: Sequence[OwnedGaussians], rows: Ints, mine: Gradients) -> tuple[Ints, F32]:
    """Tracks (B,), and derivatives (B, SHIFT_SIZE) by what their boxes are off by; `rows` and `mine` of all parts."""
    tracks, found = [], []
    means, quats = (state.learned[name].values for name in ("means", "quats"))
    for part in parts:
        if part.track is not None:
            span = slice(*np.searchsorted(rows, [part.rows[0], part.rows[-1] + 1]))
            shift, turn = box_gradient(
                part,
                *(array.astype(np.float64) for array in (means[rows[span]], quats[rows[span]])),
                *(array.astype(np.float64) for array in (mine.means[span], mine.quats[span])),
            )
            tracks.append(part.track)
            found.append(np.append(shift, turn))
    return np.array(tracks, np.int64), np.array(found, np.float32).reshape(-1, SHIFT_SIZE)
