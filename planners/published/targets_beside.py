"""What the public target builder makes of a made-up street; it runs in the public code's own Python.

main([<checkout>, <out.npz>])
"""

from __future__ import annotations

import json
import sys
from types import SimpleNamespace
from typing import Any

import numpy as np

from planners.published.beside import origin
from planners.published.formula import street


def main(argv: list[str]) -> None:
    """See the module."""
    import cv2
    from navsim.agents.diffusiondrive.transfuser_config import TransfuserConfig
    from navsim.agents.diffusiondrive.transfuser_features import TransfuserTargetBuilder
    from nuplan.common.actor_state.state_representation import StateSE2

    code, out = argv
    around = street()
    builder = TransfuserTargetBuilder(TransfuserConfig())
    told = annotated(around)
    bev = builder._compute_bev_semantic_map(told, Map(around), StateSE2(0.0, 0.0, 0.0))
    agents, there = builder._compute_agent_targets(told)
    versions = {"python": sys.version.split()[0], "numpy": np.__version__, "opencv": cv2.__version__}
    record = json.dumps({"code": origin(code), "versions": versions})
    np.savez_compressed(
        out, told=np.array(record), bev=bev.numpy().astype(np.uint8), agents=agents.numpy(), there=there.numpy()
    )


def annotated(around: dict[str, Any]) -> Any:
    """The boxes as a frame's annotations hold them: x, y, z, length, width, height, heading."""
    boxes = np.zeros((len(around["boxes"]), 7), np.float32)
    boxes[:, [0, 1, 6, 3, 4]] = around["boxes"]
    boxes[:, 5] = 1.0
    return SimpleNamespace(boxes=boxes, names=around["kinds"])


class Map:
    """A map of nothing but lanes."""

    def __init__(self, around: dict[str, Any]) -> None:
        self.around = around

    def get_proximal_map_objects(self, point: Any, radius: float, layers: Any) -> dict[Any, list[Any]]:
        """All lanes, wherever the point is."""
        from nuplan.common.maps.abstract_map import SemanticMapLayer
        from shapely.geometry import LineString, Polygon

        found: dict[Any, list[Any]] = {layer: [] for layer in layers}
        if SemanticMapLayer.INTERSECTION in layers:
            found[SemanticMapLayer.LANE] = [SimpleNamespace(polygon=Polygon(ring)) for ring in self.around["rings"]]
        elif SemanticMapLayer.LANE in layers:
            paths = [SimpleNamespace(linestring=LineString(line)) for line in self.around["lines"]]
            found[SemanticMapLayer.LANE] = [SimpleNamespace(baseline_path=path) for path in paths]
        return found
