"""Everything on the command line of `planners drive`, typed."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from factory.config.compose import fill, refuse_unknown
from factory.config.datasets import reader_settings
from factory.config.run import VocabularyChoice, own_settings, refuse_missing_root
from factory.config.shapes import deep_merge, defaults_of
from planners.drive.loop import LoopSettings
from planners.drive.mpc import ControllerName
from planners.evaluation.planner_names import compose_with_planner
from tasks.render.settings import RenderSettings
from tasks.settings import PerturbSettings, TrafficSettings

Pictures = Literal["truth", "engine", "renderer", "none"]


@dataclass(frozen=True)
class DriveSettings:
    """Who drives, from where, among whom, seeing what."""

    clips: dict[str, Any]  # the reader, and which clips of its data
    planner: str | None = None  # a training's folder, human, pdm_closed, constant_velocity, or my.module:MyPlanner
    planners: list[str] | dict[str, str] | None = None  # several: a list, or {label: planner, ...}
    driver: str | None = None  # host:port of a driver of AlpaSim's, in their place
    bounds: bool = True  # human, pdm_closed and constant_velocity too
    settings: dict[str, Any] = field(default_factory=dict)  # of planning, changed in all trained planners
    pictures: tuple[Pictures, ...] = ("truth",)  # of planners that look: truth: the town's painter; engine: scenes
    renderer: str | None = None  # of pictures=[renderer]: host:port of AlpaSim's, or a run, whose scenes are drawn here
    logged: bool = True  # drive from the log at T
    perturbed: int = 0  # drive from so many candidates of each clip too, at T+H
    seconds: float = 5.5  # of the log, that are driven
    controller: ControllerName = "linear"  # AlpaSim's, that follows plans; its board has nonlinear
    films: int | Literal["none", "all"] = "none"  # or n for one drive in n: MP4 files under out/films
    out: str = "drives"  # folder or URL; the same command on it drives what is not driven yet
    cache: str | None = None  # folder of scenes, such as a run's out/cache; null: out/cache
    executor: Literal["local", "ray"] = "local"
    workers: int | None = None  # processes; null: one here, every core on Ray
    limit: int | None = None  # the first so many clips only
    only_logs: tuple[str, ...] = ()  # ids of logs, whose clips alone; none: of all
    seed: int = 0  # of the perturbations
    device: str = "cpu"  # or cuda
    confidence: float = 0.95  # of the intervals
    vocabulary: VocabularyChoice = field(default_factory=VocabularyChoice)
    perturb: PerturbSettings = field(default_factory=PerturbSettings)
    traffic: TrafficSettings = field(default_factory=TrafficSettings)
    render: RenderSettings = field(default_factory=RenderSettings)

    def __post_init__(self) -> None:
        """Raises ValueError for what cannot be driven."""
        self.rules  # noqa: B018 - raises ValueError for a drive that cannot be
        for name in ("workers", "limit"):
            if getattr(self, name) is not None and getattr(self, name) < 1:
                raise ValueError(f"{name}={getattr(self, name)}: must be positive, or null for no bound")
        if self.perturbed < 0 or not (self.logged or self.perturbed):
            raise ValueError(f"perturbed={self.perturbed}, logged={self.logged}: there is nothing to drive from")
        if self.films == 0 or self.one_film_in < 0:
            raise ValueError(f"films={self.films}: must be none, all, or n for one drive in n")
        if len(set(self.pictures)) < len(self.pictures) or not self.pictures:
            raise ValueError(f"pictures={list(self.pictures)}: each kind once, at least one")
        if ("renderer" in self.pictures) != (self.renderer is not None):
            raise ValueError("renderer=host:port, or a run, goes with pictures=[renderer], and that with it")
        if not 0.0 < self.confidence < 1.0:
            raise ValueError(f"confidence={self.confidence}: must lie between 0 and 1")

    @property
    def rules(self) -> LoopSettings:
        """What every drive depends on."""
        return LoopSettings(self.seconds, self.controller, self.traffic)

    @property
    def one_film_in(self) -> int:
        """Drives; 0 for no film at all."""
        return {"none": 0, "all": 1}[self.films] if isinstance(self.films, str) else self.films


def settings_of(argv: Sequence[str]) -> DriveSettings:
    """The settings of a command line. Raises ConfigError."""
    settings = fill(DriveSettings, compose_with_planner("drive", argv, DriveSettings, with_reader_defaults), "")
    refuse_missing_root(settings.clips)
    return settings


def with_reader_defaults(values: dict[str, Any]) -> dict[str, Any]:
    """With the defaults of the reader's settings, held against their types where it is a built-in one."""
    clips = values["clips"]
    shape = reader_settings(clips)
    if shape is None:
        return values
    refuse_unknown(shape, own_settings(clips), "clips")
    full = {**clips, **deep_merge(defaults_of(shape), clips)}
    fill(shape, own_settings(full), "clips")
    return values | {"clips": full}
