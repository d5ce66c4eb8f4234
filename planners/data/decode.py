"""From stored rows to a batch: flat Arrow buffers are cut per sample, without a Python object per value, and decoded.

`StoredRows` is a row group in memory, of the images those at now alone. `BatchBuffer` is a batch that several threads
fill, sample by sample.
"""

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from factory.store.reader import TIME_TOLERANCE_S, labels_of
from factory.store.schema import COLUMNS, LABEL_COLUMNS, Column
from planners.data.batch import COMMANDS, Batch, BevLayout, ImageLayout, Needs, one_hot_command
from planners.data.images import stitch
from planners.data.index import AGENT_COLUMNS, BEV_COLUMNS
from planners.data.jitter import Offset
from tasks.reward.label_bytes import CRC_BYTES
from tasks.subscores import LABELLED
from tasks.world.arrays import Bools, Bytes
from tasks.world.commands import command_of_points, route_points

if TYPE_CHECKING:
    from torch import Tensor

# Columns in the frame of the ego at now: lists of points, and what begins with x, y, heading.
GEOMETRY = ("lane_polygons", "lane_centerlines", "drivable_rings", "crossing_rings")
POSES = ("route_centerline", "agent_boxes")

Stitch = Callable[[Sequence[Bytes], ImageLayout, Bytes], None]


class StoredRows:
    """Some rows of one row group."""

    def __init__(self, table: pa.Table, cameras: Sequence[tuple[str, ...]], stitched: Stitch = stitch) -> None:
        """cameras: (rows) of each row's picture, whose JPEGs are copied; none for rows that are not asked for.

        stitched: how a picture is made of its JPEGs.
        """
        self._stitched = stitched
        self._jpegs: list[tuple[Bytes, ...]] = []
        if "images" in table.column_names:
            self._jpegs = _jpegs_at_now(_in_one_chunk(table["images"]), cameras)
            table = table.drop_columns(["images"])
        self._values = {name: _row_getter(COLUMNS[name], _in_one_chunk(table[name])) for name in table.column_names}
        self._rasters: dict[tuple[int, BevLayout], Bytes] = {}
        self._pictures: dict[tuple[int, ImageLayout], Bytes] = {}

    def value(self, column: str, row: int) -> Any:
        """A value as the sample reader gives it: an array, a list of arrays, a text or a number."""
        return self._values[column](row)

    def values(self, columns: Sequence[str], row: int) -> dict[str, Any]:
        """Several columns of a row."""
        return {column: self._values[column](row) for column in columns}

    def raster(self, row: int, layout: BevLayout) -> Bytes:
        """The row seen from above (T, rows, columns), drawn once: a raster is smaller than the map it is drawn from."""
        from planners.data.bev import bev_raster

        if (row, layout) not in self._rasters:
            self._rasters[row, layout] = bev_raster(self.values(BEV_COLUMNS, row), layout)
        return self._rasters[row, layout]

    def jpegs(self, row: int) -> tuple[Bytes, ...]:
        """The images at now of the row's cameras, left to right."""
        return self._jpegs[row]

    def picture(self, row: int, layout: ImageLayout, out: Bytes, keep: bool = False) -> None:
        """Write the row's wide picture into `out`; keep: it is decoded once and stays, beside its smaller JPEGs."""
        kept = self._pictures.get((row, layout))
        if kept is not None:
            out[:] = kept
            return
        self._stitched(self.jpegs(row), layout, out)
        if keep:
            self._pictures[row, layout] = out.copy()


class MovedRows(StoredRows):
    """Rows as the ego sees them where it is put; its status and the way that it came are its own and move with it."""

    def __init__(self, stored: StoredRows, offset: Offset) -> None:
        self._stored, self._offset = stored, offset

    def value(self, column: str, row: int) -> Any:
        if column in ("label_10hz", "label_2hz"):
            bent = self._offset.bent_back(self._stored.value("label_10hz", row))
            return bent if column == "label_10hz" else bent[4::5]
        value = self._stored.value(column, row)
        if column in GEOMETRY:
            return [self._offset.seen(points).astype(np.float32) for points in value]
        return self._offset.seen_poses(value).astype(np.float32) if column in POSES else value

    def values(self, columns: Sequence[str], row: int) -> dict[str, Any]:
        return {column: self.value(column, row) for column in columns}

    def raster(self, row: int, layout: BevLayout) -> Bytes:
        from planners.data.bev import bev_raster

        return bev_raster(self.values(BEV_COLUMNS, row), layout)


class BatchBuffer:
    """A batch of `size` samples whose tensors are still to be filled; samples may be filled by several threads."""

    def __init__(
        self, size: int, needs: Needs, n_labels: int, pinned: bool = False, keep_pictures: bool = False
    ) -> None:
        """n_labels: K of the vocabulary; keep_pictures: what is decoded stays with its row, for the next pass."""
        import torch

        def empty(*shape: int, dtype: torch.dtype = torch.float32) -> "Tensor":
            return torch.empty((size, *shape), dtype=dtype, pin_memory=pinned)

        self._needs, self._keep_pictures = needs, keep_pictures
        self._tensors: dict[str, Tensor] = {
            "status": empty(len(COMMANDS) + 4),
            "history": empty(4, 3),
            "plan_2hz": empty(8, 3),
            "plan_10hz": empty(40, 3),
        }
        if needs.image is not None:
            self._tensors["image"] = empty(needs.image.height, needs.image.width, 3, dtype=torch.uint8)
        if needs.bev is not None:
            self._tensors["bev"] = empty(len(needs.bev.times_s), *needs.bev.shape, dtype=torch.uint8)
        if needs.n_agents:
            self._tensors["agents"] = empty(needs.n_agents, 5)
            self._tensors["agents_valid"] = empty(needs.n_agents, dtype=torch.bool)
        self._labels = {name: empty(n_labels) for name in LABELLED} if needs.labels is not None else {}
        self._arrays = {name: tensor.numpy() for name, tensor in (self._tensors | self._labels).items()}

    def fill(self, i: int, stored: StoredRows, row: int) -> None:
        """Decode a row as sample i. Raises ValueError for what cannot be decoded."""
        arrays, needs = self._arrays, self._needs
        if needs.command == "navsim":
            command = stored.value("command", row)
        else:
            command = command_of_points(route_points(stored.value("route_centerline", row)), needs.command)
        arrays["status"][i, : len(COMMANDS)] = one_hot_command(command)
        arrays["status"][i, len(COMMANDS) :] = stored.value("ego_status", row)
        arrays["history"][i] = stored.value("ego_history_2hz", row)
        arrays["plan_2hz"][i] = stored.value("label_2hz", row)
        arrays["plan_10hz"][i] = stored.value("label_10hz", row)
        if needs.image is not None:
            stored.picture(row, needs.image, arrays["image"][i], self._keep_pictures)
        if needs.bev is not None:
            arrays["bev"][i] = stored.raster(row, needs.bev)
            if needs.n_agents:
                from planners.data.bev import nearest_vehicles

                seen = stored.values(AGENT_COLUMNS, row)
                arrays["agents"][i], arrays["agents_valid"][i] = nearest_vehicles(seen, needs.bev, needs.n_agents)
        if needs.labels is not None:
            labels = labels_of(stored.values(LABEL_COLUMNS, row), needs.labels)
            for name in LABELLED:
                arrays[name][i] = labels.ep(needs.normalise) if name == "ep" else getattr(labels, name)

    def batch(self, attempt_ids: Sequence[str], simulated: Bools, imitate: Bools) -> Batch:
        """What was filled. The image is channels last in memory, as it was decoded."""
        import torch

        tensors: dict[str, Any] = dict(self._tensors)
        if "image" in tensors:
            tensors["image"] = tensors["image"].permute(0, 3, 1, 2)
        return Batch(
            attempt_ids=tuple(attempt_ids),
            simulated=torch.from_numpy(simulated.copy()),
            imitate=torch.from_numpy(imitate.copy()),
            labels=dict(self._labels) or None,
            **tensors,
        )


def count_labels(stored: StoredRows, row: int) -> int:
    """K of a row's vocabulary, from the length of its bytes alone."""
    return (len(stored.value("label_progress", row)) - CRC_BYTES) // 2


def _in_one_chunk(column: pa.ChunkedArray) -> pa.Array:
    """In one piece. Of a single chunk `combine_chunks` would make a copy."""
    return column.chunk(0) if column.num_chunks == 1 else column.combine_chunks()


def _jpegs_at_now(images: pa.ListArray, cameras: Sequence[tuple[str, ...]]) -> list[tuple[Bytes, ...]]:
    starts, entries = images.offsets.to_numpy(), images.values
    at_now = np.flatnonzero(np.abs(entries.field("time_s").to_numpy()) <= TIME_TOLERANCE_S)
    names = entries.field("camera").take(pa.array(at_now)).to_pylist()
    row_of = np.searchsorted(starts, at_now, side="right") - 1
    found = {(row, name): entry for row, name, entry in zip(row_of.tolist(), names, at_now.tolist())}
    jpeg = entries.field("jpeg")
    _, _, data = jpeg.buffers()
    ends = np.frombuffer(jpeg.buffers()[1], np.int32)[jpeg.offset : jpeg.offset + len(jpeg) + 1]
    flat = np.frombuffer(data, np.uint8)

    entries = [[found[row, name] for name in chosen] for row, chosen in enumerate(cameras)]
    return [tuple(flat[ends[entry] : ends[entry + 1]].copy() for entry in mine) for mine in entries]


def _row_getter(column: Column, stored: pa.Array) -> Callable[[int], Any]:
    """Row -> value, in the declared shape."""
    if column.dtype in ("string", "binary"):
        return lambda row: stored[row].as_py()
    if not column.shape:
        scalars = stored.to_numpy(zero_copy_only=False)
        return lambda row: scalars[row].item()
    offsets, inner = [], stored
    for _ in column.shape:
        offsets.append(inner.offsets.to_numpy())
        inner = inner.values
    flat = inner.to_numpy(zero_copy_only=False)

    def ends(bounds: Any, level: int) -> Any:
        """Where lists at a level begin in `flat`."""
        for deeper in offsets[level:]:
            bounds = deeper[bounds]
        return bounds

    if len(column.shape) > 1 and isinstance(column.shape[1], str):
        item = (-1, *column.shape[2:])

        def ragged(row: int) -> list[NDArray[Any]]:
            edges = ends(np.arange(offsets[0][row], offsets[0][row + 1] + 1), 1).tolist()
            return [flat[start:stop].reshape(item) for start, stop in pairwise(edges)]

        return ragged
    shape = tuple(-1 if isinstance(size, str) else size for size in column.shape)
    return lambda row: flat[ends(row, 0) : ends(row + 1, 0)].reshape(shape)
