"""Pictures of samples, made when they are asked for and kept in bounded memory: GET /picture/<attempt_id>/<name>.

    front.jpg           what the camera that looks ahead saw at now
    <n>.jpg             the n-th stored image, n as in the sample's `images`
    bev.jpg             seen from above; step=0..55 (-1.5 .. 4.0 s at 10 Hz, 15 is now), size=300, or 600 with the whole
                        logged drive, for which the prepared clip is read: 70 ms, too long for a gallery's page

A sample's row is read by its file and row group: one group, never a file, and the latest groups are kept. Stored JPEGs
go out as they are, unless they are wider than WIDE_PX and small=1 asks for less.
"""

import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache, partial
from typing import Any, Generic, TypeVar

import pyarrow as pa

from factory.readers.pictures import header_of
from factory.store.parquet_file import open_parquet, with_partition
from factory.store.reader import decoded, group_of
from factory.store.samples import Store
from factory.store.schema import AGENT_STEPS, SAMPLES, SCHEMA, table_to_rows
from factory.views.board.gallery import BadRequest, NotThere, place_of
from factory.views.board.watch import Snapshot
from factory.views.episode_messages import episode_of
from factory.views.sample_picture import (
    BEV_COLUMNS,
    encoded,
    front_camera,
    images_at_now,
    nearer,
    sample_bev,
    small_jpeg,
)
from factory.views.show import logged_drive
from tasks.world.arrays import Array

LARGE_PX = 600
BEV_SIZES = (300, LARGE_PX)  # divisible by 3 and 4
WIDE_PX = 640
KEPT_BYTES = 64 * 2**20  # of pictures
KEPT_GROUP_BYTES = 128 * 2**20  # of row groups, some 4 MB each: neighbours in the gallery stand in one
KEPT_FILES = 16  # their footers
KEPT_DRIVES = 4096  # logs' drives of 2 kB, read from prepared clips
MADE_FROM = ("clip_id", "settings_hash")  # what tells a row's prepared clip
COLUMNS = tuple(name for name in SCHEMA.names if name not in ("label_subscores", "label_progress"))  # of a row
Sample = Mapping[str, Any]
Value = TypeVar("Value")


class Kept(Generic[Value]):
    """Values by key up to a sum of sizes; the least recently used go first. Safe to use from many threads."""

    def __init__(self, most: int, size: Callable[[Value], int]) -> None:
        self._most, self._size, self._held = most, size, 0
        self._values: OrderedDict[tuple[object, ...], Value] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, key: tuple[object, ...], make: Callable[[], Value]) -> Value:
        """The value, made now where it is not kept."""
        with self._lock:
            if key in self._values:
                self._values.move_to_end(key)
                return self._values[key]
        made = make()
        with self._lock:
            if key not in self._values and self._size(made) <= self._most:
                self._values[key] = made
                self._held += self._size(made)
            while self._held > self._most:
                self._held -= self._size(self._values.popitem(last=False)[1])
        return made


class Pictures:
    """Of one store's samples."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._logged: Kept[Array | None] = Kept(KEPT_DRIVES, lambda drive: 1)
        self._kept: Kept[bytes] = Kept(KEPT_BYTES, len)
        self._groups: Kept[pa.Table] = Kept(KEPT_GROUP_BYTES, lambda group: int(group.nbytes))
        self._lock = threading.Lock()
        self._file = lru_cache(maxsize=KEPT_FILES)(partial(open_parquet, store.samples.location))

    def row(self, shot: Snapshot, attempt_id: str, columns: Sequence[str] = COLUMNS) -> Sample:
        """Some columns of one sample. Raises NotThere."""
        path, row, partition = self._place(shot, attempt_id)
        with self._lock:  # the pictures of a page ask at once; one of them reads for all
            file = self._file(path)
            group, row = group_of(file, row)
            kept = [name for name in COLUMNS if name not in partition]
            stored = self._groups.get((path, group), lambda: file.read_row_group(group, columns=kept))
        schema = pa.schema([SCHEMA.field(name) for name in columns])
        return table_to_rows(with_partition(stored.slice(row, 1), schema, partition))[0]

    def front(self, shot: Snapshot, attempt_id: str) -> bytes:
        """JPEG, small. Raises NotThere where the sample has no image."""

        def make() -> bytes:
            row = self.row(shot, attempt_id, ("cameras", "images", "image_source"))
            name = front_camera(row)
            found = [image for image in images_at_now(row) if image["camera"] == name]
            if not found:
                raise NotThere(f"{attempt_id} has no image: image_source is {row['image_source']}")
            return _jpeg(found[0], small=True)

        return self._kept.get((*self._place(shot, attempt_id)[:2], "front"), make)

    def image(self, shot: Snapshot, attempt_id: str, index: int, small: bool = False) -> bytes:
        """JPEG of the n-th stored image. Raises NotThere."""

        def make() -> bytes:
            images = self.row(shot, attempt_id, ("images",))["images"] or ()
            if index >= len(images):
                raise NotThere(f"{attempt_id} has {len(images)} images, none of number {index}")
            return _jpeg(images[index], small)

        return self._kept.get((*self._place(shot, attempt_id)[:2], index, small), make)

    def bev(self, shot: Snapshot, attempt_id: str, size_px: int, step: int) -> bytes:
        """JPEG, square. Raises BadRequest for another size or step, NotThere."""
        if size_px not in BEV_SIZES or not 0 <= step < AGENT_STEPS:
            raise BadRequest(f"size={size_px} step={step}: size is one of {BEV_SIZES}, step 0 to {AGENT_STEPS - 1}")

        def make() -> bytes:
            size = (size_px * 4 // 3,) * 2  # `nearer` keeps three quarters
            row = self.row(shot, attempt_id, (*BEV_COLUMNS, *MADE_FROM))
            logged = self._logged_drive(row) if size_px == LARGE_PX else None
            return encoded(nearer(sample_bev(row, logged, size, step=step, legend=False)))

        return self._kept.get((*self._place(shot, attempt_id)[:2], "bev", size_px, step), make)

    def episode(self, shot: Snapshot, attempt_id: str) -> bytes:
        """The sample as an MCAP file, see docs/formats.md. Raises NotThere, also for a row that makes none."""
        row = self.row(shot, attempt_id)
        try:
            return episode_of(row, self._logged_drive(row))
        except ValueError as error:
            raise NotThere(f"{attempt_id} makes no episode: {error}") from error

    def _logged_drive(self, row: Sample) -> Array | None:
        made_from = tuple(row[name] for name in MADE_FROM)
        return self._logged.get(made_from, lambda: logged_drive(self._store, dict(row)))

    def _place(self, shot: Snapshot, attempt_id: str) -> tuple[str, int, Mapping[str, object]]:
        """Its file, its row in it, and what the file's path says."""
        row = shot.newest(place_of(shot, attempt_id))
        return shot.sample_paths[row["_file"]], row["_row"], {name: row[name] for name in SAMPLES.partition_by}


def _jpeg(image: Mapping[str, Any], small: bool) -> bytes:
    """As it is stored, or not wider than WIDE_PX. Raises NotThere where it cannot be decoded to be made smaller."""
    if not small:
        return bytes(image["jpeg"])
    try:
        pixels = decoded(image) if header_of(image["jpeg"])[1][0] > WIDE_PX else None
    except ValueError as error:
        raise NotThere(str(error)) from error
    if pixels is None:
        return bytes(image["jpeg"])
    return small_jpeg(pixels, WIDE_PX)
