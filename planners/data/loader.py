"""Batches of samples for a planner: one process's share of every global batch, in an order that nothing disturbs.

    loader = Loader(open_data(settings), needs, MixSettings(), batch_size=64, seed=0)
    for batch in loader.epoch(0): ...
    state = loader.state()      # after any batch; `resume(state)` in another process goes on with the next one

Threads read and decode ahead: OpenCV, zlib and Arrow do their work without the interpreter's lock. Of a data set whose
decoded pictures fit into the memory for shuffling each picture is decoded once.

Rows in memory: windows are read ahead in the order in which an epoch needs them, two of a side at a time. A row group
is read once per window, file by file, and of it only the rows that are wanted. A side that fits into one window is read
once and stays.
"""

import json
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from factory.store.location import raising_damaged_file
from planners.data.batch import Batch, Needs
from planners.data.decode import BatchBuffer, MovedRows, StoredRows, count_labels
from planners.data.files import leaf_paths
from planners.data.images import GB, PictureCache, stitch
from planners.data.index import Dataset, Feed, make_feed, order_inputs
from planners.data.jitter import check_jitter, draw_offset
from planners.data.mix import EpochOrder, MixSettings, Side, WindowKey, make_order
from tasks.world.arrays import Ints

AHEAD = 2  # windows of a side that are in memory, the one in use among them

Place = tuple[StoredRows, int]  # a row group in memory, a row of it


@dataclass(frozen=True, eq=False)
class ShuffleWindow:
    """What is wanted of one window."""

    key: WindowKey
    samples: Ints  # places in the data set, rising
    last: int  # batch after which it can go


class _PendingRows:
    """Samples that are being read, a future a file."""

    def __init__(self, futures: list[Future[dict[int, Place]]], last: int) -> None:
        self.futures, self.last = futures, last

    @property
    def is_done(self) -> bool:
        return all(future.done() for future in self.futures)

    @cached_property
    def rows(self) -> dict[int, Place]:
        return {sample: place for future in self.futures for sample, place in future.result().items()}


def open_picture_cache(feed: Feed) -> PictureCache | None:
    """Those of `data.pictures`, where there are pictures to be kept. Raises ValueError where too few can be."""
    settings, layout = feed.dataset.settings, feed.needs.image
    if settings.pictures is None or layout is None:
        return None
    kept = PictureCache(Path(settings.pictures).expanduser(), settings.pictures_gb)
    kept.check(layout)
    return kept


class WindowMemory:
    """The rows of windows that are in use or about to be, and of sides that stay."""

    def __init__(self, feed: Feed, staying: Mapping[int, Ints]) -> None:
        """staying: side -> its samples, for those that fit into one window."""
        self._feed, self._staying = feed, staying
        self.pictures = open_picture_cache(feed)
        self._stay: dict[int, _PendingRows] = {}
        self._checked: set[tuple[int, int]] = set()  # row groups whose pages were found undamaged

    def __getstate__(self) -> dict[str, Any]:
        """For another process, which reads for itself."""
        lasting = ("_feed", "_staying", "pictures", "_checked")
        return {name: self.__dict__[name] for name in lasting} | {"_stay": {}}

    def start_epoch(self, windows: Sequence[ShuffleWindow], executor: Executor) -> None:
        """Start to read for an epoch; what an earlier one left is dropped, but what stays."""
        self._executor = executor
        self._to_come = [window for window in windows if window.key[0] not in self._staying]
        self._read: dict[WindowKey, _PendingRows] = {}
        for side in sorted({window.key[0] for window in windows} & set(self._staying)):
            if side not in self._stay or any(future.cancelled() for future in self._stay[side].futures):
                self._stay[side] = self._submit(self._staying[side], 0)
        self._advance()

    def is_ready(self, key: WindowKey) -> bool:
        """Whether the rows of a window are there."""
        return self._reading(key).is_done

    def rows(self, key: WindowKey) -> Mapping[int, Place]:
        """Sample -> its row, once they are read. Raises OSError for a damaged file."""
        return self._reading(key).rows

    def release(self, batch: int) -> None:
        """No batch up to this one will ask again: windows that only they need are dropped, the next ones read."""
        for key in [key for key, reading in self._read.items() if reading.last <= batch]:
            del self._read[key]
        self._advance()

    def _reading(self, key: WindowKey) -> _PendingRows:
        if key[0] in self._staying:
            return self._stay[key[0]]
        if key not in self._read:  # a batch that is larger than two windows
            (window,) = (window for window in self._to_come if window.key == key)
            self._to_come.remove(window)
            self._read[key] = self._submit(window.samples, window.last)
        return self._read[key]

    def _advance(self) -> None:
        """Submit the next windows of every side that has fewer than AHEAD."""
        waiting = []
        for window in self._to_come:
            if sum(key[0] == window.key[0] for key in self._read) < AHEAD:
                self._read[window.key] = self._submit(window.samples, window.last)
            else:
                waiting.append(window)
        self._to_come = waiting

    def _submit(self, samples: Ints, last: int) -> _PendingRows:
        files = self._feed.dataset.rows.file[samples]
        tasks = [self._executor.submit(self._load, int(n), samples[files == n]) for n in np.unique(files)]
        return _PendingRows(tasks, last)

    def _load(self, number: int, samples: Ints) -> dict[int, Place]:
        """Rows of one file."""
        file = self._feed.dataset.files[number]
        groups = self._feed.dataset.rows.group[samples]
        found: dict[int, Place] = {}
        with raising_damaged_file(file.where):
            checked = all((number, group) in self._checked for group in groups.tolist())
            stored = file.open(check_pages=not checked)
            paths = leaf_paths(stored, self._feed.columns)
            for group in np.unique(groups).tolist():
                leaves = stored.read_row_group(group, columns=paths, use_threads=False)
                found |= self._rows(leaves, samples[groups == group])
                self._checked.add((number, group))
        return found

    def _rows(self, table: pa.Table, samples: Ints) -> dict[int, Place]:
        """Those of a row group that are wanted."""
        places = self._feed.dataset.rows.place[samples]
        if len(samples) < table.num_rows:
            table, places = table.take(places), np.arange(len(samples))
        cameras: list[tuple[str, ...]] = [()] * table.num_rows
        for sample, place in zip(samples.tolist(), places.tolist()):
            cameras[place] = self._feed.cameras[sample]
        stitched = stitch if self.pictures is None else self.pictures.stitch
        stored = StoredRows(table, cameras, stitched)
        return {sample: (stored, place) for sample, place in zip(samples.tolist(), places.tolist())}


STATE_VERSION = 1
READERS = 4
TASK = 8  # samples that a thread decodes before it looks for more work
BATCHES_AHEAD = 2


class Loader:
    """The batches of one process among `world`."""

    def __init__(
        self,
        dataset: Dataset,
        needs: Needs,
        mix: MixSettings,
        batch_size: int,
        rank: int = 0,
        world: int = 1,
        seed: int = 0,
        workers: int = 2,
        pinned: bool = False,
    ) -> None:
        """batch_size: of a global batch, over all `world` processes; workers: threads that decode.

        pinned: batches lie in memory that a GPU copies from while others compute.
        Raises ValueError where the data is not what the planner needs or the mix asks for, or a batch does not divide.
        """
        if batch_size < 1 or batch_size % world:
            raise ValueError(f"a global batch of {batch_size} samples does not divide among {world} processes")
        self.mix, self.batch_size, self.rank, self.world, self.seed = mix, batch_size, rank, world, seed
        self._needs, self._workers, self._pinned = needs, workers, pinned
        check_jitter(mix.jitter, needs)
        self._feed = make_feed(dataset, needs)
        samples = order_inputs(self._feed)
        self._order = make_order(samples, mix, batch_size, seed)
        staying = {side.number: side.rows for side in self._order.sides if side.fits}
        self._memory = WindowMemory(self._feed, staying)
        self._pictures_bytes = _kept_picture_bytes(self._order.sides, needs, mix)
        sha = sha256(dataset.digest.encode())
        if len(staying) < len(self._order.sides):  # windows depend on where samples stand
            sha.update(samples.group.tobytes() + samples.size.tobytes())
        self._digest = sha.hexdigest()[:16]
        self._position = (0, 0)  # epoch, batch
        self._resumed = False

    @property
    def dataset(self) -> Dataset:
        return self._feed.dataset

    def n_batches(self, epoch: int) -> int:
        """Batches of an epoch; the rest of its pass, less than a batch, is left out."""
        return self._order.n_batches

    def epoch(self, epoch: int) -> Iterator[Batch]:
        """The batches of an epoch; of one that was resumed in, those that are left.

        Raises ValueError for a sample that cannot be decoded and OSError for a damaged file, by name.
        """
        first = self._position[1] if self._resumed else 0
        if self._resumed and epoch != self._position[0]:
            raise ValueError(f"resumed in epoch {self._position[0]}, not {epoch}")
        self._resumed = False
        self._position = (epoch, first)
        return self._batches(epoch, first)

    def state(self) -> dict[str, Any]:
        """Where the next batch is, as JSON."""
        epoch, batch = self._position
        if batch == self._order.n_batches:
            epoch, batch = epoch + 1, 0
        return {
            "version": STATE_VERSION,
            "epoch": epoch,
            "batch": batch,
            "settings": self._settings(),
            "data": {"digest": self._digest, "samples": len(self.dataset)},
        }

    def resume(self, state: Mapping[str, Any]) -> None:
        """Go on behind the last batch that was handed out before `state`, with any number of workers and processes.

        Raises ValueError, naming what differs, where the order would be another.
        """
        if state.get("version") != STATE_VERSION:
            raise ValueError(f"a loader's state of version {state.get('version')}, this version reads {STATE_VERSION}")
        now, then = self._settings(), state["settings"]
        changed = [f"{k}: {then.get(k)} -> {now.get(k)}" for k in sorted({*now, *then}) if now.get(k) != then.get(k)]
        if changed:
            raise ValueError(f"the order of samples would change in the middle of a training: {'; '.join(changed)}")
        if state["data"]["digest"] != self._digest:
            raise ValueError(
                f"the samples are not those that the training began with: {state['data']['samples']} then, "
                f"{len(self.dataset)} now, digest {state['data']['digest']} -> {self._digest}"
            )
        self._position = (int(state["epoch"]), int(state["batch"]))
        self._resumed = True

    def text(self) -> str:
        """What is seen of what, in a few lines."""
        order, sides = self._order, self._order.sides
        batches = f"{order.n_batches} batches of {self.batch_size}"
        lines = [self.dataset.text()]
        if order.ratio is None:
            lines.append(f"an epoch is a pass over all {len(sides[0])} samples: {batches}")
        else:
            share = f"{float(order.ratio):g} of every batch are simulated"
            lines.append(f"an epoch is a pass over the {len(sides[0])} real samples: {batches}, {share}")
            if order.sim_per_epoch:
                passes = f"{order.sim_per_epoch / len(sides[1]):.2f} passes over {len(sides[1])} samples"
                lines.append(f"and {order.sim_per_epoch} times a simulated one, {passes}")
        lines.append(f"plans to imitate: {self.mix.imitation}")
        for side in sides:
            held = "stay in memory" if side.fits else f"are shuffled in windows of {side.window_bytes / 2**20:.0f} MB"
            lines.append(f"{len(side)} samples of {side.size.sum() / 2**20:.1f} MB {held}")
        if self._pictures_bytes:
            lines.append(f"{self._pictures_bytes / 2**20:.1f} MB of pictures stay decoded beside them")
        if pictures := self._memory.pictures:
            held_gb = pictures.held_bytes() / GB
            lines.append(f"decoded pictures: {held_gb:.1f} of at most {pictures.limit_gb:g} GB in {pictures.folder}")
        return "\n".join(lines)

    def _settings(self) -> dict[str, Any]:
        """What the order depends on beside the samples, as it is in JSON."""
        mix = {f"mix.{name}": value for name, value in asdict(self.mix).items()}
        settings: dict[str, Any] = {**mix, "seed": self.seed, "batch_size": self.batch_size}
        return dict(json.loads(json.dumps(settings)))

    def _batches(self, epoch: int, first: int) -> Iterator[Batch]:
        order, n = self._order.epoch(epoch), self._order.n_batches
        share = self.batch_size // self.world
        mine = slice(self.rank * share, (self.rank + 1) * share)
        rows, windows = order.rows[:, mine], order.window[:, mine]
        ahead = max(BATCHES_AHEAD, -(-2 * TASK * self._workers // share))
        readers, decoders = ThreadPoolExecutor(READERS, "read"), ThreadPoolExecutor(self._workers, "decode")
        coming: deque[tuple[Ints, BatchBuffer, list[Future[None]]]] = deque()
        try:
            self._memory.start_epoch(_windows(order, rows, windows, first), readers)
            batch = first
            while True:
                while batch < n and len(coming) < ahead and (not coming or self._ready(order, windows[batch])):
                    coming.append(self._started(epoch, order, rows[batch], windows[batch], decoders))
                    self._memory.release(batch)
                    batch += 1
                if not coming:
                    return
                done = self._finished(*coming.popleft())
                self._position = (epoch, batch - len(coming))
                yield done
        finally:
            for executor in (decoders, readers):
                executor.shutdown(wait=True, cancel_futures=True)

    def _ready(self, order: EpochOrder, windows: Ints) -> bool:
        return all(self._memory.is_ready(order.keys[window]) for window in np.unique(windows))

    def _started(
        self, epoch: int, order: EpochOrder, samples: Ints, windows: Ints, decoders: Executor
    ) -> tuple[Ints, BatchBuffer, list[Future[None]]]:
        """A batch that threads are filling."""
        by_window = {window: self._memory.rows(order.keys[window]) for window in np.unique(windows).tolist()}
        rows = [by_window[window][sample] for sample, window in zip(samples.tolist(), windows.tolist())]
        ids, simulated = self.dataset.rows.attempt_id[samples], self.dataset.rows.simulated[samples]
        n_labels = count_labels(*rows[0]) if self._needs.labels is not None else 0
        buffer = BatchBuffer(len(rows), self._needs, n_labels, self._pinned, keep_pictures=self._pictures_bytes > 0)

        def fill(start: int) -> None:
            for i in range(start, min(start + TASK, len(rows))):
                try:
                    stored, row = rows[i]
                    offset = None if simulated[i] else draw_offset(self.mix.jitter, self.seed, epoch, str(ids[i]))
                    buffer.fill(i, stored if offset is None else MovedRows(stored, offset), row)
                except Exception as error:
                    raise ValueError(f"{self.dataset.name(int(samples[i]))}: {error}") from error

        return samples, buffer, [decoders.submit(fill, start) for start in range(0, len(rows), TASK)]

    def _finished(self, samples: Ints, buffer: BatchBuffer, tasks: Sequence[Future[None]]) -> Batch:
        """The batch, once it is filled. Raises ValueError with the name of a sample that cannot be decoded."""
        for task in tasks:
            task.result()
        rows = self.dataset.rows
        simulated = rows.simulated[samples]
        imitate = {"all": np.ones_like(simulated), "real": ~simulated, "none": np.zeros_like(simulated)}
        return buffer.batch(rows.attempt_id[samples].tolist(), simulated, imitate[self.mix.imitation])


def _kept_picture_bytes(sides: Sequence[Side], needs: Needs, mix: MixSettings) -> int:
    """Bytes of the decoded pictures of all samples where they fit into mix.shuffle_mb beside the samples, else 0."""
    if needs.image is None or not all(side.fits for side in sides):
        return 0
    pictures = sum(map(len, sides)) * needs.image.height * needs.image.width * 3
    samples = sum(int(side.size.sum()) for side in sides)
    return pictures if samples + pictures <= mix.shuffle_mb * 2**20 else 0


def _windows(order: EpochOrder, rows: Ints, windows: Ints, first: int) -> list[ShuffleWindow]:
    """What is wanted of the windows from batch `first` on, in the order in which it is."""
    found = []
    batches = np.broadcast_to(np.arange(len(rows))[:, None], rows.shape)[first:]
    for number in np.unique(windows[first:]).tolist():
        inside = windows[first:] == number
        used = batches[inside]
        found.append(
            (int(used.min()), ShuffleWindow(order.keys[number], np.unique(rows[first:][inside]), int(used.max())))
        )
    return [window for _, window in sorted(found, key=lambda item: item[0])]
