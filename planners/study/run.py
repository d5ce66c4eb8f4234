"""`python -m planners study`: does simulated data make planners better? Trains, evaluates and compares; docs/study.md.

    python -m planners study vocabulary=<K x 40 x 3>.npy           all of it
    python -m planners study ... minutes=25                          a part of it: what is done stays done
    python -m planners study ... parts=[main,rounds]                 some comparisons only
    python -m planners study ... minutes=0                           the tables of what is done, again

Every comparison is made twice: with equal passes over a planner's own data, as the paper does, and with equal optimiser
steps, since more data in equal passes is more training as well. Seeds of parts are trained and evaluated one after the
other, small ones together; when the minutes are out, the tables hold what is done, and say with how many seeds. They
hold every part that is evaluated in `out`, whichever were asked for now. What is written goes to `report`:
`frames.parquet`, EPDMS of each frame by each planner; the tables and pictures, which are made of it
(`python -m planners study_report folder=<report>` makes them again); and the learning curves.
Exit codes: 0 complete, 2 bad settings, 3 a training failed, 4 not complete yet, resumable.
"""

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from factory.config.compose import ConfigError, compose, fill
from planners.data.index import DataSettings, open_dataset
from planners.evaluation.scores import BOUNDS
from planners.study.figures import draw_learning
from planners.study.frames_file import FRAMES, read_frames, rows_of, write_frames
from planners.study.plan import (
    Comparison,
    Portion,
    Sizes,
    StudySettings,
    comparisons,
    legs,
    portions,
    so_far,
    with_all_parts,
)
from planners.study.report import write_tables
from planners.study.sweep import (
    EVALUATIONS,
    Means,
    SweepFailed,
    Training,
    evaluate_all,
    folder_of,
    is_done,
    is_evaluated,
    train_all,
)
from planners.training.checkpoint import read_record

BAD_CONFIG, FAILED, INTERRUPTED = 2, 3, 4


def run(settings: StudySettings) -> int:
    """Train, evaluate, compare, draw, one seed of one part after the other; the exit code."""
    out, means = Path(settings.out), Means(jobs=settings.jobs, minutes=settings.minutes)
    sizes, whole = sizes_of(settings), with_all_parts(settings)
    asked = portions(comparisons(settings), settings, sizes)
    for leg in legs(asked):
        print("; ".join(f"{portion.part}, seed {portion.seed}" for portion in leg), file=sys.stderr)
        trainings = [training for portion in leg for training in portion.trainings]
        others = {label: spec for portion in leg for label, spec in portion.ensembles.items()}
        if not train_all(trainings, out, means):
            break
        if not evaluate_all(trainings, out, settings.benchmark, others=others, means=means):
            break
    wanted = comparisons(whole)
    planned = portions(wanted, whole, sizes)
    done = evaluated(planned, out)
    if done:
        trained = [training for portion in planned for training in portion.trainings if training.label in done]
        write_report(so_far(wanted, done), trained, settings)
    labels = [label for portion in asked for label in portion.labels]
    if missing := set(labels) - done:
        n = len(labels)
        print(f"{n - len(missing)} of {n} planners are evaluated: the same command goes on", file=sys.stderr)
        return INTERRUPTED
    return 0


def evaluated(planned: Sequence[Portion], out: Path) -> set[str]:
    """Labels of all that is trained to its end and evaluated as it is now, by this command or one before it."""
    trainings = [training for portion in planned for training in portion.trainings if is_done(out, training)]
    trained = {training.label: str(folder_of(out, training)) for training in trainings}
    folders = set(trained.values())
    joined = [(label, spec) for portion in planned for label, spec in portion.ensembles.items()]
    whole = {label: spec for label, spec in joined if folders.issuperset(spec.split("+"))}
    return {label for label, spec in (trained | whole).items() if is_evaluated(out, label, spec)}


def write_report(standing: Sequence[Comparison], trained: Sequence[Training], settings: StudySettings) -> None:
    """The per-frame rows of what is evaluated, and the tables and pictures, which are made of them alone."""
    out, report = Path(settings.out), Path(settings.report)
    report.mkdir(parents=True, exist_ok=True)
    compared = [one.setup.label_of(seed) for one in standing for seed in range(one.seeds)]
    labels = dict.fromkeys([*(training.label for training in trained), *compared, *BOUNDS])
    facts = [facts_of(training, out) for training in trained]
    write_frames(report / FRAMES, rows_of(labels, out / EVALUATIONS, settings.benchmark), facts, standing)
    text = write_tables(read_frames(report / FRAMES), report, settings.human_filter)
    draw_learning({t.label: folder_of(out, t) for t in trained if t.facts["seed"] == 0}, report / "learning.png")
    print(text)
    print(f"tables and pictures: {report}")


def sizes_of(settings: StudySettings) -> Sizes:
    """What the plan depends on. Raises ConfigError where one side of the PSNR bound has no samples and is asked for."""
    sim = DataSettings(sim=settings.data, experts=("pdm_closed",), max_round=settings.rounds - 1)
    high = open_dataset(replace(sim, psnr_min=settings.psnr_db))
    real = sum(len(open_dataset(DataSettings(real=table))) for table in (settings.data, settings.begin) if table)
    steps = settings.epochs * ((real + len(high)) // settings.batch_size)
    try:
        low = open_dataset(replace(sim, psnr_max=settings.psnr_db))
    except ValueError as error:
        if "psnr" not in settings.parts:
            return Sizes(steps)
        raise ConfigError(f"part psnr: {error}; leave it out of parts, or choose another psnr_db") from error
    return Sizes(steps, min(len(low), len(high)))


def facts_of(training: Training, out: Path) -> dict[str, Any]:
    """What one training is, as its own record has it."""
    record = read_record(folder_of(out, training))
    return {
        "training": training.label,
        **training.facts,
        "parameters": record["parameters"],
        "optimiser_steps": record["trained"]["steps"],
        "real": record["samples"]["real"],
        "simulated": record["samples"]["simulated"],
    }


def main(argv: Sequence[str]) -> int:
    """The command; returns the exit code."""
    if {"-h", "--help"} & set(argv):
        print(__doc__)
        return 0
    try:
        return run(fill(StudySettings, compose("study", argv), "study"))
    except (ConfigError, ValueError, FileNotFoundError) as error:
        print(f"error: {error}", file=sys.stderr)
        return BAD_CONFIG
    except SweepFailed as error:
        print(f"error: {error}", file=sys.stderr)
        return FAILED


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
