"""How the benchmarks time one call."""

import time
from collections.abc import Callable

import numpy as np


def milliseconds(call: Callable[[], object], repeats: int) -> float:
    """Median wall time of one call, after one that warms up."""
    call()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return 1e3 * float(np.median(times))
