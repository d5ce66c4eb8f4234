"""Whether a rig's calibration is corrected before its photos are used, and how far it and the poses are believed."""

from dataclasses import dataclass
from enum import StrEnum


class Adjust(StrEnum):
    AUTO = "auto"  # blocks without lidar, whose depth hangs on the calibration alone
    ON = "on"
    OFF = "off"


@dataclass(frozen=True)
class RigSettings:
    """Sigmas are what calibration and poses are expected to be off by; 0 holds a quantity fixed."""

    adjust: Adjust = Adjust.AUTO
    width: int = 960  # pixels of the photos that corners are looked for in, where they are larger
    corners: int = 4000  # a photo, at most
    partners: int = 3  # photos of each camera that a photo is matched with
    turn_deg: float = 1.0  # of a camera on the ego
    shift_m: float = 0.1
    focal: float = 0.01  # share of the focal lengths
    centre: float = 0.01  # of the principal point, as a share of the width
    lens: float = 0.02  # of k1, k2, k3; of p1, p2 a tenth
    stamp_s: float = 0.05  # of a camera's stamps against the ego's, where photos can tell
    pose_turn_deg: float = 0.5  # of the ego, root mean square over the drive
    pose_shift_m: float = 0.2

    def __post_init__(self) -> None:
        for name, least in (("width", 64), ("corners", 100), ("partners", 1)):
            if getattr(self, name) < least:
                raise ValueError(f"rig {name} must be {least} or more, not {getattr(self, name)}")
        sigmas = ("turn_deg", "shift_m", "focal", "centre", "lens", "stamp_s", "pose_turn_deg", "pose_shift_m")
        for name in sigmas:
            if not 0.0 <= getattr(self, name) < float("inf"):
                raise ValueError(f"rig {name} must be 0 or more, not {getattr(self, name)}")

    def may_correct(self, photos_alone: bool) -> bool:
        """Whether a run may have a rig to correct; photos_alone: its clips may have photos and no lidar."""
        return self.adjust is Adjust.ON or (self.adjust is Adjust.AUTO and photos_alone)
