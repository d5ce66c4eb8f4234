"""What every service of AlpaSim's contracts needs: fields held to what they may be, statuses, the gRPC server.

Requests come as bytes and are parsed here, so that what is no message is refused as anything else is. The messages'
classes are those of `carla-driver-interface`, which vendors NVlabs/alpasim 6870924 unchanged.
"""

import signal
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from factory.config.arguments import Refused
from factory.config.words import ConfigError
from tasks.world.arrays import Array

RECEIVED_BYTES = 32 << 20  # of a request; a PNG of 3840 x 2160 has up to 25 MB
SENT_BYTES = 256 << 20  # of an answer, which may have several
MOST = 10_000  # poses, waypoints or objects of a message
LARGEST = 1e7  # m, m/s and so on: beyond it a number is none of a rollout
LAST_US = 1 << 62
SESSIONS = 64  # of a service at a time
RPC_THREADS = 64
T = TypeVar("T")


class Fault(Exception):
    """The request is answered by a gRPC status of this name."""

    def __init__(self, status: str, problem: str) -> None:
        super().__init__(problem)
        self.status = status


@dataclass(frozen=True)
class Service:
    """Its name with its package, and for each RPC what answers a message, and the message's class."""

    name: str
    requests: Mapping[str, tuple[Callable[[Any], Any], Any]]
    metadata: Mapping[str, tuple[tuple[str, str], ...]] = field(default_factory=dict)  # sent first, by RPC

    def answer(self, method: str, request: bytes) -> bytes:
        """Of one RPC. Raises Fault; another exception than a ValueError, which is a request's, is the service's own."""
        from google.protobuf.message import DecodeError

        does, kind = self.requests[method]
        try:
            message = kind.FromString(request)
        except (DecodeError, UnicodeDecodeError) as error:
            raise Fault("INVALID_ARGUMENT", f"{method}: the bytes are no {kind.DESCRIPTOR.name}: {error}") from error
        try:
            return bytes(does(message).SerializeToString())
        except ValueError as error:
            raise Fault("INVALID_ARGUMENT", f"{method}: {error}") from error


def contract(who: str, extras: str) -> Any:
    """The module of the messages' classes. Raises ConfigError where the package is missing."""
    try:
        from carla_driver_interface import protocol
    except ModuleNotFoundError as error:
        raise ConfigError(f'{who}: {error}; pip install "driving-data-factory[{extras}]"') from error
    return protocol


# Fields of requests. What is wrong with one is a ValueError that names it.


def stamp_of(name: str, value: int) -> int:
    """Microseconds."""
    if value > LAST_US:
        raise ValueError(f"{name}={value}: microseconds, at most {LAST_US}")
    return int(value)


def vector_of(name: str, vector: Any) -> list[float]:
    """x, y, z of a Vec3."""
    found = [vector.x, vector.y, vector.z]
    if not all(abs(number) <= LARGEST for number in found):  # false of NaN
        raise ValueError(f"{name}={found}: finite numbers up to {LARGEST:g} are expected")
    return found


def rotation_of(name: str, quat: Any) -> Array:
    """(3, 3) of a Quat."""
    q = np.array([quat.w, quat.x, quat.y, quat.z], np.float64)
    if not abs(np.linalg.norm(q) - 1.0) <= 0.01:
        raise ValueError(f"{name}={q.tolist()}: not a unit quaternion w, x, y, z")
    w, x, y, z = q / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def pose_of(name: str, pose: Any) -> Array:
    """(4, 4) of a Pose."""
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = rotation_of(f"{name}.quat", pose.quat), vector_of(f"{name}.vec", pose.vec)
    return out


def heading_of(pose: Array) -> float:
    """Of a pose (4, 4) about z [rad]."""
    return float(np.arctan2(pose[1, 0], pose[0, 0]))


def write_pose(message: Any, pose: Array) -> None:
    """A rigid (4, 4) into a Pose, in its 32 bits."""
    message.vec.x, message.vec.y, message.vec.z = pose[:3, 3].tolist()
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()
    message.quat.w, message.quat.x, message.quat.y, message.quat.z = w, x, y, z


def bounded(name: str, repeated: Sequence[Any], most: int = MOST) -> Sequence[Any]:
    """The same, where they are no more."""
    if len(repeated) > most:
        raise ValueError(f"{name}: {len(repeated)} of them, at most {most} in a message")
    return repeated


class Sessions(Generic[T]):
    """Those that are open, by their names."""

    def __init__(self) -> None:
        self._open: dict[str, T] = {}
        self._lock = threading.Lock()

    def begin(self, uuid: str, session: T) -> None:
        """Raises ValueError for a bad name, Fault for one that is open and where too many are."""
        if not 0 < len(uuid) <= 128:
            raise ValueError(f"session_uuid: 1 to 128 characters, not {len(uuid)}")
        with self._lock:
            if uuid in self._open:
                raise Fault("ALREADY_EXISTS", f"session_uuid={uuid!r} is open")
            if len(self._open) >= SESSIONS:
                raise Fault("RESOURCE_EXHAUSTED", f"{SESSIONS} sessions are open: close_session ends one")
            self._open[uuid] = session

    def __getitem__(self, uuid: str) -> T:
        """Raises Fault."""
        with self._lock:
            if uuid not in self._open:
                raise _not_open(uuid)
            return self._open[uuid]

    def end(self, uuid: str) -> T:
        """The session that was open until now. Raises Fault."""
        with self._lock:
            if uuid not in self._open:
                raise _not_open(uuid)
            return self._open.pop(uuid)


def _not_open(uuid: str) -> Fault:
    return Fault("NOT_FOUND", f"session_uuid={uuid[:64]!r}: no such session; start_session opens one")


# The server.


def start_server(services: Sequence[Service], host: str, port: int) -> tuple[Any, int]:
    """A started gRPC server and its port; 0 asks for a free one. Raises Refused where the port is not to be had."""
    import grpc

    def handler(service: Service, method: str) -> Any:
        def answer(request: bytes, context: Any) -> bytes:
            if method in service.metadata:
                context.send_initial_metadata(service.metadata[method])
            try:
                return service.answer(method, request)
            except Fault as fault:
                context.abort(grpc.StatusCode[fault.status], str(fault))
                raise  # abort has raised

        return grpc.unary_unary_rpc_method_handler(answer)  # bytes as they are: what is no message is ours to refuse

    options = [
        ("grpc.max_receive_message_length", RECEIVED_BYTES),
        ("grpc.max_send_message_length", SENT_BYTES),
        ("grpc.so_reuseport", 0),  # a second server on a port is refused, not given every other question
    ]
    pool = ThreadPoolExecutor(RPC_THREADS, "rpc")
    server = grpc.server(pool, options=options, maximum_concurrent_rpcs=4 * RPC_THREADS)
    for service in services:
        handlers = {method: handler(service, method) for method in service.requests}
        server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler(service.name, handlers),))
    try:
        bound = server.add_insecure_port(f"{host}:{port}")
    except RuntimeError as error:
        raise Refused(
            f"host={host} port={port}: {str(error).rstrip('.')}; give another port=, or 0 for a free one"
        ) from error
    server.start()
    return server, bound


def serve(services: Sequence[Service], host: str, port: int) -> None:
    """Answer until SIGTERM, or until its terminal closes. Raises Refused where the port is not to be had."""
    server, bound = start_server(services, host, port)
    for ending in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(ending, lambda number, frame: server.stop(5.0))
    print(f"answers at {host}:{bound}", flush=True)
    server.wait_for_termination()
