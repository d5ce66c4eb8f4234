"""The driving command: where the route lies 20 m ahead."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tasks.world.frames import to_world
from tasks.world.road_map import LATERAL_M, LOOKAHEAD_M, driving_command

ORIGIN = np.zeros(3)


def bend(degrees: float, start_m: float = 5.0, spacing_m: float = 0.75) -> np.ndarray:
    """A route along x that turns at once by `degrees` at x = start_m and goes on for 40 m."""
    angle = np.radians(degrees)
    before = np.arange(-10.0, start_m, spacing_m)
    after = np.arange(0.0, 40.0, spacing_m)
    first = np.column_stack([before, np.zeros_like(before), np.zeros_like(before)])
    second = np.column_stack(
        [start_m + after * np.cos(angle), after * np.sin(angle), np.full_like(after, angle)],
    )
    return np.concatenate([first, second])


@pytest.mark.parametrize(("degrees", "command"), [(90, "left"), (-90, "right"), (0, "straight"), (5, "straight")])
def test_the_route_twenty_metres_ahead_decides(degrees: float, command: str) -> None:
    assert driving_command(bend(degrees), ORIGIN) == command


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_two_metres_to_a_side_are_the_border(sign: float) -> None:
    """The bend starts 5 m ahead, so 15 m along it: a side offset of 15 sin(angle)."""
    border = np.degrees(np.arcsin(LATERAL_M / (LOOKAHEAD_M - 5.0)))
    assert driving_command(bend(sign * (border + 0.2)), ORIGIN) == ("left" if sign > 0 else "right")
    assert driving_command(bend(sign * (border - 0.2)), ORIGIN) == "straight"


def test_a_turn_beyond_twenty_metres_is_not_yet_one() -> None:
    assert driving_command(bend(90, start_m=25.0), ORIGIN) == "straight"


def test_a_route_that_ends_within_twenty_metres_is_unknown() -> None:
    route = np.column_stack([np.linspace(0.0, 19.0, 30), np.zeros(30), np.zeros(30)])
    assert driving_command(route, ORIGIN) == "unknown"
    assert driving_command(route, np.array([-0.0, 1.0, 0.0])) == "unknown"
    assert driving_command(route[:1], ORIGIN) == "unknown"


def test_an_ego_beside_its_route_gets_the_route_s_command() -> None:
    assert driving_command(bend(0), np.array([0.0, 3.0, 0.1])) == "straight"
    assert driving_command(bend(90), np.array([0.0, 1.5, -0.2])) == "left"


def test_a_route_that_comes_back_is_looked_at_where_it_runs_the_ego_s_way() -> None:
    """Out along y = 0, back along y = 4 a little nearer to the ego: the heading tells the two apart."""
    out = np.column_stack([np.arange(0.0, 60.0), np.zeros(60), np.zeros(60)])
    back = np.column_stack([np.arange(60.0, 0.0, -1.0), np.full(60, 4.0), np.full(60, np.pi)])
    assert driving_command(np.concatenate([out, back]), np.array([10.0, 2.2, 0.0])) == "straight"


def test_the_command_does_not_depend_on_how_densely_the_route_came() -> None:
    """Corners alone, 55 m before a left turn: the nearest corner is the turn itself, the command is still straight."""
    corners = np.array([[0.0, 0.0, 0.0], [100.0, 0.0, 0.0], [100.0, 0.0, np.pi / 2], [100.0, 80.0, np.pi / 2]])
    for x, command in ((0.0, "straight"), (55.0, "straight"), (75.0, "straight"), (85.0, "left"), (95.0, "left")):
        assert driving_command(corners, np.array([x, 0.3, 0.0])) == command


@given(
    degrees=st.sampled_from([-90.0, -30.0, 0.0, 30.0, 90.0]),
    x=st.floats(-1e4, 1e4),
    y=st.floats(-1e4, 1e4),
    heading=st.floats(-3.1, 3.1),
)
def test_moving_the_world_changes_nothing(degrees: float, x: float, y: float, heading: float) -> None:
    origin, route, pose = np.array([x, y, heading]), bend(degrees), np.array([1.0, 0.4, 0.1])
    assert driving_command(to_world(origin, route), to_world(origin, pose)) == driving_command(route, pose)
