"""A z-buffered triangle rasteriser in homogeneous coordinates (Olano and Greer 1997): needs no clipping.

Vertices become rows (x, y, w) of a 3x3 matrix whose inverse gives the edge functions e_i, affine in the image, with
e_i = barycentric_i / w: inside where all are >= 0, 1/w = sum e_i, attribute/w = sum attribute_i e_i.
Visible is the largest `key`, interpolated the same way: 1/w for a camera, height above a plane for the sun's view.
"""

import math
from typing import NamedTuple

import numpy as np

from factory.readers.town.textures import LEAVES, SPOKES, TREELINE, opaque_at
from tasks.kernels.compiled import drawing_kernel
from tasks.world.arrays import F32, Array, Ints, ShortInts

NEAR_M = 0.15


class Mesh(NamedTuple):
    """T triangles; z is height above the road, x and y world or object coordinates. Kernels take it whole."""

    vertices: Array  # (T, 3, 3) m
    uv: Array  # (T, 3, 2) surface coordinates, mostly metres
    normals: Array  # (T, 3) unit
    material: Ints  # (T,) textures.py
    colour: Array  # (T, 3) 0..1
    extent: Array  # (T, 2) size of the whole face [m]
    seed: Ints  # (T,)

    def placed(self, pose: Array) -> "Mesh":
        """The object mesh standing on the road at pose (x, y, heading)."""
        c, s = np.cos(pose[2]), np.sin(pose[2])
        turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        return self._replace(vertices=self.vertices @ turn + [pose[0], pose[1], 0.0], normals=self.normals @ turn)


@drawing_kernel
def rasterise(mesh: Mesh, view: Array, keys: F32, ids: ShortInts) -> Array:
    """Draws triangles into `keys` and `ids` (H, W), the visible one's number.

    Sample (row, column) lies at (column + 0.5, row + 0.5). The view (4, 4) takes a world point (1) to x, y, w, key; it
    is seen at (x / w, y / w). Returns each triangle's 1/w, u/w, v/w as a x + b y + c, (T, 9); 0 out of the view.
    """
    vertices, uv, material, seed = mesh.vertices, mesh.uv, mesh.material, mesh.seed
    planes = np.zeros((vertices.shape[0], 9))
    height, width = keys.shape
    h = np.empty((3, 4))
    e = np.empty((3, 3))
    for t in range(vertices.shape[0]):
        n_behind = 0
        for i in range(3):
            x, y, z = vertices[t, i, 0], vertices[t, i, 1], vertices[t, i, 2]
            for k in range(4):
                h[i, k] = view[k, 0] * x + view[k, 1] * y + view[k, 2] * z + view[k, 3]
            if h[i, 2] < NEAR_M:
                n_behind += 1
        if n_behind == 3:
            continue
        x_low, x_high, y_low, y_high = 1e9, -1e9, 1e9, -1e9
        for i in range(3):
            if h[i, 2] >= NEAR_M:
                px, py = h[i, 0] / h[i, 2], h[i, 1] / h[i, 2]
                x_low, x_high, y_low, y_high = min(x_low, px), max(x_high, px), min(y_low, py), max(y_high, py)
            j = (i + 1) % 3
            if (h[i, 2] < NEAR_M) != (h[j, 2] < NEAR_M):
                along = (NEAR_M - h[i, 2]) / (h[j, 2] - h[i, 2])
                px = (h[i, 0] + along * (h[j, 0] - h[i, 0])) / NEAR_M
                py = (h[i, 1] + along * (h[j, 1] - h[i, 1])) / NEAR_M
                x_low, x_high, y_low, y_high = min(x_low, px), max(x_high, px), min(y_low, py), max(y_high, py)
        if x_high < 0 or y_high < 0 or x_low > width or y_low > height:
            continue
        row_low, row_high = max(0, math.ceil(y_low - 0.5)), min(height - 1, math.floor(y_high - 0.5))
        left, right = max(0, math.ceil(x_low - 0.5)), min(width - 1, math.floor(x_high - 0.5))
        if row_low > row_high or left > right:
            continue
        for i in range(3):
            a, b = (i + 1) % 3, (i + 2) % 3
            e[i, 0] = h[a, 1] * h[b, 2] - h[a, 2] * h[b, 1]
            e[i, 1] = h[a, 2] * h[b, 0] - h[a, 0] * h[b, 2]
            e[i, 2] = h[a, 0] * h[b, 1] - h[a, 1] * h[b, 0]
        det = h[0, 0] * e[0, 0] + h[0, 1] * e[0, 1] + h[0, 2] * e[0, 2]
        if abs(det) < 1e-12:
            continue
        e /= det
        kx, ky, kc = 0.0, 0.0, 0.0
        for i in range(3):
            kx += e[i, 0] * h[i, 3]
            ky += e[i, 1] * h[i, 3]
            kc += e[i, 2] * h[i, 3]
        kind = material[t]
        cut_out = kind in (LEAVES, TREELINE, SPOKES)
        p = planes[t]
        for i in range(3):
            for k in range(3):
                p[k] += e[i, k]
                p[3 + k] += e[i, k] * uv[t, i, 0]
                p[6 + k] += e[i, k] * uv[t, i, 1]
        for row in range(row_low, row_high + 1):
            y = row + 0.5
            start, stop = float(left), float(right)
            for i in range(3):
                value = e[i, 1] * y + e[i, 2]
                if e[i, 0] > 0:
                    start = max(start, -value / e[i, 0] - 0.5)
                elif e[i, 0] < 0:
                    stop = min(stop, -value / e[i, 0] - 0.5)
                elif value < 0:
                    stop = -1.0
            if stop < start:
                continue
            key_row = ky * y + kc
            for column in range(math.ceil(start), math.floor(stop) + 1):
                x = column + 0.5
                key = np.float32(kx * x + key_row)
                if key > keys[row, column]:
                    if cut_out:
                        w = 1.0 / (p[0] * x + p[1] * y + p[2])
                        u, v = (p[3] * x + p[4] * y + p[5]) * w, (p[6] * x + p[7] * y + p[8]) * w
                        if not opaque_at(kind, u, v, seed[t]):
                            continue
                    keys[row, column] = key
                    ids[row, column] = t
    return planes
