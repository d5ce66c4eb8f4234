"""How far something is, a bar on a terminal, plain lines elsewhere; and how long a run will still take."""

import math
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Self, TextIO

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

from factory.wording import rate_text, time_text

LINE_EVERY_S = 15.0
ASK_EVERY_S = 2.0  # how far long tasks are


@dataclass
class Bar:
    """Shows `done` of `total` things, and a text; `before` were done when it began."""

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

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def update(self, done: int, text: Callable[[float], str], last: bool) -> None:
        """Update the bar; without a terminal print a line every 15 s and at the end. text: seconds so far -> words."""
        now = time.monotonic()
        if self._bar is not None:
            self._bar.update(self._bar.task_ids[0], completed=done, text=text(now - self._began))
        elif not self.quiet and (last or now - self._said >= LINE_EVERY_S):
            self._said = now
            print(f"{self.what} {done}/{self.total}  {text(now - self._began)}", file=self.stream, flush=True)


@dataclass
class Counter(Bar):
    """The rate and the time left by it; those done before this run are not in the rate."""

    def show(self, done: int, note: str = "") -> None:
        """So many are done."""
        self.update(done, lambda elapsed_s: self.text(done, elapsed_s, note), done >= self.total)

    def text(self, done: int, elapsed_s: float, note: str) -> str:
        """Rate, time left, note."""
        rate = (done - self.before) / elapsed_s if elapsed_s > 0 else 0.0
        left = time_text((self.total - done) / rate) if rate > 0 else "?"
        return "  ".join(filter(None, [rate_text(rate), f"ETA {left}", note]))


@dataclass
class Workload:
    """One kind of work of a run."""

    left: int = 0
    done: int = 0
    spent_s: float = 0.0  # seconds of all workers together

    def finish(self, n: int) -> None:
        """`n` of what was left are done."""
        self.left -= n
        self.done += n


@dataclass
class RunForecast:
    """All work of a run; the driver keeps it.

    A run builds blocks and settles samples: makes each that a walk was asked for, or finds that it cannot be made.
    Finished clips would be a poor measure: blocks come first and cost as much as all of a clip's samples.
    """

    blocks: Workload
    samples: Workload

    def left_s(self, elapsed_s: float) -> float | None:
        """Seconds left of a run that began `elapsed_s` ago; None as long as some kind of work has no known cost.

        Workers stay as busy as they have been.
        """
        ahead = [work for work in (self.blocks, self.samples) if work.left]
        if not ahead:
            return 0.0
        spent_s = self.blocks.spent_s + self.samples.spent_s
        if spent_s == 0.0 or not all(work.done for work in ahead):
            return None
        return elapsed_s * sum(work.spent_s * work.left / work.done for work in ahead) / spent_s


@dataclass
class Tally:
    """Counts of a run; clips that were found done at its start are not among them."""

    clips: int = 0
    accepted: int = 0
    rejected: int = 0
    failed: int = 0


@dataclass
class Executed:
    """What this run did itself, and what it found done."""

    prepared: int = 0  # clip and perturb stages computed
    from_cache: int = 0  # prepared clips taken from disk
    attempts: int = 0
    found_done: int = 0  # attempts settled by earlier runs
    episodes: int = 0  # files written
    uncached: int = 0  # prepared clips that could not be kept for later runs

    def __str__(self) -> str:
        episodes = f"; wrote {self.episodes} MCAP files" if self.episodes else ""
        return (
            f"executed {self.prepared} perturb tasks ({self.from_cache} from cache) and {self.attempts} attempts; "
            f"found {self.found_done} attempts done{episodes}"
        )


class ProgressLine(Bar):
    """Shows a Tally against `total` clips."""

    def __init__(
        self,
        total: int,
        left_s: Callable[[float], float | None],  # seconds of the run so far -> seconds left, if that is known
        stream: TextIO | None = None,
        doing: Callable[[], str] = str,  # how far long tasks are
    ) -> None:
        super().__init__("clips", total, stream=stream or sys.stderr)
        self.left_s, self.doing = left_s, doing
        self._told, self._asked = "", -math.inf

    def show(self, tally: Tally, last: bool = False) -> None:
        """So far is the run."""
        self.update(tally.clips, lambda elapsed_s: self.text(tally, elapsed_s), last)

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
