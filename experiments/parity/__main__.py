"""Our planners against the public code, number by number: see README.md here.

python -m experiments.parity <checkout of SimScale> --python <its interpreter> [--cases ltf ...]
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from factory.config.compose import ConfigError
from factory.readers.pickles import load_tensors
from planners.published.import_planner import import_weights, read_public_weights
from tests.planners.published.lesson import (
    Lesson,
    apart,
    differences_in_learning,
    learned,
    lesson_of,
    read_lesson,
    samples,
)
from tests.planners.published.ours import CASES, Difference, differences, planner_of, preset, read_recorded
from tests.planners.published.start import Start, our_start, start_kind
from tests.planners.published.start import apart as spread_otherwise
from tests.planners.published.targets import differences_in_targets

HERE = Path(__file__).resolve().parent
FORMULA = HERE.parents[1] / "tests" / "planners" / "published"
ROWS = 20  # of a curve that are printed
RECORDED = 20  # steps of a training that a record keeps


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m experiments.parity", description=__doc__)
    parser.add_argument("code", type=Path, help="a checkout of SimScale")
    parser.add_argument("--python", required=True, help="an interpreter with what the checkout needs")
    parser.add_argument("--what", choices=list(COMPARED), default="outputs")
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("--width", type=int, default=256)
    parser.add_argument("--height", type=int, default=64)
    parser.add_argument("--tolerance", type=float, default=1e-4)
    parser.add_argument("--record", type=Path, help="keep what the public side said, for tests without a checkout")
    parser.add_argument("--evaluation-alone", action="store_true", help="outputs: no losses, which takes less memory")
    parser.add_argument("--checkpoints", action="store_true", help="outputs: weights go through a Lightning checkpoint")
    parser.add_argument("--steps", type=int, default=200, help="training: how many")
    parser.add_argument("--first", type=int, help="training: no more than these of the steps")
    parser.add_argument("--rate", type=float, default=1e-5, help="training: of both; rounding grows with it")
    parser.add_argument("--double", action="store_true", help="training: both in float64")
    return parser.parse_args()


def main(asked: argparse.Namespace) -> int:
    """Compare and print; 3 where something is further from the public code than the tolerance."""
    compared = COMPARED[asked.what]
    cases = ["street"] if asked.what == "targets" else asked.cases
    alike = []
    for case in cases:
        with tempfile.TemporaryDirectory() as folder:
            alike.append(compared(asked, case, Path(folder)))
    return 0 if all(alike) else 3


def outputs_alike(asked: argparse.Namespace, case: str, folder: Path) -> bool:
    """Outputs in evaluation, and losses with gradients in training mode."""
    said, checkpoint = folder / "said.npz", folder / "model.ckpt"
    words = [case, str(asked.width), str(asked.height), str(said)]
    words += [str(int(not asked.evaluation_alone)), str(checkpoint) if asked.checkpoints else ""]
    run_beside(asked, "outputs", words, folder)
    recorded = read_recorded(said)
    keep(asked, said, f"{case}_{asked.width}x{asked.height}.npz")
    found = planner_of(recorded, read_public_weights(checkpoint) if asked.checkpoints else None)
    aside = sum(value.numel() for value in found.aside.values())
    ours = sum(parameter.numel() for parameter in found.planner.parameters())
    print(f"{case}, {asked.width} x {asked.height}; public code: {recorded.origin}")
    print(f"  parameters: {recorded.parameters:,} public = {ours:,} ours + {aside:,} frozen or unused")
    return shown(differences(recorded, found), asked.tolerance) and recorded.parameters == ours + aside


def targets_alike(asked: argparse.Namespace, case: str, folder: Path) -> bool:
    """The map from above and the vehicles of a made-up street."""
    said = folder / "targets.npz"
    run_beside(asked, "targets", [str(said)], folder)
    keep(asked, said, said.name)
    origin, rows = differences_in_targets(said)
    print(f"targets of a made-up street; public code: {origin}")
    return shown(rows, asked.tolerance)


def begun_alike(asked: argparse.Namespace, case: str, folder: Path) -> bool:
    """How each array of weights is spread before a training."""
    picture, drawn = (asked.width, asked.height), folder / "drawn.ckpt"
    run_beside(asked, "start", [case, *map(str, picture), str(drawn)], folder)
    planner = import_weights(preset(case, picture), read_public_weights(drawn), case).planner
    public, arrays = start_kind(planner), {name: np.asarray(array) for name, array in planner.arrays.items()}
    origin = load_tensors(drawn)["origin"]
    if asked.record is not None:
        write_start(public, case, origin, asked.record / f"{case}_start.npz")
    said = spread_otherwise(public, our_start(case, picture, arrays))
    print(f"{case}; public code: {origin}\n  {len(said)} of {len(public.spread)} arrays begin otherwise")
    print("".join(f"  {line}\n" for line in said), end="")
    return not said


def trained_alike(asked: argparse.Namespace, case: str, folder: Path) -> bool:
    """A training of some steps each, from the same weights on the same batches."""
    wanted = lesson_of(case, (asked.width, asked.height), asked.steps, asked.rate, asked.double)
    first = asked.first or asked.steps
    given, said = folder / "lesson.npz", folder / "said.npz"
    write_lesson(wanted, given, first)
    run_beside(asked, "training", [str(given), str(said)], folder)
    public = read_lesson(said)
    if asked.record is not None:
        write_beginning(said, asked.record / f"{case}_{asked.width}x{asked.height}_training.npz")
    ours = learned(wanted, public.names, min(first, len(public.learned.losses)), folder / "ours")
    print(f"{case}, {asked.width} x {asked.height}, {first} of {asked.steps} steps; public code: {public.origin}")
    print(f"  {'step':>6}{'rate':>12}{'public loss':>14}{'ours':>14}{'apart':>10}")
    off = apart(public.learned, ours)
    for step in range(0, len(off), max(1, len(off) // ROWS)):
        rate, theirs, here = public.learned.rates[step, 0], public.learned.losses[step], ours.losses[step]
        print(f"  {step:>6}{rate:>12.3e}{theirs:>14.6f}{here:>14.6f}{off[step]:>10.1e}")
    equal = public.learned.optimiser == ours.optimiser
    print(f"  {'optimisers':<42}{'equal' if equal else 'different':>10}")
    return shown(differences_in_learning(public.learned, ours), asked.tolerance) and equal


COMPARED: dict[str, Callable[[argparse.Namespace, str, Path], bool]] = {
    "outputs": outputs_alike,
    "training": trained_alike,
    "start": begun_alike,
    "targets": targets_alike,
}


def shown(rows: list[Difference], tolerance: float) -> bool:
    """Print differences; whether all are within the tolerance."""
    for row in rows:
        print(f"  {row.what:<42}{row.largest:10.1e}   of {row.size:.4g}")
    return all(row.is_within(tolerance) for row in rows)


def keep(asked: argparse.Namespace, said: Path, name: str) -> None:
    """What the public side said, where a record is wanted."""
    if asked.record is not None:
        asked.record.mkdir(parents=True, exist_ok=True)
        (asked.record / name).write_bytes(said.read_bytes())


def write_lesson(lesson: Lesson, path: Path, first: int) -> None:
    """The first `first` steps of the lesson as beside.py reads them."""
    told = {
        "case": lesson.case,
        "picture": lesson.picture,
        "rate": lesson.training.learning_rate,
        "epoch_steps": lesson.epoch_steps,
        "steps": lesson.steps,
        "double": lesson.double,
    }
    given = samples(lesson.picture)
    np.savez(path, told=np.array(json.dumps(told)), order=lesson.order[:first], seeds=lesson.seeds, **given)


def write_beginning(said: Path, out: Path) -> None:
    """Keep the first steps of a public training."""
    out.parent.mkdir(parents=True, exist_ok=True)
    with np.load(said, allow_pickle=False) as stored:
        kept = {name: stored[name][:RECORDED] if name in ("losses", "rates") else stored[name] for name in stored.files}
    np.savez_compressed(out, **kept)


def write_start(start: Start, case: str, origin: str, path: Path) -> None:
    """Keep a public start."""
    path.parent.mkdir(parents=True, exist_ok=True)
    told = {"case": case, "origin": origin, "names": list(start.spread), "twins": dict(start.twins)}
    np.savez_compressed(path, told=np.array(json.dumps(told)), spread=np.array(list(start.spread.values())))


def run_beside(asked: argparse.Namespace, what: str, words: list[str], folder: Path) -> None:
    """beside.py in the public code's Python, told the checkout and the words. Raises ConfigError where it fails."""
    code = asked.code.resolve()
    paths = os.pathsep.join([str(FORMULA), str(code), *filter(None, [os.environ.get("PYTHONPATH")])])
    environment = {"NAVSIM_EXP_ROOT": str(folder), **os.environ, "PYTHONPATH": paths}
    # it starts in another folder; resolved, a virtual environment's link would lead out of it
    python = str(Path(asked.python).absolute()) if "/" in asked.python else asked.python
    command = [python, str(HERE / "beside.py"), what, str(code), *words]
    done = subprocess.run(  # noqa: S603 - the user's own interpreter
        command, cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["it said nothing"])[-1]
        raise ConfigError(f"{asked.python} could not run the {what} of {asked.code}: {last}")


if __name__ == "__main__":
    try:
        sys.exit(main(arguments()))
    except (ConfigError, OSError) as error:
        sys.exit(f"error: {error}")
