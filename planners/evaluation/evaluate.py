"""`python -m planners evaluate benchmark=<out> planner=<who>`: EPDMS of planners on a benchmark, one stage and two.

    python -m planners evaluate benchmark=runs/hard planner=runs/ltf
    python -m planners evaluate benchmark=runs/hard planners=[runs/ltf,human,my.module:MyPlanner] out=eval
    python -m planners evaluate benchmark=runs/hard planners={real: runs/a, with_sim: runs/b}
    python -m planners evaluate benchmark=runs/hard planner=runs/gtrs +settings.inference_entries=8192

    python -m planners evaluate benchmark=navhard data=/data/openscene planner=runs/ltf
    python -m planners evaluate benchmark=navtest planner=human limit=100 pictures=false check=rows.csv   a page of both

The benchmark is the folder that `python -m factory.run preset=hard_benchmark` or `python -m factory import` made, or
`navhard` or `navtest`, which are made of NAVSIM's folders first and are among the public traffic unless
`traffic@two_stage_traffic=` says otherwise. Who may stand under `planner=`, and what a planner of one's own looks like,
planners/evaluation/planner_names.py says. Every planner gets a folder: its plans, a row of sub-scores for each frame
(frames.parquet, frames.csv), and record.json, written last. What is done is not planned or scored again unless it, the
benchmark or the rules changed; the same command goes on after a kill. All planners of a command share what scoring
prepares of a frame, so name several at once.

    summary.csv                   all planners that were evaluated into `out` by the same rules, earlier ones first
    <planner>/navsim_*.csv        of NAVSIM's benchmarks: the tables that its own scripts write, by the score's filter
    one_stage                     the logged frames, as navtest
    stage_one, stage_two, final   as navhard: stage two weighted by how near a follow-up starts to the plan's end,
                                  final the product of both stages
    follow_ups                    the plain mean of the follow-up rows; no published table holds it
    unfiltered, filtered          without and with the human-penalty filter: the former compares with the paper's
                                  tables, the latter with today's leaderboard
    uniform                       share of clips none of whose follow-ups starts near the plan's end
"""

import json
import os
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from factory.config.arguments import command
from factory.config.compose import ConfigError, fill
from factory.config.datasets import find_function, words_of
from factory.config.shapes import to_plain
from factory.files import matching
from factory.graph.progress import RateBar
from planners.evaluation.aggregation import (
    BOUNDS,
    PAPER,
    ClipResult,
    RunScores,
    SummaryLine,
    collect_scores,
    group_by_clip,
    stage_title,
    summarise,
    summary_lines,
    table_text,
    write_table,
)
from planners.evaluation.benchmark_folder import BenchmarkFolder
from planners.evaluation.bootstrap import Interval, cluster_labels_by_level, paired_interval
from planners.evaluation.frames import FrameKey
from planners.evaluation.navsim import write_tables
from planners.evaluation.navsim_check import write_check
from planners.evaluation.planner_names import EvaluatedPlanner, compose_with_planner, find_planners, needs_of
from planners.evaluation.planning import all_plans
from planners.evaluation.score_rows import RECORD, FrameRow, is_done, read_rows, write_record, write_rows
from planners.evaluation.scoring import (
    ClipFrames,
    LoneFrame,
    Plans,
    Rules,
    prepare_clip,
    prepare_lone,
    score_clip,
    score_lone,
)
from tasks.reward.aggregate import follow_up_weights, has_uniform_weights
from tasks.rollout.simulate import TrafficSettings, traffic_record
from tasks.stages import stage_versions
from tasks.world.arrays import Array

MOST_UNIFORM = 0.2  # share of groups in the uniform fallback above which stage two says little


@dataclass(frozen=True)
class EvaluateSettings:
    """Everything on the command line of `planners evaluate`."""

    benchmark: str  # the folder that factory.run preset=hard_benchmark made, or navhard or navtest
    data: str | None = None  # of navhard and navtest: NAVSIM's folders; null: its own variable OPENSCENE_DATA_ROOT
    maps: str | None = None  # nuPlan's; null: NUPLAN_MAPS_ROOT, or `maps` in data
    split: str | None = None  # the split's .yaml; null: that of the checkout in NAVSIM_DEVKIT_ROOT
    pictures: bool = True  # false: a benchmark without any
    made: str = "benchmarks"  # navhard and navtest are made in a folder of their name here
    planner: str | None = None  # a training's folder, human, pdm_closed, constant_velocity, or my.module:MyPlanner
    planners: list[str] | dict[str, str] | None = None  # several: a list, or {label: planner, ...}
    out: str = "evaluations"  # a folder for each planner, and the table of all
    settings: dict[str, Any] = field(default_factory=dict)  # of planning, changed in all trained planners
    bounds: bool = True  # human, pdm_closed and constant_velocity too
    one_stage_traffic: TrafficSettings = field(default_factory=lambda: TrafficSettings(mode="replay"))  # as NAVSIM's
    two_stage_traffic: TrafficSettings = field(default_factory=TrafficSettings)  # both of navhard's stages are reactive
    batch_size: int = 16
    planners_at_once: int = 8  # in memory, planning from one reading of the samples
    device: str = "cpu"  # or cuda
    limit: int | None = None  # the first so many clips only
    only_logs: tuple[str, ...] = ()  # ids of logs, whose clips alone; none: of all
    check: str | None = None  # of navtest: NAVSIM's own rows of the same planner (.csv, .csv.gz); writes check.html
    navsim_python: str | None = None  # of NAVSIM's environment, whose solver the check tries; null: this one
    tables: bool = True  # summary.csv of all planners; false where others follow into the same out

    def __post_init__(self) -> None:
        for name in ("batch_size", "planners_at_once", "limit"):
            if getattr(self, name) is not None and getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, not {getattr(self, name)}")
        if self.check is None and self.navsim_python is not None:
            raise ValueError("navsim_python= is of check=<NAVSIM's rows>")
        if self.check is not None and self.planner is None:
            raise ValueError("check= holds one planner against its published rows: give planner=, such as human")

    @property
    def rules(self) -> Rules:
        """What the scores depend on beside planner and benchmark."""
        return Rules(self.one_stage_traffic, self.two_stage_traffic)


def _told(rules: Rules) -> dict[str, object]:
    """As a record holds them."""
    return asdict(rules) | {"one_stage": traffic_record(rules.one_stage), "two_stage": traffic_record(rules.two_stage)}


def evaluate(
    benchmark: BenchmarkFolder, who: Sequence[EvaluatedPlanner], settings: EvaluateSettings
) -> list[SummaryLine]:
    """Plan, score, write; the lines of all planners in their order, of those evaluated into `out` before as well.

    Raises ConfigError where a planner cannot plan from this benchmark, before any is planned.
    """
    out = Path(settings.out)
    keys = _keys(benchmark, settings)
    clips: dict[str, Any] = {"clips": len({key.clip_id for key in keys})}
    if settings.only_logs:
        clips["only_logs"] = list(settings.only_logs)
    shared = {
        "benchmark_digest": benchmark.digest,
        **clips,
        "rules": json.loads(json.dumps(_told(settings.rules))),  # as it comes back from a file
        "stage_versions": stage_versions(),
    }
    identities = {one.label: {"planner_digest": one.digest, **shared} for one in who}
    waiting = [one for one in who if not is_done(out / one.label, identities[one.label])]
    check_needs(benchmark, keys, waiting)
    for one in waiting:
        (out / one.label).mkdir(parents=True, exist_ok=True)
    planning = [
        (one, out / one.label, {"planner_digest": one.digest, "benchmark_digest": benchmark.digest, **clips})
        for one in waiting
        if one.privileged is None
    ]
    plans = all_plans(benchmark, keys, planning, settings.batch_size, settings.planners_at_once, settings.device)
    if waiting:
        rows = _score_clips(benchmark, keys, waiting, plans, settings.rules)
        for one in waiting:
            (out / one.label / RECORD).unlink(missing_ok=True)  # what the folder holds is about to be replaced
            write_rows(out / one.label, rows[one.label])
            if benchmark.tokens:
                write_tables(out / one.label, rows[one.label], benchmark.tokens)
            write_record(out / one.label, {**identities[one.label], "planner": one.label, "frames": len(keys)})
    labels = [*(_done_before(out, shared) if settings.tables else ()), *identities]
    labels = sorted(dict.fromkeys(labels), key=lambda label: (label not in BOUNDS, label in identities))
    lines = [line for label in labels for line in summary_lines(label, summarise(read_rows(out / label)))]
    if settings.tables:
        write_table(out, lines)
    return lines


def _done_before(out: Path, shared: Mapping[str, Any]) -> list[str]:
    """The planners in a folder that were evaluated on the same benchmark by the same rules, oldest first."""
    records = sorted(matching(out, f"*/{RECORD}"), key=lambda path: path.stat().st_mtime)
    return [path.parent.name for path in records if is_done(path.parent, shared)]


def check_needs(benchmark: BenchmarkFolder, keys: Sequence[FrameKey], who: Sequence[EvaluatedPlanner]) -> None:
    """Raises ConfigError for a planner that needs images of a benchmark that lacks some, naming a frame."""
    blind = [key for key in keys if benchmark.image_source(key) == "none"]
    for one in who if blind else ():
        needs = None if one.load is None else needs_of(one.load())
        if needs is not None and needs.image is not None:
            raise ConfigError(
                f"planner {one.label} needs images, and {len(blind)} of {len(keys)} frames have none, "
                f"such as {blind[0]}: make the benchmark with cameras (render=..., not render=none)"
            )


def _keys(benchmark: BenchmarkFolder, settings: EvaluateSettings) -> list[FrameKey]:
    """The frames that settings choose. Raises ConfigError where there are none."""
    clips = dict.fromkeys(key.clip_id for key in benchmark.keys)
    logs = set(settings.only_logs)
    chosen = set([clip for clip in clips if not logs or benchmark.log_of(clip) in logs][: settings.limit])
    if not chosen:
        raise ConfigError(f"only_logs={settings.only_logs[0]}: no clip of benchmark={benchmark.path} is of it")
    return [key for key in benchmark.keys if key.clip_id in chosen]


def _score_clips(
    benchmark: BenchmarkFolder,
    keys: Sequence[FrameKey],
    who: Sequence[EvaluatedPlanner],
    plans: Mapping[str, Plans],
    rules: Rules,
) -> dict[str, list[FrameRow]]:
    """The rows of every planner, clip by clip: what is prepared of a clip serves all and is let go."""
    rows: dict[str, list[FrameRow]] = {one.label: [] for one in who}
    clips = list(dict.fromkeys(key.clip_id for key in keys))
    tags = {key: tuple(sample["tags"]) for key, sample in benchmark.stream(["tags"])}
    driven: dict[tuple[str, str | None], Array] = {}  # of the clip before
    spent = 0.0
    with RateBar("clips scored", len(clips)) as progress:
        for done, clip_id in enumerate(clips, start=1):
            if benchmark.one_stage:
                prepared: ClipFrames | LoneFrame = prepare_lone(clip_id, benchmark.scene(clip_id), rules)
            else:
                prepared = prepare_clip(benchmark.scenes(clip_id), rules)
            began = time.perf_counter()
            last, driven, log_id = driven, {}, benchmark.log_of(clip_id)
            for one in who:
                own = plans[one.label] if one.privileged is None else one.privileged(prepared.frames)
                if isinstance(prepared, LoneFrame):
                    before = last.get((one.label, benchmark.before_of(clip_id)))
                    row, driven[one.label, clip_id] = score_lone(prepared, own, before)
                    scored = [row]
                else:
                    scored = score_clip(prepared, own)
                rows[one.label] += [replace(row, log_id=log_id, tags=tags[row.key]) for row in scored]
            spent += time.perf_counter() - began
            n_rows = sum(map(len, rows.values()))
            progress.show(done, f"{1000.0 * spent / n_rows:.1f} ms a frame and planner")
    return rows


def what_decides(results: Mapping[str, Sequence[ClipResult]]) -> list[str]:
    """On how much each planner's score rests, where it lies, and which differences mean nothing.

    Intervals are over the largest clusters of which there are two: towns, else logs, else clips. Planners are held
    against the first that is none of BOUNDS, and that one against constant velocity.
    """
    two_stage = any(clip.groups is not None for clips in results.values() for clip in clips)
    measure = ("final" if two_stage else "one_stage", PAPER)
    scored = {label: collect_scores([clips], "score") for label, clips in results.items()}
    runs = {label: found[measure] for label, found in scored.items() if measure in found}
    if not runs:
        return []
    one = next(iter(runs.values()))
    known = cluster_labels_by_level(one.clips, one.logs)
    level = [level for level, names in known.items() if level == "clip" or len(set(names)) > 1][-1]

    def against(a: Array, b: RunScores, form: str) -> tuple[Interval, str]:
        found = paired_interval(a, b.scores, weights=(b.weights, b.weights), clusters=known[level])
        ends = f"{100 * found.low:{form}} to {100 * found.high:{form}}" if np.isfinite(found.low) else "no interval"
        return found, f"{100 * found.difference:{form}} ({ends})"

    counted = " of ".join(f"{len(set(names))} {name}s" for name, names in known.items())
    said = [f"{stage_title(measure[0])} ({PAPER}), decided by {counted}; 95 % intervals over {level}s:"]
    for label, run in runs.items():
        score = against(np.zeros_like(run.scores), run, ".1f")[1]
        said.append(f"  {label}: {score}{_follow_ups_that_count(results[label])}")
    own = [label for label in runs if label not in BOUNDS]
    pairs = [(own[0], "constant_velocity")] if own and "constant_velocity" in runs else []
    for b, a in [*pairs, *((label, own[0]) for label in own[1:])]:
        found, difference = against(runs[a].scores, runs[b], "+.1f")
        verdict = "" if found.is_clear else ": no difference told from zero"
        said.append(f"  {b} against {a}: {difference}, by {(runs[a].scores != runs[b].scores).sum()} clips{verdict}")
    return said


def _follow_ups_that_count(clips: Sequence[ClipResult]) -> str:
    """How many follow-ups stage two rests on: Kish's effective number of each group whose weights differ, summed."""
    groups = [group for clip in clips for group in clip.groups or ()]
    if not groups:
        return ""
    near = [group for group in groups if not has_uniform_weights(group.endpoint_xy, group.starts_xy)]
    count = sum(1.0 / (follow_up_weights(group.endpoint_xy, group.starts_xy) ** 2).sum() for group in near)
    said = f", stage two on {count:.0f} of {sum(len(group.stage_two) for group in groups)} follow-ups"
    if (far := len(groups) - len(near)) > MOST_UNIFORM * len(groups):
        said += f"; {far} of {len(groups)} plans end beyond 1.92 m of every one, all then weigh alike and say little"
    return said


def settings_of(argv: Sequence[str]) -> EvaluateSettings:
    """The settings of a command line. Raises ConfigError.

    A benchmark by its name is evaluated among the public traffic, unless the words choose another.
    """

    def completed(values: dict[str, Any]) -> dict[str, Any]:
        if values["benchmark"] in words_of("BENCHMARKS") and not any("two_stage_traffic" in word for word in argv):
            return values | {"two_stage_traffic": to_plain(TrafficSettings(mode="navsim"))}
        return values

    return fill(EvaluateSettings, compose_with_planner("evaluate", argv, EvaluateSettings, completed), "evaluate")


def _folder(settings: EvaluateSettings) -> str:
    """Where the benchmark is, made where it is asked for by its name. Raises ConfigError."""
    names = words_of("BENCHMARKS")
    given = {name: getattr(settings, name) for name in ("data", "maps", "split", "pictures")}
    if settings.benchmark in names:
        return str(find_function("BENCHMARKS", settings.benchmark)(settings.benchmark, settings.made, **given))
    if any(value != getattr(EvaluateSettings, name) for name, value in given.items()):
        raise ConfigError(f"data=, maps=, split= and pictures= are of benchmark={' or '.join(names)} alone")
    return settings.benchmark


@command("evaluate", EvaluateSettings)
def main(argv: Sequence[str]) -> None:
    """The command. Raises as `evaluated`."""
    run_evaluation(settings_of(argv))


def run_evaluation(settings: EvaluateSettings) -> None:
    """Evaluate and print what settings ask for. Raises ConfigError, or OSError for a folder that is none."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    who = find_planners(settings.planner, settings.planners, settings.bounds, settings.settings)
    benchmark = BenchmarkFolder(_folder(settings))
    lines = evaluate(benchmark, who, settings)
    print(table_text(lines))
    if benchmark.tokens and benchmark.left_out:
        total = benchmark.left_out + len({key.clip_id for key in benchmark.keys})
        print(f"{benchmark.left_out} of its {total} clips are left out: no published number is over so few")
    results = {
        label: group_by_clip(read_rows(Path(settings.out) / label))
        for label in dict.fromkeys(line.planner for line in lines)
    }
    for line in what_decides(results):
        print(line)
    if settings.check is not None:
        (own, *_) = find_planners(settings.planner, None, False, settings.settings)
        rows, page = read_rows(Path(settings.out) / own.label), Path(settings.out) / "check.html"
        python = settings.navsim_python or sys.executable
        print("\n".join(write_check(page, benchmark, rows, Path(settings.check), python)))
    if settings.tables:
        print(f"look at {Path(settings.out) / 'summary.csv'}")
