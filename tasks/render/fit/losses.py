"""How far a picture is from a photo, and which way it should change: L1 and SSIM (Wang et al. 2004)."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from tasks.kernels.compiled import inlined, numpy_division_kernel
from tasks.kernels.simd import LANES, fill, fma, larger, load, smaller, store, sums, where_below
from tasks.world.arrays import F32, Array, Bools, Bytes

WINDOW, SIGMA = 11, 1.5  # pixels, as in the paper
C1, C2 = np.float32(0.01**2), np.float32(0.03**2)  # for a range of 1
ZERO, ONE, TWO = np.float32(0.0), np.float32(1.0), np.float32(2.0)
_TAPS = cv2.getGaussianKernel(WINDOW, SIGMA, cv2.CV_32F)[:, 0]

# Pictures lie here in rows of whole vectors, one channel beside the next, with as many zeros above, below and at the
# end of each row as the window reaches: it never asks where a picture ends.

REACH = WINDOW // 2
CHANNELS = 3


def _padded(image: F32) -> F32:
    """(H + 2 REACH, S): an image (H, W, 3), zeros about it."""
    height, width, _ = image.shape
    numbers = -(-CHANNELS * (width + REACH) // LANES) * LANES
    out = np.zeros((height + 2 * REACH, numbers), np.float32)
    _inside(out, width)[:] = image
    return out


def _inside(padded: F32, width: int) -> F32:
    """The image (H, W, 3) in it, as a view."""
    rows = padded[REACH:-REACH, : CHANNELS * width]
    return rows.reshape(len(rows), width, CHANNELS)


@dataclass(frozen=True)
class Target:
    """A photo and what of it every comparison needs; padded but for `counted`."""

    photo: F32  # in [0, 1]
    mean: F32  # under the window
    variance: F32  # under the window
    share: F32  # of a mean over all that says something; 0: the pixel says nothing
    counted: Bools  # (H, W) pixels that say something

    @property
    def rgb(self) -> F32:
        """The photo (H, W, 3) in [0, 1]."""
        return _inside(self.photo, self.counted.shape[1])


def photo_target(rgb: Bytes, ignored: Bools | None = None) -> Target:
    """`rgb` (H, W, 3), `ignored` (H, W) pixels to leave out."""
    image = rgb.astype(np.float32) / np.float32(255.0)
    mean = _blur(image)
    counted = np.ones(image.shape[:2], bool) if ignored is None else ~ignored
    share = np.float32(1.0 / max(CHANNELS * counted.sum(), 1)) * np.repeat(counted, CHANNELS).reshape(image.shape)
    variance = _blur(image * image) - mean * mean
    return Target(_padded(image), _padded(mean), _padded(variance), _padded(share), counted)


def _blur(image: F32) -> F32:
    """Windowed mean (H, W, C), zeros beyond the border."""
    return np.asarray(cv2.sepFilter2D(image, cv2.CV_32F, _TAPS, _TAPS, borderType=cv2.BORDER_CONSTANT), np.float32)


@inlined
def _powers_down(picture: Any, photo: Any, row: Any, lines: Any) -> None:
    """Windowed means along the columns about a row of x, x^2 and xy, into `lines` (3, S + 2 LANES)."""
    numbers, line = np.uint64(picture.shape[1]), np.uint64(lines.shape[1])
    for i in range(0, picture.shape[1], LANES):
        at, to = np.uint64(row) * numbers + np.uint64(i), np.uint64(i + LANES)
        x, xx, xy = fill(ZERO), fill(ZERO), fill(ZERO)
        for tap in range(WINDOW):
            value = load(picture, at)
            weighed = fill(_TAPS[tap]) * value
            x, xx, xy = x + weighed, fma(weighed, value, xx), fma(weighed, load(photo, at), xy)
            at += numbers
        store(lines, to, x)
        store(lines, line + to, xx)
        store(lines, line + line + to, xy)


@inlined
def _ring_down(ring: Any, row: Any, lines: Any) -> None:
    """Windowed means along the columns about a row of a `ring` (WINDOW, 3, S) of rows, into `lines`."""
    numbers, line = np.uint64(ring.shape[2]), np.uint64(lines.shape[1])
    for i in range(0, ring.shape[2], LANES):
        x, xx, xy = fill(ZERO), fill(ZERO), fill(ZERO)
        for tap in range(WINDOW):
            at, weight = _in_ring(ring, row + tap - REACH) + np.uint64(i), fill(_TAPS[tap])
            x = fma(weight, load(ring, at), x)
            xx = fma(weight, load(ring, at + numbers), xx)
            xy = fma(weight, load(ring, at + numbers + numbers), xy)
        to = np.uint64(i + LANES)
        store(lines, to, x)
        store(lines, line + to, xx)
        store(lines, line + line + to, xy)


@inlined
def _in_ring(ring: Any, row: Any) -> Any:
    """Where the three lines of a row start."""
    return np.uint64(row % WINDOW * (ring.shape[1] * ring.shape[2]))


@inlined
def _across(lines: Any, i: Any) -> Any:
    """Windowed means along the rows of three lines, from number `i` of a row on."""
    line, at = np.uint64(lines.shape[1]), np.uint64(i + LANES - CHANNELS * REACH)
    x, xx, xy = fill(ZERO), fill(ZERO), fill(ZERO)
    for tap in range(WINDOW):
        weight = fill(_TAPS[tap])
        x = fma(weight, load(lines, at), x)
        xx = fma(weight, load(lines, line + at), xx)
        xy = fma(weight, load(lines, line + line + at), xy)
        at += np.uint64(CHANNELS)
    return x, xx, xy


@numpy_division_kernel
def _compare(
    picture: Any, photo: Any, target_mean: Any, target_variance: Any, share: Any, similar: Any, alike: Any, by: Any
) -> Any:
    """Fills `alike`, the structural similarity of each number, and `by`, the derivatives by `picture` of the mean
    difference times (1 - `similar`) less the mean similarity times `similar`; `share` weighs. All are padded.

    Returns mean similarity, mean difference, and the sum of squares of what the picture, cut off as a photo is, is off
    by. In one walk down: what a row brings is spread over the rows about it once those below it have been compared.
    """
    numbers, height = picture.shape[1], picture.shape[0] - 2 * REACH
    lines = np.zeros((3, numbers + 2 * LANES), np.float32)
    ring = np.zeros((WINDOW, 3, numbers), np.float32)  # by windowed x, x^2 and xy
    zero, one, two, c1, c2 = fill(ZERO), fill(ONE), fill(TWO), fill(C1), fill(C2)
    totals, mine, line = np.zeros(3), np.empty(LANES, np.float32), np.uint64(numbers)
    for row in range(height + REACH):
        first, similars, differences, squares = _in_ring(ring, row), zero, zero, zero
        if row < height:
            _powers_down(picture, photo, row, lines)
            for i in range(0, numbers, LANES):
                at, here = np.uint64((row + REACH) * numbers + i), first + np.uint64(i)
                x, xx, xy = _across(lines, i)
                y, yy, s = load(target_mean, at), load(target_variance, at), load(share, at)
                a1, b1 = two * x * y + c1, x * x + y * y + c1
                a2, b2 = two * (xy - x * y) + c2, xx - x * x + yy + c2
                by_1, by_2 = one / b1, one / b2
                value = a1 * by_1 * a2 * by_2
                minus_by_square = s * value * by_2
                by_mean = s * (y * (a2 - a1) * by_1 * by_2 - x * value * by_1) + x * minus_by_square
                store(ring, here, two * by_mean)
                store(ring, here + line, zero - minus_by_square)
                store(ring, here + line + line, two * s * a1 * by_1 * by_2)
                store(alike, at, value)
                similars = fma(s, value, similars)
        else:
            ring[row % WINDOW] = ZERO
        if row >= REACH:
            _ring_down(ring, row - REACH, lines)
            for i in range(0, numbers, LANES):
                at = np.uint64(row * numbers + i)
                by_mean, by_square, by_cross = _across(lines, i)
                x, y, s = load(picture, at), load(photo, at), load(share, at)
                off, shown = x - y, smaller(larger(x, zero), one) - y
                sign = where_below(zero, off, one) - where_below(off, zero, one)
                by_similar = fma(two * x, by_square, fma(y, by_cross, by_mean))
                store(by, at, fill(ONE - similar) * s * sign - fill(similar) * by_similar)
                differences, squares = fma(s, off * sign, differences), fma(shown, shown, squares)
        store(mine, np.uint64(0), sums((similars, differences, squares)))
        totals += mine[:3]
    return totals


def _compared(rgb: F32, target: Target, ssim_weight: float) -> tuple[Array, F32, F32]:
    """What `_compare` returns, and fills, of a picture (H, W, 3). Raises ValueError for one of another size."""
    if rgb.shape != (*target.counted.shape, CHANNELS):  # kernels do not look
        raise ValueError(f"loss: a picture of {rgb.shape} beside a photo of {target.counted.shape}")
    picture = _padded(rgb)
    alike, by = np.empty_like(picture), np.empty_like(picture)
    with_photo = picture, target.photo, target.mean, target.variance, target.share
    return _compare(*with_photo, np.float32(ssim_weight), alike, by), alike, by


def similarity(rgb: F32, target: Target) -> F32:
    """Structural similarity of each pixel and channel (H, W, 3) of a picture. Raises ValueError as `photo_loss`."""
    return np.ascontiguousarray(_inside(_compared(rgb, target, 1.0)[1], rgb.shape[1]))


def photo_loss(rgb: F32, target: Target, ssim_weight: float) -> tuple[float, F32, float]:
    """(1 - w) L1 + w (1 - SSIM) of a picture (H, W, 3), its gradient (H, W, 3), and the mean square by which what of it
    lies between 0 and 1 is off, whether a pixel says something or not. Raises ValueError for a picture of another size
    than the photo's."""
    (alike, apart, squares), _, by = _compared(rgb, target, ssim_weight)
    loss = (1.0 - ssim_weight) * float(apart) + ssim_weight * (1.0 - float(alike))
    return loss, np.ascontiguousarray(_inside(by, rgb.shape[1])), float(squares) / rgb.size


def opaque_loss(alpha: F32, ground: Bools, weight: float) -> tuple[float, F32]:
    """`weight` times the light that passes where the picture is `ground` (H, W), as a mean over all of it, and its
    gradient by `alpha`."""
    scale = np.float32(weight / alpha.size)
    return float(scale * (1.0 - alpha[ground]).sum()), np.where(ground, -scale, np.float32(0.0))
