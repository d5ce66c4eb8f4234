"""What a run would take: the clips it would read, and attempts, hours and GB extrapolated from three clips."""

import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

from factory.graph.walk import candidate_order
from factory.graph.work import Columns, attempted
from factory.readers.base import ClipRef
from factory.setup.paper import setup_text
from factory.setup.settings import Run
from factory.store.funnel import funnel_of
from factory.store.samples import Store
from factory.store.schema import BOOKKEEPING, sample_row_to_table
from tasks.stages import TASKS, Rejected

CALIBRATION_CLIPS = 3


def plan_text(run: Run, refs: Sequence[ClipRef]) -> str:
    """What was found under the root and what the run is asked for."""
    index, config = run.index, run.config
    lines = [f"clips: {len(index.refs)} windows of {len({ref.log_id for ref in index.refs})} logs ({run.reader.name})"]
    if len(refs) < len(index.refs) + len(index.broken):
        lines[0] += f", limited to {len(refs)}"
    lines += [f"  filtered {count} windows: {reason}" for reason, count in index.dropped.items()]
    lines += [f"  skipped log {log}: {reason}" for log, reason in index.skipped_logs.items()]
    lines += [f"  broken log {ref.log_id}: {problem}" for ref, problem in index.broken.items()]
    vocabulary = run.work.vocabulary
    lines.append(f"vocabulary: {len(vocabulary)} trajectories ({vocabulary.source}, {vocabulary.digest})")
    lines.append(f"experts: {', '.join(config.experts)}; rounds: {config.rounds}; out: {config.out}")
    lines.append(setup_text(config, vocabulary))
    return "\n".join(lines)


@dataclass
class Calibration:
    """Sums over the calibration clips."""

    clips: int = 0
    candidates: int = 0
    attempts: int = 0
    accepted: int = 0
    row_bytes: int = 0
    seconds: Counter[str] = field(default_factory=Counter)
    notes: list[str] = field(default_factory=list)


def measure(run: Run, refs: Sequence[ClipRef]) -> Calibration:
    """Walk a few clips, evenly spread over the run's, in this process; nothing is written but the block cache."""
    sums = Calibration()
    chosen = [
        refs[i * len(refs) // min(CALIBRATION_CLIPS, len(refs))] for i in range(min(CALIBRATION_CLIPS, len(refs)))
    ]
    run.work.warm()
    for ref in chosen:
        if ref in run.index.broken:
            sums.notes.append(f"{ref.log_id}: {run.index.broken[ref]}")
            continue
        prepared = run.work.prepare(ref)
        sums.clips += 1
        if isinstance(prepared, Rejected):
            sums.notes.append(f"{ref.clip_id}: rejected by {prepared.stage}: {prepared.reason}")
            continue
        sums.candidates += len(prepared.candidates)
        sums.seconds.update(prepared.seconds)
        for expert in run.config.experts:
            once = run.work.once(expert)
            wanted = 1 if once else run.config.rounds
            for candidate in candidate_order(once, len(prepared.candidates)):
                result = attempted(run.work, prepared, candidate, expert)
                sums.attempts += 1
                sums.seconds.update(result.seconds)
                if isinstance(result, Columns):
                    sums.accepted += 1
                    sums.row_bytes += _bytes_of(result)
                    wanted -= 1
                if wanted == 0:
                    break
    return sums


def _bytes_of(result: Columns) -> int:
    blank: dict[str, object] = dict.fromkeys(BOOKKEEPING, "") | {"round": 0, "candidate_index": 0}
    return int(sample_row_to_table([{**blank, **result.row}]).nbytes)


def calibrate(run: Run, refs: Sequence[ClipRef], store: Store | None = None) -> str:
    """The expected size of the whole run as a text; with `store`, also by the acceptance its tables show."""
    sums = measure(run, refs)
    if sums.clips == 0:
        return "\n".join(["nothing could be measured:", *sums.notes])
    factor = len(refs) / sums.clips
    core_hours = sum(sums.seconds.values()) * factor / 3600.0
    cores = run.config.workers or os.cpu_count() or 1
    total = f"{core_hours:.2f} core-hours ({core_hours / cores:.2f} h on {cores} cores)"
    if run.work.draws_on_gpu:  # a task that draws holds its share of a GPU; where all is fused, the whole attempt does
        tasks = [task for task in TASKS if task.per == "attempt" and (task.may_draw or run.config.graph.fuse == "all")]
        spent = sum(sums.seconds[stage] for task in tasks for stage in task.stages)
        total += f", {spent * run.config.gpu_share * factor / 3600.0:.2f} GPU-hours"
    lines = [
        f"measured on {sums.clips} clips: {sums.candidates / sums.clips:.1f} candidates a clip, "
        f"{sums.accepted} of {sums.attempts} attempts accepted",
        f"  {'stage':<12}{'s a clip':>10}{'core-hours':>12}",
        *(
            f"  {stage:<12}{seconds / sums.clips:>10.2f}{seconds * factor / 3600.0:>12.2f}"
            for stage, seconds in sums.seconds.items()
        ),
        f"expected for {len(refs)} clips: {sums.attempts * factor:.0f} attempts, {sums.accepted * factor:.0f} samples, "
        f"{sums.row_bytes * factor / 1e9:.3f} GB before compression, {total}",
        *(by_the_tables(store, run.config.experts, run.config.rounds, len(refs)) if store is not None else ()),
        *sums.notes,
    ]
    return "\n".join(lines)


def by_the_tables(store: Store, experts: Sequence[str], rounds: int, n_clips: int) -> list[str]:
    """For every expert with attempts in the tables: what so many clips come to at its rates there.

    Rounds that the tables do not hold go on at the rates of the last one they do.
    """
    found: list[str] = []
    for expert in experts:
        rows = [row for row in funnel_of(store).rows if row.expert == expert and row.clips_before]
        if not rows:
            continue
        wanted = rounds if rows[0].simulated else 1
        left, attempts, samples = float(n_clips), 0.0, 0.0
        for number in range(wanted):
            row = rows[min(number, len(rows) - 1)]
            attempts += left * (row.accepted + row.rejected + row.failed) / row.clips_before
            left *= row.clip_rate
            samples += left
        tried = sum(row.accepted + row.rejected + row.failed for row in rows)
        rate = 100.0 * sum(row.accepted for row in rows) / tried if tried else 0.0
        found.append(
            f"  {expert}: {rate:.1f} % of {tried} attempts on {rows[0].clips_total} clips were accepted; "
            f"{attempts:.0f} attempts, {samples:.0f} samples"
        )
    return [f"by the acceptance measured in {store.location.uri}:", *found] if found else []
