"""One file of 123D: an Arrow IPC table whose schema carries a msgpack dictionary of plain values.

A modality's columns are named `<modality>.<field>`, stamps are microseconds, poses x, y, z [m], qw, qx, qy, qz, lengths
metres; boxes of a frame are a list in its row.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from factory.datasets.av2.reader import KIND_OF_CATEGORY
from factory.readers.arrow import read_arrow
from factory.readers.base import BadClip
from factory.wording import shown
from tasks.world.arrays import Array, Indices, Ints
from tasks.world.clip import AgentKind

VERSIONS = ("0.6", "0.7")  # of py123d, whose files are read
US_NS = 1000


@dataclass(frozen=True)
class ArrowFile:
    """A file of a log: its table, and what its schema says of it."""

    path: Path
    table: pa.Table
    metadata: Mapping[str, Any]

    def column(self, name: str) -> pa.Array:
        """A column of the modality that the file is named after, without nulls. Raises BadClip."""
        return column_without_nulls(self.path, self.table, f"{self.path.stem}.{name}")

    def stamps_ns(self, name: str = "timestamp_us") -> Ints:
        """(n,) nanoseconds. Raises BadClip."""
        column = self.column(name)
        if not pa.types.is_int64(column.type):
            raise BadClip(str(self.path), name, f"expected int64, found {column.type}")
        return np.asarray(column, np.int64) * US_NS

    def rows(self, name: str, width: int, whole: bool = True) -> Array:
        """(n, width) of a column of lists of `width` numbers; whole: finite ones. Raises BadClip."""
        return number_lists(self.path, name, self.column(name), width, whole)

    def lists(self, name: str) -> tuple[Indices, pa.Array]:
        """(m,) the row of each of the m items that a column of lists holds, and the items. Raises BadClip."""
        column = self.column(name)
        if not pa.types.is_list(column.type):
            raise BadClip(str(self.path), name, f"expected lists, found {column.type}")
        return np.asarray(pc.list_parent_indices(column), np.int64), pc.list_flatten(column)

    def text(self, *names: str) -> tuple[str, ...]:
        """Values of the metadata that are text. Raises BadClip."""
        return tuple(str(self.value(name, str)) for name in names)

    def value(self, name: str, *kinds: type[Any]) -> Any:
        """A value of the metadata, of one of the types. Raises BadClip."""
        if not isinstance(self.metadata.get(name), kinds):
            raise BadClip(str(self.path), f"metadata.{name}", f"is {shown(self.metadata.get(name))}")
        return self.metadata[name]

    def vector(self, name: str, size: int) -> Array:
        """(size,) finite numbers of the metadata. Raises BadClip."""
        try:
            vector = np.asarray(self.value(name, list), np.float64)
        except (TypeError, ValueError, OverflowError) as error:
            raise BadClip(str(self.path), f"metadata.{name}", f"not numbers ({error})") from error
        if vector.shape != (size,) or not np.isfinite(vector).all():
            raise BadClip(str(self.path), f"metadata.{name}", f"expected {size} finite numbers")
        return vector


def open_file(path: Path, rows: bool = True) -> ArrowFile:
    """The file, checked whole, or without its rows. Raises BadClip as read_arrow does, and where it has no metadata."""
    table = read_arrow(path, "an Arrow file", rows, mapped=True)
    packed = (table.schema.metadata or {}).get(b"metadata")
    if packed is None:
        raise BadClip(str(path), "metadata", "missing from the schema: not a file of py123d")
    return ArrowFile(path, table, unpack_msgpack(path, "metadata", packed))


def check_version(file: ArrowFile) -> None:
    """Raises BadClip where a py123d of another version wrote the file."""
    version = file.value("version", str)
    if ".".join(version.split(".")[:2]) not in VERSIONS:
        known = " and ".join(VERSIONS)
        raise BadClip(
            str(file.path), "metadata.version", f"written by py123d {version}, {known} are read: convert with one"
        )


def column_without_nulls(path: Path, table: pa.Table, name: str) -> pa.Array:
    """A column without nulls. Raises BadClip."""
    if name not in table.column_names:
        raise BadClip(str(path), name, f"column is missing; there are {', '.join(table.column_names)}")
    column = table[name].combine_chunks()
    if column.null_count:
        raise BadClip(str(path), name, "holds nulls")
    return column


def number_lists(path: Path, name: str, lists: pa.Array, width: int, whole: bool = True) -> Array:
    """(n, width) of n lists of `width` numbers; whole: finite ones. Raises BadClip."""
    if not pa.types.is_fixed_size_list(lists.type) or lists.type.list_size != width or lists.null_count:
        raise BadClip(str(path), name, f"expected lists of {width} numbers, found {lists.type}")
    values = lists.flatten()
    if values.null_count or not pa.types.is_floating(values.type):
        raise BadClip(str(path), name, "holds nulls or no numbers")
    out = np.asarray(values, np.float64).reshape(-1, width)
    if whole and not np.isfinite(out).all():
        raise BadClip(str(path), name, "holds NaN or infinity")
    return out


def unpack_msgpack(path: Path, field: str, data: bytes) -> dict[str, Any]:
    """A msgpack dictionary; arrays of floats in it as arrays of float64. Raises BadClip."""
    try:
        content = msgpack.unpackb(data, object_hook=_array, raw=False)
    except (KeyError, TypeError, ValueError, OverflowError, RecursionError, msgpack.UnpackException) as error:
        raise BadClip(str(path), field, f"is no msgpack of plain values and arrays ({error})") from error
    if not isinstance(content, dict):
        raise BadClip(str(path), field, f"holds a {type(content).__name__}, not a dictionary")
    return content


def _array(value: dict[Any, Any]) -> dict[Any, Any] | NDArray[np.float64]:
    if b"__ndarray__" not in value:
        return value
    kind = np.dtype(value[b"dtype"])
    if kind.kind not in "fiu":
        raise ValueError(f"an array of {kind}")
    return np.frombuffer(value[b"data"], kind).reshape(value[b"shape"]).astype(np.float64)


# The data sets that 123D converts and that are read: licences, classes of their boxes, what their maps hold.


@dataclass(frozen=True)
class ConvertedSet:
    """What differs between the data sets."""

    licence: str
    own_roadblocks: bool = False  # its lane groups are roadblocks; elsewhere 123D made them from neighbours
    own_intersections: bool = False  # polygons of its own; elsewhere 123D joined connectors
    own_centerlines: bool = True  # else 123D made them from the boundaries, as we do
    own_sweeps: str | None = None  # suffix of its own files of points, where they are read
    sweeps_of_sensor: bool = False  # such a file's points are in the lidar's frame, as it ends; else as it begins


_WAYMO = "Waymo Open Dataset licence, non-commercial (via 123D)"
SOURCES = {  # by the data set's name in a log's metadata
    "av2-sensor": ConvertedSet("CC BY-NC-SA 4.0 (Argoverse 2 via 123D)", own_centerlines=False, own_sweeps=".feather"),
    "nuplan": ConvertedSet(
        "CC BY-NC-SA 4.0 (nuPlan via 123D)", own_roadblocks=True, own_intersections=True, own_sweeps=".pcd"
    ),
    "nuscenes": ConvertedSet(
        "CC BY-NC-SA 4.0 (nuScenes via 123D)", own_intersections=True, own_sweeps=".bin", sweeps_of_sensor=True
    ),
    "wod-perception": ConvertedSet(_WAYMO),
    "wod-motion": ConvertedSet(_WAYMO),
}
WITHOUT_LANES = {  # what 123D writes no lanes of
    "pandaset": "no map",
    "physical-ai-av": "no map",
    "ncore": "no map",
    "kitti360": "surfaces alone",
}

_CAR, _WALKER, _BICYCLE, _THING = AgentKind.VEHICLE, AgentKind.PEDESTRIAN, AgentKind.BICYCLE, AgentKind.GENERIC_OBJECT
_AV2 = (
    "ANIMAL ARTICULATED_BUS BICYCLE BICYCLIST BOLLARD BOX_TRUCK BUS CONSTRUCTION_BARREL CONSTRUCTION_CONE DOG "
    "LARGE_VEHICLE MESSAGE_BOARD_TRAILER MOBILE_PEDESTRIAN_CROSSING_SIGN MOTORCYCLE MOTORCYCLIST OFFICIAL_SIGNALER "
    "PEDESTRIAN RAILED_VEHICLE REGULAR_VEHICLE SCHOOL_BUS SIGN STOP_SIGN STROLLER TRAFFIC_LIGHT_TRAILER TRUCK "
    "TRUCK_CAB VEHICULAR_TRAILER WHEELCHAIR WHEELED_DEVICE WHEELED_RIDER"
)
# Kind by label number, of the classes in py123d/parser/registry.py.
KINDS_OF_LABELS: dict[str, tuple[AgentKind, ...]] = {
    "AV2SensorBoxDetectionLabel": tuple(KIND_OF_CATEGORY[name] for name in _AV2.split()),
    "NuPlanBoxDetectionLabel": tuple(
        AgentKind[name]
        for name in ["VEHICLE", "BICYCLE", "PEDESTRIAN", "TRAFFIC_CONE", "BARRIER", "CZONE_SIGN", "GENERIC_OBJECT"]
    ),
    "NuScenesBoxDetectionLabel": (
        *(_CAR,) * 8,  # car, truck, two buses, construction, ambulance, police, trailer
        *(_BICYCLE,) * 2,  # bicycle, motorcycle
        *(_WALKER,) * 7,  # adult, child, worker, personal mobility, police officer, stroller, wheelchair
        *(AgentKind.TRAFFIC_CONE, AgentKind.BARRIER),
        *(_THING,) * 4,  # pushable, debris, bicycle rack, animal
    ),
    "WODPerceptionBoxDetectionLabel": (_THING, _CAR, _WALKER, AgentKind.CZONE_SIGN, _BICYCLE),
    "WODMotionBoxDetectionLabel": (_THING, _CAR, _WALKER, _BICYCLE, _THING),
}
