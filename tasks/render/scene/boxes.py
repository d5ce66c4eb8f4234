"""A plain shaded box made of Gaussians, for an agent nobody took a good photo of."""

from functools import lru_cache

import numpy as np

from tasks.render.scene.surfels import Discs, gaussians_of
from tasks.render.splatting.gaussians import Gaussians
from tasks.world.agents import AgentKind
from tasks.world.arrays import Array

SPACING_M = 0.15
BODY = {
    AgentKind.VEHICLE: (0.50, 0.52, 0.55),
    AgentKind.PEDESTRIAN: (0.35, 0.30, 0.30),
    AgentKind.BICYCLE: (0.30, 0.33, 0.38),
    AgentKind.TRAFFIC_CONE: (0.90, 0.45, 0.10),
}
OTHER = (0.6, 0.6, 0.6)
# Face normal -> how much light it gets: an overcast day.
SHADE = {(0, 0, 1): 1.0, (1, 0, 0): 0.8, (-1, 0, 0): 0.7, (0, 1, 0): 0.75, (0, -1, 0): 0.65}


def box_gaussians(size: Array, kind: AgentKind) -> Gaussians:
    """Five faces (the underside is never seen) of a box (3,) length, width, height [m], in box coordinates.

    Neutral colours, lit from above; vehicles get a dark band where windows are, so that they read as cars.
    """
    return _box(tuple(float(s) for s in np.round(size, 2)), kind)


@lru_cache(maxsize=256)
def _box(size: tuple[float, float, float], kind: AgentKind) -> Gaussians:
    points, across, down, colours = [], [], [], []
    half = np.array(size) / 2.0
    for normal, light in SHADE.items():
        axis = int(np.argmax(np.abs(normal)))
        first, second = [k for k in range(3) if k != axis]
        n1, n2 = (max(2, int(np.ceil(size[k] / SPACING_M))) for k in (first, second))
        grid1, grid2 = np.meshgrid((np.arange(n1) + 0.5) / n1 - 0.5, (np.arange(n2) + 0.5) / n2 - 0.5)
        face = np.zeros((n1 * n2, 3))
        face[:, first], face[:, second] = grid1.ravel() * size[first], grid2.ravel() * size[second]
        face[:, axis] = normal[axis] * half[axis]
        step1, step2 = np.zeros((len(face), 3)), np.zeros((len(face), 3))
        step1[:, first], step2[:, second] = size[first] / n1, size[second] / n2
        colour = np.tile(np.array(BODY.get(kind, OTHER)) * light, (len(face), 1))
        if kind == AgentKind.VEHICLE and axis != 2:
            height = face[:, 2] / size[2] + 0.5
            colour[(height > 0.55) & (height < 0.88)] *= 0.35
            colour[height < 0.15] *= 0.4
        points.append(face)
        across.append(step1)
        down.append(step2)
        colours.append(colour)
    stacked = np.concatenate(points)
    return gaussians_of(
        Discs(
            stacked,
            np.concatenate(across).astype(np.float32),
            np.concatenate(down).astype(np.float32),
            np.concatenate(colours).astype(np.float32),
            np.full(len(stacked), SPACING_M, np.float32),
            np.zeros((len(stacked), 2), np.int32),
        )
    )
