"""`python -m planners evaluate benchmark=<out> planner=<who>`: EPDMS of planners on a benchmark, one stage and two.

    python -m planners evaluate benchmark=runs/hard planner=runs/ltf
    python -m planners evaluate benchmark=runs/hard planners=[runs/ltf,human,my.module:MyPlanner] out=eval
    python -m planners evaluate benchmark=runs/hard planners={real: runs/a, with_sim: runs/b}
    python -m planners evaluate benchmark=runs/hard planner=runs/gtrs +settings.inference_entries=8192

    python -m planners evaluate benchmark=navhard data=/data/openscene planner=runs/ltf

The benchmark is the folder that `python -m factory.run preset=hard_benchmark` or `python -m factory import` made, or
`navhard` or `navtest`, which are made of NAVSIM's folders first and are among the public traffic unless
`traffic@two_stage_traffic=` says otherwise. Who may stand under `planner=`, and what a planner of one's own looks like,
planners/evaluation/planner_names.py says. Every planner gets a folder: its plans, a row of sub-scores for each frame
(frames.parquet, frames.csv), and record.json, written last. What is done is not planned or scored again unless it, the
benchmark or the rules changed; the same command goes on after a kill. All planners of a command share what scoring
prepares of a frame, so name several at once.

    summary.csv                   all planners of this command
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
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from factory.config.arguments import command
from factory.config.compose import ConfigError, fill
from factory.config.datasets import find_function, words_of
from factory.config.shapes import to_plain
from factory.graph.progress import RateBar
from planners.evaluation.aggregation import SummaryLine, summarise, summary_lines, table_text, write_table
from planners.evaluation.benchmark_folder import BenchmarkFolder
from planners.evaluation.frames import Benchmark, FrameKey
from planners.evaluation.navsim import write_tables
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
from tasks.experts.pdm_closed import PdmSettings
from tasks.rollout.simulate import TrafficSettings, traffic_record
from tasks.stages import stage_versions
from tasks.world.arrays import Array

MOST_UNIFORM = 0.2  # share of clips in the uniform fallback


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
    pdm: PdmSettings = field(default_factory=PdmSettings)  # row 0 of the batch that progress is held against
    batch_size: int = 16
    planners_at_once: int = 8  # in memory, planning from one reading of the samples
    device: str = "cpu"  # or cuda
    limit: int | None = None  # the first so many clips only
    tables: bool = True  # summary.csv of all planners; false where others follow into the same out

    def __post_init__(self) -> None:
        for name in ("batch_size", "planners_at_once", "limit"):
            if getattr(self, name) is not None and getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, not {getattr(self, name)}")

    @property
    def rules(self) -> Rules:
        """What the scores depend on beside planner and benchmark."""
        return Rules(self.one_stage_traffic, self.two_stage_traffic, self.pdm)


def _told(rules: Rules) -> dict[str, object]:
    """As a record holds them."""
    return asdict(rules) | {
        "one_stage": traffic_record(rules.one_stage),
        "two_stage": traffic_record(rules.two_stage),
    }


def evaluate(benchmark: Benchmark, who: Sequence[EvaluatedPlanner], settings: EvaluateSettings) -> list[SummaryLine]:
    """Plan, score, write; the lines of all planners in their order.

    Raises ConfigError where a planner cannot plan from this benchmark, before any is planned.
    """
    out = Path(settings.out)
    keys = _keys(benchmark, settings.limit)
    n_clips = len({key.clip_id for key in keys})
    shared = {
        "benchmark_digest": benchmark.digest,
        "clips": n_clips,
        "rules": json.loads(json.dumps(_told(settings.rules))),  # as it comes back from a file
        "stage_versions": stage_versions(),
    }
    identities = {one.label: {"planner_digest": one.digest, **shared} for one in who}
    waiting = [one for one in who if not is_done(out / one.label, identities[one.label])]
    check_needs(benchmark, keys, waiting)
    for one in waiting:
        (out / one.label).mkdir(parents=True, exist_ok=True)
    planning = [
        (one, out / one.label, {"planner_digest": one.digest, "benchmark_digest": benchmark.digest, "clips": n_clips})
        for one in waiting
        if one.load is not None
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
    lines = [line for one in who for line in summary_lines(one.label, summarise(read_rows(out / one.label)))]
    if settings.tables:
        write_table(out, lines)
    return lines


def check_needs(benchmark: Benchmark, keys: Sequence[FrameKey], who: Sequence[EvaluatedPlanner]) -> None:
    """Raises ConfigError for a planner that needs images of a benchmark that lacks some, naming a frame."""
    blind = [key for key in keys if benchmark.image_source(key) == "none"]
    for one in who if blind else ():
        needs = None if one.load is None else needs_of(one.load())
        if needs is not None and needs.image is not None:
            raise ConfigError(
                f"planner {one.label} needs images, and {len(blind)} of {len(keys)} frames have none, "
                f"such as {blind[0]}: make the benchmark with cameras (render=..., not render=none)"
            )


def _keys(benchmark: Benchmark, limit: int | None) -> list[FrameKey]:
    clips = list(dict.fromkeys(key.clip_id for key in benchmark.keys))[:limit]
    return [key for key in benchmark.keys if key.clip_id in set(clips)]


def _score_clips(
    benchmark: Benchmark,
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
            prepared = _prepared(benchmark, clip_id, rules)
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


def _prepared(benchmark: Benchmark, clip_id: str, rules: Rules) -> ClipFrames | LoneFrame:
    if benchmark.one_stage:
        return prepare_lone(clip_id, benchmark.scene(clip_id), rules)
    return prepare_clip(benchmark.scenes(clip_id), rules)


def fallback_notes(lines: Sequence[SummaryLine]) -> list[str]:
    """A line for each planner with more clips in the uniform fallback than a two-stage score should rest on."""
    return [
        f"{line.planner}: {100.0 * line.uniform_share:.0f} % of its plans end beyond 1.92 m of every follow-up, "
        f"whose scores then weigh the same; above {100.0 * MOST_UNIFORM:.0f} % stage two says little of this planner\n"
        for line in lines
        if (line.stage, line.human_filter) == ("final", "filtered") and line.uniform_share > MOST_UNIFORM
    ]


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
    print("".join(fallback_notes(lines)), end="")
    if settings.tables:
        print(f"look at {Path(settings.out) / 'summary.csv'}")
