"""`python -m planners scaling`: how planners' scores grow with simulated data, as in the paper's scaling figure.

    python -m planners scaling data.real=[runs/town] data.sim=[runs/town] benchmark=runs/hard \
        planners=[ltf_small,diffusiondrive_small] experts=[recovery,pdm_closed] seeds=[0,1]

Trains one planner for every combination of the axes (planners, experts, rounds, sim_ratios, imitation, real_shares,
seeds), evaluates all on one benchmark, and fits S(N) = a log^2 N + b log N + c per curve. Writes `scaling.csv` (one row
a training), `comparisons.csv` (means over seeds, differences from real samples alone with paired bootstrap intervals
over seeds and clips, logs, towns), `bounds.csv`, `curves.csv` (a, b, c, residuals, saturation), `scaling.png`, and
`frames.parquet`, EPDMS of each frame by each planner, of which the tables are made: `python -m planners scaling_table`
makes them again. The same command goes on where it stopped.
Exit codes: 0 complete, 2 bad settings, 3 a training failed, 4 interrupted or out of minutes, and resumable.
"""

import itertools
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from factory.config.compose import ConfigError, compose, fill
from planners.evaluation.aggregation import HumanFilter
from planners.evaluation.scores import BOUNDS, PAPER, name_of, shown, title_of, write_csv
from planners.study.frames_file import FRAMES, read_frames, rows_of, write_frames
from planners.study.scaling_figure import Curve, Point, draw_curves
from planners.study.scaling_law import FEWEST, fit_scaling
from planners.study.scaling_table import text_of, write_tables
from planners.study.sweep import EVALUATIONS, Means, SweepFailed, Training, evaluate_all, folder_of, train_all
from planners.training.checkpoint import read_record

BAD_CONFIG, FAILED, INTERRUPTED = 2, 3, 4
ALL_EXPERTS = EVERYONE = "all"


@dataclass(frozen=True)
class SweepData:
    """Tables."""

    real: tuple[str, ...]
    sim: tuple[str, ...]
    val: tuple[str, ...] = ()


@dataclass(frozen=True)
class ScalingSettings:
    """The keys of conf/scaling.yaml."""

    data: SweepData
    benchmark: str
    out: str
    planners: tuple[str, ...]
    experts: tuple[str, ...]
    rounds: tuple[int, ...]
    sim_ratios: tuple[float | Literal["natural"], ...]
    imitation: tuple[Literal["all", "real", "none"], ...]
    real_shares: tuple[float, ...]
    seeds: tuple[int, ...]
    report: str | None = None
    steps: int | None = None
    train: dict[str, tuple[str, ...]] = field(default_factory=dict)
    evaluate: tuple[str, ...] = ()
    stage: Literal["one_stage", "stage_one", "stage_two", "follow_ups", "final"] = "final"
    human_filter: HumanFilter = PAPER
    executor: Literal["process", "ray"] = "process"
    jobs: int | None = None
    minutes: float | None = None
    gpus: float = 0.0
    cpus: float = 1.0

    def __post_init__(self) -> None:
        for name in ("planners", "experts", "rounds", "sim_ratios", "imitation", "real_shares", "seeds"):
            values = getattr(self, name)
            if not values or len(set(values)) < len(values):
                raise ValueError(f"{name}={list(values)}: at least one, each once")
        unknown = sorted(set(self.train) - {EVERYONE, *self.planners})
        if unknown:
            raise ValueError(f"train: {', '.join(unknown)} is none of {EVERYONE}, {', '.join(self.planners)}")
        if min(self.rounds) < 0:
            raise ValueError(f"rounds={list(self.rounds)}: 0 is real samples alone, 1 the first round with them")

    @property
    def measure(self) -> tuple[str, str]:
        """The score that is drawn: one of planners.evaluation.aggregation.MEASURES."""
        return self.stage, shown(self.human_filter)[self.stage]

    @property
    def means(self) -> Means:
        return Means(self.executor, self.jobs, self.minutes, self.gpus, self.cpus)


def trainings_of(settings: ScalingSettings) -> list[Training]:
    """One for every combination; real samples alone are trained once for all experts, ratios and kinds of imitation."""
    axes = (
        settings.planners,
        settings.experts,
        settings.sim_ratios,
        settings.imitation,
        settings.real_shares,
        settings.rounds,
        settings.seeds,
    )
    found: dict[str, Training] = {}
    for planner, expert, ratio, imitation, share, rounds, seed in itertools.product(*axes):
        if rounds == 0:
            expert, ratio = "", "natural"
            imitation = "none" if imitation == "none" else "all"  # with real samples alone, all are real
        facts = {
            "planner": planner,
            "expert": expert,
            "sim_ratio": ratio,
            "imitation": imitation,
            "real_share": share,
            "rounds": rounds,
            "seed": seed,
        }
        overrides = [
            f"planner={planner}",
            f"data.real=[{','.join(settings.data.real)}]",
            f"data.sim=[{','.join(settings.data.sim) if rounds else ''}]",
            f"data.val=[{','.join(settings.data.val)}]",
            f"data.real_share={share}",
            f"mix.sim_ratio={ratio}",
            f"mix.imitation={imitation}",
            f"seed={seed}",
            *([f"data.max_round={rounds - 1}"] if rounds else []),
            *([f"data.experts=[{expert}]"] if rounds and expert != ALL_EXPERTS else []),
            *([f"steps={settings.steps}"] if settings.steps is not None else []),
            *settings.train.get(EVERYONE, ()),
            *settings.train.get(planner, ()),
        ]
        label = "-".join(str(value) for value in facts.values() if value != "")
        found[label] = Training(label, tuple(overrides), facts)
    return list(found.values())


def curves_of(rows: Sequence[dict[str, Any]], settings: ScalingSettings) -> list[Curve]:
    """The rows by planner, expert, ratio, imitation and share of real data; real samples alone stand in each curve."""
    score = name_of(*settings.measure)
    curves = []
    for planner, expert, ratio, imitation, share in itertools.product(
        settings.planners, settings.experts, settings.sim_ratios, settings.imitation, settings.real_shares
    ):
        mine = [
            row
            for row in rows
            if (row["planner"], row["real_share"]) == (planner, share)
            and (
                (row["expert"], row["sim_ratio"], row["imitation"]) == (expert, ratio, imitation)
                or (row["rounds"] == 0 and (row["imitation"] == "none") == (imitation == "none"))
            )
        ]
        parts = [expert]
        parts += [f"sim_ratio {ratio}"] if len(settings.sim_ratios) > 1 else []
        parts += [{"all": "imitation", "real": "rewards only", "none": "no imitation"}[imitation]]
        parts += [f"{share:g} of real"] if len(settings.real_shares) > 1 else []
        points = tuple(Point(row["samples"], row[score]) for row in mine)
        sizes = {point.samples for point in points}
        law = fit_scaling([p.samples for p in points], [p.score for p in points]) if len(sizes) >= FEWEST else None
        curves.append(Curve(planner, ", ".join(parts), points, law))
    return curves


def facts_of(training: Training, out: Path) -> dict[str, Any]:
    """What one training is, as its own record has it."""
    samples = read_record(folder_of(out, training))["samples"]
    counts = {name: samples[name] for name in ("real", "simulated")}
    return {"training": training.label, **training.facts, **counts, "samples": sum(counts.values())}


def run(settings: ScalingSettings) -> int:
    """Train, evaluate, fit, draw; the exit code."""
    out, trainings = Path(settings.out), trainings_of(settings)
    means = settings.means
    if not (
        train_all(trainings, out, means)
        and evaluate_all(trainings, out, settings.benchmark, *settings.evaluate, means=means)
    ):
        print("not all is trained and evaluated yet: the same command goes on", file=sys.stderr)
        return INTERRUPTED
    report = Path(settings.report or settings.out)
    report.mkdir(parents=True, exist_ok=True)
    labels = [training.label for training in trainings]
    known = [name for name in BOUNDS if (out / EVALUATIONS / name).is_dir()]
    facts = [facts_of(training, out) for training in trainings]
    write_frames(report / FRAMES, rows_of([*labels, *known], out / EVALUATIONS, settings.benchmark), facts)
    rows, differences = write_tables(read_frames(report / FRAMES), report)
    curves = curves_of(rows, settings)
    write_csv(report / "curves.csv", [curve.row() for curve in curves])
    draw_curves(curves, title_of(*settings.measure), report / "scaling.png")
    print(text_of(differences, *settings.measure))
    for curve in curves:
        print(curve.text())
    print(f"tables and picture: {report}")
    return 0


def main(argv: Sequence[str]) -> int:
    """The command; returns the exit code."""
    if {"-h", "--help"} & set(argv):
        print(__doc__)
        return 0
    try:
        return run(fill(ScalingSettings, compose("scaling", argv), "scaling"))
    except (ConfigError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return BAD_CONFIG
    except SweepFailed as error:
        print(f"error: {error}", file=sys.stderr)
        return FAILED


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
