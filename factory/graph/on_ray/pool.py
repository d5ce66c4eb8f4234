"""Any function's tasks in a cluster's workers, as futures."""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future
from typing import Any, ParamSpec, TypeVar

import ray
from ray.exceptions import RayTaskError

from factory.graph.local import MAX_RETRIES, ClusterDied
from factory.graph.on_ray.cluster import connect, prove_shared, tasks_at_once
from factory.store.location import Location
from factory.wording import one_line

R = TypeVar("R")
P = ParamSpec("P")


class RayPool(Executor):
    """Tasks of a core each as futures, of any function. What a task raises is its future's own exception."""

    def __init__(self, workers: int | None, to: Location | None) -> None:
        """Workers as of RayGraph; to: the folder that tasks write to.

        Raises BadLocation where some node does not see it, ConnectionError where no cluster answers, or none
        begins here.
        """
        self._connected = not ray.is_initialized()
        try:
            is_ours = self._connected and connect(workers, None)
        except ClusterDied as error:
            raise ConnectionError(str(error)) from error
        self.parallelism = tasks_at_once(workers, is_ours)
        self._references: dict[Future[Any], Any] = {}
        try:
            if to is not None:
                prove_shared(to, "to", "storage that all of them share")
        except BaseException:
            self.shutdown()
            raise

    def submit(self, function: Callable[P, R], /, *args: P.args, **kwargs: P.kwargs) -> Future[R]:
        """BrokenExecutor is raised by a future whose worker died, with all of its retries."""
        reference = _call.remote(function, args, kwargs)
        future: Future[R] = Future()
        future.set_running_or_notify_cancel()
        self._references[future] = reference  # by which it could be ended
        reference.future().add_done_callback(lambda done: self._hand_on(done, future))
        return future

    def _hand_on(self, done: Future[R], future: Future[R]) -> None:
        self._references.pop(future, None)
        error = done.exception()
        if error is None:
            future.set_result(done.result())
        elif isinstance(error, RayTaskError):  # Ray wraps what a task raised with its traceback
            future.set_exception(error.cause)
        else:
            future.set_exception(BrokenExecutor(f"{type(error).__name__}: {one_line(error)}"))

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Leave the cluster; cancel_futures: end what is not done. What is done is in its future already."""
        if cancel_futures:
            for reference in list(self._references.values()):
                ray.cancel(reference)
        self._references.clear()
        if self._connected:
            ray.shutdown()


@ray.remote(num_cpus=1, max_retries=MAX_RETRIES)
def _call(function: Callable[..., Any], args: Sequence[Any], kwargs: Mapping[str, Any]) -> Any:
    return function(*args, **kwargs)
