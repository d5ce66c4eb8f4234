"""Which clips of a folder of logs are taken, and what the sensors of the synthetic town record.

Light, like every module of this name: no numpy is loaded for it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

from tasks.settings import fixed

STEPS_PER_S = 10  # of clips
Split = Literal["train", "val", "test"]


@dataclass(frozen=True)
class WindowSettings:
    """What a window must be like."""

    stride_s: float = 1.0  # between the starts of two windows of one log
    min_top_speed_mps: float = 0.5  # an ego that never reaches it stands
    first: int = 0  # window of a log that is taken; those before it are skipped
    max_speed_mps: float = 100.0  # a track that moves faster between two steps has changed its object

    def __post_init__(self) -> None:
        """Raises ValueError where the stride is no positive multiple of 0.1 s, or the first window is none."""
        if self.stride_steps < 1 or abs(self.stride_steps / STEPS_PER_S - self.stride_s) > 1e-6:
            raise ValueError(f"stride_s must be a positive multiple of {1 / STEPS_PER_S} s, not {self.stride_s}")
        if self.first < 0:
            raise ValueError(f"first_window must be 0 or more, not {self.first}")

    @property
    def stride_steps(self) -> int:
        """The stride in steps of 0.1 s."""
        return round(self.stride_s * STEPS_PER_S)

    @property
    def first_step(self) -> int:
        """Where the first window begins that is taken."""
        return self.first * self.stride_steps


def check_traversals(traversals: int) -> None:
    """Raises ValueError for a number that cannot be."""
    if traversals < 0:
        raise ValueError(f"clips.traversals must be 0 or more, not {traversals}")


@dataclass(frozen=True)
class LogClips:
    """Clips of logs of one format."""

    root: str  # file or folder
    stride_s: float = 1.0  # between the starts of two windows of one log, a multiple of 0.1 s
    min_top_speed_mps: float = 0.5  # an ego that never reaches it stands: no clip
    first_window: int = 0  # of each log; those before it are skipped
    only: tuple[str, ...] = ()  # ids of logs; []: all under the root
    split: Split | None = None  # of every clip; null: the data set's own, else by the hash of the log's id
    traversals: int = 0  # other logs' drives through the same place, at most, that a block's scene is made of as well

    def __post_init__(self) -> None:
        self.windows  # noqa: B018 - raises ValueError for a stride or a first window that cannot be
        check_traversals(self.traversals)

    @property
    def windows(self) -> WindowSettings:
        """Which windows of a log are taken."""
        return WindowSettings(self.stride_s, self.min_top_speed_mps, self.first_window)

    @property
    def photos_alone(self) -> bool:
        """Whether clips may have photos and no lidar; Argoverse's have both."""
        return False


@dataclass(frozen=True)
class Py123dClips(LogClips):
    """Clips of logs that 123D converted."""

    maps_root: str | None = None  # of the maps that logs share; null: `maps` beside `logs`
    sensor_root: str | None = None  # of the data set that was converted, for its photos; null: clips without

    @property
    def photos_alone(self) -> bool:
        """Whether clips may have photos and no lidar."""
        return self.sensor_root is not None


@dataclass(frozen=True)
class ScenarioNetClips(LogClips):
    """Clips of ScenarioNet's conversions, which hold no photos themselves."""

    cameras: str | None = None  # cameras.json of the log, or a folder of such of each (docs/photos.md); null: no photos
    sensor_root: str | None = None  # what its paths of photos and sweeps count from; null: the folder it lies in

    @property
    def photos_alone(self) -> bool:
        """Whether clips may have photos and no lidar."""
        return self.cameras is not None


FRAME_STEPS = 5  # of NAVSIM's logs, 2 Hz


@dataclass(frozen=True)
class NavsimClips:
    """Clips of OpenScene logs with nuPlan's maps, as NAVSIM installs them."""

    root: str  # navsim_logs/<split>, or one log of it
    maps: str  # folder of nuPlan's maps, $NUPLAN_MAPS_ROOT
    sensors: str | None = None  # sensor_blobs/<split>; null: clips without pictures and lidar
    scene_filter: str | None = None  # .yaml of a scene filter or split, or its name: its tokens are the clips
    scene_filters: str | None = None  # folder of the names, NAVSIM's config/common/train_test_split
    stride_s: float = 1.0  # between the starts of two windows of one log without a filter, a multiple of 0.5 s
    min_top_speed_mps: float = 0.5  # an ego that never reaches it stands: no clip, unless a filter names it
    first_window: int = 0  # of each log without a filter; those before it are skipped
    only: tuple[str, ...] = ()  # names of logs; []: all under the root
    split: Split | None = None  # of every clip; null: by the name of the filter or the folder, else the log's hash
    cache_dir: str | None = None  # of what is known of each log's frames; null: the user's cache
    traversals: int = 0  # other logs' drives through the same place, at most, that a block's scene is made of as well

    def __post_init__(self) -> None:
        """Raises ValueError for a stride, a first window or a number of traversals that cannot be."""
        check_traversals(self.traversals)
        windows = WindowSettings(self.stride_s, self.min_top_speed_mps, self.first_window)
        if windows.stride_steps % FRAME_STEPS:
            raise ValueError(f"stride_s must be a multiple of 0.5 s, NAVSIM's frames, not {self.stride_s}")

    @property
    def photos_alone(self) -> bool:
        """Whether clips may have photos and no lidar."""
        return self.sensors is not None

    @property
    def stride_frames(self) -> int:
        """The stride in frames of 0.5 s."""
        return round(self.stride_s * STEPS_PER_S) // FRAME_STEPS


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
    jpeg_quality: int = fixed(92)  # 1 to 100
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

    @property
    def photos_alone(self) -> bool:
        """Whether clips have photos and no lidar."""
        return bool(self.cameras) and self.lidar_beams == 0


@dataclass(frozen=True)
class TownClips:
    """A seeded town: which of its clips."""

    cache_dir: str | None = None  # written there once; null: the user's cache ($XDG_CACHE_HOME or ~/.cache)
    n_clips: int = 12  # the town's first
    seed: int = 0  # of the town
    settings: TownSettings = field(default_factory=TownSettings)
    traversals: int = 0  # other logs' drives through the same place, at most, that a block's scene is made of as well

    def __post_init__(self) -> None:
        check_traversals(self.traversals)
        if self.n_clips < 1:
            raise ValueError(f"clips.n_clips: a town needs at least one clip, not {self.n_clips}")

    @property
    def photos_alone(self) -> bool:
        """Whether clips have photos and no lidar."""
        return self.settings.photos_alone


@dataclass(frozen=True)
class TownsClips:
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

    @property
    def photos_alone(self) -> bool:
        """Whether clips have photos and no lidar."""
        return self.settings.photos_alone
