"""Roadblocks, driven lanes and centrelines on small maps whose answer is known by hand."""

from itertools import pairwise

import numpy as np
import pytest
import shapely

from tasks.world.frames import to_world
from tasks.world.road_map import (
    CenterlineFinder,
    Lane,
    MapLayer,
    MapPolygon,
    NoRoute,
    Rings,
    RoadMap,
    Route,
    centerline_from_boundaries,
    driven_lanes,
    polygons_near,
    ring_from_boundaries,
    roadblocks_of,
    route_of_log,
    valid_ring,
)

WIDTH = 4.0


def lane(lane_id: str, points: list[tuple[float, float]], *, motion: np.ndarray | None = None, **graph: object) -> Lane:
    """A lane 4 m wide around a polyline; `motion` moves and turns it with the world."""
    line = np.asarray(points, dtype=np.float64)
    steps = np.gradient(line, axis=0)
    normal = np.stack([-steps[:, 1], steps[:, 0]], axis=1) / np.hypot(*steps.T)[:, None]
    left, right = line + WIDTH / 2 * normal, line - WIDTH / 2 * normal
    if motion is not None:
        left, right = (to_world(motion, np.column_stack([side, np.zeros(len(side))]))[:, :2] for side in (left, right))
    fields = {"is_intersection": False, "drives_cars": True, **graph}
    return Lane(lane_id, ring_from_boundaries(left, right), centerline_from_boundaries(left, right), **fields)


def mapped(*lanes: Lane) -> RoadMap:
    by_id = {lane.lane_id: lane for lane in lanes}
    return RoadMap(by_id, (), roadblock_of=roadblocks_of(by_id))


def two_lane_road(motion: np.ndarray | None = None) -> RoadMap:
    """East-bound lanes a (left) and b (right), west-bound o beside a; junction j straight on to c, k left to d."""
    return mapped(
        lane("a", [(0, 0), (50, 0)], right_neighbor="b", left_neighbor="o", successors=("k",), motion=motion),
        lane("b", [(0, -4), (50, -4)], left_neighbor="a", successors=("j",), motion=motion),
        lane("o", [(50, 4), (0, 4)], left_neighbor="a", motion=motion),
        lane("j", [(50, -4), (70, -4)], is_intersection=True, predecessors=("b",), successors=("c",), motion=motion),
        lane(
            "k",
            [(50, 0), (60, 2), (66, 10), (68, 20)],
            is_intersection=True,
            predecessors=("a",),
            successors=("d",),
            motion=motion,
        ),
        lane("c", [(70, -4), (170, -4)], predecessors=("j",), motion=motion),
        lane("d", [(68, 20), (68, 90)], predecessors=("k",), motion=motion),
        lane("bike", [(0, -8), (50, -8)], drives_cars=False, left_neighbor="b", motion=motion),
    )


def drive(*stops: tuple[float, float], heading: float = 0.0) -> np.ndarray:
    """Poses every 2 m from stop to stop."""
    parts = [np.linspace(a, b, max(2, int(np.hypot(*np.subtract(b, a)) / 2))) for a, b in pairwise(stops)]
    points = np.concatenate(parts)
    return np.column_stack([points, np.full(len(points), heading)])


def test_parallel_lanes_share_a_roadblock_and_opposite_ones_do_not() -> None:
    blocks = two_lane_road().roadblock_of
    assert blocks["a"] == blocks["b"] != blocks["o"]
    assert blocks["j"] == f"rbc_{blocks['b']}>{blocks['c']}"
    assert blocks["j"] != blocks["k"]
    assert "bike" not in blocks


def test_a_connector_at_the_edge_of_the_map_stands_alone() -> None:
    road_map = mapped(lane("x", [(0, 0), (9, 0)], is_intersection=True, successors=("gone",)))
    assert road_map.roadblock_of["x"] == "rbc_x"


def test_the_route_has_all_lanes_of_the_roadblocks_passed() -> None:
    route = route_of_log(two_lane_road(), drive((5, -4), (60, -4)))
    assert route.lane_path == ("b", "j", "c")
    assert route.lane_ids == {"a", "b", "j", "c"}


def test_a_lane_change_costs_less_than_staying_off_the_lane() -> None:
    poses = drive((5, 0), (25, 0), (30, -4), (60, -4))
    assert driven_lanes(two_lane_road(), poses) == ("a", "b", "j")


def test_a_wobble_over_the_line_is_no_lane_change() -> None:
    poses = drive((5, -4), (24, -4), (26, -2.2), (28, -4), (60, -4))
    assert driven_lanes(two_lane_road(), poses) == ("b", "j")


def test_the_oncoming_lane_is_never_driven_against_its_direction() -> None:
    with pytest.raises(NoRoute):
        driven_lanes(mapped(two_lane_road().lanes["o"]), drive((5, 4), (40, 4)))


def test_an_ego_off_the_map_has_no_route() -> None:
    with pytest.raises(NoRoute):
        route_of_log(two_lane_road(), drive((500, 500), (550, 500)))


def test_poses_off_the_lanes_are_passed_over() -> None:
    poses = np.concatenate([drive((-30, -4), (40, -4)), drive((300, 0), (320, 0))])
    assert driven_lanes(two_lane_road(), poses) == ("b",)


def test_the_extension_goes_straight_on_and_stops_after_its_length() -> None:
    lanes = [lane("s0", [(0, 0), (20, 0)], successors=("turn", "s1"))]
    lanes.append(lane("turn", [(20, 0), (28, 2), (30, 10)]))
    lanes += [lane(f"s{i}", [(20 * i, 0), (20 * i + 20, 0)], successors=(f"s{i + 1}",)) for i in range(1, 30)]
    route = route_of_log(mapped(*lanes), drive((2, 0), (18, 0)))
    assert route.lane_path == tuple(f"s{i}" for i in range(9))  # 8 x 20 m reach 150 m


def test_a_ring_road_does_not_extend_forever() -> None:
    lanes = [lane("p", [(0, 0), (50, 0)], successors=("q",)), lane("q", [(50, 0), (100, 0)], successors=("p",))]
    assert route_of_log(mapped(*lanes), drive((2, 0), (40, 0))).lane_path == ("p", "q")


def test_the_centerline_joins_lanes_with_their_shared_point_twice() -> None:
    road_map = two_lane_road()
    route = route_of_log(road_map, drive((5, -4), (60, -4)))
    line = CenterlineFinder(road_map, route).centerline_from(np.array([10.0, -4.0, 0.0]))
    along = np.hypot(*np.diff(line[:, :2], axis=0).T)
    assert (along < 1e-9).sum() == 2
    assert np.isclose(along.sum(), 170.0)
    assert along.max() <= 0.75 + 1e-9
    assert np.allclose(line[:, 2], 0.0)


def test_from_a_lane_that_does_not_lead_there_the_centerline_ends_where_it_can() -> None:
    road_map = two_lane_road()
    route = route_of_log(road_map, drive((5, -4), (60, -4)))
    line = CenterlineFinder(road_map, route).centerline_from(np.array([10.0, 0.0, 0.0]))  # lane a only leads left
    assert np.allclose(line[-1, :2], [50.0, 0.0])


def test_off_the_road_the_nearest_lane_of_the_route_counts() -> None:
    road_map = two_lane_road()
    finder = CenterlineFinder(road_map, route_of_log(road_map, drive((5, -4), (60, -4))))
    assert finder.starting_lane(np.array([10.0, -9.0, 0.0])) == "b"
    assert finder.starting_lane(np.array([-9.0, 0.5, 0.0])) == "a"


def test_of_overlapping_lanes_the_one_with_the_ego_s_heading_is_taken() -> None:
    road_map = mapped(
        lane("s", [(-20, 0), (0, 0)], successors=("straight", "left")),
        lane("straight", [(0, 0), (30, 0)], is_intersection=True, predecessors=("s",)),
        lane("left", [(0, 0), (10, 4), (14, 14)], is_intersection=True, predecessors=("s",)),
    )
    route = route_of_log(road_map, drive((-15, 0), (20, 0)))
    both = CenterlineFinder(
        road_map, type(route)(route.lane_path, (*route.roadblock_ids, "rbc_left"), frozenset(road_map.lanes))
    )
    assert both.starting_lane(np.array([4.0, 0.8, 0.0])) == "straight"
    assert both.starting_lane(np.array([4.0, 0.8, 0.6])) == "left"


def test_the_route_does_not_depend_on_where_the_world_lies() -> None:
    motion = np.array([1200.0, -800.0, 2.4])
    poses = drive((5, 0), (25, 0), (30, -4), (60, -4))
    here, there = two_lane_road(), two_lane_road(motion)
    route = route_of_log(here, poses)
    moved_route = route_of_log(there, to_world(motion, poses))
    assert route == moved_route
    line = CenterlineFinder(here, route).centerline_from(poses[0])
    moved_line = CenterlineFinder(there, moved_route).centerline_from(to_world(motion, poses[0]))
    assert np.abs(to_world(motion, line)[:, :2] - moved_line[:, :2]).max() < 1e-6


def test_centerlines_are_shared_and_cannot_be_written() -> None:
    road_map = two_lane_road()
    finder = CenterlineFinder(road_map, route_of_log(road_map, drive((5, -4), (60, -4))))
    line = finder.centerline_from(np.array([10.0, -4.0, 0.0]))
    assert line is finder.centerline_from(np.array([12.0, -4.3, 0.1]))
    with pytest.raises(ValueError, match="read-only"):
        line[0, 0] = 1.0


def test_ring_queries_equal_shapely() -> None:
    rng = np.random.default_rng(3)
    polygons = [shapely.Point(*rng.uniform(-50, 50, 2)).buffer(rng.uniform(2, 20), 3) for _ in range(12)]
    polygons.append(shapely.Polygon([(0, 0), (20, 0), (20, 20), (10, 5), (0, 20)]))  # not convex
    rings = Rings([np.asarray(polygon.exterior.coords) for polygon in polygons])
    for point in rng.uniform(-60, 60, (200, 2)):
        at = shapely.Point(point)
        assert list(rings.contains(point)) == [polygon.contains(at) for polygon in polygons]
        distance = rings.distances(point)
        assert np.abs(distance - [polygon.distance(at) for polygon in polygons]).max() < 1e-9
        for within_m in (0.0, 5.0, float(distance[0]), 1e3):
            within = rings.distances(point, within_m)
            assert np.array_equal(within, np.where(distance <= within_m, distance, np.inf))


def test_a_crossed_ring_is_repaired_to_its_largest_part() -> None:
    bow_tie = np.array([[0, 0], [10, 10], [10, 0], [0, 6], [0, 0]], dtype=np.float64)
    polygon = shapely.Polygon(valid_ring(bow_tie))
    assert polygon.is_valid
    assert 0.0 < polygon.area < 50.0
    with pytest.raises(ValueError, match="no area"):
        valid_ring(np.array([[0, 0], [1, 1], [2, 2], [0, 0]], dtype=np.float64))


def test_layers_come_in_the_reference_s_order_and_only_within_the_radius() -> None:
    road = two_lane_road()
    area = MapPolygon("da_1", MapLayer.DRIVABLE_AREA, np.array([[0, 0], [9, 0], [9, 9], [0, 0]], dtype=np.float64))
    far = MapPolygon("da_2", MapLayer.DRIVABLE_AREA, area.ring + 500.0)
    road_map = RoadMap(road.lanes, (area, far), roadblock_of=road.roadblock_of)
    tokens = [polygon.token for polygon in polygons_near(road_map, np.array([10.0, 0.0]), radius_m=45.0)]
    assert tokens == ["a", "b", "o", "j", "k", "int_j", "int_k", "da_1"]


def ahead(poses: np.ndarray, pose: tuple[float, float, float], motion: np.ndarray | None = None) -> float | None:
    """Metres of 20 that the route of poses goes on from a pose, within 0.5 m and 0.5 rad of its lanes."""
    road_map, at = two_lane_road(motion), np.array(pose)
    if motion is not None:
        poses, at = to_world(motion, poses), to_world(motion, at)
    return CenterlineFinder(road_map, route_of_log(road_map, poses)).metres_ahead(at, 0.5, 0.5, 20.0)


@pytest.mark.parametrize("motion", [None, np.array([120.0, -40.0, 1.1])])
def test_the_way_ahead_is_as_long_as_the_route_s_lanes_in_a_row(motion: np.ndarray | None) -> None:
    """Straight on over j to c: a leads to k, which is off the route, 50 m from where it begins."""
    straight = drive((5, -4), (60, -4))
    assert ahead(straight, (35.0, 0.0, 0.0), motion) == pytest.approx(15.0, abs=0.4)  # points lie 0.74 m apart
    assert ahead(straight, (10.0, 0.0, 0.0), motion) == pytest.approx(40.0, abs=0.4)
    assert ahead(straight, (35.0, -4.0, 0.0), motion) == pytest.approx(35.0, abs=0.4)  # 15 on b, all 20 of j
    assert ahead(straight, (60.0, -4.0, 0.0), motion) == np.inf  # c is the route's last
    assert ahead(straight, (150.0, -4.0, 0.0), motion) == np.inf
    left = drive((5, 0), (50, 0))
    assert ahead(left, (49.0, -4.0, 0.0), motion) == pytest.approx(1.0, abs=0.4)


def test_a_pose_beside_the_route_s_lanes_or_across_them_has_no_way_ahead() -> None:
    straight = drive((5, -4), (60, -4))
    assert ahead(straight, (30.0, -6.4, 0.4)) is not None
    assert ahead(straight, (30.0, -6.6, 0.4)) is None
    assert ahead(straight, (30.0, -4.0, 0.6)) is None
    assert ahead(straight, (30.0, -4.0, 0.4 - 2.0 * np.pi)) is not None
    assert ahead(straight, (61.0, 6.0, 0.4)) is None  # on k, which the route does not take
    assert ahead(straight, (30.0, 4.0, 0.0)) is None  # on the lane of those who come


def test_a_way_ahead_that_goes_in_a_circle_has_an_end() -> None:
    """Two short lanes that lead to each other, and the route's last one elsewhere."""
    road_map = mapped(
        lane("s", [(0, 0), (6, 0)], successors=("t",)),
        lane("t", [(6, 0), (12, 0)], successors=("s",)),
        lane("z", [(500, 0), (520, 0)]),
    )
    blocks = tuple(road_map.roadblock_of[name] for name in "stz")
    finder = CenterlineFinder(road_map, Route(("s", "t", "z"), blocks, frozenset("stz")))
    assert finder.metres_ahead(np.array([0.0, 0.0, 0.0]), 0.5, 0.5, 20.0) == pytest.approx(24.0)
