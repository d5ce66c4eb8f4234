"""A table of samples in a training loop of one's own: plain PyTorch, Lightning, or whatever takes a DataLoader.

    data = SampleDataset("runs/demo", ["status", "label_2hz"], pictures=ImageLayout(width=512, height=128))
    for batch in DataLoader(data, batch_size=64, shuffle=True, num_workers=4, collate_fn=data.collate): ...
    for batch in DataLoader(data.stream(seed=0), batch_size=64, num_workers=4, collate_fn=data.collate): ...

What a column is in a sample and in a batch stands in docs/training.md. Tensors own their memory and can be written to.
The planners' own trainings read by `planners.data.loader`, whose order and memory do not depend on workers.
"""

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain
from typing import Any

import numpy as np
import torch
from torch import Tensor, distributed
from torch.nn.utils.rnn import pad_sequence
from torch.utils.data import Dataset, IterableDataset, default_collate, get_worker_info

from factory.config.words import did_you_mean
from factory.store.reader import Sample, SampleTable, stored_image
from factory.store.schema import COLUMNS, Column
from planners.data.batch import ImageLayout, one_hot_command
from planners.data.mix import stream

Pictures = ImageLayout | Sequence[str]

STATUS = "status"  # as in planners.data.batch.Batch
STATUS_COLUMNS = ("command", "ego_status")  # that it is made of
PICTURE_COLUMNS = ("attempt_id", "image_source", "images")


class SampleDataset(Dataset[dict[str, Any]]):
    """The samples of one table, ordered by attempt_id. What is committed later is not in it, in no worker either.

    Nothing is shuffled here: that is the DataLoader's, and with a `generator` of a fixed seed its order is the same
    again. A sample is read alone, so that memory does not grow with the table, which is there as `table`.
    """

    def __init__(
        self,
        out: str | os.PathLike[str],
        columns: Sequence[str] = (STATUS, "ego_history_2hz", "label_2hz"),
        pictures: Pictures | None = None,
        storage_options: Mapping[str, str] | None = None,
    ) -> None:
        """out: a run's `out` or URL; columns: `status`, and those of docs/formats.md.

        pictures: one wide picture at now as planners see it, or names of cameras whose pictures at now are wanted as
        they are stored. Raises ValueError for a column that there is none of and for pictures that were not rendered,
        FileNotFoundError where there is no table.
        """
        self.table = SampleTable(out, storage_options)
        self.columns = (columns,) if isinstance(columns, str) else tuple(columns)
        self.pictures = (pictures,) if isinstance(pictures, str) else pictures
        known = (STATUS, *COLUMNS)
        for name in self.columns:
            if name not in known:
                raise ValueError(f"columns: {out} has no column {name}{did_you_mean(name, known)} (docs/formats.md)")
        read = chain.from_iterable(STATUS_COLUMNS if name == STATUS else (name,) for name in self.columns)
        shown = () if pictures is None else PICTURE_COLUMNS
        rig = ("cameras",) if isinstance(pictures, ImageLayout) else ()  # says which are left and right
        self._read = tuple(dict.fromkeys((*read, *shown, *rig)))
        if pictures is not None and len(self):
            sources = self.table.table(["image_source"])["image_source"].to_pylist()
            if bare := sources.count("none"):
                raise ValueError(
                    f"pictures: {bare} of {len(sources)} samples of {out} have none (image_source=none): "
                    "make the table with render=auto or render=map, or leave pictures= out"
                )
            self[0]  # a camera that no sample has is said here, not by a worker

    def __len__(self) -> int:
        return len(self.table)

    def __getitem__(self, which: int | str) -> dict[str, Any]:
        """One sample by place or attempt_id. Raises ValueError for a picture that it has not, OSError for damage."""
        return self._encoded(self.table.sample(which, self._read))

    def rows(self, path: str, group: int, rows: slice) -> Iterator[dict[str, Any]]:
        """Samples of one of `table.row_groups()`."""
        return map(self._encoded, self.table.rows(path, group, self._read, rows))

    def stream(self, seed: int | None = None, rank: int | None = None, world: int | None = None) -> "SampleStream":
        """The same samples one after another, for reading large tables or object stores: see `SampleStream`."""
        return SampleStream(self, seed, rank, world)

    def _encoded(self, row: Sample) -> dict[str, Any]:
        sample: dict[str, Any] = {}
        for name in self.columns:
            if name in (STATUS, "command"):
                motion = [row["ego_status"]] if name == STATUS else []
                sample[name] = torch.from_numpy(np.concatenate([one_hot_command(row["command"]), *motion]))
            else:
                sample[name] = _tensors(COLUMNS[name], row[name])
        if self.pictures is not None:
            try:
                sample["image"] = self._image(row, self.pictures)
            except (KeyError, ValueError) as error:
                raise ValueError(f"pictures: sample {row['attempt_id']}: {error.args[0]}") from error
        return sample

    def _image(self, row: Sample, pictures: Pictures) -> Tensor | dict[str, Tensor]:
        from planners.data.images import decode_alone, stitch_sample  # and their decoder, which few need

        if isinstance(pictures, ImageLayout):
            return torch.from_numpy(stitch_sample(row, pictures)).permute(2, 0, 1)
        images = {camera: stored_image(row, camera, 0.0) for camera in pictures}
        return {camera: torch.from_numpy(decode_alone(image)).permute(2, 0, 1) for camera, image in images.items()}

    @staticmethod
    def collate(samples: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        """A batch; keys that were added to the samples are collated as PyTorch does it."""
        batch: dict[str, Any] = {}
        for name in samples[0]:
            values, column = [sample[name] for sample in samples], COLUMNS.get(name)
            if name == "image":
                batch[name] = _stacked(values)
            elif column is None or name == "command" or (_is_numeric(column) and not _is_ragged(column)):
                batch[name] = default_collate(values)
            elif _is_numeric(column):
                batch[name], batch[f"{name}_mask"] = _padded(column, values)
            else:
                batch[name] = values
        return batch


class SampleStream(IterableDataset[dict[str, Any]]):
    """Every sample once, over all workers of a DataLoader and all ranks together; one row group is in memory at a time.

    Without a seed files follow each other by round and expert. With one the row groups, of at most 4 MB, are permuted,
    anew in each epoch that `set_epoch` names. Ranks get equally many, so that none waits for another: up to `world - 1`
    samples are left out.
    """

    def __init__(
        self, data: SampleDataset, seed: int | None = None, rank: int | None = None, world: int | None = None
    ) -> None:
        """rank, world: None: those of torch.distributed when a pass begins; 0 and 1 where others share the samples out.

        Raises ValueError for one without the other, or a rank that is not below `world`.
        """
        if (rank is None) != (world is None) or not 0 <= (rank or 0) < (world or 1):
            raise ValueError(f"rank={rank}, world={world}: give both, a rank from 0 to less than world, or neither")
        self._data, self._seed = data, seed
        self._given = None if rank is None or world is None else (rank, world)
        self._main = (0, 1)  # where the process stands that started this worker
        self._epoch = torch.zeros((), dtype=torch.int64).share_memory_()  # workers that stay see it move
        groups = list(data.table.row_groups())
        self._paths, number = np.unique([path for path, _, _ in groups], return_inverse=True)
        table = [(file, group, n_rows) for file, (_, group, n_rows) in zip(number.tolist(), groups)]
        self._groups = np.array(table, np.int64).reshape(-1, 3)  # file, row group, its rows

    def __getstate__(self) -> dict[str, Any]:
        """For a worker that is no copy of this process: ranks are known here alone."""
        return self.__dict__ | {"_main": self._place()}

    def set_epoch(self, epoch: int) -> None:
        """Of the passes that begin from now on."""
        self._epoch.fill_(epoch)

    def __iter__(self) -> Iterator[dict[str, Any]]:
        groups = self._groups
        if self._seed is not None:
            groups = groups[stream(self._seed, "stream", int(self._epoch)).permutation(len(groups))]
        ends = np.cumsum(groups[:, 2])
        rank, world = self._place()
        share, worker = int(groups[:, 2].sum()) // world, get_worker_info()
        number, workers = (0, 1) if worker is None else (worker.id, worker.num_workers)
        first, last = (rank * share + share * n // workers for n in (number, number + 1))  # of this process's samples
        for (file, group, n_rows), end in zip(groups.tolist(), ends.tolist()):
            start = end - n_rows
            if first < end and start < last:
                yield from self._data.rows(str(self._paths[file]), group, slice(max(first - start, 0), last - start))

    def _place(self) -> tuple[int, int]:
        """Rank and number of ranks."""
        if self._given is not None:
            return self._given
        if distributed.is_available() and distributed.is_initialized():
            return distributed.get_rank(), distributed.get_world_size()
        return (0, 1) if get_worker_info() is None else self._main


def _stacked(pictures: Sequence[Any]) -> Any:
    """Of dicts, or tensors (3, height, width), one of (B, 3, height, width), with channels last in memory as they are:
    turning them costs a quarter of decoding them."""
    if isinstance(pictures[0], Mapping):
        return {camera: _stacked([one[camera] for one in pictures]) for camera in pictures[0]}
    return default_collate([picture.permute(1, 2, 0) for picture in pictures]).permute(0, 3, 1, 2)


def _is_numeric(column: Column) -> bool:
    return column.dtype not in ("struct", "string", "binary") and not (column.nullable and column.dtype[:5] != "float")


def _is_ragged(column: Column) -> bool:
    return any(isinstance(size, str) for size in column.shape)


def _tensors(column: Column, value: Any) -> Any:
    """A value with tensors in place of arrays, and of the numbers of a numeric column."""
    if isinstance(value, list):
        return [_tensors(column, one) for one in value]
    if isinstance(value, Mapping):
        return {name: _tensors(column, one) for name, one in value.items()}
    if isinstance(value, np.ndarray):
        return torch.from_numpy(value.copy())  # Arrow's memory is not to be written to
    if not _is_numeric(column):
        return value
    return torch.from_numpy(np.full(column.shape, np.nan if value is None else value, column.dtype))


def _padded(column: Column, values: Sequence[Any]) -> tuple[Tensor, Tensor]:
    """Ragged values, padded, and where they are: (B, N, ...) and (B, N), twice ragged (B, N, M, ...) and (B, N, M)."""
    inner = replace(column, shape=column.shape[1:])
    if not _is_ragged(inner):
        here = [torch.ones(len(value), dtype=torch.bool) for value in values]
        return pad_sequence(list(values), batch_first=True), pad_sequence(here, batch_first=True)
    sizes = [size for size in inner.shape if isinstance(size, int)]
    nothing = torch.zeros(0, *sizes, dtype=getattr(torch, column.dtype))  # a batch may have no pieces at all
    counts = [1, *map(len, values)]
    flat = _padded(inner, [nothing, *chain.from_iterable(values)])
    whole, mask = (pad_sequence(part.split(counts)[1:], batch_first=True) for part in flat)
    return whole, mask
