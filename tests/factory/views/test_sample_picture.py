"""Pictures of samples; sides are words: nobody has to know that y points left."""

from collections import Counter
from pathlib import Path

import numpy as np

from factory.store.reader import SampleTable, decode_stored_image
from factory.store.samples import Store
from factory.views import pictures
from factory.views.pictures import BACKGROUND, BEV_LEGEND, LANE_EDGE, encode_image, letterboxed, sample_sheet
from factory.views.rendered_again import ASIDE_M, _yaw_to_the_right
from factory.views.status import side_text, turn_text
from tasks.world.frames import to_local
from tests.factory.toy import ToyWork, executed, refs


def test_what_lies_on_the_left_of_a_car_that_drives_north_lies_west_and_is_called_left() -> None:
    north = np.array([0.0, 0.0, np.pi / 2.0])
    west, east = to_local(north, np.array([[-1.5, 10.0, np.pi / 2.0 + 0.1], [1.5, 10.0, np.pi / 2.0 - 0.1]]))
    assert (side_text(west[1]), turn_text(west[2])) == ("1.50 m to the left", "5.7 deg to the left")
    assert (side_text(east[1]), turn_text(east[2])) == ("1.50 m to the right", "5.7 deg to the right")


def test_views_stand_side_by_side_as_their_cameras_do() -> None:
    def looking(yaw_rad: float) -> dict[str, object]:
        """A camera whose axis z points `yaw_rad` to the left of ahead."""
        pose = np.eye(4)
        pose[:3, 2] = np.cos(yaw_rad), np.sin(yaw_rad), 0.0
        return {"name": yaw_rad, "ego_from_camera": pose.ravel().tolist()}

    rig = [looking(yaw) for yaw in (0.0, 0.9, -0.9)]
    assert [camera["name"] for camera in sorted(rig, key=_yaw_to_the_right)] == [0.9, 0.0, -0.9]
    assert list(ASIDE_M) == sorted(ASIDE_M, reverse=True), "y points left"


def test_a_picture_keeps_its_aspect_and_survives_coding() -> None:
    wide = np.full((100, 400, 3), (200, 40, 90), np.uint8)
    tile = letterboxed(wide, 200, 100)
    assert tile.shape == (100, 200, 3)
    assert (tile[30:70] == wide[0, 0]).all() and not (tile[:20] == wide[0, 0]).all()
    back = decode_stored_image({"jpeg": encode_image(wide), "camera": "front", "time_s": 0.0})
    assert np.abs(back.astype(int) - wide).max() <= 4


def test_every_colour_that_is_drawn_from_above_has_a_legend() -> None:
    here, square = np.zeros(3), 6.0 * np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    shapes = pictures.MapShapes(*([square + np.array([20.0, 8.0 * i])] for i in range(-2, 3)))
    kinds = [*pictures.AGENT_COLOURS, "cone"]
    boxes = pictures.Boxes(np.array([[-10.0, 8.0 * i, 0.0, 4.0, 4.0] for i in range(len(kinds))]), kinds)
    colours = (pictures.LOGGED, pictures.PERTURBED, pictures.EXPERT)
    paths = [pictures.DrawnPath(square[:2] + 9.0 * i, c, "", width_px=20) for i, c in enumerate(colours)]
    pixels = pictures.draw_bev(here, shapes, boxes, here, paths).reshape(-1, 3).tolist()
    drawn = {colour for colour, n in Counter(map(tuple, pixels)).items() if n > 400}  # fewer: where edges blend
    assert drawn == {*BEV_LEGEND.values(), BACKGROUND} - {LANE_EDGE}, "its lines of one pixel are all edges"


def test_a_sample_s_sheet_holds_the_world_and_its_cameras(tmp_path: Path) -> None:
    executed(ToyWork(), refs(1), ["human"], 1, Store(tmp_path))
    sample = SampleTable(tmp_path)[0]
    assert sample_sheet(sample)[:720, :720].std() > 0
    assert sample_sheet({**sample, "images": None}).shape == (720, 720 + 400, 3)
