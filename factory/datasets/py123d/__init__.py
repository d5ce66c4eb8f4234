"""Logs that 123D (py123d) converted, read from its files alone.

`<data root>/logs/<split>/<log>/` holds one Arrow IPC file a modality, `<data root>/maps/<data set>/` the maps that logs
share. Format: kesai-labs/py123d, src/py123d/api, versions 0.6 and 0.7 (the same in all that is read here).
"""

from dataclasses import dataclass

from factory.readers.settings import LogClips


@dataclass(frozen=True)
class Py123dClips(LogClips):
    """Clips of logs that 123D converted."""

    maps_root: str | None = None  # of the maps that logs share; null: `maps` beside `logs`
    sensor_root: str | None = None  # of the data set that was converted, for its files; null: only what is packed

    @property
    def photos_alone(self) -> bool:
        """Whether clips may have photos and no lidar."""
        return True


READERS = {"Py123dReader": Py123dClips}
READS = "argoverse2 nuscenes waymo nuplan", "clips=py123d clips.root=<123D's conversion> (docs/configuration.md)"
