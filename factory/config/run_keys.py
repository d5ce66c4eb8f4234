"""The keys of conf/run.yaml, typed. Importing them is cheap, so that a mistyped value is told at once.

The groups' types stand with the stages that they set. Only those that a command line names are imported for the check.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Literal

from factory.config.compose import ConfigError, conf_dir, fill
from factory.config.known import settings_of
from factory.config.words import nearest

MOST_K = 2**17  # of a kinematic vocabulary: 126 MB of trajectories, eight times the largest in use
GROUPS = {
    "perturb": "tasks.perturb:PerturbSettings",
    "traffic": "tasks.rollout.simulate:TrafficSettings",
    "pdm": "tasks.experts.pdm_closed.settings:PdmSettings",
    "reward": "factory.config.reward:RewardSettings",
    "render": "tasks.render.settings:RenderSettings",
    "benchmark": "factory.stages.benchmark:BenchmarkSettings",
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
    keys = [word.lstrip("+~").partition("=")[0] for word in overrides]
    for key in keys:
        refuse_other_kind(values, key)
    for group in sorted({key.partition(".")[0] for key in keys} & set(GROUPS) & set(values)):
        module, _, name = GROUPS[group].partition(":")
        fill(getattr(import_module(module), name), values[group], group)


def refuse_other_kind(values: Mapping[str, Any], key: str) -> None:
    """Raises ConfigError where a group's setting is text and its default a number, or none of its choices.

    What conf/ says is enough for that; the types of some groups take a second to import.
    """
    group, _, inner = key.partition(".")
    value = at(values, key)
    if group not in GROUPS or not inner or not isinstance(value, str):
        return
    default = at(default_group(group), inner)
    choices = settings_of([]).get(key, [])
    if isinstance(default, bool):
        wrong = "must be true or false"
    elif isinstance(default, int | float):
        wrong = "must be a number"
    elif choices and value not in choices:
        wrong = f"must be {' or '.join(filter(None, (', '.join(choices[:-1]), choices[-1])))}{nearest(value, choices)}"
    else:
        return
    raise ConfigError(f"{key}: {wrong} (got {value!r})")


def default_group(group: str) -> Mapping[str, Any]:
    """The file of the choice that conf/run.yaml makes for a group; its own keys for what is no folder of choices."""
    from omegaconf import OmegaConf

    run: Any = OmegaConf.to_container(OmegaConf.load(conf_dir() / "run.yaml"))
    choice = next((line[group] for line in run["defaults"] if isinstance(line, dict) and group in line), None)
    if choice is None:
        return dict(run[group])
    chosen: Any = OmegaConf.to_container(OmegaConf.load(conf_dir() / group / f"{choice}.yaml"))
    return dict(chosen)


def at(tree: Any, key: str) -> Any:
    """The value of a dotted key; None where there is none."""
    for part in key.split("."):
        if not isinstance(tree, Mapping) or part not in tree:
            return None
        tree = tree[part]
    return tree
