"""Tags of rows made by hand."""

from typing import Any

import numpy as np

from planners.evaluation.tags import tags_of
from tasks.world.road_map import LightState

STEPS = 56
TIMES = np.arange(1, 41) * 0.1


def row(**changes: Any) -> dict[str, Any]:
    """8 m/s straight ahead on an empty road."""
    plain: dict[str, Any] = {
        "label_10hz": np.column_stack([8.0 * TIMES, 0.0 * TIMES, 0.0 * TIMES]).astype(np.float32),
        "ego_status": np.array([8.0, 0.0, 0.0, 0.0], np.float32),
        "agent_kinds": [],
        "agent_boxes": np.zeros((0, STEPS, 5), np.float32),
        "agent_valid": np.zeros((0, STEPS), bool),
        "route_centerline": np.column_stack([np.arange(-10.0, 100.0), np.zeros(110), np.zeros(110)]),
        "lane_polygons": [],
        "lane_is_intersection": [],
        "route_lane_ids": ["a"],
        "light_lane_ids": [],
        "light_states": np.zeros((0, STEPS), np.int8),
    }
    return plain | changes


def label(x: np.ndarray, y: np.ndarray | float = 0.0, heading: np.ndarray | float = 0.0) -> np.ndarray:
    return np.column_stack([x, np.broadcast_to(y, 40), np.broadcast_to(heading, 40)]).astype(np.float32)


def agents(*boxes: tuple[str, float, float]) -> dict[str, Any]:
    """Kinds and places at all times."""
    array = np.zeros((len(boxes), STEPS, 5), np.float32)
    for i, (_, x, y) in enumerate(boxes):
        array[i, :, :2] = x, y
    valid = np.ones((len(boxes), STEPS), bool)
    return {"agent_kinds": [kind for kind, _, _ in boxes], "agent_boxes": array, "agent_valid": valid}


def test_an_empty_road_has_no_tag() -> None:
    assert tags_of(row()) == ()


def test_a_turn_is_half_a_radian_in_the_label() -> None:
    angle = 0.6 * TIMES / 4.0
    arc = label(20.0 * np.sin(angle), 20.0 * (1.0 - np.cos(angle)), angle)
    follows = np.column_stack([20.0 * np.sin(angle), 20.0 * (1.0 - np.cos(angle)), angle])
    line = np.concatenate([np.zeros((1, 3)), follows])
    assert tags_of(row(label_10hz=arc, route_centerline=line)) == ("turning_left",)
    mirrored = arc * [1.0, -1.0, -1.0]
    assert tags_of(row(label_10hz=mirrored, route_centerline=line * [1.0, -1.0, -1.0])) == ("turning_right",)
    assert tags_of(row(label_10hz=label(8.0 * TIMES, 0.0, 0.4 * TIMES / 4.0))) == ()


def test_stopping_standing_starting_and_speed() -> None:
    stops, starts = label(8.0 * np.minimum(TIMES, 2.0)), label(0.75 * TIMES**2)
    still = np.zeros(4, np.float32)
    assert tags_of(row(label_10hz=stops)) == ("stopping",)
    assert tags_of(row(label_10hz=label(np.zeros(40)), ego_status=still)) == ("standing",)
    assert tags_of(row(label_10hz=starts, ego_status=still)) == ("starting",)
    assert tags_of(row(label_10hz=label(12.0 * TIMES), ego_status=np.array([12.0, 0, 0, 0]))) == ("high_speed",)


def test_a_lane_change_leaves_the_routes_centreline_by_two_metres_or_comes_back_to_it() -> None:
    aside = 3.5 * TIMES / 4.0
    assert tags_of(row(label_10hz=label(8.0 * TIMES, aside))) == ("lane_change",)
    shifted = row()["route_centerline"] + [0.0, 3.5, 0.0]
    assert tags_of(row(label_10hz=label(8.0 * TIMES, aside), route_centerline=shifted)) == ("lane_change", "off_center")
    assert tags_of(row(label_10hz=label(8.0 * TIMES, aside / 2.0))) == ()


def test_neighbours_by_kind_and_distance_from_the_egos_centre() -> None:
    assert tags_of(row(**agents(("VEHICLE", 1.4, 3.5)))) == ("near_vehicle",)
    assert tags_of(row(**agents(("VEHICLE", 20.0, 0.5)))) == ("following",)
    assert tags_of(row(**agents(("VEHICLE", 40.0, 0.5), ("VEHICLE", -10.0, 0.0)))) == ()
    assert tags_of(row(**agents(("PEDESTRIAN", 5.0, 5.0), ("BICYCLE", 5.0, -5.0)))) == (
        "near_pedestrian",
        "near_cyclist",
    )
    assert tags_of(row(**agents(*[("VEHICLE", -15.0, float(i)) for i in range(10)]))) == ("dense_traffic",)
    gone = agents(("VEHICLE", 1.4, 3.5))
    gone["agent_valid"][:, 15] = False
    gone["agent_boxes"][:, 15] = np.nan
    assert tags_of(row(**gone)) == ()


def test_junctions_and_red_lights_of_the_route() -> None:
    square = np.array([[20.0, -5.0], [30.0, -5.0], [30.0, 5.0], [20.0, 5.0], [20.0, -5.0]])
    lanes = {"lane_polygons": [square], "lane_is_intersection": [True]}
    assert tags_of(row(**lanes)) == ("intersection",)
    assert tags_of(row(**lanes | {"lane_is_intersection": [False]})) == ()
    states = np.full((1, STEPS), LightState.GREEN, np.int8)
    states[:, 15] = LightState.RED
    assert tags_of(row(light_lane_ids=["a"], light_states=states)) == ("red_light",)
    assert tags_of(row(light_lane_ids=["elsewhere"], light_states=states)) == ()
