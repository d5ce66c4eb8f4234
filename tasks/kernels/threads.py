"""Work in fixed chunks, on as many threads as asked: the chunks, and so the results, are the same on any number."""

import functools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")


@functools.cache
def _helpers(n: int) -> ThreadPoolExecutor:
    """Kept, for starting threads takes as long as some of the work."""
    return ThreadPoolExecutor(n)


os.register_at_fork(after_in_child=_helpers.cache_clear)  # a forked process has the pools but not their threads


def run_in_chunks(work: Callable[[int, int], T], n: int, size: int, threads: int) -> list[T]:
    """What `work(first, last)` returns for each `size` of n items, in order; `work` is to release the GIL.

    Raises ValueError for less than one thread.
    """
    if threads < 1:
        raise ValueError(f"threads is {threads}, expected 1 or more")
    spans = [(first, min(first + size, n)) for first in range(0, n, size)]
    if threads == 1 or len(spans) < 2:
        return [work(*span) for span in spans]
    done: dict[int, T] = {}
    waiting = iter(enumerate(spans))  # shared: whoever is free takes the next

    def run() -> None:
        for k, span in waiting:
            done[k] = work(*span)

    helpers = [_helpers(threads - 1).submit(run) for _ in range(threads - 1)]
    try:
        run()
    finally:
        for helper in helpers:
            if not helper.cancel():  # one that is still queued has nothing left to do
                helper.result()
    return [done[k] for k in range(len(spans))]
