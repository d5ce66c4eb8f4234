"""`python -m factory verify <folder or URL>`: check a run's tables, caches and episodes from their files alone.

    python -m factory verify runs/demo
    python -m factory verify runs/demo repair=true      the run's command makes again what was damaged

Damage is a file that is missing or is not what was written, of a table, its log, the episodes, the benchmark's scenes
or the cache; a key twice, a round out of order. Orphans are harmless: files that no commit names, left behind by a run
that died; readers ignore them and `python -m factory clean` removes them.
repair=true puts a damaged log back from the copies beside it and takes damaged files out of the tables, a transaction
each; nothing else is touched. It waits for no run: while one writes here it is refused.
Exit code 1: damaged, after a repair what it could not put right.
"""

import sys
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from factory.config.arguments import POSITIONAL, Refused
from factory.exits import COMPLETE, DAMAGED
from factory.views.status import open_store, out_of

if TYPE_CHECKING:
    from factory.store.verify import Verdict


@dataclass(frozen=True)
class Request:
    """The command line."""

    out: str = field(metadata=POSITIONAL)
    repair: bool = False  # what can be


def main(request: Request) -> int:
    """Print the verdict, after the repair where one is asked for."""
    from factory.store.location import BadLocation
    from factory.store.samples import OtherSchema, refuse_other_schema
    from factory.store.table import AnotherWriter, DamagedLog
    from factory.store.verify import RunInProgress, claim_for_upkeep, damaged_logs, drop_damaged, restore_logs

    out = out_of(request.out)
    try:
        refuse_other_schema(out)
        if request.repair:
            for name in restore_logs(out):
                print(f"put back {name}")
        if found := damaged_logs(out):
            for name, damage in found:
                print(f"DAMAGED {name}/{damage.name}: {damage.problem}")
            print(f"{len(found)} damages of the tables' logs; the tables were not read. repair=true puts them back")
            return DAMAGED
        store = open_store(request.out)
        verdict = _verify_again(request.out)
        if request.repair and verdict.files:
            claim_for_upkeep(store)
            drop_damaged(store, verdict)
            for name in verdict.files:
                print(f"taken out {name}")
            verdict = _verify_again(request.out)
    except DamagedLog as error:
        print(f"DAMAGED {error}")
        return DAMAGED
    except (RunInProgress, AnotherWriter, BadLocation, OtherSchema) as error:
        raise Refused(str(error)) from error
    for line in verdict.damage:
        print(f"DAMAGED {line}")
    for line in verdict.orphans:
        print(f"orphan  {line}")
    print(f"{verdict.n_samples} samples, {len(verdict.damage)} damages, {len(verdict.orphans)} orphans")
    if verdict.files:
        print(
            "repair=true takes the damaged files out; the run's command then makes again what they held",
            file=sys.stderr,
        )
    return DAMAGED if verdict.damage else COMPLETE


def _verify_again(out: str) -> "Verdict":
    """Of the tables and of the blocks in the cache, opened anew."""
    from factory.stages.assets import damaged_blocks
    from factory.store.verify import Verdict, verify

    store = open_store(out)
    found, blocks = verify(store), damaged_blocks(store.location)
    damage = (*found.damage, *(f"{name}: {problem}" for name, problem in blocks.items()))
    return Verdict(found.n_samples, damage, found.orphans, (*found.files, *blocks))
