"""`python -m factory verify <folder or URL>`: check a run's tables, episodes and keys from their files alone.

Damage is a file that is missing or fails its checksums, a key twice, a round out of order, an episode that is not
whole. Orphans are harmless: files that no commit names, left behind by a run that died; readers ignore them.
Exit code 1: damaged.
"""

from dataclasses import dataclass, field

from factory.config.arguments import WORD
from factory.exits import COMPLETE, DAMAGED
from factory.views.status import open_store


@dataclass(frozen=True)
class Request:
    """The command line."""

    out: str = field(metadata=WORD)


def main(request: Request) -> int:
    """Print the verdict."""
    from factory.store.verify import verify

    verdict = verify(open_store(request.out))
    for line in verdict.damage:
        print(f"DAMAGED {line}")
    for line in verdict.orphans:
        print(f"orphan  {line}")
    print(f"{verdict.n_samples} samples, {len(verdict.damage)} damages, {len(verdict.orphans)} orphans")
    return DAMAGED if verdict.damage else COMPLETE
