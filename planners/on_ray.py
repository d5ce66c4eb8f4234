"""A training as Ray Train processes, on this machine or on a cluster; the only module of the planners that imports ray.

Checkpoints and curves are written by the training itself under `out`, which every node must see.
"""

import os
from typing import TYPE_CHECKING, Any

import ray
from ray.train import RunConfig, ScalingConfig
from ray.train.torch import TorchConfig, TorchTrainer, get_device

from planners.world import joined

if TYPE_CHECKING:
    from planners.train import TrainConfig


def train_on_ray(config: "TrainConfig") -> None:
    """Train in `config.ray.processes` processes. What one of them raises is raised here."""
    settings, gpu = config.ray, config.ray.gpus > 0
    started = not ray.is_initialized()
    if started:
        _connect()
    try:
        TorchTrainer(
            _part,
            train_loop_config={"config": config},
            torch_config=TorchConfig(backend="nccl" if gpu else "gloo"),
            scaling_config=ScalingConfig(
                num_workers=settings.processes,
                use_gpu=gpu,
                resources_per_worker={"CPU": settings.cpus, **({"GPU": settings.gpus} if gpu else {})},
            ),
            run_config=RunConfig(name="ray", storage_path=os.path.abspath(config.out)),
        ).fit()
    finally:
        if started:
            ray.shutdown()


def _part(settings: dict[str, Any]) -> None:
    from planners.train import train

    with joined("auto", get_device()) as world:
        train(settings["config"], world)


def _connect() -> None:
    """To the cluster of RAY_ADDRESS or of the submitted job, else to one of this machine's own, on loopback."""
    there = "RAY_ADDRESS" in os.environ
    ray.init(address=None if there else "local", include_dashboard=None if there else False, log_to_driver=True)
