"""Commands before a run: plan, vocabulary, warm."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import factory.run
from factory.config.arguments import GIVEN_ALONE, POSITIONAL, RUN_SETTINGS, Refused, command, request_keys
from factory.config.datasets import words_of
from factory.config.run import RunConfig
from factory.config.words import did_you_mean, parse_command_line

if TYPE_CHECKING:
    from factory.readers.base import ClipReader


@command("run", RunConfig, refused=(), resumes=True)
def plan(argv: Sequence[str]) -> int:
    """`python -m factory plan ...`: what a run of these settings would take; nothing is written but cached blocks.

        python -m factory plan clips=av2 clips.root=<logs> rounds=5 out=runs/next

    Clips, attempts, samples, hours, GB and what holds it up, from three clips and the blocks that these lie in. Takes
    the settings of `python -m factory run`.
    Exit codes: 0 told, 2 bad settings or no clip.
    """
    return factory.run.run(parse_command_line(argv), only_plan=True)


@dataclass(frozen=True)
class VocabularyRequest:
    """What to build from the train clips."""

    out: str | None = None  # a vocabulary: .npy (k, 40, 3)
    k: int = 8192
    seed: int = 0
    table: str | None = None  # a recovery table: .npz
    vocabularies: tuple[str, ...] = ()  # files whose trajectories go into the table too
    every_s: float = 0.5  # a window starts this often
    kinematic: bool = False  # out: k seeded trajectories, as a run without vocabulary.file has; reads no clips
    settings: tuple[str, ...] = field(default=(), metadata=RUN_SETTINGS | GIVEN_ALONE)

    def __post_init__(self) -> None:
        for key, equals, _ in (word.lstrip("+").partition("=") for word in self.settings):
            if not equals:
                raise ValueError(f"{key!r}: expected key=value; see --help")
            if key.partition(".")[0] != "clips":
                meant = did_you_mean(key, [*request_keys(VocabularyRequest), "clips"])
                raise ValueError(f"{key}: there is no such setting; see --help{meant}")
        if self.kinematic and (self.out is None or self.table is not None):
            raise ValueError("kinematic=true makes a vocabulary: give out=<file>.npy, and no table")
        if self.out is None and self.table is None:
            raise ValueError("nothing to build: give out=<file>.npy, table=<file>.npz or both")
        for name, file, suffix in (("out", self.out, ".npy"), ("table", self.table, ".npz")):
            if file is not None and Path(file).suffix != suffix:
                raise ValueError(f"{name}={file} must end in {suffix}")


def vocabulary(request: VocabularyRequest) -> None:
    """`python -m factory vocabulary`: vocabularies and recovery tables out of a data set's own TRAIN logs.

        python -m factory vocabulary clips=av2 clips.root=<logs> k=1024 out=vocabulary.npy
        python -m factory vocabulary kinematic=true k=1024 out=labels.npy
        python -m factory vocabulary clips=av2 clips.root=<logs> table=recovery.npz vocabularies=[human_8192x40x3.npy]

    `clips` and `clips.*` are those of `python -m factory.run`. Other keys: k=8192 and seed=0 of the vocabulary,
    every_s=0.5 between the starts of windows. Each artefact has a .json with its digest and origin beside it.
    """
    from factory.config.compose import build, compose
    from factory.setup.vocabulary import save_vocabulary
    from tasks.world.vocabulary import Vocabulary, kinematic_trajectories

    try:
        if request.kinematic:
            made = Vocabulary(kinematic_trajectories(request.k, request.seed), source="kinematic")
            save_vocabulary(str(request.out), made, {"source": "kinematic", "seed": request.seed})
            print(f"{request.out}: {len(made)} kinematic trajectories, {made.digest}")
        else:
            print("\n".join(build_from_logs(request, build(compose("run", request.settings)["clips"], "clips"))))
    except (ValueError, OSError) as error:
        raise Refused(str(error)) from error


def build_from_logs(request: VocabularyRequest, reader: "ClipReader") -> list[str]:
    """Builds and writes what is asked for; one line of report for each artefact.

    Raises ValueError where the root has no data, no train log or too few windows, or a vocabulary file is broken.
    """
    from factory.setup.vocabulary import (
        build_recovery_table,
        build_vocabulary,
        load_vocabulary,
        save_recovery_table,
        save_vocabulary,
        train_windows,
    )

    vocabularies = [load_vocabulary(file) for file in request.vocabularies]  # first: broken files fail at once
    windows = train_windows(reader, request.every_s)
    origin: dict[str, object] = {
        "reader": reader.name,
        "train_logs": list(windows.logs),
        "train_windows": len(windows.trajectories),
        "unreadable": windows.broken,
    }
    lines = []
    if request.out is not None:
        vocabulary = build_vocabulary(windows, request.k, request.seed)
        save_vocabulary(request.out, vocabulary, origin | {"seed": request.seed})
        lines.append(f"{request.out}: {len(vocabulary)} of {len(windows.trajectories)} windows, {vocabulary.digest}")
    if request.table is not None:
        table = build_recovery_table([windows], vocabularies)
        files = {Path(file).name: vocabulary.digest for file, vocabulary in zip(request.vocabularies, vocabularies)}
        save_recovery_table(request.table, table, origin | {"vocabularies": files})
        lines.append(
            f"{request.table}: {len(table)} trajectories, {len(windows.trajectories)} of them from "
            f"{len(windows.logs)} train logs, {table.digest}"
        )
    lines += [f"unreadable {name}: {reason}" for name, reason in sorted(windows.broken.items())]
    return lines


@dataclass(frozen=True)
class WarmRequest:
    """The command line."""

    parts: tuple[str, ...] = field(default=(), metadata=POSITIONAL)


def warm(request: WarmRequest) -> None:
    """`python -m factory warm [part ...]`: compile the kernels before the first run, some 110 s on a core.

        python -m factory warm                  all of them, and what the synthetic town is drawn with
        python -m factory warm drive judge      parts: what a run that only drives needs, what scores need

    Each is compiled once per machine, processor and version; what is there is not compiled again.
    """
    from factory.graph.steps import NotReady
    from factory.stages.warm import PARTS, compile_kernels

    if unknown := sorted(set(request.parts) - PARTS.keys()):
        raise Refused(f"no part {', '.join(unknown)}; there are {', '.join(PARTS)}")
    try:
        compile_kernels(request.parts or ("judge", "plan", "drive", "fit", "rig", *words_of("KERNELS")))
    except NotReady as error:
        raise Refused(str(error)) from error
