"""The public metric's recorded scenes as inputs of our reward (docs/reward.md 6)."""

import importlib.util
from functools import cache
from pathlib import Path
from types import ModuleType

import numpy as np

from tasks.reward.epdms import PreparedScene, prepare
from tasks.world.clip import AgentKind, AgentTracks
from tasks.world.road_map import MapLayer, MapPolygon

SCENES = ("7fab2350_20", "7fab2350_44", "adcf7d18_64", "adcf7d18_80", "7fab2350_104")
RECORDED_K = {  # what was recorded besides K = 256
    "7fab2350_20": (4096, 16384),
    "7fab2350_44": (4096,),
    "adcf7d18_64": (4096,),
    "adcf7d18_80": (4096,),
}


@cache
def loader(root: Path) -> ModuleType:
    """reference/load_reference.py as a module."""
    spec = importlib.util.spec_from_file_location("load_reference", root / "reference" / "load_reference.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def tracks(inputs: dict, box: np.ndarray, velocity: np.ndarray, valid: np.ndarray, tokens: list[str]) -> AgentTracks:
    """Recorded objects with boxes, velocities and presence of one's choice."""
    kind_of = dict(zip(inputs["object_tokens"], inputs["object_type"]))
    return AgentTracks(
        track_ids=tuple(tokens),
        kinds=tuple(AgentKind(kind_of[token]) for token in tokens),
        boxes=box,
        velocities=velocity,
        valid=valid,
        center_z=np.zeros(valid.shape),
        heights=np.ones(len(tokens)),
    )


def logged_tracks(inputs: dict) -> AgentTracks:
    """The recorded objects as the log has them."""
    arrays = (inputs[f"object_{name}"] for name in ("box", "velocity", "valid", "tokens"))
    return tracks(inputs, *arrays)


def map_polygons(inputs: dict) -> list[MapPolygon]:
    """The recorded map in its order."""
    columns = zip(inputs["map_tokens"], inputs["map_layers"], inputs["map_rings"])
    return [MapPolygon(token, MapLayer(layer), ring) for token, layer, ring in columns]


def prepared_scene(
    inputs: dict, objects: AgentTracks | None = None, red_lanes: tuple[str, ...] = (), with_past: bool = True
) -> PreparedScene:
    """A recorded scene, ready to be scored."""
    return prepare(
        past_states=inputs["past_states"] if with_past else None,
        centerline=inputs["centerline"],
        polygons=map_polygons(inputs),
        route_lane_ids=frozenset(inputs["route_lane_ids"]),
        objects=logged_tracks(inputs) if objects is None else objects,
        red_lanes=(red_lanes, np.ones((41, len(red_lanes)), dtype=bool)),
        ego_state0=inputs["ego_state0"],
    )


def world_poses(module: ModuleType, inputs: dict, proposals: np.ndarray) -> np.ndarray:
    """Proposals (K, 40, 3) of the ego frame in the city frame."""
    poses: np.ndarray = module.proposal_states(inputs["ego_state0"], proposals)[:, 1:, :3]
    return poses
