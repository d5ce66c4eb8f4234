"""The keys of conf/run.yaml, typed. Importing them is cheap, so that a mistyped value is told at once.

The groups' types stand with the stages that they set. Only those that a command line names are imported for the check.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Literal

from factory.commands import nearest
from factory.config import fill

MOST_K = 2**17  # of a kinematic vocabulary: 126 MB of trajectories, eight times the largest in use
GROUPS = {
    "perturb": "tasks.perturb:PerturbSettings",
    "traffic": "tasks.rollout.simulate:TrafficSettings",
    "pdm": "tasks.experts.pdm_settings:PdmSettings",
    "reward": "factory.reward_settings:RewardSettings",
    "render": "tasks.render.settings:RenderSettings",
    "benchmark": "factory.benchmark:BenchmarkSettings",
}


@dataclass(frozen=True)
class VocabularyChoice:
    """Which trajectories perturb the ego."""

    file: str | None = None
    k: int | None = None
    human: bool = False  # whether a file must be given

    def __post_init__(self) -> None:
        if self.k is not None and self.k < 1:
            raise ValueError(f"k={self.k}: must be positive, or null for the whole file")
        if self.human and self.file is None:
            raise ValueError("file is missing: give vocabulary.file=<.npy (K, 40, 3) of human trajectories>")
        if self.file is None and self.k is not None and self.k > MOST_K:
            raise ValueError(f"k={self.k}: a kinematic vocabulary has at most {MOST_K:,} trajectories")


@dataclass(frozen=True)
class RunKeys:
    """The keys of `python -m factory.run` outside of GROUPS; conf/run.yaml says what each means."""

    clips: dict[str, Any]
    expert: dict[str, dict[str, Any]]
    vocabulary: VocabularyChoice
    rounds: int
    experts: tuple[str, ...]
    executor: Literal["ray", "local"]
    workers: int | None
    gpu_share: float
    limit: int | None
    seed: int
    out: str
    on_change: Literal["stop", "keep", "redo"]
    retry_failed: bool
    minutes: float | None
    shard_seconds: float
    episodes: int | Literal["none", "all"]
    dry_run: bool

    def __post_init__(self) -> None:
        if self.rounds < 1:
            raise ValueError(f"rounds={self.rounds}: at least one round is needed")
        if not self.experts or len(set(self.experts)) != len(self.experts):
            raise ValueError(f"experts={list(self.experts)}: name each expert once, at least one")
        if self.minutes is not None and not self.minutes >= 0.0:
            raise ValueError(f"minutes={self.minutes}: must not be negative, or null for no bound")
        if not self.shard_seconds > 0.0:
            raise ValueError(f"shard_seconds={self.shard_seconds}: must be positive")
        if self.one_episode_in < 0 or self.episodes == 0:
            raise ValueError(f"episodes={self.episodes}: must be none, all, or n for one sample in n")
        for name in ("limit", "workers"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ValueError(f"{name}={value}: must be positive, or null for no bound")
        if not 0.0 <= self.gpu_share <= 1.0:
            raise ValueError(f"gpu_share={self.gpu_share}: the share of one GPU that an attempt claims, 0 to 1")
        unknown = [name for name in self.experts if name not in self.expert]
        if unknown:
            raise ValueError(
                f"experts: {unknown} is not among {sorted(self.expert)}{nearest(unknown[0], list(self.expert))}; "
                "add your own with +expert.<name>"
            )

    @property
    def one_episode_in(self) -> int:
        """Samples; 0 for no episode at all."""
        return {"none": 0, "all": 1}[self.episodes] if isinstance(self.episodes, str) else self.episodes


def check(values: Mapping[str, Any], overrides: Sequence[str]) -> None:
    """Hold the composed settings of a run against their types, as far as the overrides name them.

    Raises ConfigError. Everything else is held against its type when the run is put together.
    """
    fill(RunKeys, {key: value for key, value in values.items() if key not in GROUPS}, "")
    named = {word.lstrip("+~").partition("=")[0].partition(".")[0] for word in overrides}
    for group in sorted(named & set(GROUPS) & set(values)):
        module, _, name = GROUPS[group].partition(":")
        fill(getattr(import_module(module), name), values[group], group)
