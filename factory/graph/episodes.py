"""Episodes beside the table of samples, made of what is committed: files for people, one for every chosen sample.

The tables say which files there are to be. A file's name holds the sample and what its row was made under, so that a
name that is there is written, whole and of the present row: what a killed run left out the next one makes up for, and
what a redo replaced goes. Which samples are chosen follows from their ids, whatever the order they were made in.
"""

import re
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from factory.graph.local import Graph, Ticket
from factory.graph.steps import EpisodesOf, EpisodesWritten, Failure, MakeEpisode
from factory.readers.base import ClipRef
from factory.store.mcap_files import FOLDER, episode_name, is_chosen
from factory.store.samples import Store

ROWS = ["attempt_id", "clip_id", "settings_hash", "stage_versions"]
PER_TASK = 4  # episodes, some 0.1 to 1 s each
OURS = re.compile(r"[0-9A-Za-z_-]+-[0-9a-f]{8}\.mcap|\..*\.tmp")  # names that may be tidied away; drafts too


@dataclass(frozen=True)
class EpisodesWanted:
    """Which samples are to have an episode, and what makes it."""

    every: int  # 1 all, n one in n
    make: MakeEpisode  # a function that workers can import


class Episodes:
    """Keeps the episodes of a run in step with its table: says what is missing and has tasks write it."""

    def __init__(self, store: Store, wanted: EpisodesWanted, refs: Iterable[ClipRef]) -> None:
        """refs: the run's clips; episodes of others are left as they are."""
        self._store, self._wanted = store, wanted
        self._refs = {ref.clip_id: ref for ref in refs}
        self._folder = store.location.child(FOLDER)
        self._there = set(self._folder.names())
        self._queue: deque[EpisodesOf] = deque()
        self._writing: set[Ticket] = set()
        self._graph: Graph | None = None
        self.written = 0
        self.errors: list[str] = []
        for path, partition in sorted(store.samples.live_files().items()):
            self._look(path, partition)

    @property
    def is_due(self) -> bool:
        return bool(self._queue or self._writing)

    def begin(self, graph: Graph) -> None:
        self._graph = graph
        self._submit()

    def tidy(self) -> None:
        live = {episode_name(row) for row in self._store.samples.read(ROWS).to_pylist()}
        for name in sorted(set(self._folder.names()) - live):
            if OURS.fullmatch(name):
                self._folder.remove(name)

    def committed(self, paths: Sequence[str]) -> None:
        live = self._store.samples.live_files()
        for path in paths:
            if path in live:
                self._look(path, live[path])
        self._submit()

    def finished(self, ticket: Ticket, report: Any) -> bool:
        if ticket not in self._writing:
            return False
        self._writing.remove(ticket)
        told = EpisodesWritten(0, (report.error,)) if isinstance(report, Failure) else report
        self.written += told.written
        self.errors += [error.splitlines()[-1] for error in told.errors]
        self._submit()
        return True

    def stop(self) -> None:
        self._queue.clear()

    def _look(self, path: str, partition: Mapping[str, str]) -> None:
        missing: dict[str, ClipRef] = {}
        for row in self._store.samples.read_file(path, partition, ROWS).to_pylist():
            name = episode_name(row)
            chosen = is_chosen(row["attempt_id"], self._wanted.every)
            if chosen and name not in self._there and row["clip_id"] in self._refs:
                missing[row["attempt_id"]] = self._refs[row["clip_id"]]
                self._there.add(name)  # asked for once
        keys = sorted(missing)
        for i in range(0, len(keys), PER_TASK):
            refs = {key: missing[key] for key in keys[i : i + PER_TASK]}
            self._queue.append(EpisodesOf(path, partition, refs, self._wanted.make))

    def _submit(self) -> None:
        """A few at once: walks and episodes share the cores."""
        assert self._graph is not None, "begin() comes first"
        while self._queue and len(self._writing) < self._graph.parallelism:
            self._writing.add(self._graph.submit("episodes", self._queue.popleft()))
