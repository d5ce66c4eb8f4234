"""How long a run will still take: what is left to do, at what the same has cost so far.

A run builds blocks and settles samples: makes each that a walk was asked for, or finds that it cannot be made. Finished
clips would be a poor measure, since blocks come first and cost as much as all of a clip's samples.
"""

from dataclasses import dataclass


@dataclass
class Work:
    """One kind of work of a run."""

    left: int = 0
    done: int = 0
    spent_s: float = 0.0  # seconds of all workers together

    def finish(self, n: int) -> None:
        """`n` of what was left are done."""
        self.left -= n
        self.done += n


@dataclass
class Forecast:
    """All work of a run; the driver keeps it."""

    blocks: Work
    samples: Work

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
