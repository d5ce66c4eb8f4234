"""Comfort limits hold on the whole of history and horizon; extended comfort compares overlapping plans."""

import numpy as np
import pytest

from tasks.reward.comfort import interpolated_history
from tasks.reward.epdms import score
from tasks.world.frames import AX, AY, HEADING, X
from tests.tasks.reward.straight_street import drive, past_of, street


def test_constant_speed_is_comfortable_and_braking_beyond_the_limit_is_not():
    calm = drive(8.0)
    hard = drive(8.0)
    hard[0, 20:, AX] = -5.0
    prepared = street(past=past_of(calm))
    scores = score(prepared, np.concatenate([calm, hard]))
    assert scores.hc.tolist() == [1.0, 0.0]
    assert scores.comfort[0].all()
    assert not scores.comfort[1, 0] and scores.comfort[1, 1]  # longitudinal, not lateral
    assert 14 <= scores.hc_index[1] <= 20


@pytest.mark.parametrize(
    ("column", "low", "high"), [(AX, -4.05, 2.40), (AY, -4.89, 4.89)], ids=["along the road", "across"]
)
def test_a_steady_acceleration_is_comfortable_up_to_its_limit_to_either_side(column, low, high):
    """As it always was: the filters leave a constant as it is, and its jerk is none."""
    for value, comfortable in ((0.99 * low, 1.0), (1.01 * low, 0.0), (0.99 * high, 1.0), (1.01 * high, 0.0)):
        states = drive(8.0)
        past = past_of(states)
        states[..., column], past[:, column] = value, value
        assert score(street(past=past), states).hc[0] == comfortable, value


def test_without_a_history_comfort_is_not_judged():
    hard = drive(8.0)
    hard[0, 20:, AX] = -5.0
    assert score(street(), hard).hc[0] == 1.0
    assert score(street(past=past_of(drive(8.0))), hard, with_history=False).hc[0] == 1.0


def test_a_harsh_past_is_held_against_any_plan():
    past = past_of(drive(8.0))
    past[:2, AY] = 6.0
    scores = score(street(past=past), drive(8.0))
    assert scores.hc[0] == 0.0 and not scores.comfort[0, 1]
    assert scores.hc_index[0] == -15


def test_history_is_interpolated_across_the_heading_jump_and_ends_at_minus_0_2_s():
    past = np.zeros((4, 11))
    past[:, X] = [0.0, 5.0, 10.0, 15.0]
    past[:, HEADING] = [3.1, -3.1, -3.0, -2.9]
    rows = interpolated_history(past)
    assert rows.shape == (14, 11)
    np.testing.assert_allclose(rows[:, X], np.arange(14.0), atol=1e-12)
    assert np.abs(np.diff(rows[:, HEADING])).max() < 0.03
