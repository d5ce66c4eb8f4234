"""Corners of a photo, and which of them two photos share (SIFT, Lowe 2004)."""

from dataclasses import dataclass

import cv2
import numpy as np

from tasks.world.arrays import F32, Array, Bools, Bytes, Indices

CONTRAST = 0.02  # OpenCV's threshold, half its default: asphalt and facades have faint corners
RATIO = 0.85  # the second best match must be this much worse
UNIT = 512.0  # length of a descriptor: whole numbers whose products are exact in float32, in any order of the sum
EPIPOLAR_PX = 2.0  # of the picture that corners were looked for in: how far a match may miss its line
LEAST_MATCHES = 12  # that agree with one geometry of two photos


@dataclass(frozen=True)
class Corners:
    """What is remembered of one photo."""

    at: Array  # (K, 2) pixels of the photo as it was taken, the centre of the first at (0.5, 0.5)
    descriptors: F32  # (K, 128) whole numbers
    pixel: float  # pixels of the photo per pixel of the picture that was looked at


def corners_of(rgb: Bytes, width: int, most: int, hidden: Bools | None = None) -> Corners:
    """The corners of a photo (H, W, 3) shrunk to `width`, none where it is `hidden` (h, w), a mask of any size."""
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    scale = max(1.0, rgb.shape[1] / width)
    size = round(rgb.shape[1] / scale), round(rgb.shape[0] / scale)
    if scale > 1.0:
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    mask = None
    if hidden is not None:
        mask = 255 - 255 * cv2.resize(hidden.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    sift = cv2.SIFT_create(nfeatures=most, contrastThreshold=CONTRAST)  # type: ignore[attr-defined]
    found, descriptors = sift.detectAndCompute(grey, mask)
    if descriptors is None:
        return Corners(np.zeros((0, 2)), np.zeros((0, 128), np.float32), scale)
    at = (np.array([corner.pt for corner in found], np.float64) + 0.5) * [
        rgb.shape[1] / size[0],
        rgb.shape[0] / size[1],
    ]
    # One corner may be found with several orientations; distances of square roots compare better (Arandjelovic 2012).
    share = descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1.0)
    return Corners(at, np.rint(UNIT * np.sqrt(share)).astype(np.float32), scale)


def matches(a: Corners, b: Corners) -> tuple[Indices, Indices]:
    """Rows of corners that are each other's best by far and agree with one geometry; none where too few do."""
    nobody = np.zeros(0, np.intp), np.zeros(0, np.intp)
    if min(len(a.at), len(b.at)) < LEAST_MATCHES:
        return nobody
    alike = a.descriptors @ b.descriptors.T
    best = alike.argmax(axis=1)
    rows = np.arange(len(best))
    first = alike[rows, best]
    mutual = alike.argmax(axis=0)[best] == rows
    alike[rows, best] = -1.0
    second = alike.max(axis=1)
    norms = [(c.descriptors**2).sum(axis=1) for c in (a, b)]
    near = norms[0] + norms[1][best] - 2.0 * first
    next_near = norms[0] + UNIT**2 - 2.0 * second
    keep = np.flatnonzero(mutual & (near < RATIO**2 * next_near))
    if len(keep) < LEAST_MATCHES:
        return nobody
    pairs = [c.at[r] / c.pixel for c, r in ((a, keep), (b, best[keep]))]
    _, agree = cv2.findFundamentalMat(pairs[0], pairs[1], cv2.USAC_MAGSAC, EPIPOLAR_PX, 0.999, 2000)
    if agree is None or agree.sum() < LEAST_MATCHES:
        return nobody
    keep = keep[agree.ravel() > 0]
    return keep, best[keep]
