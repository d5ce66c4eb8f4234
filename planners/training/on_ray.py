"""A training on this machine's or a cluster's Ray; the only module of the planners that imports it.

Checkpoints and curves are written by the training itself under `out`, which every node must see.
"""

import logging
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
os.environ.setdefault("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")  # keeps every listener on 127.0.0.1

import ray
from ray.exceptions import ActorDiedError, AuthenticationError
from ray.train import RunConfig, ScalingConfig, WorkerGroupError
from ray.train.torch import TorchConfig, TorchTrainer, get_device

from factory.exits import terminal_signals_blocked
from factory.graph.local import ClusterDied
from factory.graph.own_process import no_cluster_text
from factory.wording import one_line
from planners.training.processes import TrainingProcess, join_process_group


def train_on_ray(train: Callable[[TrainingProcess], None], out: str, processes: int, gpus: int, cpus: int) -> None:
    """Call `train` in each of `processes`, with so many GPUs and CPUs each. What one of them raises is raised here.

    Raises ClusterDied where Ray's own trainer dies.
    """
    gpu = gpus > 0
    with _connected():
        trainer = TorchTrainer(
            _part,
            train_loop_config={"train": train},
            torch_config=TorchConfig(backend="nccl" if gpu else "gloo"),
            scaling_config=ScalingConfig(
                num_workers=processes, use_gpu=gpu, resources_per_worker={"CPU": cpus, **({"GPU": gpus} if gpu else {})}
            ),
            run_config=RunConfig(name="ray", storage_path=os.path.abspath(out)),
        )
        try:
            trainer.fit()
        except WorkerGroupError as error:
            cause = next(iter(error.worker_failures.values()))
            raise getattr(cause, "_base_exc", cause) from error  # Ray wraps what a process raised with its traceback
        except ActorDiedError as error:  # the trainer's own, with the node of this process
            raise ClusterDied(f"Ray's trainer died: {one_line(error)}", "RAY_ADDRESS" not in os.environ) from error


def _part(settings: dict[str, Any]) -> None:
    with join_process_group("auto", get_device()) as process:
        settings["train"](process)


@contextmanager
def _connected() -> Iterator[None]:
    """To the cluster of RAY_ADDRESS or of the submitted job, else to one of this machine's own, on loopback.

    Where a connection stands already it is used and stays.
    """
    if ray.is_initialized():
        yield
        return
    there = "RAY_ADDRESS" in os.environ
    if not there:  # Ray warns that a cluster of our own asks for a token, as it should
        logging.getLogger("ray._private.authentication.authentication_token_setup").setLevel(logging.ERROR)
    try:
        with terminal_signals_blocked(signal.SIGHUP):  # Ray keeps SIGINT from its processes itself
            ray.init(
                address=None if there else "local",
                include_dashboard=None if there else False,
                logging_level=logging.WARNING,
            )
    except (ConnectionError, AuthenticationError) as error:
        if not there:
            raise
        raise ConnectionError(no_cluster_text(os.environ["RAY_ADDRESS"], error)) from error
    try:
        yield
    finally:
        ray.shutdown()
