"""Settings of an experiment: a short file of YAML, and the words of a command line over it."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal

from factory.config.compose import ConfigError, conf_dir, fill
from factory.config.shapes import deep_merge, defaults_of, yaml_lines
from factory.config.words import SettingsShown, parse_command_line
from planners.training.many import SweepResources

BUILT_IN = "ab.yaml"


@dataclass(frozen=True)
class Arm:
    """What a planner learns from beside the real samples of all arms."""

    __pydantic_config__: ClassVar[dict[str, str]] = {"extra": "forbid"}  # a misspelt key is an error

    real: tuple[str, ...] = ()  # further tables of real samples
    sim: tuple[str, ...] = ()  # tables of simulated ones
    experts: tuple[str, ...] = ()  # whose samples of these; none: everybody's
    added: int | None = None  # simulated samples, where they are not as many as the other arms'
    train: str = ""  # further settings of `python -m planners train`

    def __post_init__(self) -> None:
        if self.experts and not self.sim:
            raise ValueError(f"experts={list(self.experts)}: of which tables? name them under sim")
        if self.added is not None and (self.added < 1 or not self.sim):
            raise ValueError(f"added={self.added}: must be at least 1, of the tables under sim")


@dataclass(frozen=True, kw_only=True)
class AbSettings(SweepResources):
    """Everything in the settings file and on the command line of `planners ab`."""

    out: str  # folder; the same command on it goes on
    real: tuple[str, ...]  # tables whose real samples every arm learns from; names of runs, folders or URLs
    benchmark: tuple[str, ...]  # of held-out clips, by factory.run preset=hard_benchmark; names of runs or folders
    planners: dict[str, str]  # name -> settings of `planners train`, planner=... first
    arms: dict[str, Arm | None]  # name -> what it adds; null takes an arm out
    reference: str = "real"  # the arm that all others are held against
    claim: str = "pdm_closed"  # the arm that the verdict is on
    runs: dict[str, str] = field(default_factory=dict)  # folder below out -> settings of `factory run` that make it
    common: dict[str, str] = field(default_factory=dict)  # texts that settings share by ${common.<name>}
    train: str = ""  # further settings of every training
    steps: int = 1500  # optimiser steps of every training, whatever it learns from
    seeds: int = 2
    added: int | Literal["fewest", "all"] = "fewest"  # simulated samples to each arm: as many as every arm has
    folds: int | Literal["each"] | None = None  # parts of the towns or logs, each held out once; null: already apart
    drives: tuple[str, ...] = ()  # settings of `planners drive`, one for each benchmark; none: no drives
    rows: str | None = None  # folder of an earlier report, made again from its rows; nothing is trained
    executor: Literal["local", "ray"] = "local"
    confidence: float = 0.95

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("reference", "claim"):
            if getattr(self, name) not in self.chosen:
                raise ValueError(f"{name}={getattr(self, name)}: no arm; arms are {', '.join(self.chosen)}")
        if self.reference == self.claim:
            raise ValueError(f"claim={self.claim}: is the reference itself; name another arm")
        if odd := [name for name in (*self.arms, *self.planners) if not name.replace("_", "").isalnum()]:
            raise ValueError(f"{odd[0]}: names of arms and planners have letters, digits and _ alone")
        for name, least in {"steps": 1, "seeds": 1, "added": 1, "folds": 2}.items():
            if isinstance(value := getattr(self, name), int) and value < least:
                raise ValueError(f"{name}={value}: must be at least {least}")
        if not self.benchmark or (self.drives and len(self.drives) != len(self.benchmark)):
            raise ValueError(
                f"{len(self.drives)} drives for {len(self.benchmark)} benchmarks: give one for each, or none"
            )
        if not 0.0 < self.confidence < 1.0:
            raise ValueError(f"confidence={self.confidence}: must lie between 0 and 1")

    @property
    def chosen(self) -> dict[str, Arm]:
        """The arms that are there."""
        return {name: arm for name, arm in self.arms.items() if arm is not None}

    def table(self, name: str) -> str:
        """Where a table or the benchmark lies."""
        return str(Path(self.out) / name) if name in self.runs else name


def settings_of(argv: Sequence[str]) -> AbSettings:
    """The settings of a command line, whose first word may name a file. Raises ConfigError, SettingsShown."""
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    named = bool(argv) and "=" not in argv[0] and not argv[0].startswith("-")
    file = Path(argv[0]) if named else conf_dir() / BUILT_IN
    asked = parse_command_line(argv[named:])
    try:
        found = OmegaConf.merge(OmegaConf.load(file), OmegaConf.from_dotlist(list(asked.overrides)))
        values: Any = OmegaConf.to_container(found, resolve=True, throw_on_missing=not asked.shows)
    except (OmegaConfBaseException, OSError) as error:
        raise ConfigError(f"{file}: {str(error).splitlines()[0]}") from error
    if not isinstance(values, dict):
        raise ConfigError(f"{file}: no settings: it must be a mapping of keys, as conf/{BUILT_IN} is")
    values = deep_merge(defaults_of(AbSettings), values)
    if asked.shows:
        raise SettingsShown("\n".join(yaml_lines(values, AbSettings, {})))
    return fill(AbSettings, values, "")
