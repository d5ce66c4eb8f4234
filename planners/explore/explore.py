"""`python -m planners explore planner=<who>`: where a planner drives itself in the clips.

    python -m planners explore planner=runs/ltf out=runs/explored
    python -m planners explore planner=runs/ltf clips=av2 clips.root=/data/av2/train pictures=engine executor=ray
    python -m factory.run explore=runs/explored out=runs/explored_data

From the log at T and 1, 2 and 3 s later the planner drives in closed loop up to T+H, and once in open loop; where it is
then, the factory takes for candidates beside the vocabulary's. Then it drives on for H, and where the reward would
reject that drive it fails: such candidates are tried first. docs/exploring.md says more.

    out/explored        a Delta table, one row a clip; what stands there is not driven again

Exit codes: 0 complete, 2 settings or files that do not fit, 3 some clips could not be explored, 4 interrupted, and the
same command goes on.
"""

import os
from collections import Counter
from collections.abc import Sequence
from contextlib import closing
from functools import partial

from factory.config.compose import ConfigError, need_run_extra
from factory.graph.each import WorkerDied, each
from factory.graph.progress import Counter as Progress
from factory.graph.work import Halted
from factory.readers.base import ClipReader, ClipRef
from factory.setup.settings import open_reader
from factory.store.disk import why_unusable
from factory.store.explored.table import ExploredClip, explored_clips, open_explored, write_explored
from factory.store.location import Location
from factory.store.table import AnotherWriter, KeyedTable
from planners.command import Failed, Stopped, command
from planners.drive.drivers import PlannerDriver, driver_of
from planners.drive.table import Committer
from planners.drive.work import DrivingPlanner, NotDriven, reads_towns
from planners.evaluation.planner_names import EvaluatedPlanner, needs_of, planner_of
from planners.explore.settings import ExploreSettings, settings_of
from planners.explore.work import ExploreWork
from tasks.render.scene import engine
from tasks.render.splatting.gsplat_backend import BackendMissing

SHOWN_FAILURES = 5


def explore(settings: ExploreSettings) -> tuple[list[ExploredClip], list[NotDriven]]:
    """Explore what is not explored yet: the rows of all clips that were asked for, and what could not be.

    Raises ConfigError, also where `out` is another planner's, Halted where it was interrupted, WorkerDied,
    AnotherWriter.
    """
    if settings.planner is None:
        raise ConfigError("planner is missing: give planner=<training folder>")
    if unusable := why_unusable(settings.out):
        raise ConfigError(unusable)
    one = planner_of(settings.planner, changed=settings.settings)
    reader, index = open_reader(settings.clips)
    work = _work(settings, one, reader)
    refs, table = index.refs[: settings.limit], open_explored(work.out)
    _refuse_another(table, work)
    table.claim()
    failed = [NotDriven(ref.clip_id, why) for ref, why in index.broken.items()]
    failed += _explore(work, refs, table)
    wanted = {ref.clip_id for ref in refs}
    return [row for row in explored_clips(table.read()) if row.clip_id in wanted], failed


def _work(settings: ExploreSettings, one: EvaluatedPlanner, reader: ClipReader) -> ExploreWork:
    """Raises ConfigError where a planner that looks has nothing to look at."""
    driver = driver_of(one, settings.pdm)
    says_so = isinstance(driver, PlannerDriver) and needs_of(driver.made) is not None  # that it looks, if it does
    if settings.pictures == "none" and driver.needs_pictures and says_so:
        raise ConfigError(f"planner={settings.planner} looks: give pictures=truth or pictures=engine")
    looks = driver.needs_pictures and settings.pictures != "none"
    if looks and settings.pictures == "truth" and not reads_towns(reader):
        raise ConfigError("pictures=truth is the painter's of the synthetic town: give pictures=engine for these clips")
    if looks and settings.pictures == "engine":
        try:
            engine.check(settings.render.backend)
        except BackendMissing as error:
            raise ConfigError(str(error)) from error
    who = DrivingPlanner(one.label, one.spec, one.digest)
    return ExploreWork(reader, settings, who, looks, Location.parse(settings.out))


def _refuse_another(table: KeyedTable, work: ExploreWork) -> None:
    """Raises ConfigError where rows of another planner, or of other settings, are in the table."""
    mine = (work.planner.digest, work.depends_on)
    for row in table.read(["planner", "planner_digest", "settings"]).to_pylist():
        if (row["planner_digest"], row["settings"]) != mine:
            raise ConfigError(
                f"out={work.settings.out} holds drifts of {row['planner']} ({row['planner_digest']}), or of other "
                "settings: choose another out"
            )


def _explore(work: ExploreWork, refs: Sequence[ClipRef], table: KeyedTable) -> list[NotDriven]:
    """Explore the clips that the table does not hold and commit them as they come; those that could not be."""
    done = set(table)
    waiting = [ref for ref in refs if ref.clip_id not in done]
    failed: list[NotDriven] = []
    rows, n_done = Committer(partial(write_explored, table)), len(refs) - len(waiting)
    try:
        with (
            Progress("clips", len(refs), before=n_done) as progress,
            closing(each(work, waiting, work.settings.executor, work.settings.workers, work.out)) as results,
        ):
            for made in results:
                if isinstance(made, ExploredClip):
                    rows.add([made])
                else:
                    failed.append(made)
                n_done += 1
                progress.show(n_done)
    finally:
        rows.close()
    return failed


def told(rows: Sequence[ExploredClip]) -> str:
    """What was found, in three lines."""
    drifts = [one for row in rows for one in row.drifts]
    failing = Counter(one.fails for one in drifts if one.fails)
    dropped = sum((Counter(row.dropped) for row in rows), Counter[str]())
    lost = Counter(row.fails for row in rows if row.fails)
    mean = sum(row.score for row in rows) / len(rows)
    return "\n".join(
        [
            f"{rows[0].planner} ({rows[0].planner_digest}) in {len(rows)} clips: EPDMS {mean:.3f} over the 4 s from T, "
            f"fails in {lost.total()}{_listed(lost)}",
            f"drifts: {len(drifts)}; from {failing.total()} of them it fails{_listed(failing)}",
            f"ways that led nowhere: {dropped.total()}{_listed(dropped)}",
        ]
    )


def _listed(counts: Counter[str]) -> str:
    most_first = sorted(counts.items(), key=lambda item: (-item[1], item[0]))
    return f" ({', '.join(f'{name} {n}' for name, n in most_first)})" if most_first else ""


def explore_command(argv: Sequence[str]) -> None:
    """Explore and print what a command line asks for. Raises ConfigError, Failed, Stopped."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    settings = settings_of(argv)
    if settings.executor == "ray":
        need_run_extra("ray")
    try:
        rows, failed = explore(settings)
    except (Halted, KeyboardInterrupt) as error:
        raise Stopped("interrupted; what is explored is kept, and the same command goes on") from error
    except (WorkerDied, AnotherWriter) as error:
        raise Failed(str(error)) from error
    if rows:
        print(told(rows))
        print(f"go on: python -m factory.run explore={settings.out} out=<folder>, and the clips as here")
    if failed:
        shown = "; ".join(f"clip {one.clip_id}: {one.why}" for one in failed[:SHOWN_FAILURES])
        raise Failed(f"{len(failed)} clips could not be explored: {shown}")


main = command(explore_command)
