"""The gate for blocks: what a block's held-out photos must come out with, at the size that pictures are stored in.

PSNR depends on that size: fine texture, which no scene has in full, is averaged away in small pictures.
"""

from tasks.render.scene.asset import RenderAsset, camera_psnr_db
from tasks.render.settings import RenderSettings


def poor_block(asset: RenderAsset, settings: RenderSettings) -> str | None:
    """In what a block does not come up to `psnr_min` and, camera by camera, `camera_psnr_min`.

    None where it does, where nothing was held out, and where `psnr_min` is 0: then any block will do.
    """
    if settings.psnr_min == 0.0:
        return None
    photos = f"{asset.n_held_out} held-out photos at {settings.width}x{settings.height}"
    if asset.psnr_db < settings.psnr_min:
        return f"block at {asset.psnr_db:.2f} dB over {photos}, below {settings.psnr_min:g}"
    cameras = camera_psnr_db(asset)
    below = sorted((value, name) for name, value in cameras.items() if value < settings.camera_psnr_min)
    if below:
        value, name = below[0]
        like = f"{settings.camera_psnr_min:g} like {len(below)} of {len(cameras)} cameras"
        return f"{name} at {value:.2f} dB, below {like}; block at {asset.psnr_db:.2f} dB over {photos}"
    return None
