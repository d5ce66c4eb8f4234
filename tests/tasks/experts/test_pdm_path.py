"""Paths by arc length."""

import numpy as np
import pytest

from tasks.experts.pdm_path import drive_path, parallel


def test_a_repeated_point_at_a_lane_joint_changes_nothing() -> None:
    line = np.stack([np.linspace(0, 10, 11), np.zeros(11), np.zeros(11)], axis=1)
    doubled = np.insert(line, [0, 5, 5], line[[0, 5, 5]], axis=0)
    at = np.array([-1.0, 0.0, 2.5, 5.0, 9.9, 10.0, 12.0])
    np.testing.assert_allclose(drive_path(doubled).at(at), drive_path(line).at(at), atol=1e-12)


def test_headings_are_interpolated_the_short_way_round() -> None:
    path = drive_path(np.array([[0.0, 0.0, 3.1], [2.0, 0.0, -3.1]]))
    assert abs(abs(path.at(np.array([1.0]))[0, 2]) - np.pi) < 1e-12


def test_a_parallel_of_a_left_curve_is_shorter_on_its_left() -> None:
    angle = np.linspace(0.0, np.pi / 2.0, 200)
    arc = np.stack([20.0 * np.sin(angle), 20.0 - 20.0 * np.cos(angle), angle], axis=1)
    lengths = [drive_path(parallel(arc, offset)).length_m for offset in (-1.0, 0.0, 1.0)]
    np.testing.assert_allclose(lengths, np.pi / 2.0 * np.array([21.0, 20.0, 19.0]), rtol=1e-4)


def test_a_path_needs_a_length() -> None:
    with pytest.raises(ValueError, match="needs a length"):
        drive_path(np.zeros((4, 3)))
    with pytest.raises(ValueError, match=r"shape \(P >= 2, 3\)"):
        drive_path(np.zeros((1, 3)))
