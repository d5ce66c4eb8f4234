"""How the benchmarks time one call: by the clock, or by this process's CPU time, which other programs' load spares."""

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np


def milliseconds(call: Callable[[], object], repeats: int) -> float:
    """Median wall time of one call, after one that warms up."""
    return _times_ms(call, repeats, time.perf_counter)[1]


def cpu_milliseconds(call: Callable[[], object], repeats: int) -> float:
    """Median CPU time of one call, after one that warms up."""
    return _times_ms(call, repeats, time.process_time)[1]


def least_and_median_cpu_ms(call: Callable[[], object], repeats: int) -> tuple[float, float]:
    """CPU time of the quickest and of the median call, after one that warms up."""
    return _times_ms(call, repeats, time.process_time)


def memory_mb(field: str) -> float:
    """This process's memory now ("VmRSS") or at its peak ("VmHWM")."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return float(next(line.split()[1] for line in lines if line.startswith(field))) / 1024.0


def _times_ms(call: Callable[[], object], repeats: int, clock: Callable[[], float]) -> tuple[float, float]:
    call()
    times = []
    for _ in range(repeats):
        start = clock()
        call()
        times.append(clock() - start)
    return 1e3 * min(times), 1e3 * float(np.median(times))
