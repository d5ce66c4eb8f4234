"""What an export is asked for."""

from dataclasses import dataclass
from typing import Literal

Layout = Literal["moved", "released"]
Missing = Literal["refuse", "black", "none"]

MAP_LOCATIONS = ("sg-one-north", "us-ma-boston", "us-nv-las-vegas-strip", "us-pa-pittsburgh-hazelwood")
PUBLIC_SIZE = (1920, 1080)  # pixels; the released agents cut their pictures as if they were this large


class CannotExport(ValueError):
    """A sample, or all of them, cannot be written as asked; the message says which, why and what would help."""


@dataclass(frozen=True)
class ExportSettings:
    """What is written of which samples; two exports into one folder have the same."""

    experts: tuple[str, ...] = ()  # of whom; none: all
    rounds: tuple[int, ...] = ()  # which; none: all
    splits: tuple[str, ...] = ()  # train, val, test; none: all
    tag: str = ""  # behind an expert's name, so that a split of ours stands beside the released one
    layout: Layout = "moved"  # as after SimScale's tools/move.sh, or as its archives unpack
    resize: bool = False  # pictures of other sizes, to PUBLIC_SIZE
    missing: Missing = "refuse"  # pictures of eight cameras and four instants that a sample has not
    map_location: str = ""  # of all samples; empty: what their maps say

    def __post_init__(self) -> None:
        if self.tag and not (self.tag.isascii() and self.tag.replace("_", "").isalnum()):
            raise ValueError(f"tag={self.tag}: letters, digits and _ alone, as it becomes part of names")
        if self.map_location and self.map_location not in MAP_LOCATIONS:
            raise ValueError(
                f"map_location={self.map_location}: the public code knows {', '.join(MAP_LOCATIONS)} "
                "(navsim/common/dataclasses.py:441)"
            )
