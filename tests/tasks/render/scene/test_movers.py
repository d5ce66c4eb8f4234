"""Which sight lines meet a box, as many points along each say it; and boxes where photos say that they were."""

import numpy as np
import pytest
import street

from tasks.render.scene.movers import BEYOND_M, KNOT_S, BoxShifts, behind_boxes, boxes_at, shift_boxes

SAMPLES = 2000  # along a line


def meets(points: np.ndarray, eye: np.ndarray, boxes: np.ndarray, slack_m: float) -> np.ndarray:
    """Whether a point of the line from the eye to BEYOND_M behind its end lies in a box grown by BEYOND_M + slack."""
    lines = points - eye
    ends = 1.0 + (BEYOND_M + slack_m) / np.linalg.norm(lines, axis=1)
    shares = np.linspace(0.0, 1.0, SAMPLES)[:, None] * ends
    along = eye + shares[..., None] * lines  # (SAMPLES, M, 3)
    met = np.zeros(len(points), bool)
    for box in boxes:
        c, s = np.cos(box[3]), np.sin(box[3])
        local = (along - box[:3]) @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        met |= (np.abs(local) <= 0.5 * box[4:] + BEYOND_M + slack_m).all(axis=-1).any(axis=0)
    return met


@pytest.mark.slow
def test_a_line_meets_a_box_where_one_of_its_points_lies_in_it() -> None:
    rng = np.random.default_rng(0)
    eye = np.array([1.0, -2.0, 1.5])
    points = eye + rng.normal(size=(250, 3)) * [20.0, 20.0, 4.0]
    place, heading, size = (
        rng.normal(size=(12, 3)) * [15.0, 15.0, 2.0],
        rng.uniform(-np.pi, np.pi, (12, 1)),
        rng.uniform(0.5, 8.0, (12, 3)),
    )
    boxes = np.hstack([place, heading, size])
    found = np.asarray(behind_boxes(points, eye, boxes))
    surely, perhaps = meets(points, eye, boxes, -0.03), meets(points, eye, boxes, 0.03)
    assert 40 < surely.sum() < 210
    assert found[surely].all()
    assert not found[~perhaps].any()
    assert (perhaps & ~surely).sum() < 25, "nearly every line is decided"


def test_an_eye_inside_a_box_sees_nothing_else() -> None:
    points = np.random.default_rng(1).normal(size=(50, 3)) * 10.0
    box = np.array([[0.0, 0.0, 0.0, 0.3, 4.0, 2.0, 2.0]])
    assert np.asarray(behind_boxes(points, np.zeros(3), box)).all()


def test_without_boxes_every_line_is_free() -> None:
    assert not np.asarray(behind_boxes(np.ones((3, 3)), np.zeros(3), np.zeros((0, 7)))).any()


def test_a_box_is_turned_and_then_moved_along_its_new_heading() -> None:
    box = np.array([[10.0, 5.0, 1.0, 0.0, 4.0, 2.0, 1.5]])
    found = shift_boxes(box, np.array([[2.0, 0.5, 0.25, np.pi / 2]]))
    np.testing.assert_allclose(found, [[9.5, 7.0, 1.25, np.pi / 2, 4.0, 2.0, 1.5]], atol=1e-12)


def test_tracks_come_to_lie_where_photos_say_linear_between_knots_and_others_stay() -> None:
    """The block's third knot is at 1 s; the tracks begin 0.7 s behind the block."""
    tracks = street.tracks()
    rows = np.zeros((1, 4, 4), np.float32)
    rows[0, 2] = [0.4, -0.2, 0.1, 0.0]
    settled = BoxShifts(("car",), rows).settled(tracks, 0.7)
    assert KNOT_S == 0.5
    for step, share in ((0, 0.4), (3, 1.0), (5, 0.6), (8, 0.0), (40, 0.0)):
        off = boxes_at(settled, 0.1 * step)[0] - boxes_at(tracks, 0.1 * step)[0]
        np.testing.assert_allclose(off[0, :4], share * np.array([0.4, -0.2, 0.1, 0.0]), atol=1e-6, err_msg=str(step))
    assert BoxShifts(("other",), rows).settled(tracks, 0.0).boxes.tolist() == tracks.boxes.tolist()
