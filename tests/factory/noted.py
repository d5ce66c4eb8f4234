"""The real work of a run, with a journal: for tests of where on a cluster which of its tasks are done."""

import json
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass

from factory.graph.steps import (
    AcceptedDrive,
    BlockReport,
    PreparedClip,
    RejectedAttempt,
    SampleColumns,
    StopCheck,
    never_stop,
)
from factory.pipeline import FactoryWork
from factory.readers.base import ClipRef
from tasks.stages import Rejected
from tests.factory.toy import where


@dataclass(frozen=True)
class NotedWork(FactoryWork):
    """A run that notes on which node, from when to when, it does what; it draws with the CPU whatever it claims."""

    journal: str = ""

    @contextmanager
    def noted(self, task: str) -> Iterator[None]:
        began = time.time()
        yield
        with open(self.journal, "a") as file:
            file.write(json.dumps([task, where().split()[1], began, time.time()]) + "\n")

    def reconstruct(self, ref: ClipRef, threads: int, stopped: StopCheck = never_stop) -> BlockReport:
        with self.noted("reconstruct"):
            return super().reconstruct(ref, threads, stopped)

    def prepare(self, ref: ClipRef) -> PreparedClip | Rejected:
        with self.noted("perturb"):
            return super().prepare(ref)

    def drive(self, prepared: PreparedClip, candidate: int, expert: str) -> AcceptedDrive | RejectedAttempt:
        with self.noted("drive"):
            return super().drive(prepared, candidate, expert)

    def draw(self, driven: Sequence[AcceptedDrive]) -> list[SampleColumns | RejectedAttempt]:
        with ExitStack() as each:
            for _ in driven:
                each.enter_context(self.noted("render"))
            return super().draw(driven)

    def label(self, driven: AcceptedDrive) -> SampleColumns:
        with self.noted("label"):
            return super().label(driven)
