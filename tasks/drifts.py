"""Drifts: motions that a planner drove itself into, which perturb a clip as vocabulary trajectories do.

A vocabulary says where an ego could be, a planner's own drive where it will be. To label the states that the learner
itself comes to is DAgger (Ross, Gordon and Bagnell 2011); here an expert does, where the reward accepts it.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from tasks.world.arrays import Array

OF_LOG = -1  # stands for the log itself where a vocabulary trajectory has its row


@dataclass(frozen=True)
class Drift:
    """Where a planner drove from the log, and how it did from there."""

    number: int  # names it among its clip's, 0 ...
    ego_states: Array  # (41, 11) T .. T+H, world; row 0 is the log's
    score: float  # EPDMS (/14) of its own drive from T+H on
    fails: str  # the first sub-score for which the reward would reject that drive; "": none


def index_of(number: int) -> int:
    """What stands for a drift where a vocabulary trajectory has its row: -2 - number."""
    return OF_LOG - 1 - number


def number_of(index: int) -> int | None:
    """The drift that `index_of` made this index from; None where it is the log or a row of the vocabulary."""
    return OF_LOG - 1 - index if index < OF_LOG else None


def worst_first(drifts: Sequence[Drift]) -> list[int]:
    """Places of those where the planner then failed, then of the others, each by its score; ties by number."""

    def rank(place: int) -> tuple[bool, float, int]:
        one = drifts[place]
        return not one.fails, one.score, one.number

    return sorted(range(len(drifts)), key=rank)


def alternating(first: Sequence[int], second: Sequence[int]) -> Iterator[int]:
    """One of either in turn; when one is at its end, what is left of the other."""
    shared = min(len(first), len(second))
    for pair in zip(first, second):
        yield from pair
    yield from (*first[shared:], *second[shared:])
