"""Small convex quadratic programs, solved exactly."""

import daqp
import numpy as np

from tasks.world.arrays import Array

WITHIN = 1e-9  # of a bound that counts as kept, in the unit of what it bounds
SOLVED, INFEASIBLE = 1, -1  # of DAQP's exit flags


def minimum(hessian: Array, gradient: Array, rows: Array, low: Array, high: Array) -> Array | str:
    """argmin 1/2 x' H x + g' x of x (N,), low <= (x, rows x) <= high; or why there is none.

    hessian: (N, N), positive definite. rows: (M, N). low, high: (N + M,), infinite where nothing bounds. By a dual
    active set (Arnstroem, Bemporad and Axehill, IEEE Transactions on Automatic Control 67(8), 2022): it ends at the
    minimum itself and not within a tolerance of it, always at the same.
    """
    inequalities = np.zeros(len(low), np.int32)
    best, _, flag, found = daqp.solve(hessian, gradient, rows, high, low, inequalities, primal_tol=WITHIN)
    if flag == SOLVED:
        return np.asarray(best)
    why = "no solution" if flag == INFEASIBLE else f"none found (DAQP's flag {flag})"
    return f"{why} after {found['iterations']} iterations"
