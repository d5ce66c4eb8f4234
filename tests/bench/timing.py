"""How the benchmarks time one call: by the clock, or by this process's CPU time, which other programs' load spares."""

import time
from collections.abc import Callable

import numpy as np


def milliseconds(call: Callable[[], object], repeats: int) -> float:
    """Median wall time of one call, after one that warms up."""
    return _median_ms(call, repeats, time.perf_counter)


def cpu_milliseconds(call: Callable[[], object], repeats: int) -> float:
    """Median CPU time of one call, after one that warms up."""
    return _median_ms(call, repeats, time.process_time)


def _median_ms(call: Callable[[], object], repeats: int, clock: Callable[[], float]) -> float:
    call()
    times = []
    for _ in range(repeats):
        start = clock()
        call()
        times.append(clock() - start)
    return 1e3 * float(np.median(times))
