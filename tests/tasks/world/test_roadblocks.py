"""A log's roadblocks mended around a pose, on streets whose answer is known by hand and against a literal search."""

from collections import deque

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from tasks.world.road_map import NoRoute
from tasks.world.roadblocks import Roadblocks, _search, corrected_roadblocks


def street(n: int) -> Roadblocks:
    """Groups g0, g1, ... of one lane, 20 m long along x, with connectors c0, c1, ... of 20 m between them."""
    names = [f"{'gc'[k % 2]}{k // 2}" for k in range(2 * n - 1)]
    spans = {name: 20.0 * k for k, name in enumerate(names)}
    lines = {
        name: np.column_stack([x + np.linspace(0.0, 20.0, 11), np.zeros(11), np.zeros(11)]) for name, x in spans.items()
    }
    ordered = sorted(names, key=lambda name: name[0] == "c")
    shapes = {name: shapely.box(spans[name], -2.0, spans[name] + 20.0, 2.0) for name in ordered}
    joins = {f"c{k}": (f"g{k}", f"g{k + 1}") for k in range(n - 1)}
    return Roadblocks(shapes, {name: (name,) for name in names}, joins, lines.__getitem__)


AT_G0 = np.array([10.0, 0.5, 0.1])


@pytest.mark.parametrize(
    ("given_ids", "pose", "wanted"),
    [
        (["g0", "c0", "g1"], AT_G0, ["g0", "c0", "g1"]),
        (["g0", "g0", "c0", "g1"], AT_G0, ["g0", "c0", "g1"]),  # repeated ids count once
        (["g0", "g1", "g2"], AT_G0, ["g0", "c0", "g1", "c1", "g2"]),  # gaps are filled
        (["g2", "c2", "g3"], AT_G0, ["g0", "c0", "g1", "c1", "g2", "c2", "g3"]),  # a way from the ego's own
        (["g0", "far", "c0"], AT_G0, ["g0", "c0"]),  # what the map has not
        (["g1", "c1", "g2"], np.array([10.0, 400.0, 0.0]), ["c0", "g1", "c1", "g2"]),  # g0 and c0 are near
    ],
)
def test_routes_on_a_street(given_ids: list[str], pose: np.ndarray, wanted: list[str]) -> None:
    assert corrected_roadblocks(street(5), given_ids, pose) == wanted


def test_a_route_ends_before_a_connector_that_shares_ground_with_an_earlier_one() -> None:
    blocks = street(4)
    shapes = dict(blocks.shapes) | {"c2": blocks.shapes["c0"]}
    looped = Roadblocks(shapes, blocks.lanes_of, blocks.joins, blocks.centerline)
    route = ["g0", "c0", "g1", "c1", "g2", "c2", "g3"]
    assert corrected_roadblocks(looped, route, AT_G0) == route[:5]


def test_a_route_of_another_place_is_none() -> None:
    with pytest.raises(NoRoute, match="elsewhere"):
        corrected_roadblocks(street(2), ["elsewhere"], AT_G0)


def literal(graph: dict[str, list[str]], start: str, targets: list[str], max_depth: int) -> list[str]:
    """Breadth first with one queue, every way kept and the last parent of each depth: as the public code is written."""
    queue, depth, parent = deque([start, None]), 1, {(start, 1): None}
    while queue:
        current = queue.popleft()
        if depth > max_depth:
            break
        if current is None:
            depth += 1
            queue.append(None)
            if queue[0] is None:
                break
            continue
        if current in targets:
            path = [current]
            while parent[path[-1], depth] is not None:
                path.append(parent[path[-1], depth])
                depth -= 1
            return path[::-1]
        for after in graph[current]:
            queue.append(after)
            parent[after, depth + 1] = current
    return []


@settings(max_examples=100, deadline=None)
@given(st.lists(st.lists(st.integers(0, 6), max_size=3), min_size=7, max_size=7), st.integers(0, 6), st.integers(1, 7))
def test_the_search_is_the_literal_one(edges: list[list[int]], goal: int, depth: int) -> None:
    graph = {str(k): [str(other) for other in row] for k, row in enumerate(edges)}
    targets = [str(goal), str((goal + 3) % 7)]
    assert _search(graph.__getitem__, "0", targets, depth) == literal(graph, "0", targets, depth)
