"""Which blocks are too poor to be drawn from, and what is said of them."""

from dataclasses import replace

import numpy as np
import pytest

from tasks.render.block_gate import poor_block
from tasks.render.scene.asset import RenderAsset, ViewQuality, camera_psnr_db, mean_psnr_db
from tasks.render.settings import PsnrOver, RenderSettings


def block(**psnr_db: tuple[float, ...]) -> RenderAsset:
    """A scene with held-out photos of these cameras; a photo that was learned from does not count."""
    views = tuple(
        ViewQuality(camera, 0.5 * k, value, 0.9, held_out=True)
        for camera, values in psnr_db.items()
        for k, value in enumerate(values)
    )
    learned = ViewQuality("front", 9.0, 5.0, 0.1, held_out=False)
    empty = RenderAsset(np.zeros(3), None, {}, None, mean_psnr_db(views), len(views))  # type: ignore[arg-type]
    return replace(empty, views=(*views, learned))


def test_the_worst_camera_decides_and_is_named_with_the_size_of_the_photos() -> None:
    asset = block(front=(31.0, 33.0), left=(26.0, 27.0), right=(25.0, 27.0))
    said = poor_block(asset, RenderSettings(width=480, height=270))
    assert said == (
        "right at 26.00 dB, below 27 like 2 of 3 cameras; block at 28.17 dB over 6 held-out photos at 480x270"
    )
    assert poor_block(asset, RenderSettings(psnr_min=26.0)) is None


def test_over_the_block_a_good_camera_makes_up_for_a_poor_one() -> None:
    asset, paper = block(front=(31.0, 33.0), left=(26.0, 27.0), right=(25.0, 27.0)), PsnrOver.BLOCK
    assert poor_block(asset, RenderSettings(psnr_over=paper)) is None
    said = poor_block(asset, RenderSettings(psnr_over=paper, psnr_min=29.0, width=1920, height=1080))
    assert said == "block at 28.17 dB over 6 held-out photos at 1920x1080, below 29"


@pytest.mark.parametrize("over", PsnrOver)
def test_a_block_without_held_out_photos_is_not_refused(over: PsnrOver) -> None:
    assert poor_block(block(), RenderSettings(psnr_over=over, psnr_min=60.0)) is None


@pytest.mark.parametrize("over", PsnrOver)
def test_a_block_whose_photos_were_not_measured_one_by_one_goes_by_its_mean(over: PsnrOver) -> None:
    asset = replace(block(front=(20.0, 22.0)), views=())
    said = poor_block(asset, RenderSettings(psnr_over=over, width=64, height=36))
    assert said == "block at 21.00 dB over 2 held-out photos at 64x36, below 27"


def test_a_camera_s_mean_is_over_its_held_out_photos_that_could_be_measured() -> None:
    asset = block(front=(30.0, float("nan"), 32.0), left=(float("nan"),))
    assert camera_psnr_db(asset) == {"front": 31.0}
