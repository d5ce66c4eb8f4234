"""`python -m planners parity <public checkout> python=<its interpreter>`: our planners against the public code.

    python -m planners parity SimScale python=navsim_env/bin/python
    python -m planners parity SimScale python=... cases=[gtrs_dense_v2_99] width=2048 height=512
    python -m planners parity SimScale python=... record=tests/planners/published/recorded
    python -m planners parity SimScale python=... steps=200 cases=[ltf]

The public models (ltf, diffusiondrive, gtrs_dense, gtrs_dense_v2_99) are built of the checkout's source in its own
Python, with weights and inputs made of their names by a formula; ours get the same weights by way of the import. Held
against each other: all outputs in evaluation, and in training mode the losses with their terms and the norm of the
gradient of every matrix, without dropout, since its random numbers differ. Differences are absolute for outputs and
relative for the others.
    train=false          outputs alone, which takes less memory
    checkpoints=true     weights go through a Lightning checkpoint that the public trainer's libraries write
    targets=true         instead of that, what is learnt beside planning: the map from above and the vehicles of a
                         made-up street by the public target builder and ours
    start=true           instead of that, weights as a training begins with them: how each array is spread
    record=<folder>      keep what the public side said, for tests that have no checkout
    steps=200            instead of that, a training of 200 steps each: the public agent with its own optimiser and
                         schedule in Lightning's Trainer, our `fit` with conf/planner/<case>_public.yaml
    first=20             no more than the first 20 of these steps
    rate=1e-5            of both; rounding grows with the rate, see docs/training.md
    double=true          both in float64
Exit code 3 where something is further from the public code than `tolerance` (metres of boxes and losses of a training
ten times, gradients a hundred times: so far goes rounding in float32).
"""

import os
import subprocess
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

from factory.config.arguments import WORD, Refused
from factory.exits import COMPLETE, COMPLETE_WITH_FAILURES
from factory.readers.torch_file import load_tensors
from planners.published.lesson import (
    apart,
    differences_in_learning,
    learned,
    lesson_of,
    read_lesson,
    write_beginning,
    write_lesson,
)
from planners.published.ours import CASES, differences, planner_of, read_recorded
from planners.published.start import apart as spread_otherwise
from planners.published.start import our_start, public_start, write_start
from planners.published.targets import differences_in_targets
from planners.published.weights import read_public

ROWS = 20  # of a curve that are printed
BESIDE = "import sys; sys.path[:0] = sys.argv[1:3]; from planners.published.{0} import main; main(sys.argv[2:])"


@dataclass(frozen=True)
class Request:
    """The command line."""

    code: str = field(metadata=WORD)  # a checkout of SimScale
    python: str  # an interpreter with what the checkout needs
    cases: tuple[str, ...] = CASES
    width: int = 256
    height: int = 64
    tolerance: float = 1e-4
    train: bool = True
    checkpoints: bool = False
    targets: bool = False
    start: bool = False
    record: str | None = None
    steps: int = 0
    first: int = 0
    rate: float = 1e-5
    double: bool = False

    def __post_init__(self) -> None:
        if unknown := [case for case in self.cases if case not in CASES]:
            raise ValueError(f"cases={','.join(unknown)}: give some of {', '.join(CASES)}")
        if self.width % 32 or self.height % 32 or not self.width or not self.height:
            raise ValueError(f"width={self.width} height={self.height}: both must be multiples of 32")
        if not 0 <= self.first <= self.steps:
            raise ValueError(f"first={self.first}: must be within the {self.steps} steps")
        if not (Path(self.code) / "navsim" / "agents").is_dir():
            raise ValueError(f"{self.code}: no checkout of the public code, there is no navsim/agents in it")


def main(request: Request) -> int:
    """Compare and print. Raises Refused where the public side cannot be run."""
    worst = COMPLETE
    if request.targets:
        return COMPLETE if _targets_alike(request) else COMPLETE_WITH_FAILURES
    if request.steps or request.start:
        alike = _trained_alike if request.steps else _begun_alike
        for case in request.cases:
            worst = worst if alike(request, case) else COMPLETE_WITH_FAILURES
        return worst
    for case in request.cases:
        with tempfile.TemporaryDirectory() as folder:
            path, checkpoint = said_beside(request, case, Path(folder))
            recorded = read_recorded(path)
            public = None if checkpoint is None else read_public(checkpoint)
            if request.record is not None:
                kept = Path(request.record)
                kept.mkdir(parents=True, exist_ok=True)
                (kept / f"{case}_{request.width}x{request.height}.npz").write_bytes(path.read_bytes())
        found = planner_of(recorded, public)
        aside = sum(value.numel() for value in found.aside.values())
        ours = sum(parameter.numel() for parameter in found.planner.parameters())
        print(f"{case}, {request.width} x {request.height}; public code: {recorded.origin}")
        print(f"  parameters: {recorded.parameters:,} public = {ours:,} ours + {aside:,} frozen or unused")
        worst = worst if recorded.parameters == ours + aside else COMPLETE_WITH_FAILURES
        for row in differences(recorded, found):
            worst = worst if row.is_within(request.tolerance) else COMPLETE_WITH_FAILURES
            print(f"  {row.what:<42}{row.largest:10.1e}   of {row.size:.4g}")
    return worst


def _targets_alike(request: Request) -> bool:
    """Draw the street in both and print how far apart; whether within the tolerance."""
    with tempfile.TemporaryDirectory() as folder:
        said = Path(folder) / "targets.npz"
        run_beside(request, "targets_beside", [str(said)], "target builder", Path(folder))
        origin, rows = differences_in_targets(said)
        if request.record is not None:
            (Path(request.record) / said.name).write_bytes(said.read_bytes())
    print(f"targets of a made-up street; public code: {origin}")
    for row in rows:
        print(f"  {row.what:<42}{row.largest:10.1e}   of {row.size:.4g}")
    return all(row.is_within(request.tolerance) for row in rows)


def _begun_alike(request: Request, case: str) -> bool:
    """Draw weights in both and print what is spread otherwise; whether nothing is."""
    picture = request.width, request.height
    with tempfile.TemporaryDirectory() as folder:
        drawn = Path(folder) / "drawn.ckpt"
        run_beside(request, "start_beside", [case, *map(str, picture), str(drawn)], case, Path(folder))
        public, arrays = public_start(case, picture, drawn)
        origin = load_tensors(drawn)["origin"]
    if request.record is not None:
        write_start(public, case, origin, Path(request.record) / f"{case}_start.npz")
    said = spread_otherwise(public, our_start(case, picture, arrays))
    print(f"{case}; public code: {origin}\n  {len(said)} of {len(public.spread)} arrays begin otherwise")
    print("".join(f"  {line}\n" for line in said), end="")
    return not said


def _trained_alike(request: Request, case: str) -> bool:
    """Train both and print how; whether they keep within the tolerance."""
    wanted = lesson_of(case, (request.width, request.height), request.steps, request.rate, request.double)
    first = request.first or request.steps
    with tempfile.TemporaryDirectory() as folder:
        given, said = Path(folder) / "lesson.npz", Path(folder) / "said.npz"
        write_lesson(wanted, given, first)
        run_beside(request, "lesson_beside", [str(given), str(said)], case, Path(folder))
        public = read_lesson(said)
        ours = learned(wanted, public.names, first, Path(folder) / "ours")
        if request.record is not None:
            write_beginning(said, Path(request.record) / f"{case}_{request.width}x{request.height}_training.npz")
    print(f"{case}, {request.width} x {request.height}, {first} of {request.steps} steps; public code: {public.origin}")
    print(f"  {'step':>6}{'rate':>12}{'public loss':>14}{'ours':>14}{'apart':>10}")
    off = apart(public.learned, ours)
    for step in range(0, len(off), max(1, len(off) // ROWS)):
        rate, theirs, here = public.learned.rates[step, 0], public.learned.losses[step], ours.losses[step]
        print(f"  {step:>6}{rate:>12.3e}{theirs:>14.6f}{here:>14.6f}{off[step]:>10.1e}")
    rows = differences_in_learning(public.learned, ours)
    for row in rows:
        print(f"  {row.what:<42}{row.largest:10.1e}   of {row.size:.4g}")
    print(f"  {'optimisers':<42}{'equal' if public.learned.optimiser == ours.optimiser else 'different':>10}")
    return public.learned.optimiser == ours.optimiser and all(row.is_within(request.tolerance) for row in rows)


def said_beside(request: Request, case: str, folder: Path) -> tuple[Path, Path | None]:
    """What the public code says of a case, and its checkpoint where one is wanted. Raises Refused."""
    said, checkpoint = folder / "said.npz", folder / "model.ckpt"
    words = [case, str(request.width), str(request.height), str(said)]
    words += [str(int(request.train)), str(checkpoint) if request.checkpoints else ""]
    run_beside(request, "beside", words, case, folder)
    return said, checkpoint if request.checkpoints else None


def run_beside(request: Request, module: str, words: list[str], case: str, folder: Path) -> None:
    """`main` of a module of this room in the public code's Python, told the checkout and the words. Raises Refused."""
    checkout, code = Path(__file__).resolve().parents[2], Path(request.code).resolve()
    environment = {"NAVSIM_EXP_ROOT": str(folder), **os.environ}
    # it starts in another folder; resolved, a virtual environment's link would lead out of it
    python = str(Path(request.python).absolute()) if "/" in request.python else request.python
    asked = [python, "-c", BESIDE.format(module), str(checkout), str(code), *words]
    try:
        done = subprocess.run(  # noqa: S603 - the user's own interpreter
            asked, cwd=folder, env=environment, capture_output=True, text=True, check=False
        )
    except OSError as error:
        raise Refused(f"python={request.python} could not be started: {error.strerror}") from error
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["it said nothing"])[-1]
        raise Refused(f"{request.python} could not run the {case} of {request.code}: {last}")
