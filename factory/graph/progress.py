"""How far a run is: a bar on a terminal, plain lines elsewhere."""

import math
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TextIO

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

from factory.wording import rate_text, time_text

LINE_EVERY_S = 15.0
ASK_EVERY_S = 2.0  # how far long tasks are


@dataclass
class Tally:
    """Counts of a run; clips that were found done at its start are not among them."""

    clips: int = 0
    accepted: int = 0
    rejected: int = 0
    failed: int = 0


@dataclass
class ProgressLine:
    """Shows a Tally against `total` clips."""

    total: int
    left_s: Callable[[float], float | None]  # seconds of the run so far -> seconds left, if that is known
    stream: TextIO = field(default_factory=lambda: sys.stderr)
    doing: Callable[[], str] = str  # how far long tasks are
    _began: float = field(default_factory=time.monotonic)
    _said: float = field(default_factory=time.monotonic)
    _bar: Progress | None = None
    _told: str = ""
    _asked: float = -math.inf

    def __post_init__(self) -> None:
        if self.stream.isatty():
            columns = (
                TextColumn("clips"),
                BarColumn(),
                TextColumn("{task.completed}/{task.total}  {task.fields[text]}"),
            )
            self._bar = Progress(*columns, console=Console(file=self.stream), transient=True)
            self._bar.add_task("", total=self.total, text="")
            self._bar.start()

    def __enter__(self) -> "ProgressLine":
        return self

    def __exit__(self, *error: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def show(self, tally: Tally, last: bool = False) -> None:
        """Update the bar; without a terminal print a line every 15 s and at the end."""
        now = time.monotonic()
        if self._bar is not None:
            self._bar.update(self._bar.task_ids[0], completed=tally.clips, text=self.text(tally, now - self._began))
        elif last or now - self._said >= LINE_EVERY_S:
            self._said = now
            text = self.text(tally, now - self._began)
            print(f"clips {tally.clips}/{self.total}  {text}", file=self.stream, flush=True)

    def text(self, tally: Tally, elapsed_s: float) -> str:
        rate = tally.clips / elapsed_s if elapsed_s > 0 else 0.0
        left_s = self.left_s(elapsed_s)
        left = "?" if left_s is None else time_text(left_s)
        counts = f"{tally.accepted} accepted, {tally.rejected} rejected, {tally.failed} failed"
        return "  ".join(filter(None, [rate_text(rate, " clips"), counts, f"ETA {left}", self._doing()]))

    def _doing(self) -> str:
        now = time.monotonic()
        if now - self._asked >= ASK_EVERY_S:
            self._asked, self._told = now, self.doing()
        return self._told
