"""`python -m planners drive planner=<who>`: closed loop, from logged or perturbed starts as long as the log goes on.

    python -m planners drive planner=runs/ltf
    python -m planners drive planner=runs/ltf pictures=[truth,engine] perturbed=2 films=all out=runs/drives
    python -m planners drive clips=av2 clips.root=/data/av2/val planners=[runs/a,runs/b] pictures=engine executor=ray

Who may stand under `planner=`, planners/evaluation/planner_names.py says. It is AlpaSim's loop: every 0.5 s the planner
is asked by its messages, in process or over the wire, and its MPC follows the plan. docs/driving.md says what is
measured.

    out/drives          a Delta table, one row a drive, AlpaSim's columns; what stands there is not driven again
    out/summary.csv     all planners of this command, with intervals
    out/results-summary.json   the same in AlpaSim's form
    out/differences.csv what the engine's pictures change, of planners that drove with both
    out/films           MP4 files, as many as films= says

Exit codes: 0 complete, 2 settings or files that do not fit, 3 some drives could not be made, 4 interrupted, and the
same command goes on.
"""

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, fields, replace
from pathlib import Path

from factory.alpasim import wire
from factory.config.arguments import command
from factory.config.compose import ConfigError, need_run_extra
from factory.exits import Failed, Stopped
from factory.files import why_unusable
from factory.graph.own_process import run_command_in_own_process
from factory.graph.parallel import WorkerDied, parallel_map
from factory.graph.progress import RateBar
from factory.graph.steps import TaskStopped
from factory.readers.base import ClipRef, painter_of
from factory.store.location import Location
from factory.store.table import AnotherWriter, KeyedTable
from planners.drive.alpasim_score import AlpasimColumns, SummaryEntry, results_summary
from planners.drive.contract import WIRE, planner_over_the_wire
from planners.drive.drivers import make_driver
from planners.drive.settings import DriveSettings, Pictures, settings_of
from planners.drive.starts import LOGGED
from planners.drive.summary import Row, picture_source_effects, summarise_drives, summary_text, write_summary
from planners.drive.work import (
    FACTS,
    DriveItem,
    DriveWork,
    DrivingPlanner,
    FailedDrive,
    RowCommitter,
    open_drives,
)
from planners.evaluation.planner_names import EvaluatedPlanner, find_planners
from tasks.render.scene import engine
from tasks.render.splatting.gsplat_backend import BackendMissing

SHOWN_FAILURES = 5


@dataclass(frozen=True)
class RequestedDrives:
    """Drives that a command asks for, whether they are made or not."""

    work: DriveWork
    items: Sequence[DriveItem]
    broken: Mapping[ClipRef, str]
    planners: Sequence[str]  # labels, in order

    def rows(self, table: KeyedTable) -> list[Row]:
        """Those of the table, by planner and clip, under the labels of now."""
        found = {row["drive_id"]: row for row in table.read(FACTS).to_pylist()}
        asked = [(who.label, found.get(key.drive_id)) for item in self.items for who, key in item.keys]
        rows = [row | {"planner": label} for label, row in asked if row is not None]
        return sorted(rows, key=lambda row: self.planners.index(row["planner"]))


def drive_all(settings: DriveSettings) -> tuple[list[Row], list[FailedDrive]]:
    """Drive what is not driven yet: the rows of all that were asked for, by planner and clip, and what could not be.

    Raises ConfigError; Stopped where it was interrupted, a process died or another command drives here.
    """
    if unusable := why_unusable(settings.out):
        raise ConfigError(unusable)
    asked = _requested_drives(settings)
    table = open_drives(asked.work.out)
    failed = [FailedDrive(ref.clip_id, why) for ref, why in asked.broken.items()]
    try:
        table.claim()
        failed += _drive(asked.work, asked.items, table)
    except (TaskStopped, KeyboardInterrupt) as error:
        raise Stopped("interrupted; what is driven is kept, and the same command goes on") from error
    except (WorkerDied, AnotherWriter) as error:
        raise Stopped(str(error)) from error
    return asked.rows(table), failed


def _requested_drives(settings: DriveSettings) -> RequestedDrives:
    from factory.setup.settings import choose_vocabulary, open_reader  # half a second that no refusal waits for

    planners: list[tuple[DrivingPlanner, tuple[Pictures, ...]]] = []  # and which pictures each is shown
    for one in _asked(settings):
        looks = one.spec.startswith(WIRE) or make_driver(one).needs_pictures
        planners.append((DrivingPlanner(one.label, one.spec, one.digest), settings.pictures if looks else ("none",)))
    reader, index = open_reader(settings.clips)
    if any("truth" in kinds for _, kinds in planners) and painter_of(reader) is None:
        raise ConfigError("pictures=truth is the painter's of the synthetic town: give pictures=engine for these clips")
    if any("engine" in kinds for _, kinds in planners):
        try:
            engine.require_backend(settings.render.backend)
        except BackendMissing as error:
            raise ConfigError(str(error)) from error
    out = Location.parse(settings.out)
    work = DriveWork(reader, choose_vocabulary(settings.vocabulary), settings, out)
    refs = [ref for ref in index.refs if not settings.only_logs or ref.log_id in settings.only_logs]
    if settings.only_logs and not refs:
        raise ConfigError(f"only_logs={settings.only_logs[0]}: none of the {len(index.refs)} clips is of it")
    items = list(_items(work, refs[: settings.limit], planners))
    return RequestedDrives(work, items, index.broken, [who.label for who, _ in planners])


def _asked(settings: DriveSettings) -> list[EvaluatedPlanner]:
    """Who drives. Raises ConfigError, also without the messages' package."""
    wire.contract("planners drive", "planners")
    if settings.driver is None:
        return find_planners(settings.planner, settings.planners, settings.bounds, settings.settings)
    if settings.planner is not None or settings.planners is not None:
        raise ConfigError("driver= stands in the place of planner= and planners=: give one of them")
    return [planner_over_the_wire(settings.driver)]


def _items(
    work: DriveWork, refs: Sequence[ClipRef], planners: Sequence[tuple[DrivingPlanner, tuple[Pictures, ...]]]
) -> Iterator[DriveItem]:
    """All drives of a clip that see the same are one item: its world is at hand once."""
    settings = work.settings
    starts = ([LOGGED] if settings.logged else []) + list(range(settings.perturbed))
    kinds = list(dict.fromkeys(kind for _, kinds in planners for kind in kinds))
    for ref in refs:
        for kind in kinds:
            who = [one for one, seen in planners if kind in seen]
            keys = [(one, work.key_of(ref, start, one, kind)) for start in starts for one in who]
            yield DriveItem(ref, kind, tuple(keys))


def _drive(work: DriveWork, items: Sequence[DriveItem], table: KeyedTable) -> list[FailedDrive]:
    """Make the drives that the table does not hold and commit them as they come; those that could not be made."""
    done = set(table)
    waiting = [replace(item, keys=left) for item in items if (left := item.missing(done))]
    total = sum(len(item.keys) for item in items)
    failed: list[FailedDrive] = []
    settings, rows = work.settings, RowCommitter(table)
    n_done = total - sum(len(item.keys) for item in waiting)
    try:
        with (
            RateBar("drives", total, before=n_done) as progress,
            closing(parallel_map(work, waiting, settings.executor, settings.workers, work.out)) as results,
        ):
            for made in results:
                rows.add(row for row in made if not isinstance(row, FailedDrive))
                failed += [row for row in made if isinstance(row, FailedDrive)]
                n_done += len(made)
                progress.show(n_done)
    finally:
        rows.close()
    return failed


@command("drive", DriveSettings)
def main(argv: Sequence[str]) -> int | None:
    """Drive and print what a command line asks for. Raises ConfigError, Failed, Stopped."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    settings = settings_of(argv)
    if settings.executor == "ray":
        need_run_extra("ray")
        return run_command_in_own_process(_main_on_ray, tuple(argv))
    _drive_and_print(settings)
    return None


def _main_on_ray(argv: Sequence[str]) -> int:
    return replace(main, does=lambda words: _drive_and_print(settings_of(words)))(argv)


def _drive_and_print(settings: DriveSettings) -> None:
    rows, failed = drive_all(settings)
    if rows:
        lines, apart = summarise_drives(rows, settings.confidence), picture_source_effects(rows, settings.confidence)
        print(summary_text(lines, apart, settings.confidence))
        place = Location.parse(settings.out)
        place.write("results-summary.json", _results_summary(rows, failed).encode())
        if place.is_local:  # on an object store the table of drives says all
            write_summary(Path(place.uri), lines, apart)
            print(f"look at {place.uri}")
    if failed:
        shown = "; ".join(f"clip {one.clip_id}: {one}" for one in failed[:SHOWN_FAILURES])
        raise Failed(f"{len(failed)} drives or clips could not be driven: {shown}")


def _results_summary(rows: Sequence[Row], failed: Sequence[FailedDrive]) -> str:
    names = [field.name for field in fields(AlpasimColumns)]
    entries = [
        SummaryEntry(
            row["planner"], row["clip_id"], row["drive_id"], AlpasimColumns(**{name: row[name] for name in names})
        )
        for row in rows
    ]
    labels = dict.fromkeys(row["planner"] for row in rows)
    for one in failed:
        who = [one.planner] if one.planner else labels
        entries += [SummaryEntry(label, one.clip_id, "failed", None, one.why) for label in who]
    return results_summary(entries)
