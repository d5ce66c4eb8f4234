"""One function of many items, here, in processes or on Ray: a few at once, results as they come, until a signal."""

import multiprocessing
import os
import pickle
import threading
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from itertools import islice
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from traceback import format_exc
from typing import TYPE_CHECKING, Any, Literal, ParamSpec, TypeVar

from factory.exits import calling_on_stop_signal, end_with_parent, ignore_terminal_signals, terminal_signals_blocked

if TYPE_CHECKING:  # a worker imports this file before it can tell its driver of what fails: nothing heavy is above
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
    to: "Location | None" = None,
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
            from factory.graph.steps import TaskStopped

            raise TaskStopped


@contextmanager
def _pool(executor: str, workers: int | None, to: "Location | None") -> Iterator[tuple[Executor, int]]:
    """What runs the function, and how many items it is to hold. What has not begun when it is left is dropped."""
    pool: Executor
    if executor == "ray":
        from factory.graph.on_ray.graph import RayPool

        pool = RayPool(workers, to)
        most = IN_HAND * pool.parallelism
    elif workers is None or workers == 1:
        pool, most = _InThisProcess(), 1
    else:
        pool, most = _Processes(workers), IN_HAND * workers
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


class _Processes(ThreadPoolExecutor):
    """A process for each thread, begun with its first item; a terminal does not reach it, also while it starts.

    Unlike of a ProcessPoolExecutor, each thread is begun by who submits and each failure ends as a future's exception:
    where memory is short, that one's threads die with a traceback and their futures never end.
    """

    def __init__(self, workers: int) -> None:
        super().__init__(workers)
        self._begun: list[tuple[BaseProcess, Connection[Any, Any]]] = []
        self._of_thread, self._died = threading.local(), False
        with terminal_signals_blocked():  # what spawning begins first is a process, too
            resource_tracker.ensure_running()

    def submit(self, function: Callable[P, R], /, *args: P.args, **kwargs: P.kwargs) -> Future[R]:
        return super().submit(self._call, function, *args, **kwargs)

    def _call(self, function: Callable[P, R], /, *args: P.args, **kwargs: P.kwargs) -> R:
        if not hasattr(self._of_thread, "process"):
            self._of_thread.process = self._begin()
        process, pipe = self._of_thread.process
        result: R = self._ask(process, pipe, (function, args, kwargs))
        return result

    def _begin(self) -> tuple[BaseProcess, "Connection[Any, Any]"]:
        ours, theirs = multiprocessing.Pipe()
        process = multiprocessing.get_context("spawn").Process(target=_answer_all, args=(theirs,))
        with theirs, terminal_signals_blocked():
            process.start()
        self._begun.append((process, ours))
        self._ask(process, ours, (end_with_parent, (1,), {}))
        return process, ours

    def _ask(self, process: BaseProcess, pipe: "Connection[Any, Any]", call: tuple[Any, ...]) -> Any:
        question = pickle.dumps(call)
        try:
            pipe.send_bytes(question)
            answer = pipe.recv_bytes()
        except (EOFError, ConnectionError) as error:
            self._died = True
            process.join()
            raise BrokenExecutor(f"exit code {process.exitcode}") from error
        result, raised = pickle.loads(answer)  # noqa: S301 (our own worker's)
        if raised is not None:
            raise raised
        return result

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """What is in hand is waited for, unless a process has died."""
        if self._died:
            for process, _ in self._begun:
                process.terminate()
        super().shutdown(wait, cancel_futures=cancel_futures)
        for process, pipe in self._begun:
            pipe.close()
            process.join()


def _answer_all(pipe: "Connection[Any, Any]") -> None:
    """A worker process out of reach of what is sent to all of a terminal, until its pipe closes."""
    ignore_terminal_signals()
    os.setpgrp()
    with suppress(EOFError, ConnectionError):  # its driver is done with it, or gone
        while True:
            question = pipe.recv_bytes()
            try:
                function, args, kwargs = pickle.loads(question)  # noqa: S301 (our own driver's)
                answer = pickle.dumps((function(*args, **kwargs), None))
            except Exception as error:
                error.add_note(format_exc())
                answer = pickle.dumps((None, error))
            pipe.send_bytes(answer)
