"""The policy that was fitted to logs: a small network's acceleration and steering, and what they make of a vehicle.

    neighbours (8, NEAR) -> relu -> the largest of each, joined to oneself, way, stop line, leader (OWN)
    -> relu -> relu -> acceleration, and by how much the curvature differs from that of pursuing the way

Every sum is taken in one order whatever the batch, so that a world's answer is the same bits alone and among others.
`python -m planners train_traffic` fits the weights. Compiled.
"""

import hashlib
import io
import math
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple
from zipfile import BadZipFile

import numpy as np

from tasks.kernels.compiled import inner_kernel, kernel
from tasks.rollout.learned.look import COLUMNS, NEAR, NOW, OWN, PURSUIT, asked_of, forward_speed, look
from tasks.rollout.learned.policy import HEADING, SPEED, BadPolicy, RoadLines, SeenWorlds, X, Y
from tasks.sealed import Damaged, sealed, unsealed
from tasks.world.arrays import Array, Ints
from tasks.world.clip import STEP_S
from tasks.world.geometry import wrapped

ACCELERATION_SCALE = 3.0  # [m/s2] of an output of 1
MOST_BESIDE = 0.02  # [1/m] that the network may steer beside the pursuit of its way: 1 m at 10 m/s
HARDEST_BRAKE, HARDEST_START = 8.0, 4.0  # [m/s2]: what tyres can
SHARPEST, MOST_SIDEWAYS = 0.25, 6.0  # [1/m], [m/s2]
STARTS_ABOVE = 0.3  # [m/s2] that a standing vehicle must want: it does not creep
STANDS_BELOW = 0.1  # [m/s]


class NetworkWeights(NamedTuple):
    """Layers as (inputs, outputs) and (outputs,)."""

    near_weight: Array  # (NEAR, G)
    near_bias: Array
    first_weight: Array  # (OWN + G, H)
    first_bias: Array
    second_weight: Array  # (H, H)
    second_bias: Array
    last_weight: Array  # (H, 2)
    last_bias: Array


@dataclass(frozen=True)
class ImitationPolicy:
    """The policy of these weights."""

    weights: NetworkWeights
    told: str  # digest of the file they are from

    def digest(self) -> str:
        """Of the file."""
        return self.told

    def next_states(self, seen: SeenWorlds, streets: RoadLines) -> Array:
        """As TrafficPolicy has it."""
        who = asked_of(seen.asked)
        wants = forward(self.weights, *look(seen, streets.ways, streets.way, who))
        return advanced(seen, who, wants)


def from_file(weights: str | None) -> ImitationPolicy:
    """The policy of a file of weights. Raises BadPolicy."""
    if weights is None:
        raise BadPolicy("traffic.weights is missing: name a file that `python -m planners train_traffic` made")
    try:
        data = Path(weights).expanduser().read_bytes()
        return ImitationPolicy(weights_from(data), hashlib.sha256(data).hexdigest()[:16])
    except OSError as error:
        raise BadPolicy(f"traffic.weights: {weights}: {error.strerror}") from error
    except ValueError as error:
        raise BadPolicy(f"traffic.weights: {weights}: {error}") from error


def unfitted(weights: str | None = None) -> ImitationPolicy:
    """One that keeps speed and heading, whatever it sees: what kernels are compiled with."""
    shapes = ((NEAR, 4), 4, (OWN + 4, 4), 4, (4, 4), 4, (4, 2), 2)
    return ImitationPolicy(NetworkWeights(*(np.zeros(shape) for shape in shapes)), "unfitted")


def weights_from(data: bytes) -> NetworkWeights:
    """Those of a file's bytes. Raises ValueError that says what is wrong with them."""
    try:
        with np.load(io.BytesIO(unsealed(data)), allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except Damaged:
        raise
    except (BadZipFile, ValueError, OSError, EOFError, KeyError) as error:
        raise ValueError(f"no weights of traffic: {error}") from error
    columns = arrays.pop("columns", None)
    arrays.pop("record", None)
    if columns is None or columns.dtype.kind != "i" or columns.tolist() != COLUMNS:
        raise ValueError(f"it was fitted to see other things than this version shows (columns {COLUMNS}): fit it again")
    if set(arrays) != set(NetworkWeights._fields):
        raise ValueError(f"it holds {sorted(arrays)}, not {sorted(NetworkWeights._fields)}")
    g, h = arrays["near_bias"].size, arrays["second_bias"].size
    shapes = NetworkWeights((NEAR, g), (g,), (OWN + g, h), (h,), (h, h), (h,), (h, 2), (2,))  # type: ignore[arg-type]
    for name, shape in shapes._asdict().items():
        if arrays[name].shape != shape or arrays[name].dtype.kind != "f" or not np.isfinite(arrays[name]).all():
            raise ValueError(f"{name} must hold finite numbers {shape}, not {arrays[name].dtype} {arrays[name].shape}")
    return NetworkWeights(**{name: np.ascontiguousarray(arrays[name], np.float64) for name in NetworkWeights._fields})


def weights_file(weights: NetworkWeights, record: str) -> bytes:
    """What to write: in half the precision, with a record of what they were fitted to and a checksum."""
    file = io.BytesIO()
    halved = {name: np.asarray(array, np.float32) for name, array in weights._asdict().items()}
    np.savez(file, allow_pickle=False, columns=np.array(COLUMNS), record=np.array(record), **halved)
    return sealed(file.getvalue())


@kernel
def forward(weights: NetworkWeights, own: Array, near: Array, count: Ints) -> Array:
    """(A, 2) acceleration [m/s2] and curvature [1/m] that the network wants of what A vehicles see."""
    out = np.empty((len(own), 2))
    point, hidden = np.empty(len(weights.near_bias)), np.empty(len(weights.first_bias))
    second, last = np.empty(len(weights.second_bias)), np.empty(2)
    joined = np.empty(OWN + len(point))
    for a in range(len(own)):
        for k in range(OWN):
            joined[k] = own[a, k]
        for k in range(len(point)):
            joined[OWN + k] = 0.0
        for n in range(count[a]):
            _layer(near[a, n], weights.near_weight, weights.near_bias, point)
            for k in range(len(point)):
                joined[OWN + k] = max(joined[OWN + k], point[k])
        _layer(joined, weights.first_weight, weights.first_bias, hidden)
        _rectify(hidden)
        _layer(hidden, weights.second_weight, weights.second_bias, second)
        _rectify(second)
        _layer(second, weights.last_weight, weights.last_bias, last)
        out[a, 0], out[a, 1] = ACCELERATION_SCALE * last[0], own[a, PURSUIT] + MOST_BESIDE * math.tanh(last[1])
    return out


@inner_kernel
def _layer(x: Array, weight: Array, bias: Array, out: Array) -> None:
    for k in range(len(bias)):
        out[k] = bias[k]
    for i in range(len(x)):
        for k in range(len(bias)):
            out[k] += x[i] * weight[i, k]


@inner_kernel
def _rectify(x: Array) -> None:
    for k in range(len(x)):
        x[k] = max(x[k], 0.0)


@kernel
def advanced(seen: SeenWorlds, who: Ints, wants: Array) -> Array:
    """(B, N, 4) where acceleration and curvature (A, 2), within what a car can, lead in 0.1 s; 0 for all others."""
    n_worlds, n = seen.asked.shape
    out = np.zeros((n_worlds, n, 4))
    for a in range(len(who)):
        b, i = who[a, 0], who[a, 1]
        speed, h = forward_speed(seen, NOW, b, i), seen.boxes[NOW, b, i, 2]
        acceleration = min(max(wants[a, 0], -HARDEST_BRAKE), HARDEST_START)
        bound = min(SHARPEST, MOST_SIDEWAYS / max(speed * speed, 1.0))
        curvature = min(max(wants[a, 1], -bound), bound)
        new_speed = max(speed + acceleration * STEP_S, 0.0)
        if speed < STANDS_BELOW and acceleration < STARTS_ABOVE:
            speed, new_speed = 0.0, 0.0
        way = 0.5 * (speed + new_speed) * STEP_S
        turn = curvature * way
        out[b, i, X] = seen.boxes[NOW, b, i, 0] + way * math.cos(h + 0.5 * turn)
        out[b, i, Y] = seen.boxes[NOW, b, i, 1] + way * math.sin(h + 0.5 * turn)
        out[b, i, HEADING], out[b, i, SPEED] = wrapped(h + turn), new_speed
    return out
