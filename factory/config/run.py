"""The settings of `python -m factory.run`, typed, and their defaults.

Importing them is cheap, and all are held against their types here, so that a mistyped word is told at once.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from factory.config.compose import compose, conf_dir, fill, need_run_extra, refuse_unknown
from factory.config.datasets import reader_settings
from factory.config.plugins import add_installed_experts
from factory.config.shapes import deep_merge, defaults_of, setting_keys
from factory.config.words import ConfigError, did_you_mean
from factory.files import broken_link, in_submitted_job, matching
from tasks.render.settings import RenderMode, RenderSettings, SceneFrom
from tasks.settings import ExpertGate, PerturbSettings, RecoverySettings, TrafficSettings
from tasks.stages import FRAMES, HUMAN, TASKS

MOST_K = 2**17  # of a kinematic vocabulary: 126 MB of trajectories, eight times the largest in use
Repairs = Literal["make", "refuse"]
RemadeStage = Literal["render", "label", "gate"]
RECOVERY = "factory.setup.settings.recovery_expert"
FIRST_LOOK = ("clips.n_clips=3", "clips.settings.width=256", "clips.settings.height=144", "render=town")


@dataclass(frozen=True)
class VocabularyChoice:
    """Which trajectories perturb the ego."""

    file: str | None = None  # .npy (K, 40, 3) of human ones; null: the kinematic vocabulary, for first looks
    k: int | None = None  # the first k of the file alone, null: all; size of the kinematic vocabulary, null: 1024
    human: bool = False  # true: refuse to run without a file

    def __post_init__(self) -> None:
        if self.k is not None and self.k < 1:
            raise ValueError(f"k={self.k}: must be positive, or null for the whole file")
        if self.human and self.file is None:
            raise ValueError("file is missing: give vocabulary.file=<.npy (K, 40, 3) of human trajectories>")
        if self.file is None and self.k is not None and self.k > MOST_K:
            raise ValueError(f"k={self.k}: a kinematic vocabulary has at most {MOST_K:,} trajectories")


@dataclass(frozen=True)
class RewardSettings(ExpertGate):
    """What an expert's drive must reach, and the vocabulary labels that stand in every sample."""

    labels: Literal["vocabulary", "none"] = "vocabulary"  # of a whole vocabulary, for planners that learn to score
    label_vocabulary: str | None = None  # another .npy file (K, 40, 3); null: the run's vocabulary

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.labels == "none" and self.label_vocabulary is not None:
            raise ValueError(
                f"label_vocabulary={self.label_vocabulary} is for labels=vocabulary, but labels=none: leave one out"
            )


@dataclass(frozen=True)
class PerturbSources(PerturbSettings):
    """The gates of a perturbation, and what they are asked about beside the vocabulary."""

    starts: str | None = None  # .parquet of start states by clip, tried before the vocabulary's; null: none

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.starts is not None and self.at_log:
            raise ValueError(f"perturb starts={self.starts}: at_log=true tries the log alone: leave one out")


@dataclass(frozen=True)
class BenchmarkSettings:
    """What makes a clip of preset=hard_benchmark count."""

    min_follow_ups: int = 8  # complete pairs; clips with fewer are named and do not count

    def __post_init__(self) -> None:
        if self.min_follow_ups < 1:
            raise ValueError(f"min_follow_ups={self.min_follow_ups}: at least one is needed")


@dataclass(frozen=True)
class RecoverySources(RecoverySettings):
    """A recovery expert, and what its table is made from."""

    table: str | None = None  # .npz of `factory vocabulary table=...`; null: the clips' TRAIN windows and vocabularies
    vocabularies: tuple[str, ...] = ()  # further .npy files of human trajectories, beside the run's vocabulary.file


EXPERTS: Mapping[str, type[Any]] = {RECOVERY: RecoverySources}  # `_target_` of a built-in expert -> its own settings


@dataclass(frozen=True)
class GraphChoice:
    """Where tasks work, and what they claim on Ray; rows do not depend on it."""

    isolated: Literal["auto", "always", "never"] = "auto"  # local work in another process; auto: plug-ins, pickles
    memory_gb: dict[str, float] = field(default_factory=dict)  # by task, where it is not the 1 GB (reconstruct: 2)
    limit_s: dict[str, float] = field(default_factory=dict)  # seconds after which a task is ended, by task
    limit_gb: dict[str, float] = field(default_factory=dict)  # memory beyond which a task is ended, by task

    def __post_init__(self) -> None:
        known = [task.name for task in TASKS]
        for key in ("memory_gb", "limit_s", "limit_gb"):
            for name, value in getattr(self, key).items():
                if name not in known:
                    raise ValueError(
                        f"{key}.{name}: there is no such task{did_you_mean(name, known)}; there are {known}"
                    )
                if not value >= 0.0:
                    raise ValueError(f"{key}.{name}={value}: must not be negative")


@dataclass(frozen=True)
class RunConfig:
    """Everything on the command line of `python -m factory.run`."""

    clips: dict[str, Any]  # the reader, and which clips of its data
    expert: dict[str, dict[str, Any]]  # all there are; `experts` picks
    out: str  # folder or URL; the same command on it resumes; default $FACTORY_RUNS or runs/, and the name of the clips
    rounds: int = 1  # accepted attempts wanted per clip and expert
    experts: tuple[str, ...] = ("pdm_closed", "recovery", "human")  # who drives
    executor: Literal["ray", "local"] = "ray"  # local: in this process, for a debugger
    workers: int | None = None  # processes; null: every core; on a cluster that grows: tasks at once
    gpu_share: float = (
        0.1  # of a GPU that a task which draws or fits claims with render.backend=gsplat; 1/share share one
    )
    graph: GraphChoice = field(default_factory=GraphChoice)
    limit: int | None = None  # read this many clips only
    seed: int = 0  # of every random draw
    repairs: Repairs = "make"  # refuse: a clip of which anything had to be repaired or left out fails
    on_change: Literal["stop", "keep", "redo"] = "stop"  # when settings or stage versions differ from the table's
    remake: tuple[RemadeStage, ...] = ()  # stages of a finished run to be made again: python -m factory remake
    retry_failed: bool = False  # run attempts again that failed on their input or by a bug
    minutes: float | None = None  # after which nothing new is begun (exit code 4); the same command goes on
    shard_seconds: float = 30.0  # between commits, if no partition reaches 128 MB before; longer: larger files
    episodes: int | Literal["none", "all"] = "none"  # or n for one sample in n: MCAP files under out/episodes
    vocabulary: VocabularyChoice = field(default_factory=VocabularyChoice)
    perturb: PerturbSources = field(default_factory=PerturbSources)
    traffic: TrafficSettings = field(default_factory=TrafficSettings)
    reward: RewardSettings = field(default_factory=RewardSettings)
    render: RenderSettings = field(default_factory=RenderSettings)
    benchmark: BenchmarkSettings = field(default_factory=BenchmarkSettings)

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
            raise ValueError(f"gpu_share={self.gpu_share}: the share of one GPU that a task which draws claims, 0 to 1")
        if self.perturb.at_log and self.reward.near_log and set(self.experts) - {HUMAN, *FRAMES}:
            raise ValueError("perturb.at_log=true: what is driven from the log is refused by reward.near_log: false it")
        known = sorted({*self.expert, *FRAMES})
        unknown = [name for name in self.experts if name not in known]
        if unknown:
            raise ValueError(
                f"experts: {unknown} is not among {known}{did_you_mean(unknown[0], known)}; "
                "add your own with expert.<name>._target_=<class>"
            )

    @property
    def one_episode_in(self) -> int:
        """Samples; 0 for no episode at all."""
        return {"none": 0, "all": 1}[self.episodes] if isinstance(self.episodes, str) else self.episodes


def compose_run(words: Sequence[str]) -> dict[str, Any]:
    """The settings of a command line with all defaults, not yet typed. Raises ConfigError, SettingsShown."""
    return compose("run", [*first_look(words), *words], RunConfig, completed, settings_classes)


def first_look(words: Sequence[str]) -> list[str]:
    """What goes before a command line that leaves open which clips: FIRST_LOOK, but for a group that it chooses."""
    given = {word.partition("=")[0] for word in words}
    return [] if given & {"clips", "preset"} else [word for word in FIRST_LOOK if word.partition("=")[0] not in given]


def announcement(config: RunConfig, words: Sequence[str]) -> str:
    """What a run is about to do, as far as its settings tell; and how other clips are chosen, where none were."""
    render, name, shape = config.render, config.clips["name"], reader_settings(config.clips)
    fitted = render.mode is RenderMode.AUTO and render.scene is SceneFrom.FIT
    fit = f"where there are photos, from scenes fitted in {render.fit.iterations} iterations"
    how = fit if fitted else f"({render.mode})"
    drawn = f"pictures of {render.width}x{render.height} {how}" if render.mode is not RenderMode.NONE else "no pictures"
    told = [f"rounds={config.rounds}", drawn, f"out={config.out}"]
    if shape is not None and (clips := fill(shape, own_settings(config.clips), "clips").summary):
        told.insert(0, clips)
    line = f"clips={name}: {'; '.join(told)}"
    if not (first := first_look(words)):
        return line
    others = "|".join(other for other in built_in_classes("clips") if not other.startswith(name))
    return f"{line}\nno clips= given, so this is a first look ({' '.join(first)}); your logs: clips={others}"


def completed(values: Mapping[str, Any]) -> dict[str, Any]:
    """With every installed expert, and the defaults of the chosen reader and of the experts."""
    values = add_installed_experts(values, conf_dir())
    for key, shape in settings_classes(values).items():
        group, _, name = key.partition(".")
        given = values[group][name] if name else values[group]
        refuse_unknown(shape, own_settings(given), key, said=_choices_with_key)
        full = {**given, **deep_merge(defaults_of(shape), given)}
        values = {**values, group: {**values[group], name: full} if name else full}
    return values


def typed_run_config(values: Mapping[str, Any]) -> RunConfig:
    """The typed settings of composed ones, those of the reader and of the experts held against their types too.

    Raises ConfigError.
    """
    config = fill(RunConfig, values, "")
    rig: tuple[str, ...] = ()
    painted = config.render.mode is RenderMode.PAINTER
    for key, shape in settings_classes(values).items():
        group, _, name = key.partition(".")
        filled = fill(shape, own_settings(values[group][name] if name else values[group]), key)
        rig = filled.rig(painted) if key == "clips" else rig
    asked = config.render.cameras if rig and config.render.mode is not RenderMode.NONE else ()
    if missing := [name for name in asked if name not in rig]:
        raise ConfigError(f"render.cameras: no camera {', '.join(missing)}; this rig has {', '.join(rig)}")
    if painted and not rig:
        raise ConfigError("render.mode=painter: only the synthetic town has a painter, and these clips are of no town")
    if config.executor == "ray":
        need_run_extra("ray")
    return config


def photos_alone(config: RunConfig) -> bool:
    """Whether clips may have photos and no lidar, as far as the settings of their reader tell. Raises ConfigError."""
    shape = reader_settings(config.clips)
    return shape is None or bool(fill(shape, own_settings(config.clips), "clips").photos_alone)


def refuse_relative_root(clips: Mapping[str, Any]) -> None:
    """Raises ConfigError for relative logs or photos inside a submitted Ray job, whose folder is a temporary copy."""
    for key in ("root", "cameras", "sensor_root") if reader_settings(clips) else ("root",):
        path = clips.get(key)
        if in_submitted_job() and isinstance(path, str) and not Path(path).is_absolute():
            raise ConfigError(
                f"clips.{key}={path} is relative, and a submitted job runs in a copy of the working directory: "
                "name an absolute path that every node sees"
            )


def refuse_missing_root(clips: Mapping[str, Any]) -> None:
    """Raises ConfigError where a built-in reader's clips.root is not there, before the reader is imported."""
    refuse_relative_root(clips)
    root = clips.get("root")
    if reader_settings(clips) and isinstance(root, str) and not Path(root).exists():
        raise ConfigError(f"clips: {root}: {broken_link(root) or 'no such folder'}")


def load_config(words: Sequence[str]) -> RunConfig:
    """The typed settings of a command line. Raises ConfigError."""
    return typed_run_config(compose_run(words))


def settings_classes(values: Mapping[str, Any]) -> dict[str, type[Any]]:
    """Key -> dataclass of the built-in reader and experts that a run's settings name."""
    reader = reader_settings(values["clips"])
    experts = {
        f"expert.{name}": EXPERTS[spec["_target_"]]
        for name, spec in values["expert"].items()
        if spec.get("_target_") in EXPERTS
    }
    return {**({} if reader is None else {"clips": reader}), **experts}


def own_settings(spec: Mapping[str, Any]) -> dict[str, Any]:
    """What is a setting of the reader or expert itself."""
    return {
        key: own_settings(value) if isinstance(value, Mapping) else value
        for key, value in spec.items()
        if key not in ("name", "_target_")
    }


def built_in_classes(group: str) -> dict[str, str]:
    """Choice -> `_target_` of the files in conf/<group>."""
    found = {
        file.stem: re.search(r"^_target_: (\S+)", file.read_text(encoding="utf-8"), re.M)
        for file in matching(conf_dir() / group, "*.yaml")
    }
    return {name: target[1] for name, target in sorted(found.items()) if target}


def reader_settings_class(choice: str) -> type[Any] | None:
    """The settings of the built-in reader `clips=<choice>`; None where there is none of that name."""
    return reader_settings({"_target_": built_in_classes("clips").get(choice, "")})


def _choices_with_key(key: str) -> str:
    """Which other choices have this key of `clips`."""
    group, _, inner = key.partition(".")
    names = [file.stem for file in matching(conf_dir() / "clips", "*.yaml")] if group == "clips" else []
    shapes = {name: shape for name in names if (shape := reader_settings_class(name)) is not None}
    having = [f"clips={name}" for name, shape in shapes.items() if inner in dict(setting_keys(shape))]
    return f"{key} is a setting of {', '.join(having)}: choose one of them too" if having else ""
