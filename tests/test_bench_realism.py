"""What tests.bench.realism measures: distances, likelihoods and faults in closed form."""

from dataclasses import replace

import numpy as np
import pytest
import shapely

from tasks.world.clip import NOW
from tasks.world.frames import box_corners
from tests.bench.realism import DEEP_M, FEATURES, box_distance, faults_of, likelihood, nearest
from tests.tasks.rollout import worlds
from tests.tasks.rollout.worlds import Track

FAR_EGO = np.tile([0.0, 500.0, 0.0, 5.0, 2.0], (41, 1))


def test_the_distance_of_boxes_is_shapely_s_and_below_zero_how_far_one_must_be_moved() -> None:
    rng = np.random.default_rng(0)
    boxes, others = (
        np.column_stack([rng.uniform(-5, 5, (500, 2)), rng.uniform(-3, 3, 500), rng.uniform(0.5, 6, (500, 2))])
        for _ in range(2)
    )
    found = box_distance(boxes, others)
    shapes = [shapely.polygons(box_corners(b)) for b in (boxes, others)]
    apart = found > 0.0
    assert 100 < apart.sum() < 400
    assert found[apart] == pytest.approx(shapely.distance(*shapes)[apart])
    assert (shapely.area(shapely.intersection(*shapes))[~apart] > 0.0).all()
    inside = box_distance(np.array([0.0, 0.0, 0.0, 4.0, 2.0]), np.array([1.0, 1.7, 0.0, 4.0, 2.0]))
    assert inside == pytest.approx(-0.3)


def test_the_nearest_is_that_of_all_pairs() -> None:
    """What is left out beforehand is farther off: a lorry that reaches far among small ones, some of them away."""
    rng = np.random.default_rng(1)
    boxes = np.concatenate(
        [rng.uniform(-60, 60, (20, 9, 2)), rng.uniform(-3, 3, (20, 9, 1)), rng.uniform(0.5, 20, (20, 9, 2))], axis=-1
    )
    valid = rng.random((20, 9)) < 0.8
    found = nearest(boxes, valid, np.arange(9))
    radius = 0.35 * boxes[..., 3:].min(axis=-1)
    cores = boxes - np.stack([0.0 * radius] * 3 + [2.0 * radius] * 2, axis=-1)
    for step, i in np.argwhere(valid):
        others = np.flatnonzero(valid[step] & (np.arange(9) != i))
        each = box_distance(np.broadcast_to(cores[step, i], (len(others), 5)), cores[step, others])
        assert found[step, i] == pytest.approx((each - radius[step, others]).min() - radius[step, i])
    assert np.isnan(found[~valid]).all()


def test_values_that_keep_to_their_bin_are_as_likely_as_the_pseudocounts_leave_them() -> None:
    """Ten bins of 2.5 m/s: all of 41 values in one bin, the log in the same or in another."""
    speed = FEATURES["speed"]
    values = np.full((41, 2), 3.0)
    assert likelihood(speed, values, values) == pytest.approx(41.1 / 42.0)
    assert likelihood(speed, values, values + 5.0) == pytest.approx(0.1 / 42.0)
    assert likelihood(speed, values, np.full((41, 2), np.nan)) == pytest.approx(0.1)


def test_faults_are_what_the_log_does_not_do() -> None:
    """A car that stands 1 m behind another rolls 1.6 m; pairs that overlap in the log are no new ones."""
    scene = worlds.scene(worlds.straight_road(), Track(0.0), Track(5.6), Track(40.0), Track(42.0))
    logged = scene.agents.window(NOW, NOW + 41)
    nothing = faults_of(logged, logged, FAR_EGO)
    assert (nothing.overlaps, nothing.rolling, nothing.standing) == (0, 0, 4)
    boxes = logged.boxes.copy()
    boxes[20:, 0, 0] += 1.0 + 0.6
    found = faults_of(logged, replace(logged, boxes=boxes), FAR_EGO)
    assert DEEP_M < 0.6 and (found.overlaps, found.deep, found.with_ego, found.rolling) == (1, 1, 0, 1)
