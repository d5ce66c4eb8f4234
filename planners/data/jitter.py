"""Real samples from beside the log, without a simulator: the ego shifted and turned, the log's own label bent back.

What every planner of the kind is taught with before anybody simulates (Bojarski et al. 2016, "End to end learning for
self-driving cars", of pictures; Bansal et al. 2018, "ChauffeurNet", of maps), and so what simulated samples have to
beat. Who stands around, and what they do, stays as logged; no drive is checked.
"""

import hashlib
from dataclasses import dataclass

import numpy as np

from planners.data.batch import Needs
from tasks.world.arrays import Array


@dataclass(frozen=True)
class JitterSettings:
    """Real samples seen from beside the log."""

    share: float = 0.0  # of the real samples, drawn anew in every pass; 0: none
    lateral_m: float = 1.0  # the ego is shifted by at most, to either side
    heading_rad: float = 0.15  # and turned by at most
    back_m: float = 20.0  # along the log after which the label is the log again

    def __post_init__(self) -> None:
        turns = 0.0 <= self.heading_rad < np.pi / 2.0
        if not (0.0 <= self.share <= 1.0 and self.lateral_m >= 0.0 and turns and self.back_m > 0.0):
            raise ValueError(f"{self}: share from 0 to 1, shift and turn from 0, below a right angle, way back above 0")


@dataclass(frozen=True)
class Offset:
    """Where the ego is put, in its own frame at now."""

    lateral_m: float  # to the left
    heading_rad: float  # to the left
    back_m: float

    def seen(self, points: Array) -> Array:
        """(n, 2) points or (..., 2+) of the ego's frame in that of the ego where it is put; what follows x, y stays."""
        cos, sin = np.cos(self.heading_rad), np.sin(self.heading_rad)
        turn = np.array([[cos, -sin], [sin, cos]])  # of row vectors: by -heading
        there = np.array(points, np.float64)
        there[..., :2] = (there[..., :2] - [0.0, self.lateral_m]) @ turn
        return there

    def seen_poses(self, poses: Array) -> Array:
        """(..., 3+) x, y, heading, and whatever follows."""
        there = self.seen(poses)
        turned = there[..., 2] - self.heading_rad
        there[..., 2] = (turned + np.pi) % (2.0 * np.pi) - np.pi
        return there

    def bent_back(self, label: Array) -> Array:
        """(n, 3) the label from where the ego is put, in its frame there.

        Beside the log's way at arc length d by the cubic that begins with the shift and the turn and ends with none of
        both after `back_m`: as fast as the log, and an ego that stands stays.
        """
        ahead = np.vstack([[0.0, 0.0], np.asarray(label, np.float64)[:, :2]])
        s = np.minimum(np.linalg.norm(np.diff(ahead, axis=0), axis=1).cumsum() / self.back_m, 1.0)
        slope = np.tan(self.heading_rad) * self.back_m
        aside = self.lateral_m * (1 - 3 * s**2 + 2 * s**3) + slope * (s - 2 * s**2 + s**3)
        turned = (self.lateral_m * (6 * s**2 - 6 * s) + slope * (1 - 4 * s + 3 * s**2)) / self.back_m
        bent = np.array(label, np.float64)
        bent[:, :2] += aside[:, None] * np.stack([-np.sin(bent[:, 2]), np.cos(bent[:, 2])], axis=-1)
        bent[:, 2] += np.arctan(turned)
        return self.seen_poses(bent)


def draw_offset(settings: JitterSettings, seed: int, epoch: int, attempt_id: str) -> Offset | None:
    """Of one sample in one pass, by nothing else; None: it stays where it is."""
    if settings.share == 0.0:
        return None
    key = hashlib.sha256(f"{seed}\x1f{epoch}\x1f{attempt_id}".encode()).digest()
    rng = np.random.default_rng(int.from_bytes(key[:8], "little"))
    if rng.random() >= settings.share:
        return None
    lateral_m, heading_rad = rng.uniform(-1.0, 1.0, 2) * [settings.lateral_m, settings.heading_rad]
    return Offset(float(lateral_m), float(heading_rad), settings.back_m)


def check_jitter(settings: JitterSettings, needs: Needs) -> None:
    """Raises ValueError for a planner that sees or learns what a shift makes wrong."""
    what = "sees pictures" if needs.image is not None else "learns scores of a vocabulary" if needs.labels else ""
    if settings.share and what:
        raise ValueError(
            f"mix.jitter.share={settings.share}: the planner {what}, which are of the log's own pose: give 0, or a "
            "planner that sees the map, such as ego_mlp_bev"
        )
