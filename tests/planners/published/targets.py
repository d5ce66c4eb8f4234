"""Our half of a comparison of what is learnt beside planning: the made-up street from above, and its vehicles."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from factory.store.schema import AGENT_STEPS
from planners.data.batch import BevLayout
from planners.data.bev import BevClass, bev_raster, nearest_vehicles
from tasks.world.clip import AgentKind
from tests.planners.published.formula import AGENTS, street
from tests.planners.published.ours import Difference

PUBLIC = BevLayout(public=True)
EDGES = 16.0  # cells beside a line that another OpenCV draws otherwise: 4.11 and 5.0 are 5 apart in 32,768


def street_sample() -> dict[str, Any]:
    """A row of samples in which the street stands still, with what the public raster does not show."""
    around = street()
    boxes = around["boxes"]
    return {
        "drivable_rings": [],
        "lane_polygons": list(around["rings"]),
        "crossing_rings": [around["rings"][0]],
        "lane_centerlines": list(around["lines"]),
        "route_centerline": around["rings"][0],
        "agent_kinds": [str(AgentKind[kind.upper()]) for kind in around["kinds"]],
        "agent_boxes": np.repeat(boxes[:, None], AGENT_STEPS, axis=1),
        "agent_valid": np.ones((len(boxes), AGENT_STEPS), bool),
    }


def differences_in_targets(path: Path) -> tuple[str, list[Difference]]:
    """Origin of a file of experiments.parity, and how far ours are from it, in cells and metres."""
    with np.load(path, allow_pickle=False) as stored:
        told, theirs, agents, there = (
            json.loads(str(stored["told"])),
            *(stored[x] for x in ("bev", "agents", "there")),
        )
    ours = bev_raster(street_sample(), PUBLIC)[0]
    boxes, valid = nearest_vehicles(street_sample(), PUBLIC, AGENTS)
    off = ours != theirs
    lines = off & ((ours == BevClass.CENTERLINE) | (theirs == BevClass.CENTERLINE))
    versions = ", ".join(f"{name} {version}" for name, version in told["versions"].items())
    return f"{told['code']} ({versions})", [
        Difference("cells of the map from above", float((off & ~lines).sum()), float(off.size)),
        Difference("cells of it at a line's edge", float(lines.sum()), float(off.size), EDGES * 1e4),
        Difference("slots of vehicles", float((valid != there).sum()), float(len(there))),
        Difference("boxes of vehicles", float(np.abs(boxes - agents).max()), float(np.abs(agents).max())),
    ]
