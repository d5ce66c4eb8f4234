"""Box arithmetic agrees with polygon geometry."""

import numpy as np
import shapely

from tasks.world.frames import PACIFICA, box_corners, ego_boxes, touching


def test_separating_axes_agree_with_polygon_intersection():
    rng = np.random.default_rng(0)
    first, second = (
        np.concatenate(
            [rng.uniform(-4, 4, (20000, 2)), rng.uniform(-7, 7, (20000, 1)), rng.uniform(0.2, 5, (20000, 2))], axis=1
        )
        for _ in range(2)
    )
    verdict = shapely.intersects(shapely.polygons(box_corners(first)), shapely.polygons(box_corners(second)))
    assert 0.2 < verdict.mean() < 0.8
    assert np.array_equal(touching(first, second), verdict)


def test_boxes_that_share_an_edge_touch_and_absent_ones_do_not():
    one = np.array([0.0, 0.0, 0.0, 4.0, 2.0])
    assert touching(one, np.array([4.0, 0.0, 0.0, 4.0, 2.0]))
    assert not touching(one, np.array([4.0 + 1e-9, 0.0, 0.0, 4.0, 2.0]))
    assert not touching(one, np.full(5, np.nan))


def test_the_ego_body_reaches_from_rear_to_front_bumper():
    state = np.zeros(11)
    corners = box_corners(ego_boxes(state, PACIFICA))
    np.testing.assert_allclose(corners[:, 0], [4.049, -1.127, -1.127, 4.049])
    np.testing.assert_allclose(corners[:, 1], [1.1485, 1.1485, -1.1485, -1.1485])
