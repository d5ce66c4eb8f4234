"""The stitched picture: which cameras, which parts of them, where."""

import io

import cv2
import numpy as np
import pytest
from PIL import Image

from planners.data.batch import ImageLayout
from planners.data.images import chosen_cameras, stitch, stitch_sample
from tests.planners.samples import FRONT_YAWS, Pixels, grey_pictures, jpeg, pictures, plain

PUBLIC = ImageLayout(width=512, height=128)
NEAR = 6  # of 255, by JPEG


def axes(*degrees: float) -> np.ndarray:
    angles = np.deg2rad(degrees)
    return np.stack([np.cos(angles), np.sin(angles)], axis=1)


@pytest.mark.parametrize(
    ("rig", "chosen"),
    [
        ({"f": 0, "l": 55, "r": -55, "bl": 110, "br": -110, "b": 180}, ("l", "f", "r")),
        ({"r": -45, "l": 45, "sl": 90, "f": 3, "sr": -89}, ("l", "f", "r")),
        ({"f": 1, "stereo_left": 0, "stereo_right": 0, "l": 50, "r": -50}, ("l", "f", "r")),
        ({"image_02": 0, "image_03": 0}, ("image_02",)),
        ({"f": 0, "r": -60, "b": 180}, ("f", "r")),
        ({"l": 30, "r": -32}, ("l", "r")),
    ],
)
def test_the_front_camera_and_its_neighbours_are_found_by_yaw(rig: dict[str, float], chosen: tuple[str, ...]) -> None:
    assert chosen_cameras(list(rig), axes(*rig.values()), ImageLayout()) == chosen


def test_cameras_can_be_named_and_are_refused_by_name() -> None:
    names = ["a", "b"]
    assert chosen_cameras(names, axes(0, 90), ImageLayout(cameras=("b", "a"))) == ("b", "a")
    with pytest.raises(ValueError, match=r"no camera c .*there are \['a', 'b'\]"):
        chosen_cameras(names, axes(0, 90), ImageLayout(cameras=("a", "c")))
    with pytest.raises(ValueError, match="no camera looks ahead"):
        chosen_cameras(names, axes(180, 100), ImageLayout())
    with pytest.raises(ValueError, match="no camera looks ahead"):
        chosen_cameras([], np.zeros((0, 2)), ImageLayout())


def striped(n: int, stripe: int) -> Pixels:
    """1920 x 1080, black but for one white stripe of 1/n of the width."""
    picture = plain((0, 0, 0), 1920, 1080)
    width = 1920 // n
    picture[:, stripe * width : (stripe + 1) * width] = 255
    return picture


def test_the_public_cuts_put_every_column_where_it_belongs() -> None:
    """4096 x 1024 of three 1920 x 1080: at an eighth, the left camera's columns 416 .. 1504 are 0 .. 136, and so on."""
    views = {"left": striped(30, 10), "front": striped(30, 0), "right": striped(30, 22)}
    picture = stitch_sample(pictures({name: jpeg(view) for name, view in views.items()}), PUBLIC)
    assert picture.shape == (128, 512, 3)
    white = np.flatnonzero(picture.min(axis=(0, 2)) > 250 - NEAR)
    expected = [
        *range((640 - 416) // 8, (704 - 416) // 8),  # columns 640 .. 704 of the left camera
        *range(136, 136 + 64 // 8),  # the front camera is whole: its first 64
        *range(136 + 240 + (1408 - 416) // 8, 136 + 240 + (1472 - 416) // 8),  # 1408 .. 1472 of the right
    ]
    assert white.tolist() == expected


def test_rows_are_cut_above_and_below() -> None:
    view = plain((0, 0, 0), 1920, 1080)
    view[:28], view[-28:] = 255, 255  # all of it, and nothing more, is cut
    view[28:32] = (200, 0, 0)
    picture = stitch_sample(pictures(dict.fromkeys(FRONT_YAWS, jpeg(view))), ImageLayout(width=1024, height=256))
    assert abs(picture[0].astype(int) - (200, 0, 0)).max() <= 8 * NEAR, "the first row shows the first four left"
    assert picture[2:].max() <= 2 * NEAR


@pytest.mark.parametrize("cameras", [("front",), ("left", "front"), ("right", "front", "left")])
def test_any_number_of_cameras_in_any_order(cameras: tuple[str, ...]) -> None:
    colours = {"left": (200, 40, 40), "front": (40, 200, 40), "right": (40, 40, 200)}
    sample = pictures({name: jpeg(plain(colour, 96, 54)) for name, colour in colours.items()})
    picture = stitch_sample(sample, ImageLayout(cameras=cameras, width=120, height=32))
    parts = np.split(
        picture, np.flatnonzero((np.abs(np.diff(picture[16].astype(int), axis=0)) > 60).any(axis=1)) + 1, 1
    )
    assert len(parts) == len(cameras)
    for name, part in zip(cameras, parts):
        assert abs(part.astype(int) - colours[name]).max() <= NEAR


def test_cameras_of_other_sizes_are_brought_to_one_height() -> None:
    """A portrait front camera between two landscape ones keeps its shape: 3:4 beside 4:3, uncut."""
    sizes = {"left": (160, 120), "front": (120, 160), "right": (160, 120)}
    colours = {"left": (200, 0, 0), "front": (0, 200, 0), "right": (0, 0, 200)}
    sample = pictures({name: jpeg(plain(colours[name], *sizes[name])) for name in sizes})
    picture = stitch_sample(sample, ImageLayout(width=410, height=120, rows_cut=0.0, sides_cut=0.0))
    assert [int((picture[60].argmax(axis=1) == i).sum()) for i in range(3)] == [160, 90, 160]


def seen(seed: int, width: int = 1920, height: int = 1080) -> Pixels:
    """Shapes and edges at all scales, none of which repeats."""
    rng = np.random.default_rng(seed)
    scales = [rng.integers(0, 86, (height // n, width // n, 3), dtype=np.uint8) for n in (4, 20, 120)]
    return np.sum([cv2.resize(scale, (width, height)) for scale in scales], axis=0).clip(0, 255).astype(np.uint8)


def test_decoded_in_full_the_picture_is_the_public_code_s_to_the_bit() -> None:
    """Opened with Pillow, cut, joined and resized as TransfuserFeatureBuilder does with three 1920 x 1080 pictures."""
    views = [jpeg(seen(i)) for i in range(3)]
    left, front, right = (np.asarray(Image.open(io.BytesIO(view))) for view in views)
    joined = np.concatenate([left[28:-28, 416:-416], front[28:-28], right[28:-28, 416:-416]], axis=1)
    public = cv2.resize(joined, (2048, 512))
    full, reduced = (np.empty((512, 2048, 3), np.uint8) for _ in range(2))
    stitch([np.frombuffer(view, np.uint8) for view in views], ImageLayout(decoding="full"), full)
    assert (full == public).all()
    stitch([np.frombuffer(view, np.uint8) for view in views], ImageLayout(), reduced)
    off = np.abs(reduced.astype(int) - public).mean()
    assert 0.0 < off < 3.0, "colours of single pixels, half of which JPEG leaves out"


def test_pixels_are_those_of_opencv_at_every_fraction() -> None:
    data = np.frombuffer(jpeg(seen(1, 320, 192)), np.uint8)
    by = {2: cv2.IMREAD_REDUCED_COLOR_2, 4: cv2.IMREAD_REDUCED_COLOR_4, 8: cv2.IMREAD_REDUCED_COLOR_8}
    for factor, flag in {1: cv2.IMREAD_COLOR, **by}.items():
        picture = np.empty((192 // factor, 320 // factor, 3), np.uint8)
        stitch([data], ImageLayout(width=320 // factor, height=192 // factor, rows_cut=0.0), picture)
        assert (picture == cv2.imdecode(data, flag)[..., ::-1]).all(), factor


def test_a_small_picture_is_enlarged_and_a_huge_one_averaged() -> None:
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 2, (512, 1024, 1), dtype=np.uint8).repeat(3, axis=2) * 255
    layout = ImageLayout(width=16, height=8, rows_cut=0.0)
    picture = np.empty((8, 16, 3), np.uint8)
    stitch([np.frombuffer(jpeg(noise), np.uint8)], layout, picture)
    assert abs(picture.astype(float) - 127.5).max() < 20, "4,096 pixels each: 5 sd of their mean are 10"
    stitch([np.frombuffer(jpeg(plain((9, 90, 190), 4, 2)), np.uint8)], layout, picture)
    assert abs(picture.astype(int) - (9, 90, 190)).max() <= NEAR


def test_what_cannot_be_stitched_says_why() -> None:
    sample = grey_pictures(100)
    with pytest.raises(ValueError, match=r"no image of camera left at now; there are \['front', 'right'\]"):
        stitch_sample(sample | {"images": [i for i in sample["images"] if i["camera"] != "left"]}, PUBLIC)
    with pytest.raises(ValueError, match="not a JPEG"):
        stitch_sample(sample | {"images": [image | {"jpeg": b"picture"} for image in sample["images"]]}, PUBLIC)
    headless = [image | {"jpeg": image["jpeg"][:200]} for image in sample["images"]]
    with pytest.raises(ValueError, match="not a JPEG"):
        stitch_sample(sample | {"images": headless}, PUBLIC)
    whole = jpeg(seen(0, 320, 192))
    with pytest.raises(ValueError, match="not a JPEG that can be decoded: Premature end"):
        stitch_sample(pictures(dict.fromkeys(FRONT_YAWS, whole[: len(whole) // 2])), PUBLIC)
    with pytest.raises(ValueError, match="leave nothing of an image of 32 x 18"):
        stitch_sample(sample, ImageLayout(sides_cut=0.5))
