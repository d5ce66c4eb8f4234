"""Which clips may be prepared: each waits for the block that it is rendered from, and that is built once, as a task.

Clips keep their order but for those that wait; as many blocks are built at once as there are workers.
"""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from factory.graph.plan import ClipPlan, wants_payload
from factory.readers.base import ClipRef

BlockOf = Callable[[ClipRef], str | None]


@dataclass(frozen=True)
class Build:
    """The next task: the block of this clip."""

    block: str
    ref: ClipRef


class BlockQueue:
    """The clips of a plan, handed out one by one."""

    def __init__(self, clips: Sequence[ClipPlan], block_of: BlockOf, workers: int) -> None:
        self._ahead = deque(clips)
        self._ready: deque[ClipPlan] = deque()  # their block is built
        self._waiting: dict[str, list[ClipPlan]] = {}  # block that is being built -> clips
        self._built: set[str] = set()
        self._block_of = block_of
        needed = {block_of(clip.ref) for clip in clips if wants_payload(clip)} - {None}
        self.n_blocks = len(needed)
        self.at_once = max(1, min(workers, self.n_blocks))

    def __bool__(self) -> bool:
        """Some clip has not been handed out."""
        return bool(self._ahead or self._ready or self._waiting)

    def next(self, wanted: bool) -> ClipPlan | Build | None:
        """A clip to begin with, if one is `wanted`, or a block to build; None: nothing for now."""
        if wanted and self._ready:
            return self._ready.popleft()
        while self._ahead:
            clip = self._ahead[0]
            block = self._block_of(clip.ref) if wants_payload(clip) else None
            if block is None or block in self._built:
                return self._ahead.popleft() if wanted else None
            if block in self._waiting:
                self._waiting[block].append(self._ahead.popleft())
            elif len(self._waiting) < self.at_once:
                self._waiting[block] = [self._ahead.popleft()]
                return Build(block, clip.ref)
            else:
                return None
        return None

    def built(self, block: str) -> None:
        """Its clips may go on, also where building failed: each of them will say so itself."""
        self._built.add(block)
        self._ready.extend(self._waiting.pop(block))
