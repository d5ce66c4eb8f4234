"""Comfort of drives of any length: instant by instant what history comfort says of a whole horizon."""

import numpy as np
import pytest

from tasks.kernels.compiled import read_only
from tasks.reward.comfort import N_FLAGS, comfort_scratch, comfortable, first_uncomfortable_steps
from tasks.world.frames import AX, AY, EGO_STATE_SIZE, HEADING, YAW_RATE


def test_it_is_history_comfort_instant_by_instant() -> None:
    """On series of history comfort's own length both judge alike, and find the same first instant."""
    rng = np.random.default_rng(0)
    judged = set()
    for scale in np.geomspace(0.05, 3.0, 40):
        states = np.zeros((55, EGO_STATE_SIZE))
        smooth = np.cumsum(rng.normal(size=(55, 4)), axis=0) * scale * 0.1
        states[:, [AX, AY, HEADING, YAW_RATE]] = smooth
        flags, steps = np.empty((1, N_FLAGS), np.bool_), np.empty(1)
        history, drive = states[:14].copy(), states[14:].copy()
        first_uncomfortable_steps(history, drive[None], comfort_scratch(55), flags, steps)
        first = steps[0]
        within = comfortable(read_only(states))
        assert within.all() == flags.all() == np.isinf(first)
        judged.add(bool(flags.all()))
        if np.isfinite(first):
            row = int(np.argmin(within))
            assert first == (row - 15 if row < 14 else row - 14)
    assert judged == {True, False}


def test_a_drive_shorter_than_the_longest_filter_is_refused() -> None:
    assert comfortable(np.zeros((15, EGO_STATE_SIZE))).all()
    with pytest.raises(ValueError, match="T >= 15"):
        comfortable(np.zeros((14, EGO_STATE_SIZE)))
