"""Which cameras of a block are too poor to be drawn, which blocks are refused, and what is said of them."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tasks.render.gate import judge_block
from tasks.render.scene.asset import RenderAsset, ViewQuality, camera_psnr_db, mean_psnr_db
from tasks.render.settings import RenderSettings
from tasks.world.clip import Camera

YAWS_DEG = {"front": 0.0, "left": 60.0, "right": -60.0, "rear": 180.0}
SETTINGS = RenderSettings(psnr_min=24.0, camera_psnr_min=20.0, width=480, height=270)


def camera(name: str) -> Camera:
    mount = np.eye(4)
    mount[:3, :3] = Rotation.from_euler("z", YAWS_DEG[name], degrees=True).as_matrix() @ np.array(
        [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]
    )
    return Camera(name, 480, 270, np.diag([300.0, 300.0, 1.0]), np.zeros(5), mount)


def block(**psnr_db: tuple[float, ...]) -> RenderAsset:
    """A scene with held-out photos of these cameras; a photo that was learned from does not count."""
    views = tuple(
        ViewQuality(name, 0.5 * k, value, 0.9, held_out=True)
        for name, values in psnr_db.items()
        for k, value in enumerate(values)
    )
    learned = ViewQuality("front", 9.0, 5.0, 0.1, held_out=False)
    empty = RenderAsset(np.zeros(3), None, {}, None, mean_psnr_db(views), len(views))  # type: ignore[arg-type]
    return replace(empty, views=(*views, learned))


GOOD_FRONT = {"front": (28.0, 30.0), "left": (19.0, 19.6), "right": (24.0, 25.0), "rear": (23.0, 25.0)}
POOR_FRONT = {"front": (17.0, 20.0), "left": (31.0, 33.0), "right": (19.0, 19.0)}


@pytest.mark.parametrize(
    ("psnr_db", "settings", "left_out", "fault"),
    [
        (GOOD_FRONT, {}, {"left": "19.30 dB, below 20"}, None),
        (GOOD_FRONT, {"camera_psnr_min": 19.0}, {}, None),
        (GOOD_FRONT, {"cameras": ("front", "right")}, {}, None),
        (
            GOOD_FRONT,
            {"cameras": ("front", "left")},
            {"left": "19.30 dB, below 20"},
            "left at 19.30 dB, below 20 like 1 of 2 cameras; 8 held-out photos at 480x270",
        ),
        (
            GOOD_FRONT,
            {"psnr_min": 27.0},
            {"left": "19.30 dB, below 20"},
            "block at 25.83 dB over 6 held-out photos of 3 of 4 cameras at 480x270, below 27",
        ),
        (
            POOR_FRONT,
            {},
            {"front": "18.50 dB, below 20", "right": "19.00 dB, below 20"},
            "front at 18.50 dB, below 20 like 2 of 3 cameras; 6 held-out photos at 480x270",
        ),
        (
            POOR_FRONT,
            {"cameras": ("right", "front")},
            {"right": "19.00 dB, below 20", "front": "18.50 dB, below 20"},
            "front at 18.50 dB, below 20 like 2 of 2 cameras; 6 held-out photos at 480x270",
        ),
        (POOR_FRONT, {"camera_psnr_min": 0.0, "psnr_min": 23.0}, {}, None),
        (
            POOR_FRONT,
            {"camera_psnr_min": 0.0, "psnr_min": 27.0},
            {},
            "block at 23.17 dB over 6 held-out photos at 480x270, below 27",
        ),
        (
            {"left": (19.0,), "rear": (18.0,)},
            {},
            {"left": "19.00 dB, below 20", "rear": "18.00 dB, below 20"},
            "left at 19.00 dB, below 20 like 2 of 2 cameras; 2 held-out photos at 480x270",
        ),
        (POOR_FRONT, {"psnr_min": 0.0}, {}, None),
    ],
)
def test_a_poor_camera_is_left_out_and_what_planners_need_is_not_drawn_without_it(
    psnr_db: dict[str, tuple[float, ...]], settings: dict[str, object], left_out: dict[str, str], fault: str | None
) -> None:
    chosen = replace(SETTINGS, **settings)  # type: ignore[arg-type]
    found = judge_block(block(**psnr_db), [camera(name) for name in chosen.cameras or psnr_db], chosen)
    assert (found.left_out, found.fault) == (left_out, fault)
    if fault is None and left_out:
        assert found.psnr_db == pytest.approx(25.8333, abs=1e-4)


def test_a_block_without_held_out_photos_is_not_refused() -> None:
    bounds = RenderSettings(psnr_min=60.0, camera_psnr_min=60.0)
    assert judge_block(block(), [camera("front")], bounds).fault is None


def test_a_camera_s_mean_is_over_its_held_out_photos_that_could_be_measured() -> None:
    asset = block(front=(30.0, float("nan"), 32.0), left=(float("nan"),))
    assert camera_psnr_db(asset) == {"front": 31.0}
