"""How a run stands, from its tables: its store, what is in it, what failed."""

import os
import shlex
import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from functools import reduce
from typing import TYPE_CHECKING, Any

from factory.config.arguments import Refused
from factory.exits import EXIT_CODE_TEXT
from factory.wording import one_line, time_left_text, time_text
from tasks.subscores import RECORDS

if TYPE_CHECKING:
    import pyarrow as pa

    from factory.store.location import Location
    from factory.store.samples import NewestRun, Store
    from factory.store.table import KeyedTable

RETRY = {
    "input": "fix or take out the named file, then python -m factory retry out=...",
    "bug": "python -m factory retry out=..., once the code or the plug-in is fixed",
    "machine": "the machine was ill, which never counts: the next run of the same command tries it again by itself",
    "system": "the next run of the same command tries it again by itself",
    "limit": "the next run of the same command tries it again by itself, in three runs at most; "
    "graph.limit_s.<task>= and graph.limit_gb.<task>= give it more",
    "poison": "it brought workers down in several runs; python -m factory retry out=... tries it once more",
}
IMPORT_AGAIN = "give the same command again, python -m factory import {} ..."  # of what it was imported from


def how_to_retry(error_kind: str, runs: Sequence[Mapping[str, Any]]) -> str:
    """A failed attempt of a table with these records (Store.runs)."""
    from factory.store.samples import imported_from

    source = imported_from(runs)
    if source is None:
        return RETRY[error_kind]
    return f"fix or take out the named file, then {IMPORT_AGAIN.format(source)}"


def open_store(out: str) -> "Store":
    """Raises Refused where there is no run, or can be none."""
    location = location_of_out(out)
    from deltalake.exceptions import DeltaError

    from factory.files import DamagedFile
    from factory.store.samples import OtherSchema, Store

    try:
        store = Store(location)
    except OtherSchema as error:
        raise Refused(str(error)) from error
    except DamagedFile:
        raise
    except (OSError, DeltaError) as error:
        raise Refused(f"out={out}: {one_line(error)}") from error
    if all(table.version is None for table in store.tables):
        begins = "give the out= of a run of python -m factory.run, of one that has just begun once it says its clips"
        raise Refused(f"no store at {store.location.uri}: {begins}")
    return store


def location_of_out(out: str) -> "Location":
    """Where a run is. Raises Refused where there can be none."""
    if not out.strip():
        raise Refused("out= is empty: name the folder or URL of a run (a shell variable that is not set?)")
    os.environ.setdefault("RUST_LOG", "error")  # what the object store's client warns of, the error says again
    from factory.store.location import BadLocation, Location

    try:
        return Location.parse(out)
    except BadLocation as error:
        raise Refused(f"out={out}: {one_line(error)}") from error


def status_lines(store: "Store") -> Iterable[str]:
    """Tables, counts, funnel and the newest run."""
    from factory.store.funnel import funnel_of_tables, funnel_tables

    samples, fell, lists = funnel_tables(store, ("split", "image_source", "dataset"))
    outcomes = value_counts(fell["kind"])
    yield f"store       {store.location.uri}"
    for table in (store.samples, store.candidates, store.outcomes, store.plans):
        version = "not there yet" if table.version is None else f"version {table.version}"
        yield f"{table.spec.name:<12}{len(table):,} rows, {len(table.live_files())} files, {version}"
    for title in ("dataset", "split", "image_source"):
        counts = value_counts(samples[title])
        yield f"{title:<14}" + (", ".join(f"{name} {n}" for name, n in sorted(counts.items())) or "no samples")
    yield "not samples   " + (", ".join(f"{kind} {n}" for kind, n in sorted(outcomes.items())) or "none")
    yield ""
    funnel = funnel_of_tables(samples, fell, lists, store.plans.read(), store.runs())
    yield funnel.text().rstrip()
    yield ""
    if funnel.balance.stages:
        yield "planned = accepted + rejected + failed + pending"
        yield funnel.balance.text().rstrip()
        yield ""
    yield from _long_running_tasks(store)
    yield from _last_run(store)


def _long_running_tasks(store: "Store") -> Iterable[str]:
    """Tasks that have been at work for long, as their guards said in the last half minute."""
    from factory.graph.guard import SHOWN_S, WORK, read_note
    from factory.graph.local import notes_folder

    for path in sorted(notes_folder(store.location).glob(f"*{WORK}")):
        if (note := read_note(path)) is None or time.time() - path.stat().st_mtime > 3 * SHOWN_S:
            continue
        least = f"of at most {note['seconds']:.0f} " if note.get("seconds") else ""
        held = f"{note['held_gb']:.1f} GB, process {note['pid']} on {note['host']}"
        yield f"at work       {note['what']}: {time.time() - note['since']:.0f} s {least}so far, {held}"


def _last_run(store: "Store") -> Iterable[str]:
    newest = store.newest_run()
    committed_ms, now_s = store.last_commit_ms(), time.time()
    word, _ = run_state(newest, committed_ms, now_s)
    if newest.damaged:
        yield f"newest run    {word}"
        return
    if newest.goes_on or not newest.last:
        left = time_left_text(newest.current.get("ends_ms"), now_s * 1000)
        heard = f"{word}, last heard of {time_text(newest.heard_s_ago(committed_ms, now_s))} ago"
        yield f"newest run    {heard}: " + (f"ETA {left}" if word == RUNNING else QUIET)
        return
    run = newest.last
    yield f"newest run    exit code {run['exit_code']}: {EXIT_CODE_TEXT[run['exit_code']]}"
    executed = ", ".join(f"{name} {count}" for name, count in run["executed"].items())
    yield f"executed      {executed}"
    seconds = ", ".join(f"{stage} {s['seconds']:.1f} ({s['tasks']})" for stage, s in run["seconds"].items())
    yield f"seconds       {seconds or 'nothing was left to do'}  (tasks in brackets)"
    for note in (*([run["message"]] if run["message"] else []), *run["notes"]):
        yield f"note          {note}"
    if store.location.read("report.html") is not None:
        yield f"report        {store.location.uri}/report.html"


def failure_summary(store: "Store") -> str:
    """What failed, how often, how the first error ends, and what shows all of it; for the end of a run."""
    rows, kinds = _failed_rows(store)
    counts, first = ", ".join(f"{kind} {n}" for kind, n in kinds.items()), rows[0]
    where = f"{first['expert']} on clip {first['clip_id']}" if first["expert"] else f"clip {first['clip_id']}"
    said = (first["error"].strip().splitlines() or ["no message"])[-1]
    return (
        f"{len(rows)} failed ({counts}), the first, {where}: {said}\n"
        f"all of them: python -m factory failed out={shlex.quote(store.location.uri)}"
    )


def value_counts(column: "pa.ChunkedArray") -> dict[Any, int]:
    """Value -> rows, also of texts as numbers into a dictionary."""
    return {row["values"]: row["counts"] for row in column.unify_dictionaries().value_counts().to_pylist()}


def rows_where(
    table: "KeyedTable", values: Mapping[str, str], columns: Sequence[str] | None = None
) -> list[dict[str, Any]]:
    """Rows with these values, None: whole; more than these columns is read only of files that hold some."""
    import pyarrow.compute as pc

    found, live = [], table.live_files()
    for path, rows in table.files(list(values)):
        fits = [pc.equal(rows[name], value) for name, value in values.items()]
        if pc.any(at := reduce(pc.and_, fits)).as_py():
            found += table.read_file(path, live[path], columns).filter(at).to_pylist()
    return found


def outcome_text(row: Mapping[str, Any]) -> str:
    """What became of an attempt that is no sample, from its row of outcomes."""
    why = row["error"] or f"{row['stage']}.{row['reason']} {row['detail']}".strip(". ")
    return f"{row['attempt_id']} is no sample but a {row['kind']} attempt of {row['expert'] or 'a clip'}: {why}"


def _failed_rows(store: "Store") -> tuple[list[dict[str, Any]], dict[str, int]]:
    """By log, clip and walk; how many of each kind of error."""
    rows = rows_where(store.outcomes, {"kind": "failed"})
    rows.sort(key=lambda row: (row["log_id"], row["clip_id"], row["expert"], row["candidate_index"]))
    return rows, dict(sorted(Counter(row["error_kind"] for row in rows).items()))


def failed_lines(store: "Store") -> Iterable[str]:
    """Every failed attempt with its message, and how to try it again."""
    (rows, kinds), runs = _failed_rows(store), store.runs()
    yield f"{len(rows)} failed" + (": " + ", ".join(f"{kind} {n}" for kind, n in kinds.items()) if rows else "")
    for row in rows:
        what = f"expert {row['expert']}, candidate {row['candidate_index']}" if row["expert"] else "the clip as a whole"
        yield ""
        yield f"{row['attempt_id']}  {row['error_kind']}, tried in {row['tries']} runs"
        yield f"  log {row['log_id']}, clip {row['clip_id']}, {what}"
        yield from (f"  | {line}" for line in row["error"].splitlines())
    for kind in kinds:
        yield ""
        yield f"to retry {kind}: {how_to_retry(kind, runs)}"


# What reasons, gates and ends of a run are called on the pages, and the published rates beside ours.

# SimScale: clips with a sample of the round, in % of those with one of the round before.
PAPER_CLIP_PERCENT = {"pdm_closed": (63, 85, 83, 83, 84), "recovery": (43, 80, 78, 78, 78)}
STATUS = {  # exit code -> words, tone
    0: ("complete", "good"),
    3: ("complete, with failed attempts", "warn"),
    4: ("interrupted: the same command goes on", "warn"),
}
RUNNING = "running"
QUIET = "it did not finish, or is at one long task; if it is gone, the same command goes on"


def run_state(run: "NewestRun", committed_ms: int, now_s: float) -> tuple[str, str]:
    """Word and tone of the newest run: of one that goes on, or of how the last one ended, never both."""
    from factory.store.samples import QUIET_S

    if run.damaged:
        return f"run status unknown: {' and '.join(run.damaged)} not readable; factory verify says more", "warn"
    if not run.goes_on:
        return STATUS.get(run.last.get("exit_code", -1), ("run status unknown", "warn"))
    quiet = run.heard_s_ago(committed_ms, now_s) > QUIET_S
    return ("quiet", "warn") if quiet else (RUNNING, "live")


REASON_WORDS = {
    **{record.name: record.wrong for record in RECORDS},
    "off_route": "the route does not go on where the drive ends",
    "after": "somebody is hit in the second after the drive",
    "near_log": "it is the log's own drive",
    "no_plan": "the expert found no plan",
    "out_of_reach": "the log's end cannot be reached from there",
    "not_recovered": "it ends too far from the log",
    "route_ended": "no route is left to drive along",
    "psnr": "block reconstructed too poorly",
    "holes": "rendered where nothing was seen",
    "lens_covered": "something covers the lens",
    "blank": "nothing to be seen on a picture",
    "blurred": "a picture without detail",
    "guessed": "a part of a picture that photos do not show, or not like that",
    "unlike_photos": "a vehicle nearby looks like none of its photos",
    "ego_standing": "ego stands",
    "no_earlier_frame": "the log begins too late for a frame before it",
    "broken_tracks": "broken tracks",
    "no_gated_candidate": "no trajectory passes the gates",
    "no_good_candidate": "no trajectory scores well enough",
    "input": "input is broken",
    "bug": "the code raised",
    "machine": "the machine was ill",
    "system": "a worker died, or a file could not be read",
    "limit": "ended over its limits of time or memory",
    "poison": "workers died at it again and again",
}
GATE_WORDS = {
    "raw_longitudinal": "raw end pose too far along",
    "raw_lateral": "raw end pose too far aside",
    "raw_heading": "raw end pose turned too far",
    "reached_longitudinal": "reached end pose too far along",
    "reached_lateral": "reached end pose too far aside",
    "reached_heading": "reached end pose turned too far",
    "white_cell": "in a cell the grid leaves out",
    "replay_score": "scored too low against log replay",
    "reactive_score": "scored too low among reacting agents",
}


def side_text(y_m: float) -> str:
    """A distance across, by the word for its side: y of the ego frame points left."""
    return f"{abs(y_m):.2f} m to the {'left' if y_m >= 0.0 else 'right'}"


def turn_text(heading_rad: float) -> str:
    """A turn by the word for its side: counter-clockwise is left."""
    return f"{abs(heading_rad) * 57.29578:.1f} deg to the {'left' if heading_rad >= 0.0 else 'right'}"
