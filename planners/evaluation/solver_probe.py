"""What NAVSIM's tracker finds with the numpy at hand: `PYTHON solver_probe.py`, a line of JSON. Needs numpy alone.

NAVSIM fits a plan's speeds by `np.linalg.pinv` of a 40 x 40 system (navsim/planning/simulation/planner/pdm_planner/
simulation/batch_lqr_utils.py at autonomousvision/navsim @ 0a380a9). Here it is given straight plans of one speed, of
which that speed must come out. numpy 1.23.4, which NAVSIM pins, carries OpenBLAS 0.3.20, whose kernels for Intel's
AVX512-BF16 (OPENBLAS_CORETYPE=Cooperlake) make -491 m/s of it; its other kernels and numpy 1.26.4 are sound.
"""

import json
import platform

import numpy as np

STEP_S, STEPS, JERK_PENALTY = 0.1, 40, 1e-4
SPEED_MPS = 12.533835468245853
HEADINGS = [-1.26986045, *np.linspace(-np.pi, np.pi, 500)]  # the first: of a plan of navtest that is known to fail


def first_speed_mps(heading: float) -> float:
    """The speed at the beginning [m/s] of a straight plan of SPEED_MPS along a heading [rad], as NAVSIM fits it."""
    rate_changes = np.tril(np.full((STEPS, STEPS - 1), STEP_S**2), -1)
    along = np.hstack([np.full((STEPS, 1), STEP_S), rate_changes])
    system = np.stack([np.cos(heading) * along, np.sin(heading) * along], axis=1).reshape(2 * STEPS, STEPS)
    moved = np.tile([np.cos(heading), np.sin(heading)], STEPS) * SPEED_MPS * STEP_S
    # Not first differences, though called so: all accelerations but the last, and the last less the one before.
    penalised = np.zeros((STEPS - 2, STEPS))
    penalised[np.arange(STEPS - 2), np.arange(STEPS - 2) + 1] = -1.0
    penalised[-1, -1] = 1.0
    normal = system.T @ system + JERK_PENALTY * penalised.T @ penalised
    return float((np.linalg.pinv(normal) @ system.T @ moved)[0])


def main() -> None:
    """Print the worst of all headings."""
    found = [first_speed_mps(heading) for heading in HEADINGS]
    off = np.abs(np.array(found) - SPEED_MPS)
    told = {
        "machine": platform.processor() or platform.machine(),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "plans": len(HEADINGS),
        "speed_mps": SPEED_MPS,
        "worst_mps": found[int(np.argmax(off))],
        "wrong": int((~(off <= 1e-6)).sum()),
    }
    print(json.dumps(told))


if __name__ == "__main__":
    main()
