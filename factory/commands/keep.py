"""Commands that keep a run's tables in order: retry, verify, clean, compact."""

import contextlib
import re
import shlex
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, get_args

from factory.commands.look import FolderRequest
from factory.config.arguments import GIVEN_ALONE, POSITIONAL, RUN_SETTINGS, Refused
from factory.config.run import RemadeStage
from factory.exits import COMPLETE, DAMAGED
from factory.views.status import IMPORT_AGAIN, failed_lines, location_of_out, open_store
from factory.wording import MOST_SAID, printable

if TYPE_CHECKING:
    from factory.store.samples import Store
    from factory.store.verify import Verdict


MOST_LINES = 100  # that verify prints of a kind


@dataclass(frozen=True)
class RetryRequest:
    """The command line."""

    out: str
    settings: tuple[str, ...] = field(default=(), metadata=RUN_SETTINGS | GIVEN_ALONE)


def retry(request: RetryRequest) -> int:
    """`python -m factory retry out=<folder or URL>`: failed attempts once more, with the run's own settings.

        python -m factory retry out=runs/demo                   says what is tried again and how, then does it
        python -m factory retry out=runs/demo executor=local    with other settings of the run beside the recorded ones

    What it would try: python -m factory failed. The settings are those of the newest start of the run
    (current_run.json); attempts that are settled are not touched. Code that they name (`_target_`) is not called on
    the word of a table: give those settings again. A table that `import` wrote is no run: the same import again
    tries what failed. Exit codes: those of the run; 0 where nothing failed.
    """
    from factory.store.samples import imported_from

    store = open_store(request.out)
    print("\n".join(failed_lines(store)))
    if "failed" not in store.outcomes.read(["kind"])["kind"].to_pylist():
        return COMPLETE
    if source := imported_from(store.runs()):
        raise Refused(f"{store.location.uri} is no run, its rows were imported: {IMPORT_AGAIN.format(source)}")
    return _run_again(store, request.settings, "retry_failed=true")


@dataclass(frozen=True)
class RemakeRequest:
    """The command line."""

    out: str
    stages: tuple[RemadeStage, ...] = field(metadata=POSITIONAL)  # one or more
    settings: tuple[str, ...] = field(default=(), metadata=RUN_SETTINGS | GIVEN_ALONE)

    def __post_init__(self) -> None:
        if unknown := sorted(set(self.stages) - set(get_args(RemadeStage))):
            raise ValueError(f"{unknown[0]}: the stages are {', '.join(get_args(RemadeStage))}")


def remake(request: RemakeRequest) -> int:
    """`python -m factory remake <stage> out=<folder or URL>`: a stage of a finished run again, under new settings.

        python -m factory remake render out=runs/big render.width=1024 render.height=576    cameras, sizes, their gate
        python -m factory remake label out=runs/big reward.label_vocabulary=other.npy       the vocabulary labels
        python -m factory remake gate out=runs/big reward.progress_above=0.6                what the reward asks
        python -m factory remake render label out=runs/big ...                              both

    The run's recorded settings with the given ones in their place; at its end the table is as if the run had been made
    so. What the stage leaves as it was is taken over: rejections, and the pictures and labels of samples whose drive,
    made again, is the same in every bit. A changed setting of another stage is refused. A walk's rows are replaced in
    one transaction; what was killed goes on by the same command. The rows as they were stay readable, at the versions
    that run.json and `python -m factory lineage` name, until `python -m factory clean replaced=true`.
    Exit codes: those of the run.
    """
    return _run_again(open_store(request.out), request.settings, f"remake=[{','.join(request.stages)}]")


def _run_again(store: "Store", settings: Sequence[str], word: str) -> int:
    """The newest start's command where it was given, with further settings and a word of its own."""
    from factory.run import main as run

    folder, recorded = recorded_command(store, [*settings, word])
    command = [*recorded, *settings, f"out={store.location.uri}", word]
    there = Path(folder).is_dir()
    where = folder if there else f"this folder, as {folder} is not on this machine"
    print(f"\nin {where}: python -m factory run {shlex.join(command)}", flush=True)
    with contextlib.chdir(folder if there else "."):  # paths among the settings are relative to where it was started
        return run(command)


def _key_of(word: str) -> str:
    return word.lstrip("+").partition("=")[0]


def recorded_command(store: "Store", given: Sequence[str]) -> tuple[str, list[str]]:
    """The folder that the newest start was given in, and its settings less those that are `given`.

    Raises Refused where none is recorded, and where they name code: a table is data, whoever wrote it, and what is
    called on its behalf must be said by who runs it.
    """
    from factory.store.samples import CURRENT_RUN

    document = store.document(CURRENT_RUN)
    where = f"{store.location.uri}/{CURRENT_RUN}"
    if document.get("command") is None:
        raise Refused(f"{where} records no settings: run the same command with {given[-1]}")
    mine = {"out", "retry_failed", *given, *(_key_of(word) for word in given if not word.startswith("-"))}
    words = [word for word in map(str, document["command"]) if mine.isdisjoint((word, _key_of(word)))]
    code = [word for word in words if "_target_" in word or word.startswith("-")]
    if code:
        raise Refused(f"{where} names code to be called: if you trust it, give it yourself: {shlex.join(code)}")
    return str(document["folder"]), words


@dataclass(frozen=True)
class VerifyRequest:
    """The command line."""

    out: str = field(metadata=POSITIONAL)
    repair: bool = False  # what can be


def verify(request: VerifyRequest) -> int:
    """`python -m factory verify <folder or URL>`: check a run's tables, caches and episodes from their files alone.

        python -m factory verify runs/demo
        python -m factory verify runs/demo repair=true      the run's command makes again what was damaged

    Damage is a file that is missing or is not what was written, of a table, its log, the episodes, the benchmark's
    scenes or the cache; a key twice, a round out of order. Orphans are harmless: files that no commit names, left
    behind by a run that died; readers ignore them and `python -m factory clean` removes them. repair=true puts
    damaged logs and run.json back from the copies beside them and takes damaged files out of the tables, a transaction
    each; nothing else is touched, and rounds whose earlier ones went are told as missing. It waits for no run: while
    one writes here it is refused. Exit code 1: damaged, after a repair what it could not put right.
    """
    from factory.stages.assets import damaged_blocks
    from factory.store.location import BadLocation
    from factory.store.samples import OtherSchema, refuse_other_schema
    from factory.store.table import AnotherWriter, DamagedLog
    from factory.store.verify import (
        RunInProgress,
        claim_for_upkeep,
        damaged_beside_logs,
        damaged_logs,
        drop_damaged,
        restore_logs,
    )

    out = location_of_out(request.out)
    try:
        refuse_other_schema(out)
        if request.repair:
            _print_some("put back", restore_logs(out))
        if found := damaged_logs(out):
            told = [str(part) for part in (*found, *damaged_beside_logs(out))]
            told += [f"{name}: {problem}" for name, problem in damaged_blocks(out).items()]
            _print_some("DAMAGED", told)
            how = "repair=true puts the tables' logs back first"
            if request.repair:
                how = (
                    "neither what is in the logs nor its copy tells what was written; put them back from a copy of out"
                )
            print(f"{len(told)} damages; rows were not read: {how}")
            return DAMAGED
        store = open_store(request.out)
        verdict = _verify_again(request.out)
        if request.repair and verdict.files:
            claim_for_upkeep(store)
            drop_damaged(store, verdict)
            _print_some("taken out", verdict.files)
            verdict = _verify_again(request.out)
    except DamagedLog as error:
        print(f"DAMAGED {error}")
        return DAMAGED
    except (RunInProgress, AnotherWriter, BadLocation, OtherSchema) as error:
        raise Refused(str(error)) from error
    _print_some("DAMAGED", verdict.damage)
    _print_some("orphan ", verdict.orphans)
    _print_some("missing", [f"{line}: the run's command makes the others again" for line in verdict.missing])
    print(f"{verdict.n_samples} samples, {len(verdict.damage)} damages, {len(verdict.orphans)} orphans")
    if verdict.files:
        print(
            "repair=true takes the damaged files out; the run's command then makes again what they held",
            file=sys.stderr,
        )
    return DAMAGED if verdict.damage else COMPLETE


def _print_some(kind: str, lines: Sequence[str]) -> None:
    """A line each, which may quote files, as many as a person reads."""
    for line in lines[:MOST_LINES]:
        print(f"{kind} {printable(line[:MOST_SAID])}")
    if len(lines) > MOST_LINES:
        print(f"{kind} and {len(lines) - MOST_LINES:,} more")


def _verify_again(out: str) -> "Verdict":
    """Of the tables and of the blocks in the cache, opened anew."""
    from factory.stages.assets import damaged_blocks
    from factory.store.verify import verify

    store = open_store(out)
    found, blocks = verify(store), damaged_blocks(store.location)
    damage = (*found.damage, *(f"{name}: {problem}" for name, problem in blocks.items()))
    return replace(found, damage=damage, files=(*found.files, *blocks))


UNITS_S = {"d": 86_400.0, "h": 3600.0, "min": 60.0}


@dataclass(frozen=True)
class CleanRequest:
    """The command line."""

    out: str
    older_than: str = "1d"  # days, hours or minutes, as 7d, 12h, 30min: what is younger stays
    say: bool = False  # and remove nothing
    replaced: bool = False  # the rows that remakes replaced, too

    def __post_init__(self) -> None:
        _ = self.older_s

    @property
    def older_s(self) -> float:
        """Raises ValueError for what is no time."""
        told = re.fullmatch(r"(\d+(?:\.\d+)?)(d|h|min)", self.older_than)
        if told is None:
            raise ValueError(
                f"older_than={self.older_than}: must be a number of days, hours or minutes: 7d, 12h, 30min"
            )
        return float(told[1]) * UNITS_S[told[2]]


def clean(request: CleanRequest) -> None:
    """`python -m factory clean out=<folder or URL>`: remove what runs that died left behind.

        python -m factory clean out=runs/demo                     what was last written a day ago or earlier
        python -m factory clean out=runs/demo older_than=2h       days, hours or minutes: 7d, 12h, 30min
        python -m factory clean out=runs/demo say=true            name them and remove nothing
        python -m factory clean out=runs/demo replaced=true       and the rows that remakes replaced

    These are temporary files, files in the tables' folders that no commit names, and episodes of rows that were
    replaced. A reader that was opened before rows were replaced or shards merged still reads what they stood in:
    leave it its time. While a run writes here the command is refused.
    """
    from factory.store.location import BadLocation
    from factory.store.remake import is_interrupted_remake
    from factory.store.table import AnotherWriter
    from factory.store.verify import RunInProgress, claim_for_upkeep, old_leftovers, refuse_while_running

    store = open_store(request.out)
    try:
        (refuse_while_running if request.say else claim_for_upkeep)(store)
        if request.replaced and is_interrupted_remake(store):
            raise Refused(f"{store.location.uri}: its remake, which takes these rows over, is not finished")
        found = old_leftovers(store, request.older_s, time.time(), request.replaced)
    except (RunInProgress, AnotherWriter, BadLocation, OSError) as error:
        raise Refused(str(error)) from error
    for name in found:
        if not request.say:
            store.location.remove(name)
        print(f"{'leftover' if request.say else 'removed'}  {name}")
    print(f"{len(found)} files older than {request.older_than}")


def compact(request: FolderRequest) -> None:
    """`python -m factory compact out=<folder or URL>`: merge the small shards of a run into larger ones.

    Of each round and expert, files below 64 MB are merged into files of up to 128 MB, one transaction a table. No
    sample changes: readers, trainings and their order are the same before and after. What was merged is left for
    readers that are open; `python -m factory clean` removes it. While a run writes here the command is refused.
    """
    from factory.store.location import BadLocation
    from factory.store.table import AnotherWriter
    from factory.store.verify import RunInProgress, claim_for_upkeep
    from factory.store.verify import compact as merge_shards

    store = open_store(request.out)
    try:
        claim_for_upkeep(store)
        for table, before, after in merge_shards(store):
            print(f"{table:<13}{before} files, now {after}")
    except (RunInProgress, AnotherWriter, BadLocation) as error:
        raise Refused(str(error)) from error
