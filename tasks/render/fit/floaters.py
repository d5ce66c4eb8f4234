"""Gaussians of the street that hang before a vehicle which drives: they explain a photo or two, and hide it elsewhere.

A vehicle that drives past is seen for a few instants, each time against another part of the street. Where its own
Gaussians do not match a photo yet, some of the street come to stand between; from the photo's own place the picture is
right, from a metre aside there is rubble before the vehicle. What really stands there, other photos show as well.
"""

from typing import Any

import numpy as np

from tasks.kernels.compiled import kernel
from tasks.render.fit.corrections import corrected, exposed
from tasks.render.fit.start import Problem, Shot
from tasks.render.fit.state import BACKGROUND, FitState, opacities_of
from tasks.render.scene.body import BEFORE_M, bodies_near, nearest_box
from tasks.render.scene.movers import SHIFT_SIZE, at_knots, shifted_boxes
from tasks.world.arrays import F32, Array, Ints

LEAST_OPACITY = 0.02  # what hides less may stay
ALIKE = 0.08  # of every colour channel: a photo that differs by less shows the Gaussian
FARTHER = 2.0  # times the depth at which it hides: photos from farther off see too little of it
SHOWN_BY = 0.5  # of the photos that look at its place: no more, and it is a floater
NEAREST_M = 0.3  # to a camera
GONE_LOGIT = -8.0  # of its opacity


def clear_floaters(problem: Problem, state: FitState) -> int:
    """Makes floaters transparent, in place, for `refine` to put them elsewhere. Returns how many there were."""
    rows = floaters(problem, state)
    state.learned["logits"].values[rows] = GONE_LOGIT
    state.learned["logits"].forget(rows)
    if state.noted:
        state.averages["logits"][rows] = GONE_LOGIT
    return len(rows)


def floaters(problem: Problem, state: FitState) -> Ints:
    """Rows (M,) of Gaussians of the street, not of its road, that hide the body of a vehicle which drives in some photo
    by BEFORE_M or more, and that at most SHOWN_BY of the other photos which look there show in their own colour.

    No other photo looks there: it goes too. A photo in which such a body hides the place says nothing of it.
    """
    n = int(np.searchsorted(state.owner, BACKGROUND + 1))
    loose = ~state.road[:n] & (opacities_of(state.learned["logits"].values[:n, 0]) > LEAST_OPACITY)
    rows = np.flatnonzero(loose)
    means = state.learned["means"].values[rows].astype(np.float64)
    least_m, silent = np.full(len(rows), np.inf), list[Ints]()
    for i in range(len(problem.train)):
        hiding, depths_m, hidden = _at_bodies(problem, state, i, means)
        least_m[hiding] = np.minimum(least_m[hiding], depths_m)
        silent.append(np.concatenate([hiding, hidden]))
    found = np.flatnonzero(np.isfinite(least_m))
    looked, shown = np.zeros(len(found), np.int64), np.zeros(len(found), np.int64)
    colours = state.learned["colours"].values[rows[found]]
    for i, shot in enumerate(problem.train):
        pixel, depth_m = _in_photo(shot, state.learned["poses"].values[i], means[found])
        looking = (pixel >= 0) & (depth_m < FARTHER * least_m[found]) & ~np.isin(found, silent[i])
        if shot.hidden is not None:
            looking &= ~shot.hidden.ravel()[pixel]
        mine = exposed(colours[looking], state.learned["exposure"].values[i])
        theirs = shot.photo.rgb.reshape(-1, 3)[pixel[looking]] / np.float32(255.0)
        looked += looking
        shown[looking] += np.abs(np.clip(mine, 0.0, 1.0) - theirs).max(axis=1) < ALIKE
    return rows[found[shown <= SHOWN_BY * looked]]


def _at_bodies(problem: Problem, state: FitState, i: int, means: Array) -> tuple[Ints, Array, Ints]:
    """Of `means` (M, 3) those that hide the body of a vehicle which drives in photo `i`, their depths in it [m], and
    those that such a body hides."""
    shot, tracks, nothing = problem.train[i], problem.tracks, np.zeros(0, np.int64)
    boxes, valid = tracks.at(shot.photo.taken_s)
    off = state.learned["boxes"].values.reshape(len(boxes), tracks.n_knots, SHIFT_SIZE)
    boxes = shifted_boxes(boxes, at_knots(off, shot.photo.taken_s))
    eye = corrected(shot.photo.world_from_camera, state.learned["poses"].values[i])[:3, 3].copy()
    bodies, drives = bodies_near(boxes, valid, tracks, eye)
    if not drives.any():
        return nothing, np.zeros(0), nothing
    pixel, depth_m = _in_photo(shot, state.learned["poses"].values[i], means)
    rows = np.flatnonzero(pixel >= 0)
    along, first = nearest_box(means[rows] - eye, eye, bodies)
    on = (first >= 0) & drives[first]
    rows, along = rows[on], along[on]
    before_m = (along - 1.0) * np.linalg.norm(means[rows] - eye, axis=1)
    hiding = rows[before_m > BEFORE_M]
    return hiding, depth_m[hiding], rows[before_m < 0.0]


def _in_photo(shot: Shot, pose: F32, means: Array) -> tuple[Ints, Array]:
    """Which pixel of the photo shows each mean (M, 3), row by row, -1 where none does; and its depth [m]."""
    camera_from_scene = np.linalg.inv(corrected(shot.photo.world_from_camera, pose))
    return project(means, camera_from_scene, shot.photo.intrinsics, *shot.photo.rgb.shape[:2])


@kernel
def project(means: Any, camera_from_scene: Any, k: Any, height: int, width: int) -> Any:
    """As `_in_photo` has it, for a camera (4, 4) with intrinsics (3, 3)."""
    pixel, depth = np.full(means.shape[0], -1, np.int64), np.zeros(means.shape[0])
    m = camera_from_scene
    for i in range(means.shape[0]):
        x, y, z = means[i, 0], means[i, 1], means[i, 2]
        depth[i] = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
        if depth[i] <= NEAREST_M:
            continue
        u = k[0, 0] * (m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]) / depth[i] + k[0, 2]
        v = k[1, 1] * (m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]) / depth[i] + k[1, 2]
        if 0.0 <= u < width and 0.0 <= v < height:
            pixel[i] = int(v) * width + int(u)
    return pixel, depth
