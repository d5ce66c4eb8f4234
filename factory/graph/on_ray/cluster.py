"""A Ray cluster joined, or begun on this machine: whether it answers and lives, its nodes, and what they all see.

Nothing but loopback is opened for a cluster of our own, and `ray stop` is never called.
"""

import logging
import os
import secrets
import shutil
import signal
import socket
import tempfile
import time
from pathlib import Path
from typing import Any

import ray
from ray.autoscaler.sdk import request_resources
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from factory.exits import without_terminal
from factory.graph.local import ClusterDied, ClusterLacks
from factory.store.disk import DiskFull, existing
from factory.store.location import BadLocation, Location
from factory.wording import one_line

VITAL = ("raylet", "gcs_server")
PROBE_SECONDS = 120.0
ANSWER_S = 10.0  # for a cluster's port to be reached
OWN_BYTES = 2**20  # of files of a cluster of our own, before it does anything: less, and another will not begin either
GPU_WAIT_S = 900.0  # for the first node with one to come
WORKER_ENV = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
FORWARDED_ENV = ("NUMBA_CACHE_DIR",)


@ray.remote(num_cpus=0)
def _sees(out: Location, name: str, token: bytes) -> bool:
    return out.read(name) == token


def connect(workers: int | None, address: str | None) -> bool:
    """Join the cluster of `address` or RAY_ADDRESS, else start one in this machine (then True).

    Raises ConnectionError where nothing answers there; where nothing listens at once: Ray itself tries for minutes.
    Raises ClusterDied where one of our own does not come up, DiskFull where there is no space for its files: another
    would wait half a minute in vain, as this one did.
    """
    named = address or os.environ.get("RAY_ADDRESS", "")
    environment = WORKER_ENV | {name: os.environ[name] for name in FORWARDED_ENV if name in os.environ}
    where = address or ("auto" if os.environ.get("RAY_ADDRESS") else "local")
    own: dict[str, Any] = {"num_cpus": workers, "include_dashboard": False} if where == "local" else {}
    if where == "local":  # Ray warns that a cluster of our own asks for a token, as it should
        logging.getLogger("ray._private.authentication.authentication_token_setup").setLevel(logging.ERROR)
    try:
        must_answer(named)
        with without_terminal(signal.SIGHUP):  # Ray keeps SIGINT from its processes itself
            ray.init(
                address=where,
                runtime_env={"env_vars": environment},
                log_to_driver=False,
                logging_level=logging.WARNING,
                **own,
            )
    except Exception as error:  # Ray has none of its own for what keeps it from beginning
        if where == "local":
            ray.shutdown()
            folder, free = _files_of_ray()
            said = f"Ray did not begin on this machine ({one_line(error)}); its files lie in {folder}"
            if free < OWN_BYTES:
                raise DiskFull(f"{said}: the disk is full, {free:,} bytes are free") from error
            raise ClusterDied(f"{said}, where {free:,} bytes are free", True) from error
        if not isinstance(error, ConnectionError):
            raise
        said = f"no Ray cluster answers at RAY_ADDRESS={named} ({one_line(error)})"
        raise ConnectionError(f"{said}; unset it to run on this machine alone") from error
    return where == "local"


def _files_of_ray() -> tuple[str, int]:
    """Where a cluster of our own has its files, and the bytes that are free there."""
    folder = os.environ.get("RAY_TMPDIR") or os.environ.get("TMPDIR") or tempfile.gettempdir()
    return folder, shutil.disk_usage(existing(Path(folder))).free


def tasks_at_once(workers: int | None, is_ours: bool) -> int:
    """Tasks: of a cluster of our own no more than it has cores, of another what was asked for, as it may grow."""
    available = int(ray.cluster_resources().get("CPU", 1))
    return max(1, min(workers or available, available) if is_ours else workers or available)


def dead_part() -> str:
    """A process of a cluster that this one began, where it has died.

    Looked at before anything is asked of Ray, which ends this process when it finds the object store gone.
    """
    node = ray._private.worker._global_node
    return next((name for name, _ in node.dead_processes() if name in VITAL), "") if node is not None else ""


def must_answer(address: str) -> None:
    """Raises ConnectionError for a host:port, or ray://host:port, at which nothing listens."""
    host, colon, port = address.removeprefix("ray://").rpartition(":")
    if not (colon and port.isdecimal()):
        return  # auto, local: Ray knows where
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=ANSWER_S).close()
    except OSError as error:
        raise ConnectionError(str(error)) from error


def nodes_of_cluster(having: str = "") -> list[str]:
    return [n["NodeID"] for n in ray.nodes() if n["Alive"] and (not having or n["Resources"].get(having))]


def of_nodes(resource: str) -> list[int]:
    """Of each node that works: a head without cores does not."""
    working = [node["Resources"] for node in ray.nodes() if node["Alive"] and node["Resources"].get("CPU")]
    return [int(resources[resource]) for resources in working if resources.get(resource)]


def has_gpu(wait: bool) -> bool:
    """Some node has a GPU; where none has, one is asked for and waited for."""
    if nodes_of_cluster("GPU") or not wait:
        return bool(nodes_of_cluster("GPU"))
    request_resources(bundles=[{"GPU": 1}])
    began = time.monotonic()
    while not nodes_of_cluster("GPU"):
        if time.monotonic() - began > GPU_WAIT_S:
            raise ClusterLacks(
                f"no node of the cluster has a GPU, and none came in {GPU_WAIT_S:.0f} s: start one, or draw with "
                "render.backend=cpu"
            )
        time.sleep(min(2.0, GPU_WAIT_S))
    request_resources(bundles=[])  # the attempts themselves hold it from now on
    return True


def on_node(node: str) -> NodeAffinitySchedulingStrategy:
    return NodeAffinitySchedulingStrategy(node, soft=False)


def prove_shared(out: Location, setting: str, wanted: str) -> None:
    """Every node reads what the driver wrote under `out`. Raises BadLocation with what is `wanted` of the setting."""
    nodes = nodes_of_cluster()
    if len(nodes) < 2:
        return
    name, token = f"probe-{secrets.token_hex(8)}", secrets.token_bytes(16)
    out.write(name, token)
    try:
        answers = ray.get(
            [_sees.options(scheduling_strategy=on_node(node)).remote(out, name, token) for node in nodes],
            timeout=PROBE_SECONDS,
        )
    finally:
        out.remove(name)
    blind = [node for node, sees in zip(nodes, answers) if not sees]
    if blind:
        raise BadLocation(f"{setting}={out.uri} is not the same folder on nodes {blind}: name {wanted}")
