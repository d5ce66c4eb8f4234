"""In what a run differs from the paper's set-up, which conf/preset/paper.yaml holds: one line at its start."""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from factory.config.run import RunConfig, load_config
from tasks.world.vocabulary import Vocabulary

# What the paper says of how samples are made; the rest is this project's own, or how much and where.
WATCHED = (
    "perturb",
    "traffic",
    "pdm",
    "reward.full",
    "reward.progress_above",
    "expert.recovery.smooth",
    "render.mode",
    "render.width",
    "render.height",
    "render.psnr_min",
    "render.psnr_gate",
    "render.gate.enabled",
)


def setup_text(config: RunConfig, vocabulary: Vocabulary) -> str:
    """One line: that the set-up is the paper's, or every setting that is another, with the paper's in brackets."""
    found = differences(config, vocabulary)
    if not found:
        return "set-up: the paper's (preset=paper)"
    return f"set-up: not the paper's (in brackets; preset=paper): {', '.join(found)}"


def differences(config: RunConfig, vocabulary: Vocabulary) -> list[str]:
    """`key=value (the paper's)` for each watched setting that is another.

    Nothing is said of pictures where none are rendered, nor of experts that do not drive.
    """
    paper = load_config(["preset=paper", "vocabulary.file=given"])
    given, wanted = _dotted(dataclasses.asdict(config)), dict(_dotted(dataclasses.asdict(paper)))
    found, size = [], paper.vocabulary.k
    if len(vocabulary) != size or config.vocabulary.file is None:
        kind = "kinematic" if config.vocabulary.file is None else "given"
        found.append(f"vocabulary of {len(vocabulary):,} {kind} trajectories ({size:,} human ones)")
    unseen = [f"expert.{name}" for name in paper.expert if name not in config.experts]
    if config.render.mode is not paper.render.mode:
        unseen += [key for key in WATCHED if key.startswith("render.") and key != "render.mode"]
    return found + [
        f"{key}={value} ({wanted[key]})"
        for key, value in given
        if _within(key, WATCHED) and not _within(key, unseen) and value != wanted[key]
    ]


def _within(key: str, groups: Sequence[str]) -> bool:
    return any(key == group or key.startswith(f"{group}.") for group in groups)


def _dotted(tree: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Keys with dots -> values."""
    for key, value in tree.items():
        if isinstance(value, Mapping):
            yield from _dotted(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value
