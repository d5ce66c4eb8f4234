"""Weights and inputs out of names and shapes, so that two programs make the same ones and nobody has to store them.

numpy and torch alone, and Python 3.9: the public code's own interpreter imports it.
"""

from __future__ import annotations

import math
import zlib
from typing import Any

import numpy as np
import torch
from torch.overrides import TorchFunctionMode

BATCH = 2
ENTRIES, ANCHORS, AGENTS = 64, 20, 30
BEV = (128, 256)
CELLS = 8  # of the map from above every so many rows and columns are compared
SEED = 0  # of what a model itself draws
FROZEN = {"vocab": "vocabulary", "plan_anchor": "anchors"}  # last word of a parameter's name -> the input that it is
SCORES = (  # of the public code's pickles, in which each is an array over the vocabulary
    *("no_at_fault_collisions", "drivable_area_compliance", "time_to_collision_within_bound", "ego_progress"),
    *("driving_direction_compliance", "lane_keeping", "traffic_light_compliance", "history_comfort"),
)


def drawn(name: str, shape: tuple[int, ...]) -> Any:
    """Numbers of 0 .. 1 that depend on the name alone: float32 `shape`."""
    return np.random.Generator(np.random.Philox(zlib.crc32(name.encode()))).random(shape, np.float32)


def weight(name: str, shape: tuple[int, ...]) -> Any:
    """A weight of that name in a state dict: of a size at which 34 layers neither vanish nor explode.

    Matrices and kernels have variance 1 / fan-in, scales lie around 1, offsets around 0, variances in 0.5 .. 1.5;
    what has a leading 1 (positions, the latent picture) has variance 1.
    """
    if name.endswith("num_batches_tracked"):
        return np.zeros(shape, np.int64)
    values = drawn(name, shape)
    if name.endswith("running_var"):
        return values + np.float32(0.5)
    values = (2.0 * values - 1.0) * np.float32(math.sqrt(3.0))
    if len(shape) > 1:
        return values * np.float32(1.0 if shape[0] == 1 and len(shape) > 2 else 1.0 / math.sqrt(math.prod(shape[1:])))
    return np.float32(1.0 if name.endswith("weight") else 0.0) + np.float32(0.1) * values


def first_weight(name: str, shape: tuple[int, ...]) -> Any:
    """A weight of that name of the kind that a public training begins with.

    As torch, timm and the public GPT draw them: variance 1 / (3 fan-in), of kernels without bias 2 / fan-out, of the
    GPT's matrices 0.02^2, of embeddings and latent pictures 1; scales are 1 and offsets 0, the last scale of a residual
    block 0, so that it begins as its shortcut.
    """
    if name.endswith("num_batches_tracked"):
        return np.zeros(shape, np.int64)
    if len(shape) < 2:
        is_scale = name.endswith(("running_var", "weight")) and not name.endswith("bn2.weight")
        return np.full(shape, 1.0 if is_scale else 0.0, np.float32)
    if name.endswith("pos_emb"):
        return np.zeros(shape, np.float32)
    deviation = 1.0 / math.sqrt(3.0 * math.prod(shape[1:]))
    if ".transformers." in name:
        deviation = 0.02
    elif "embedding" in name or name.endswith("lidar_latent"):
        deviation = 1.0
    elif "_encoder." in name:
        deviation = math.sqrt(2.0 / (shape[0] * math.prod(shape[2:])))
    return (2.0 * drawn(name, shape) - 1.0) * np.float32(math.sqrt(3.0) * deviation)


def inputs(width: int, height: int, count: int = BATCH) -> dict[str, Any]:
    """What a model is shown and told: `count` samples with pictures of `width` x `height`."""
    patches = (drawn("image", (count, 3, height // 8, width // 8)) * 256).astype(np.uint8)
    status = np.zeros((count, 8), np.float32)
    status[np.arange(count), np.arange(count) % 4] = 1.0
    status[:, 4:] = drawn("status", (count, 4)) * np.array([10.0, 0.5, 2.0, 0.5], np.float32)
    agents = drawn("agents", (count, AGENTS, 5)) * np.array([64.0, 64.0, 6.0, 6.0, 3.0], np.float32)
    agents[..., :2] -= 32.0
    agents[..., 2] -= 3.0
    scores = {f"score {name}": np.floor(drawn(name, (count, ENTRIES)) * 3.0) / 2.0 for name in SCORES}
    return {
        "image": patches.repeat(8, axis=2).repeat(8, axis=3),
        "status": status,
        "plan": arcs("plan", count, 8),
        "agents": agents,
        "agents_valid": drawn("there", (count, AGENTS)) < 0.5,
        "bev": (drawn("bev", (count, *BEV)) * 7.0).astype(np.uint8),
        "vocabulary": arcs("vocabulary", ENTRIES, 40),
        "anchors": np.ascontiguousarray(arcs("anchors", ANCHORS, 8)[..., :2]),
        **{name: values.astype(np.float32) for name, values in scores.items()},
    }


def arcs(name: str, count: int, poses: int) -> Any:
    """(count, poses, 3) float32 x, y, heading over 4 s, at 2 .. 12 m/s and -0.04 .. 0.04 1/m."""
    speed = 2.0 + 10.0 * drawn(name + " speed", (count, 1)).astype(np.float64)
    curvature = (drawn(name + " curvature", (count, 1)).astype(np.float64) - 0.5) * 0.08 + 1e-6
    heading = speed * curvature * np.arange(1, poses + 1) * (4.0 / poses)
    x, y = np.sin(heading) / curvature, (1.0 - np.cos(heading)) / curvature
    return np.stack([x, y, heading], axis=-1).astype(np.float32)


KINDS = ("vehicle", "pedestrian", "bicycle", "traffic_cone", "barrier", "czone_sign", "generic_object")
NEAR_M = 40.0  # somewhat further than a raster reaches


def street(boxes: int = 420, rings: int = 6, lines: int = 8) -> dict[str, Any]:
    """Things around the ego: boxes (n, 5) with their kinds, every kind in turn, rings (m, 8, 2), lines (k, 6, 2)."""
    of_boxes = drawn("boxes", (boxes, 5)) * np.array([2 * NEAR_M, 2 * NEAR_M, 6.0, 5.0, 3.0], np.float32)
    of_boxes += np.array([-NEAR_M, -NEAR_M, -3.0, 0.2, 0.2], np.float32)
    angles = np.arange(8) * (np.pi / 4.0)
    radii = 4.0 + 12.0 * drawn("radii", (rings, 8, 1))
    centres = (drawn("centres", (rings, 1, 2)) - 0.5) * 2.0 * NEAR_M
    way = (drawn("way", (lines, 6, 2)) - 0.3) * 16.0
    starts = (drawn("starts", (lines, 1, 2)) - 0.7) * NEAR_M
    return {
        "boxes": of_boxes.astype(np.float32),
        "kinds": [KINDS[i % len(KINDS)] for i in range(boxes)],
        "rings": (centres + radii * np.stack([np.cos(angles), np.sin(angles)], -1)).astype(np.float32),
        "lines": (starts + way.cumsum(axis=1)).astype(np.float32),
    }


def told_of(optimiser: torch.optim.Optimizer) -> dict[str, Any]:
    """What an optimiser does beside its rate, and to how many numbers that have a gradient."""
    numbers: dict[str, int] = {}
    for group in optimiser.param_groups:
        does = {key: group[key] for key in ("eps", "amsgrad")}
        does.update(betas=list(group["betas"]), weight_decay=float(group["weight_decay"]))
        with_gradient = sum(parameter.numel() for parameter in group["params"] if parameter.grad is not None)
        words = ", ".join(f"{key} {does[key]}" for key in sorted(does))
        numbers[words] = numbers.get(words, 0) + with_gradient
    return {"kind": type(optimiser).__name__, **{words: count for words, count in numbers.items() if count}}


class Doubled(TorchFunctionMode):
    """Inside, what would become float32 becomes float64, so that rounding tells nothing."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return args[0].double() if func is torch.Tensor.float else func(*args, **(kwargs or {}))
