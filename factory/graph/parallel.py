"""One function of many items, here, in processes or on Ray: a few at once, results as they come, until a signal."""

import multiprocessing
import os
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager
from itertools import islice
from typing import Literal, ParamSpec, TypeVar

from factory.exits import calling_on_stop_signal, end_with_parent, ignore_terminal_signals, terminal_signals_blocked
from factory.graph.steps import TaskStopped
from factory.store.location import Location

T = TypeVar("T")
R = TypeVar("R")
P = ParamSpec("P")
IN_HAND = 2  # items for every worker, so that none waits until the driver has taken a result


class WorkerDied(RuntimeError):
    """A worker died at an item: killed, or out of memory."""


def parallel_map(
    function: Callable[[T], R],
    items: Iterable[T],
    executor: Literal["local", "ray"] = "local",
    workers: int | None = None,
    to: Location | None = None,
) -> Generator[R, None, None]:
    """function(item) of each item, in whatever order they are done. What one raises is raised here and ends it.

    workers: at once; None: 1 here, every core on Ray, which is the cluster of RAY_ADDRESS or one of this machine's own.
    to: the folder that the function writes to, called `to=` where a node of a cluster does not see it. At the first
    SIGINT or SIGTERM nothing new is begun; what is in hand still comes. Close the iterator to have the signals back.
    Raises TaskStopped where items are left then, WorkerDied, BadLocation, ConnectionError where no cluster answers, and
    ClusterDied where Ray dies on this machine.
    """
    stopped: list[bool] = []
    waiting = iter(items)
    with _pool(executor, workers, to) as (pool, most), calling_on_stop_signal(lambda: stopped.append(True)):
        in_hand: dict[Future[R], T] = {}
        while True:
            if not stopped:
                for item in islice(waiting, most - len(in_hand)):
                    in_hand[pool.submit(function, item)] = item
            if not in_hand:
                break
            done, _ = wait(in_hand, return_when=FIRST_COMPLETED)
            for future in done:
                item = in_hand.pop(future)
                try:
                    result = future.result()
                except BrokenExecutor as error:
                    raise WorkerDied(f"{item}: its worker died ({error}); run the same command again") from error
                yield result
        if stopped and any(True for _ in waiting):
            raise TaskStopped


@contextmanager
def _pool(executor: str, workers: int | None, to: Location | None) -> Iterator[tuple[Executor, int]]:
    """What runs the function, and how many items it is to hold. What has not begun when it is left is dropped."""
    pool: Executor
    if executor == "ray":
        from factory.graph.on_ray.graph import RayPool

        pool = RayPool(workers, to)
        most = IN_HAND * pool.parallelism
    elif workers is None or workers == 1:
        pool, most = _InThisProcess(), 1
    else:
        with terminal_signals_blocked():  # what keeps the pool's semaphores is a process, too
            pool = _Processes(workers, multiprocessing.get_context("spawn"), _detach_worker)
        most = IN_HAND * workers
    try:
        yield pool, most
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


class _InThisProcess(Executor):
    """In this process, at once."""

    def submit(self, function: Callable[P, R], /, *args: P.args, **kwargs: P.kwargs) -> Future[R]:
        future: Future[R] = Future()
        try:
            future.set_result(function(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


class _Processes(ProcessPoolExecutor):
    """Processes that a terminal does not reach, also while they start."""

    def submit(self, function: Callable[P, R], /, *args: P.args, **kwargs: P.kwargs) -> Future[R]:
        with terminal_signals_blocked():  # they begin with the first item
            return super().submit(function, *args, **kwargs)


def _detach_worker() -> None:
    """A worker process out of reach of what is sent to all of a terminal, that ends when its driver was killed."""
    ignore_terminal_signals()
    os.setpgrp()
    end_with_parent(1)
