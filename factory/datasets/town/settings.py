"""What the sensors of the synthetic town record, and which of its clips are taken."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from factory.readers.settings import ReaderSettings, Split, check_traversals
from tasks.settings import constant

LOG_STEPS = 116  # annotated frames of a log, 11.5 s
STEPS_PER_SWEEP = 5  # 2 Hz
MOUNTS = {  # name: yaw [deg], x, y, z in the ego frame [m]; names as in AV2, but for the eighth
    "ring_front_center": (0.0, 1.62, 0.0, 1.32),
    "ring_front_left": (50.0, 1.52, 0.35, 1.32),
    "ring_front_right": (-50.0, 1.52, -0.35, 1.32),
    "ring_side_left": (100.0, 1.20, 0.45, 1.32),
    "ring_side_right": (-100.0, 1.20, -0.45, 1.32),
    "ring_rear_left": (150.0, 0.80, 0.35, 1.32),
    "ring_rear_right": (-150.0, 0.80, -0.35, 1.32),
    "ring_rear_center": (180.0, 0.70, 0.0, 1.32),
}
CAMERA_NAMES = tuple(MOUNTS)
LOGS_PER_TOWN = 18  # one of each kind of drive; then another town of the same plan, with other lengths, bends, houses


def check_cameras(names: Sequence[str]) -> None:
    """Raises ValueError for a name that the rig has not."""
    unknown = [name for name in names if name not in MOUNTS]
    if unknown:
        raise ValueError(f"unknown cameras {unknown}; known: {', '.join(CAMERA_NAMES)}")


@dataclass(frozen=True)
class TownSettings:
    """What the sensors of the synthetic ego record."""

    cameras: tuple[str, ...] = ("ring_front_left", "ring_front_center", "ring_front_right")  # any of CAMERA_NAMES
    width: int = 320  # pixels
    height: int = 180  # pixels
    jpeg_quality: int = constant(92)  # 1 to 100
    steps_per_photo: int = 5  # of 0.1 s: 5 is 2 Hz, as fast as samples want them; 1 is 10 Hz, for scenes to learn from
    photo_steps: int = LOG_STEPS  # of a log, from its first, that are photographed; the three windows' histories are 36
    lidar_beams: int = 64  # 0: no lidar
    lidar_azimuths: int = 900  # directions a beam is fired in, a turn

    def __post_init__(self) -> None:
        object.__setattr__(self, "cameras", tuple(self.cameras))  # configuration files give lists
        check_cameras(self.cameras)
        if self.width < 16 or self.height < 16 or not 1 <= self.jpeg_quality <= 100:
            raise ValueError(f"impossible picture: {self.width}x{self.height}, quality {self.jpeg_quality}")
        if self.steps_per_photo < 1 or STEPS_PER_SWEEP % self.steps_per_photo:
            raise ValueError(f"steps_per_photo must divide {STEPS_PER_SWEEP}, not {self.steps_per_photo}")
        if not 1 <= self.photo_steps <= LOG_STEPS:
            raise ValueError(f"photo_steps must be 1 to {LOG_STEPS}, the steps of a log, not {self.photo_steps}")
        if self.lidar_beams < 0 or self.lidar_azimuths < 1:
            raise ValueError(f"impossible lidar: {self.lidar_beams} beams, {self.lidar_azimuths} azimuths")


class TownReaderSettings(ReaderSettings):
    """Settings with those of a town's sensors."""

    settings: TownSettings

    @property
    def photos_alone(self) -> bool:
        """Whether clips have photos and no lidar."""
        return bool(self.settings.cameras) and self.settings.lidar_beams == 0

    def rig(self, painted: bool) -> tuple[str, ...]:
        """Of a town without photos, the painter has the usual cameras."""
        return self.settings.cameras or (TownSettings().cameras if painted else ())


@dataclass(frozen=True)
class TownClips(TownReaderSettings):
    """A seeded town: which of its clips."""

    cache_dir: str | None = None  # written there once; null: the user's cache ($XDG_CACHE_HOME or ~/.cache)
    n_clips: int = 12  # the town's first
    seed: int = 0  # of the town
    settings: TownSettings = field(default_factory=TownSettings)
    traversals: int = 0  # other logs' drives through the same place, at most, that a block's scene is made of as well

    @property
    def summary(self) -> str:
        """How many clips, and the sensors."""
        seen, lidar = self.settings, ", lidar" if self.settings.lidar_beams else ""
        return f"{self.n_clips} clips of a drawn town, {len(seen.cameras)} cameras of {seen.width}x{seen.height}{lidar}"

    def __post_init__(self) -> None:
        check_traversals(self.traversals)
        if self.n_clips < 1:
            raise ValueError(f"clips.n_clips: a town needs at least one clip, not {self.n_clips}")


@dataclass(frozen=True)
class TownsClips(TownReaderSettings):
    """The towns of several seeds, a few logs of each."""

    seeds: tuple[int, ...] | None = None  # null: n_towns of them from first_seed on
    first_seed: int = 0  # of the towns
    n_towns: int = 1  # one a seed
    logs_per_town: int = 3  # of 18 kinds of drives, others in the next seed's town; a log holds three clips
    first_log: int = 0  # of each town's turn; those before it are skipped: logs_per_town for others of the same towns
    split: Split = "train"  # of every clip, whatever its log's hash says
    first_window: int = 0  # of each log; those before it are skipped
    cache_dir: str | None = None  # each town is written there once; null: the user's cache
    settings: TownSettings = field(default_factory=TownSettings)
    traversals: int = 0  # other logs' drives through the same place, at most, that a block's scene is made of as well

    def __post_init__(self) -> None:
        check_traversals(self.traversals)
        chosen = self.chosen
        if not chosen or min(chosen) < 0 or len(set(chosen)) < len(chosen):
            raise ValueError(f"clips.seeds: each town's seed once, 0 or more, at least one; not {list(chosen)}")
        if not 1 <= self.logs_per_town <= LOGS_PER_TOWN:
            raise ValueError(f"clips.logs_per_town={self.logs_per_town}: a town has 1 to {LOGS_PER_TOWN} logs")
        if not 0 <= self.first_log <= LOGS_PER_TOWN - self.logs_per_town:
            raise ValueError(
                f"clips.first_log={self.first_log}: a town has {LOGS_PER_TOWN} logs, {self.logs_per_town} are taken"
            )

    @property
    def chosen(self) -> tuple[int, ...]:
        """The towns' seeds."""
        return tuple(range(self.first_seed, self.first_seed + self.n_towns)) if self.seeds is None else self.seeds
