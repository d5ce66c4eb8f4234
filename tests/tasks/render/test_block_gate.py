"""Which blocks are too poor to be drawn from, and what is said of them."""

from dataclasses import replace

import numpy as np

from tasks.render.gate import block_fault
from tasks.render.scene.asset import RenderAsset, ViewQuality, camera_psnr_db, mean_psnr_db
from tasks.render.settings import RenderSettings


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


def test_a_camera_below_its_bound_is_named_with_the_size_of_the_photos() -> None:
    asset = block(front=(38.0, 40.0), left=(19.0, 21.0), right=(17.0, 20.0), rear=(22.0, 22.0))
    assert block_fault(asset, RenderSettings(psnr_min=24.0, width=480, height=270, camera_psnr_min=21.0)) == (
        "right at 18.50 dB, below 21 like 2 of 4 cameras; block at 24.88 dB over 8 held-out photos at 480x270"
    )
    assert block_fault(asset, RenderSettings(psnr_min=24.0, camera_psnr_min=18.5)) is None
    assert block_fault(asset, RenderSettings(psnr_min=24.0, camera_psnr_min=0.0)) is None


def test_the_mean_over_the_block_is_held_against_its_own_bound() -> None:
    asset = block(front=(31.0, 33.0), left=(26.0, 27.0), right=(25.0, 27.0))
    assert block_fault(asset, RenderSettings()) is None
    said = block_fault(asset, RenderSettings(psnr_min=29.0, width=1920, height=1080))
    assert said == "block at 28.17 dB over 6 held-out photos at 1920x1080, below 29"


def test_at_0_any_block_will_do() -> None:
    assert block_fault(block(front=(5.0, 6.0)), RenderSettings(psnr_min=0.0)) is None


def test_a_block_without_held_out_photos_is_not_refused() -> None:
    assert block_fault(block(), RenderSettings(psnr_min=60.0, camera_psnr_min=60.0)) is None


def test_a_camera_s_mean_is_over_its_held_out_photos_that_could_be_measured() -> None:
    asset = block(front=(30.0, float("nan"), 32.0), left=(float("nan"),))
    assert camera_psnr_db(asset) == {"front": 31.0}
