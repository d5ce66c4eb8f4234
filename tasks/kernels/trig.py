"""Sine, cosine and angle wrapping that kernels can take into their vectorised loops.

The machine's libm is called one value at a time and differs between machines; these are additions and products only,
so a loop over them runs four or eight values wide and gives the same bits everywhere.

Cody and Waite's reduction x = n pi/2 + r with |r| <= pi/4, then a polynomial in r for each function and the quadrant
n mod 4 to choose between them.
"""

import numpy as np

from tasks.kernels.compiled import inlined

TAU = 2.0 * np.pi
PER_TAU = 1.0 / TAU
PER_QUARTER = 2.0 / np.pi

# pi/2 in three parts; the first two have 33 bits, so that their product with n < 2^20 is exact.
QUARTER_1 = 1.57079632673412561417
QUARTER_2 = 6.07710050630396597660e-11
QUARTER_3 = 2.02226624879595063154e-21

# Minimax coefficients on [-pi/4, pi/4] of S. L. Moshier's Cephes library (sin.c, double precision):
# sin r = r + r^3 S(r^2), cos r = 1 - r^2 / 2 + r^4 C(r^2), highest power first.
S5, S4, S3 = 1.58962301576546568060e-10, -2.50507477628578072866e-8, 2.75573136213857245213e-6
S2, S1, S0 = -1.98412698295895385996e-4, 8.33333333332211858878e-3, -1.66666666666666307295e-1
C5, C4, C3 = -1.13585365213876817300e-11, 2.08757008419747316778e-9, -2.75573141792967388112e-7
C2, C1, C0 = 2.48015872888517045348e-5, -1.38888888888730564116e-3, 4.16666666666665929218e-2


@inlined
def sincos(angle: float) -> tuple[float, float]:
    """Sine and cosine of `angle` [rad], each within 2.5 units in the last place for |angle| <= 1e6."""
    quarters = np.rint(angle * PER_QUARTER)
    r = ((angle - quarters * QUARTER_1) - quarters * QUARTER_2) - quarters * QUARTER_3
    quadrant = quarters - 4.0 * np.floor(0.25 * quarters)
    z = r * r
    s = r + r * z * (((((S5 * z + S4) * z + S3) * z + S2) * z + S1) * z + S0)
    c = 1.0 - 0.5 * z + z * z * (((((C5 * z + C4) * z + C3) * z + C2) * z + C1) * z + C0)
    swapped = (quadrant == 1.0) | (quadrant == 3.0)
    sine, cosine = (c if swapped else s), (s if swapped else c)
    sine = -sine if quadrant >= 2.0 else sine
    cosine = -cosine if (quadrant == 1.0) | (quadrant == 2.0) else cosine
    return sine, cosine


@inlined
def wrap(angle: float) -> float:
    """`angle` [rad] in [-pi, pi); an angle that is there already keeps its bits."""
    wrapped = angle - TAU * np.floor((angle + np.pi) * PER_TAU)
    return wrapped if wrapped >= -np.pi else -np.pi  # rounding may step one bit past the end
