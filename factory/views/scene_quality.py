"""How well scenes show photos they were not made of, camera by camera: for `factory scene` and the report."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from factory.stages.scene_file import SUFFIX, BadScene, stored_views
from tasks.render.scene.asset import ViewQuality

MEANS = ("psnr_db", "ssim", "lpips", "away_m")  # of views


@dataclass(frozen=True)
class CameraRow:
    """Means over a camera's photos that were held out; NaN where something was not measured."""

    camera: str
    photos: int
    psnr_db: float
    ssim: float
    lpips: float
    away_m: float  # from the nearest photo that the scene was made of
    psnr_db_of: Mapping[str, float]  # by class: road, vehicles, rest

    @property
    def text(self) -> str:
        """In one line; what was not measured is left out."""
        said = [f"{self.psnr_db:.2f} dB", f"SSIM {self.ssim:.3f}", f"LPIPS {self.lpips:.3f}"]
        numbers = (self.psnr_db, self.ssim, self.lpips)
        found = ", ".join(text for text, number in zip(said, numbers, strict=True) if not math.isnan(number))
        away = "" if math.isnan(self.away_m) else f", {self.away_m:.1f} m from the nearest photo used"
        classes = ", ".join(f"{name} {value:.2f} dB" for name, value in self.psnr_db_of.items())
        return f"{found} over {self.photos} held-out photos{away}" + (f" ({classes})" if classes else "")


def camera_rows(views: Sequence[ViewQuality]) -> list[CameraRow]:
    """A row a camera, in the order of the views."""
    rows = []
    for camera in dict.fromkeys(view.camera for view in views if view.held_out):
        mine = [view for view in views if view.held_out and view.camera == camera]
        classes: dict[str, list[float]] = {}
        for part in (part for view in mine for part in view.classes):
            classes.setdefault(part.name, []).append(part.psnr_db)
        means = {name: _mean([getattr(view, name) for view in mine]) for name in MEANS}
        of = {name: _mean(values) for name, values in classes.items()}
        rows.append(CameraRow(camera=camera, photos=len(mine), psnr_db_of=of, **means))
    return rows


def scene_tables(folder: Path) -> dict[str, dict[str, str]]:
    """Scene file -> camera -> its row in words, of the scenes in a cache folder; what is no scene is left out."""
    found = {}
    for path in sorted(folder.glob(f"block-*{SUFFIX}")):
        try:
            found[path.name] = {row.camera: row.text for row in camera_rows(stored_views(path))}
        except BadScene:
            continue  # whoever needs that scene says so, and builds it again
    return found


def _mean(values: Sequence[float]) -> float:
    known = [value for value in values if not math.isnan(value)]
    return sum(known) / len(known) if known else math.nan
