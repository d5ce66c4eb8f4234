"""Where shapes and agents land in a raster, by closed forms."""

from typing import Any

import numpy as np
import pytest

from factory.store.schema import AGENT_STEPS, NOW_INDEX
from planners.data.batch import BevLayout
from planners.data.bev import BevClass, bev_raster, nearest_vehicles
from tasks.world.clip import AgentKind
from tasks.world.frames import box_corners

LAYOUT = BevLayout(ahead_m=32.0, behind_m=8.0, side_m=16.0, cell_m=0.5)


def scene(agents: dict[AgentKind, list[tuple[float, ...]]] | None = None, **shapes: Any) -> dict[str, Any]:
    """A row with these shapes and agents that stand still."""
    boxes = [(kind, box) for kind, of_kind in (agents or {}).items() for box in of_kind]
    names = ("drivable_rings", "lane_polygons", "crossing_rings", "lane_centerlines")
    return {
        **{name: [] for name in names},
        "route_centerline": np.zeros((0, 3), np.float32),
        "agent_kinds": [str(kind) for kind, _ in boxes],
        "agent_boxes": np.array([np.tile(box, (AGENT_STEPS, 1)) for _, box in boxes], np.float32),
        "agent_valid": np.ones((len(boxes), AGENT_STEPS), bool),
        **shapes,
    }


def rectangle(x0: float, y0: float, x1: float, y1: float) -> np.ndarray[Any, Any]:
    return np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0)], np.float32)


def centres(layout: BevLayout) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """x and y of every cell's centre: row 0 farthest ahead, column 0 farthest left."""
    rows, columns = layout.shape
    x = layout.ahead_m - (np.arange(rows) + 0.5) * layout.cell_m
    y = layout.side_m - (np.arange(columns) + 0.5) * layout.cell_m
    return np.broadcast_to(x[:, None], (rows, columns)), np.broadcast_to(y, (rows, columns))


def covers(
    raster: np.ndarray[Any, Any], what: BevClass, inside: np.ndarray[Any, Any], near: np.ndarray[Any, Any]
) -> None:
    """All cells inside show it, and none that are not near it."""
    assert (raster[inside] == what).all() and not (raster[~near] == what).any()


@pytest.mark.parametrize("name", ["lane_polygons", "drivable_rings", "crossing_rings"])
def test_a_rectangle_covers_its_cells(name: str) -> None:
    raster = bev_raster(scene(**{name: [rectangle(4.0, -3.0, 10.0, 6.0)]}), LAYOUT)[0]
    x, y = centres(LAYOUT)
    inside = (x > 4) & (x < 10) & (y > -3) & (y < 6)
    near = (x > 3.5) & (x < 10.5) & (y > -3.5) & (y < 6.5)
    covers(raster, BevClass.CROSSING if name == "crossing_rings" else BevClass.ROAD, inside, near)


def test_row_0_is_ahead_and_column_0_is_left() -> None:
    raster = bev_raster(scene(lane_polygons=[rectangle(30.0, 14.0, 32.0, 16.0)]), LAYOUT)[0]
    assert raster.shape == (80, 64) and raster[0, 0] == BevClass.ROAD and raster[-1, -1] == BevClass.BACKGROUND


@pytest.mark.parametrize("heading", [0.0, 0.7, np.pi / 2, -2.5])
def test_an_agents_box_covers_its_cells(heading: float) -> None:
    box = (12.0, -4.0, heading, 8.0, 3.0)
    raster = bev_raster(scene({AgentKind.VEHICLE: [box]}), LAYOUT)[0]
    x, y = centres(LAYOUT)
    along = (x - 12) * np.cos(heading) + (y + 4) * np.sin(heading)
    across = -(x - 12) * np.sin(heading) + (y + 4) * np.cos(heading)
    margin = LAYOUT.cell_m * 1.5
    near = (np.abs(along) < 4.0 + margin) & (np.abs(across) < 1.5 + margin)
    covers(raster, BevClass.VEHICLE, (np.abs(along) < 4.0) & (np.abs(across) < 1.5), near)
    corner = box_corners(np.array(box))[0]
    assert abs(along - 4).min() < 1 and np.hypot(*(corner - (12, -4))) == pytest.approx(np.hypot(4, 1.5))


def test_a_route_lies_over_its_lane_and_under_an_agent() -> None:
    line = np.stack([np.linspace(0, 30, 31), np.full(31, 0.25), np.zeros(31)], axis=1).astype(np.float32)
    sample = scene(
        {AgentKind.VEHICLE: [(20.0, 0.0, 0.0, 4.0, 2.0)], AgentKind.PEDESTRIAN: [(20.0, 0.0, 0.0, 1.0, 1.0)]},
        lane_polygons=[rectangle(0, -2, 30, 2)],
        lane_centerlines=[line, line + np.float32([0, 8, 0])],
        route_centerline=line,
    )
    raster = bev_raster(sample, LAYOUT)[0]

    def at(x: float, y: float) -> int:
        return int(raster[int((32 - x) / 0.5), int((16 - y) / 0.5)])

    assert at(10.1, 0.1) == BevClass.ROUTE and at(10.1, 8.1) == BevClass.CENTERLINE and at(10.1, 1.6) == BevClass.ROAD
    assert at(18.6, 0.1) == BevClass.VEHICLE and at(20.1, 0.1) == BevClass.PEDESTRIAN
    assert at(10.1, 5.0) == BevClass.BACKGROUND


def test_every_time_shows_the_agents_of_then_over_the_same_map() -> None:
    sample = scene({AgentKind.BICYCLE: [(0.0, 0.0, 0.0, 2.0, 2.0)]}, lane_polygons=[rectangle(20, 10, 24, 14)])
    sample["agent_boxes"][0, :, 0] = (np.arange(AGENT_STEPS) - NOW_INDEX) * 1.0 + 10  # 10 m/s
    sample["agent_valid"][0, NOW_INDEX - 5] = False
    sample["agent_boxes"][0, NOW_INDEX - 5] = np.nan
    rasters = bev_raster(sample, BevLayout(ahead_m=32, behind_m=8, side_m=16, cell_m=0.5, times_s=(-1.0, -0.5, 0.0)))
    x, _ = centres(LAYOUT)
    means = [x[r == BevClass.PEDESTRIAN].mean() if (r == BevClass.PEDESTRIAN).any() else None for r in rasters]
    assert means == [pytest.approx(0.0, abs=0.3), None, pytest.approx(10.0, abs=0.3)]
    assert all((r == BevClass.ROAD).sum() == (rasters[0] == BevClass.ROAD).sum() > 0 for r in rasters)


def test_what_is_to_come_is_not_shown() -> None:
    with pytest.raises(ValueError, match=r"times_s has 0\.5"):
        bev_raster(scene(), BevLayout(times_s=(0.0, 0.5)))


def test_an_empty_world_is_background() -> None:
    assert not bev_raster(scene(), LAYOUT).any()
    boxes, valid = nearest_vehicles(scene(), LAYOUT, 3)
    assert boxes.shape == (3, 5) and not boxes.any() and not valid.any()


def test_a_shape_larger_than_the_raster_fills_it_and_one_beside_it_is_not_seen() -> None:
    assert (bev_raster(scene(drivable_rings=[rectangle(-500, -500, 500, 500)]), LAYOUT) == BevClass.ROAD).all()
    assert not bev_raster(scene(drivable_rings=[rectangle(40, 40, 60, 60)]), LAYOUT).any()


def test_nearest_agents_are_vehicles_inside_in_order_of_distance() -> None:
    vehicles = [(20.0, 0.0, 0.1, 4.0, 2.0), (5.0, -5.0, 0.2, 5.0, 2.0), (40.0, 0, 0, 4, 2), (0.0, 17.0, 0, 4, 2)]
    sample = scene({AgentKind.VEHICLE: [*vehicles, (-7.0, 0, 0, 4, 2)], AgentKind.PEDESTRIAN: [(1.0, 0, 0, 1, 1)]})
    boxes, valid = nearest_vehicles(sample, LAYOUT, 4)
    expected = np.array([(-7.0, 0, 0, 4, 2), vehicles[1], vehicles[0], (0,) * 5], np.float32)
    order = np.argsort(np.hypot(expected[:3, 0], expected[:3, 1]))
    np.testing.assert_array_equal(boxes[:3], expected[:3][order])
    assert valid.tolist() == [True, True, True, False] and not boxes[3].any()
    sample["agent_valid"][1, NOW_INDEX], sample["agent_boxes"][1, NOW_INDEX] = False, np.nan
    assert nearest_vehicles(sample, LAYOUT, 1)[0][0].tolist() == [-7.0, 0, 0, 4, 2]
