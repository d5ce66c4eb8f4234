"""Which clips of ScenarioNet's conversions are taken, and where their photos are said to be."""

from dataclasses import dataclass

from factory.readers.settings import LogClips


@dataclass(frozen=True)
class ScenarioNetClips(LogClips):
    """Clips of ScenarioNet's conversions, which hold no photos themselves."""

    cameras: str | None = None  # cameras.json of the log, or a folder of such of each (docs/photos.md); null: no photos
    sensor_root: str | None = None  # what its paths of photos and sweeps count from; null: the folder it lies in

    @property
    def photos_alone(self) -> bool:
        """Whether clips may have photos and no lidar."""
        return self.cameras is not None
