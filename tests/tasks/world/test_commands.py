"""The command from a route's first points is NAVSIM's on arcs, wherever the points begin."""

import numpy as np
import pytest

from tasks.world.commands import SENT_M, command_of_points, route_points
from tasks.world.road_map import driving_command

RADII_M = (50, 80, 99, 103, 150, 250, 400, 440, 445, 1000)
BORDER_M = 101.0  # R (1 - cos(20 / R)) = 2 m: 101 - 0.33
SIMSCALE_BORDER_M = 441.0  # R (1 - cos(s / R)) = 2 m at its first point, s = 42.1 m


def arc(radius_m: float, side: float, end_m: float = 80.0) -> np.ndarray:
    """(P, 3) x, y, heading from the ego on, every 0.25 m."""
    turned = side * np.arange(0.0, end_m + 0.1, 0.25) / radius_m
    return np.column_stack([radius_m * np.sin(side * turned), side * radius_m * (1.0 - np.cos(turned)), turned])


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("radius_m", RADII_M)
def test_on_an_arc_the_rule_is_the_closed_form_and_navsim_s(radius_m: float, side: float) -> None:
    turn = "left" if side > 0 else "right"
    route, expected = arc(radius_m, side), turn if radius_m < BORDER_M else "straight"
    assert driving_command(route, np.zeros(3)) == expected
    assert command_of_points(route_points(route), "curvature") == expected
    assert command_of_points(route[:, :2], "curvature") == expected, "from the ego on"
    theirs = turn if radius_m < SIMSCALE_BORDER_M else "straight"
    assert command_of_points(route_points(route), "simscale") == theirs


@pytest.mark.parametrize("rule", ["curvature", "simscale"])
def test_a_route_s_points_are_those_that_alpasim_sends(rule: str) -> None:
    route = np.column_stack([np.linspace(-20.0, 70.0, 181), np.full(181, 0.4), np.zeros(181)])
    points = route_points(route)
    assert np.isnan(points[:10]).all() and np.isnan(points[17:]).all(), "before 40 m, and beyond its end"
    np.testing.assert_allclose(points[10:17], np.column_stack([SENT_M[10:17], np.full(7, 0.4)]), atol=1e-9)
    assert command_of_points(points, rule) == "straight"  # type: ignore[arg-type]
    nothing_ahead = "straight" if rule == "simscale" else "unknown"
    assert command_of_points(points[:10], rule) == nothing_ahead  # type: ignore[arg-type]
    assert command_of_points(points[:0], rule) == "unknown"  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"route_centerline is empty.*command=navsim"):
        route_points(route[:0])


@pytest.mark.parametrize(
    ("points", "theirs"),
    [
        ([], "unknown"),
        ([(np.nan, np.nan)] * 20, "straight"),
        ([(4.0, 2.9), (-1.0, 0.0)], "straight"),
        ([(4.0, 2.9), (np.nan, 9.0), (4.0, 3.1)], "left"),
        ([(6.0, 2.0)], "straight"),
        ([(6.0, -2.0)], "straight"),
        ([(6.0, -2.25), (40.0, 30.0)], "right"),
    ],
)
def test_simscale_s_rule_is_its_own_code_s(points: list[tuple[float, float]], theirs: str) -> None:
    """As `command_from_route` of NVlabs/alpasim a2a98a2 answers (e2e_challenge/sample_submission_simscale_*)."""
    assert command_of_points(np.array(points, float).reshape(-1, 2), "simscale") == theirs


def test_a_heading_that_flips_simscale_s_rule_on_a_straight_road_does_not_flip_ours() -> None:
    turned = np.radians(8.0)
    points = SENT_M[10:, None] * [np.cos(turned), np.sin(turned)]
    assert command_of_points(points, "simscale") == "left"
    assert command_of_points(points, "curvature") == "straight"


def test_a_turn_that_has_begun_is_one_though_the_sent_points_are_straight_again() -> None:
    """A right angle of 12 m radius that begins 8 m ahead ends before the first point that is sent."""
    ahead = np.column_stack([np.arange(0.0, 8.0, 0.5), np.zeros(16), np.zeros(16)])
    bend = np.add(arc(12.0, 1.0, 12.0 * np.pi / 2), [8.0, 0.0, 0.0])
    after = np.column_stack([np.full(100, 20.0), 12.0 + np.arange(0.5, 50.5, 0.5), np.full(100, np.pi / 2)])
    route = np.concatenate([ahead, bend, after])
    assert driving_command(route, np.zeros(3)) == command_of_points(route_points(route), "curvature") == "left"


def test_an_ego_beside_its_straight_route_is_told_straight_where_the_route_begins_at_it() -> None:
    assert command_of_points(np.column_stack([SENT_M, np.ones(len(SENT_M))]), "curvature") == "straight"
