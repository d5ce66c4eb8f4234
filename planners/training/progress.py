"""How far a count is: a bar on a terminal, plain lines elsewhere."""

import sys
import time
from dataclasses import dataclass, field
from typing import TextIO

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

from factory.wording import rate_text, time_text

LINE_EVERY_S = 15.0


@dataclass
class Counter:
    """Shows `done` of `total` things with rate and time left; those done before this run are not in the rate."""

    what: str
    total: int
    before: int = 0
    stream: TextIO = field(default_factory=lambda: sys.stderr)
    quiet: bool = False
    _began: float = field(default_factory=time.monotonic)
    _said: float = field(default_factory=time.monotonic)
    _bar: Progress | None = None

    def __post_init__(self) -> None:
        if self.stream.isatty() and not self.quiet:
            columns = (
                TextColumn(self.what),
                BarColumn(),
                TextColumn("{task.completed}/{task.total}  {task.fields[text]}"),
            )
            self._bar = Progress(*columns, console=Console(file=self.stream), transient=True)
            self._bar.add_task("", total=self.total, completed=self.before, text="")
            self._bar.start()

    def __enter__(self) -> "Counter":
        return self

    def __exit__(self, *error: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def show(self, done: int, note: str = "") -> None:
        """Update the bar; without a terminal print a line every 15 s and at the end."""
        if self.quiet:
            return
        now = time.monotonic()
        if self._bar is not None:
            self._bar.update(self._bar.task_ids[0], completed=done, text=self.text(done, now - self._began, note))
        elif done >= self.total or now - self._said >= LINE_EVERY_S:
            self._said = now
            text = self.text(done, now - self._began, note)
            print(f"{self.what} {done}/{self.total}  {text}", file=self.stream, flush=True)

    def text(self, done: int, elapsed_s: float, note: str) -> str:
        """Rate, time left, note."""
        rate = (done - self.before) / elapsed_s if elapsed_s > 0 else 0.0
        left = time_text((self.total - done) / rate) if rate > 0 else "?"
        return "  ".join(filter(None, [rate_text(rate), f"ETA {left}", note]))
