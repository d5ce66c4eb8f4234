"""The gate for blocks: what a block's held-out photos must come out with, at the size that pictures are stored in.

PSNR depends on that size: fine texture, which no scene has in full, is averaged away in small pictures.
"""

from tasks.render.scene.asset import RenderAsset, camera_psnr_db
from tasks.render.settings import PsnrOver, RenderSettings


def poor_block(asset: RenderAsset, settings: RenderSettings) -> str | None:
    """In what a block does not come up to `psnr_min`; None where it does, or where nothing was held out."""
    least, whole = settings.psnr_min, f"block at {asset.psnr_db:.2f} dB"
    photos = f"{asset.n_held_out} held-out photos at {settings.width}x{settings.height}"
    if settings.psnr_over is PsnrOver.CAMERA:
        found = camera_psnr_db(asset)
        below = sorted((value, camera) for camera, value in found.items() if value < least)
        if below:
            value, camera = below[0]
            poor = f"{camera} at {value:.2f} dB, below {least:g} like {len(below)} of {len(found)} cameras"
            return f"{poor}; {whole} over {photos}"
    return f"{whole} over {photos}, below {least:g}" if asset.psnr_db < least else None
