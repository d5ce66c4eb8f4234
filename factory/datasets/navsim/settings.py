"""Which clips of NAVSIM's logs are taken."""

from dataclasses import dataclass

from factory.readers.settings import STEPS_PER_S, ReaderSettings, Split, WindowSettings, check_traversals

FRAME_STEPS = 5  # of NAVSIM's logs, 2 Hz


@dataclass(frozen=True)
class NavsimClips(ReaderSettings):
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
