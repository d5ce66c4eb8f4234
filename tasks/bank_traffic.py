"""A bank's answering traffic: what the rollout prepares of a scene at T (tasks/rollout/simulate.py), as bytes."""

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tasks.caches import Damaged
from tasks.experts.pdm_closed import plan_for
from tasks.reward.epdms import N_TIMES, collision_scores
from tasks.reward.packing import packed, unpacked
from tasks.rollout.corridor import Paths, stretch_rectangles
from tasks.rollout.idm import AgentStates, Roles, Yielding
from tasks.rollout.simulate import prepare_traffic
from tasks.settings import TrafficSettings
from tasks.world.arrays import Array, Bytes
from tasks.world.clip import CLIP_STEPS, NOW, Clip, scene_of_clip
from tasks.world.frames import EGO_STATE_SIZE, all_within

# Fields of AgentStates, Roles, Paths and Yielding, and what the reward asks for besides, with their shapes as they are
# packed, steps and places last: N agents, M paths of P points, Q stop lines, Z zones, T steps from now on, S of the
# clip, K of the trails; L is M + 1. Heights, which move nobody, and rectangles around paths are not among them.
_SHAPES: dict[Any, dict[str, str]] = {
    np.float64: {"boxes": "N5T", "velocities": "N2T", "trails": "N2K", "collision_score": "N", "reference": "ET"}
    | {"xy": "M2P", "heading": "MP", "target_speed": "MP", "line_at": "Q", "at": "MS", "speed": "MS", "turned": "MP"}
    | {"zone_in": "Z", "zone_out": "Z", "other_in": "Z", "other_out": "Z", "trailing": "N"},
    np.int64: dict.fromkeys(("path", "logged_path", "join_step", "hold_until", "clock", "first_part"), "N")
    | {"line_start": "L", "last": "M", "zone_start": "L", "zone_agent": "Z", "zone_path": "Z"},
    np.bool_: {"valid": "NT", "standing": "N", "moving_kind": "N", "enters_clear": "N", "gives_way": "Z"},
    np.uint8: {"line_state": "QT"},
}
_LAST = {"boxes": 0, "velocities": 0, "valid": 0, "line_state": 0, "reference": 0, "xy": 1, "trails": 1}  # that axis
_NAMES = tuple(name for shapes in _SHAPES.values() for name in shapes)
_ORDERS = tuple(2 if kind is np.float64 else 1 for kind, shapes in _SHAPES.items() for _ in shapes)


@dataclass(frozen=True)
class BankedTraffic:
    """A scene's traffic at T as `tasks.rollout.simulate.drive` takes it, whatever the ego will do."""

    log: AgentStates  # over NOW + 41 steps
    now: AgentStates
    roles: Roles
    paths: Paths
    yielding: Yielding | None
    collision_score: Array  # (N,)
    reference: Array  # (41, 11) PDM-Closed as the tracker drives it


def pack_traffic(clip: Clip, settings: TrafficSettings) -> bytes:
    """A clip's traffic from T on, of mode idm. Raises ValueError as `prepare_traffic`."""
    scene = scene_of_clip(clip)
    ready, log = prepare_traffic(scene, settings), clip.agents.window(NOW, NOW + N_TIMES)
    assert ready.roles is not None and ready.paths is not None
    held: dict[str, Any] = {"boxes": log.boxes, "velocities": log.velocities, "valid": log.valid}
    held |= ready.roles._asdict() | ready.paths._asdict() | (ready.yielding._asdict() if ready.yielding else {})
    held |= {"collision_score": collision_scores(log.kinds), "reference": plan_for(scene).driven}
    parts = [np.moveaxis(held[name], _LAST.get(name, -1), -1) if name in held else np.empty(0) for name in _NAMES]
    return packed(parts, _ORDERS)


def unpack_traffic(data: Bytes) -> BankedTraffic:
    """What `pack_traffic` packed. Raises Damaged for other bytes, of which no kernel is to read anything."""
    values, starts = unpacked(data, _ORDERS)
    parts = {name: values[first:last] for name, (first, last) in zip(_NAMES, pairwise(starts.tolist()), strict=True)}
    n, m = len(parts["path"]), len(parts["line_start"]) - 1
    sizes = {"N": n, "M": m, "L": m + 1, "Q": len(parts["line_at"]), "Z": len(parts["zone_agent"]), "T": N_TIMES}
    sizes |= {"S": CLIP_STEPS, "E": EGO_STATE_SIZE, "2": 2, "5": 5}
    sizes |= {"P": len(parts["heading"]) // m if m > 0 else 2, "K": len(parts["trails"]) // (2 * n) if n else 0}
    yields, found = len(parts["zone_start"]) > 0, dict[str, NDArray[Any]]()
    try:
        for kind, shapes in _SHAPES.items():
            for name, shape in shapes.items():
                part = parts[name].view(kind) if kind is np.float64 else parts[name].astype(kind)
                if yields or name not in Yielding._fields:
                    part = part.reshape([sizes[letter] for letter in shape])
                    found[name] = np.ascontiguousarray(np.moveaxis(part, -1, _LAST[name])) if name in _LAST else part
    except ValueError as error:
        raise Damaged("its parts do not fit together") from error
    if not _is_sound(found, n, m, sizes["P"]):
        raise Damaged("its numbers are no traffic")
    log = AgentStates(*map(_since_start, (found["boxes"], found["velocities"], found["valid"], np.zeros((N_TIMES, n)))))
    xy, heading = found["xy"], found["heading"]
    found |= {"height": np.zeros_like(heading), "stretches": stretch_rectangles(xy, heading)}
    return BankedTraffic(
        log,
        AgentStates(*(part[NOW : NOW + 1] for part in log)),  # type: ignore[arg-type]
        Roles(*(found[name] for name in Roles._fields)),
        Paths(*(found[name] for name in Paths._fields)),
        Yielding(*(found[name] for name in Yielding._fields)) if yields else None,
        found["collision_score"],
        found["reference"],
    )


def _since_start(part: NDArray[Any]) -> NDArray[Any]:
    """Steps from T on as steps of the clip: nobody looks at those before."""
    return np.concatenate([np.zeros((NOW, *part.shape[1:]), part.dtype), part])


def _is_sound(found: dict[str, NDArray[Any]], n: int, m: int, n_points: int) -> bool:
    """Whether numbers are such that no kernel looks beyond its arrays: places are some, indices of what there is."""
    there = found["valid"]
    bounds = {"path": (-1, m), "logged_path": (-1, m), "zone_path": (-1, m), "zone_agent": (0, n)}
    bounds |= {"first_part": (0, n), "clock": (0, NOW + 1)}
    return (
        m >= 0
        and n_points >= 2
        and all(all_within(found[name][there]) for name in ("boxes", "velocities"))
        and all_within(np.nan_to_num(found["trails"]))
        and all(
            all_within(found[name])
            for name in _SHAPES[np.float64]
            if name in found and name not in ("boxes", "velocities", "trails")
        )
        and found["target_speed"].min(initial=1.0) > 0.0
        and all(
            found[name].min(initial=low) >= low and found[name].max(initial=low) < max(high, low + 1)
            for name, (low, high) in bounds.items()
            if name in found
        )
        and all(
            found[name][0] == 0 and found[name][-1] == len(found[of]) and (np.diff(found[name]) >= 0).all()
            for name, of in (("line_start", "line_at"), ("zone_start", "zone_agent"))
            if name in found
        )
    )
