"""The run that experiments.chaos.kills kills: `python -m experiments.chaos.killed_run OUT EXECUTOR JOURNAL`."""

import os
import sys
from pathlib import Path
from typing import Any

from factory.graph.execute import Execution, execute
from factory.store.samples import Store
from tests.factory.toy import ToyWork, refs

EXPERTS = ["recovery", "pdm_closed", "human"]
CLIPS, ROUNDS, TASK_S = 4, 2, 0.01


def drive(out: str, executor: str, journal: str, seconds: float = TASK_S, notes: str = "", clips: int = CLIPS) -> int:
    """The command: one run in this process; executor=node: on a cluster of two nodes, the second's pid in `notes`.

    executor=ADDRESS, with a colon: on the cluster there.
    """
    if ":" in executor:
        os.environ["RAY_ADDRESS"], executor = executor, "ray"
    if executor == "node":
        from ray.cluster_utils import Cluster

        cluster = Cluster()
        cluster.add_node(num_cpus=1, num_gpus=0, include_dashboard=False)
        second = cluster.add_node(num_cpus=1, num_gpus=0)
        (raylet,) = second.all_processes["raylet"]
        Path(notes).write_text(str(raylet.process.pid))
        os.environ["RAY_ADDRESS"], executor = cluster.address, "ray"
    work, how = ToyWork(journal=journal, seconds=seconds), Execution(executor, 2, shard_seconds=0.1)
    return execute(work, refs(clips), EXPERTS, ROUNDS, Store(out), how, say=str).exit_code


def leave(*given: Any) -> None:
    """The same, and the process with it."""
    sys.exit(drive(*given))


if __name__ == "__main__":
    leave(*sys.argv[1:])
