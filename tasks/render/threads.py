"""Work in fixed chunks, on as many threads as asked: the chunks, and so the results, are the same on any number."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")


def in_chunks(work: Callable[[int, int], T], n: int, size: int, threads: int) -> list[T]:
    """What `work(first, last)` returns for each `size` of n items, in order; `work` is to release the GIL.

    Raises ValueError for less than one thread.
    """
    if threads < 1:
        raise ValueError(f"threads is {threads}, expected 1 or more")
    spans = [(first, min(first + size, n)) for first in range(0, n, size)]
    if threads == 1 or len(spans) < 2:
        return [work(*span) for span in spans]
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(lambda span: work(*span), spans))
