"""The fit on the CPU: photos drawn and differentiated by the compiled kernels, to the same bytes on any machine's
number of threads."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tasks.render.fit.backend import Derivatives, OwnedGaussians, backdrop_gradient, by_box, parts_of
from tasks.render.fit.corrections import corrected, exposed, exposed_gradient
from tasks.render.fit.losses import opaque_loss, photo_loss
from tasks.render.fit.start import Problem
from tasks.render.fit.state import FitState
from tasks.render.scene.asset import psnr
from tasks.render.scene.movers import SHIFT_SIZE
from tasks.render.scene.sensed import Photo
from tasks.render.scene.sky import SkyCells, backdrop, sky_cells
from tasks.render.settings import FitSettings
from tasks.render.splatting.gaussians import Gaussians, concatenate, moved
from tasks.render.splatting.gradient import Gradients, backward, unmoved
from tasks.render.splatting.project import DEPTH
from tasks.render.splatting.raster import ForwardPass, forward
from tasks.world.arrays import F32, Array, Ints

_PER_GAUSSIAN = ("index", "means", "quats", "log_scales", "logits", "colours", "screen")


@dataclass(frozen=True)
class OnCpu:
    """The state is worked on where it is."""

    threads: int = 1

    def take(self, state: FitState) -> FitState:
        """The state itself."""
        return state

    def give_back(self, held: FitState, state: FitState) -> None:
        """It was never away."""

    def derivatives(self, problem: Problem, held: FitState, row: int, settings: FitSettings) -> Derivatives:
        """As `FitBackend` has it."""
        shot, state = problem.train[row], held
        compared = shot.compared
        camera = corrected(shot.photo.world_from_camera, state.learned["poses"].values[row])
        scene, parts = compose(problem, state, state.learned["boxes"].values, shot.photo)
        seen, sky = forward_pass(state, scene, shot.photo, camera, self.threads)
        colours = state.learned["exposure"].values[row]
        picture = exposed(seen.view.rgb, colours)
        loss, d_picture = photo_loss(picture, compared.target, settings.ssim_weight)
        d_rgb, d_colours = exposed_gradient(seen.view.rgb, colours, d_picture)
        d_alpha = None
        if settings.opaque_weight > 0.0:
            through, d_alpha = opaque_loss(seen.view.alpha, compared.ground, settings.opaque_weight)
            loss += through
        back = backward(seen, scene, d_rgb, d_alpha=d_alpha, threads=self.threads)
        cells, d_cells = backdrop_gradient(d_rgb, seen.view.alpha, sky)
        rows, mine = _of_owners(back, parts)
        tracks, boxes = _of_boxes(state, parts, rows, mine)
        score = psnr(np.clip(picture, 0.0, 1.0), compared.target.rgb)
        depths = seen.splats.projected[:, DEPTH]
        return Derivatives(loss, score, d_colours, back.camera, cells, d_cells, rows, mine, depths, tracks, boxes)


def compose(problem: Problem, state: FitState, off: F32, photo: Photo) -> tuple[Gaussians, list[OwnedGaussians]]:
    """All Gaussians that a photo (pose local) may show, in the scene, and whose they are; the background's first.

    `off` (tracks * knots, SHIFT_SIZE): what boxes are off by.
    """
    every = state.gaussians()
    parts = parts_of(problem, state.owner, off, photo)
    scenes = []
    for part in parts:
        mine = every.take(slice(part.rows[0], part.rows[-1] + 1) if len(part.rows) else slice(0))
        scenes.append(mine if part.scene_from_owner is None else moved(mine, part.scene_from_owner))
    return (scenes[0] if len(scenes) == 1 else concatenate(scenes)), parts


def forward_pass(
    state: FitState, scene: Gaussians, photo: Photo, camera: Array, threads: int
) -> tuple[ForwardPass, SkyCells]:
    """The photo's picture from `camera` (4, 4), and where its sky comes from."""
    height, width = photo.rgb.shape[:2]
    sky = sky_cells(photo.intrinsics, camera, width, height, threads)
    behind = backdrop(state.learned["sky"].values, sky, threads)
    return forward(scene, photo.intrinsics, camera, width, height, behind, threads), sky


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


def _of_boxes(state: FitState, parts: Sequence[OwnedGaussians], rows: Ints, mine: Gradients) -> tuple[Ints, F32]:
    """Tracks (B,), and derivatives (B, SHIFT_SIZE) by what their boxes are off by; `rows` and `mine` of all parts."""
    tracks, found = [], []
    means, quats = (state.learned[name].values for name in ("means", "quats"))
    for part in parts:
        if part.track is not None:
            span = slice(*np.searchsorted(rows, [part.rows[0], part.rows[-1] + 1]))
            shift, turn = by_box(
                part,
                *(array.astype(np.float64) for array in (means[rows[span]], quats[rows[span]])),
                *(array.astype(np.float64) for array in (mine.means[span], mine.quats[span])),
            )
            tracks.append(part.track)
            found.append(np.append(shift, turn))
    return np.array(tracks, np.int64), np.array(found, np.float32).reshape(-1, SHIFT_SIZE)
