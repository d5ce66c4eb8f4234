"""What kind of scenario a sample is, by plain rules on its row; the names follow nuPlan's scenario tags in spirit."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from factory.store.schema import AGENT_STEPS, NOW_INDEX
from tasks.world.arrays import Array
from tasks.world.clip import STEP_S, AgentKind
from tasks.world.frames import PACIFICA, wrap_angle
from tasks.world.road_map import LightState, Rings

TURN_RAD = 0.5  # change of heading over the label's 4 s
STANDING_MPS, MOVING_MPS, HIGH_SPEED_MPS = 0.5, 2.0, 10.0
LANE_CHANGE_M = 2.0  # change of the distance from the route's centreline over the label
OFF_ROUTE_LINE_M = 0.75
NEAR_VEHICLE_M, NEAR_PERSON_M = 8.0, 10.0  # between the centres
LEAD_AHEAD_M, LEAD_ASIDE_M = 25.0, 1.5
DENSE_COUNT, DENSE_M = 10, 30.0

TAG_COLUMNS = (
    "label_10hz",
    "ego_status",
    "agent_kinds",
    "agent_boxes",
    "agent_valid",
    "route_centerline",
    "route_lane_ids",
    "lane_polygons",
    "lane_is_intersection",
    "light_lane_ids",
    "light_states",
)


def tags_of(row: Mapping[str, Any]) -> tuple[str, ...]:
    """The tags that a sample's row (TAG_COLUMNS) has.

    Movement is that of the label, the drive that follows; agents, lights and places are those at now.
    """
    found = _movement(row) | _aside(row) | _agents(row) | _places(row)
    return tuple(name for name, has in found.items() if has)


def _movement(row: Mapping[str, Any]) -> dict[str, bool]:
    label = np.asarray(row["label_10hz"], dtype=np.float64)
    speed = float(np.hypot(*np.asarray(row["ego_status"])[:2]))
    last = float(np.hypot(*(label[-1, :2] - label[-2, :2]))) / STEP_S
    turned = float(np.unwrap(np.append(0.0, label[:, 2]))[-1])
    return {
        "turning_left": turned > TURN_RAD,
        "turning_right": turned < -TURN_RAD,
        "standing": speed < STANDING_MPS and last < STANDING_MPS,
        "starting": speed < STANDING_MPS and last > MOVING_MPS,
        "stopping": speed > MOVING_MPS and last < STANDING_MPS,
        "high_speed": speed > HIGH_SPEED_MPS,
    }


def _agents(row: Mapping[str, Any]) -> dict[str, bool]:
    kinds = np.array(row["agent_kinds"], dtype=str)
    boxes = np.asarray(row["agent_boxes"], dtype=np.float64).reshape(len(kinds), AGENT_STEPS, 5)[:, NOW_INDEX]
    there = np.asarray(row["agent_valid"], dtype=bool).reshape(len(kinds), AGENT_STEPS)[:, NOW_INDEX]
    x, y = boxes[:, 0] - PACIFICA.rear_axle_to_center, boxes[:, 1]
    distance = np.where(there, np.hypot(x, y), np.inf)

    def within(kind: AgentKind, metres: float) -> int:
        return int(((kinds == kind) & (distance < metres)).sum())

    ahead = there & (kinds == AgentKind.VEHICLE) & (x > 0.0) & (x < LEAD_AHEAD_M) & (np.abs(y) < LEAD_ASIDE_M)
    return {
        "near_vehicle": within(AgentKind.VEHICLE, NEAR_VEHICLE_M) > 0,
        "near_pedestrian": within(AgentKind.PEDESTRIAN, NEAR_PERSON_M) > 0,
        "near_cyclist": within(AgentKind.BICYCLE, NEAR_PERSON_M) > 0,
        "following": bool(ahead.any()),
        "dense_traffic": within(AgentKind.VEHICLE, DENSE_M) >= DENSE_COUNT,
    }


def _aside(row: Mapping[str, Any]) -> dict[str, bool]:
    line = np.asarray(row["route_centerline"], dtype=np.float64)
    now, then = _aside_m(line, np.zeros(3)), _aside_m(line, np.asarray(row["label_10hz"], dtype=np.float64)[-1])
    return {"lane_change": abs(then - now) > LANE_CHANGE_M, "off_center": abs(now) > OFF_ROUTE_LINE_M}


def _places(row: Mapping[str, Any]) -> dict[str, bool]:
    label = np.asarray(row["label_10hz"], dtype=np.float64)
    junctions = [ring for ring, is_one in zip(row["lane_polygons"], row["lane_is_intersection"], strict=True) if is_one]
    places = np.concatenate([np.zeros((1, 2)), label[4::5, :2]])
    rings = Rings(junctions) if junctions else None
    on_route = set(row["route_lane_ids"])
    reds = [
        lane_id
        for lane_id, states in zip(row["light_lane_ids"], row["light_states"], strict=True)
        if lane_id in on_route and states[NOW_INDEX] == LightState.RED
    ]
    return {
        "intersection": rings is not None and any(rings.contains(place).any() for place in places),
        "red_light": bool(reds),
    }


def _aside_m(line: Array, pose: Array) -> float:
    """Metres to the left of a centreline (P, 3), of the rear axle (3,); along the headings of its nearest points."""
    gaps = np.hypot(*(line[:, :2] - pose[:2]).T) + np.abs(wrap_angle(line[:, 2] - pose[2]))
    x, y, heading = line[int(np.argmin(gaps))]
    return float(np.cos(heading) * (pose[1] - y) - np.sin(heading) * (pose[0] - x))
