"""Everything on the command line of `planners explore`, typed."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from factory.config.compose import fill
from factory.config.run import refuse_missing_root
from planners.drive.loop import PLAN_STEPS
from planners.drive.settings import Pictures, with_clips
from planners.evaluation.planner_names import composed
from planners.explore.drift import Handover, Judging, ways_of
from tasks.experts.pdm_closed.settings import PdmSettings
from tasks.render.settings import RenderSettings
from tasks.rollout.settings import TrafficSettings
from tasks.settings import ExpertGate, PerturbSettings
from tasks.world.clip import HORIZON_STEPS, STEP_S


@dataclass(frozen=True)
class ExploreSettings:
    """Who drives in which clips, in what ways, judged by what."""

    clips: dict[str, Any]  # the reader, and which clips of its data
    planner: str | None = None  # a training's folder, constant_velocity, pdm_closed, or my.module:MyPlanner
    settings: dict[str, Any] = field(default_factory=dict)  # of planning, changed in a trained planner
    pictures: Pictures = "truth"  # of a planner that may look: truth: the town's painter; engine: the blocks' scenes
    handover_s: tuple[float, ...] = (0.0, 1.0, 2.0, 3.0)  # closed loop from so long after T; before, the log
    open_loop: bool = True  # the plan at T too, followed for 4 s
    out: str = "explored"  # folder or URL, of one planner; the same command on it explores what is not explored yet
    cache: str | None = None  # folder of scenes, such as a run's out/cache; null: out/cache
    executor: Literal["local", "ray"] = "local"
    workers: int | None = None  # processes; null: one here, every core on Ray
    limit: int | None = None  # the first so many clips only
    device: str = "cpu"  # or cuda
    perturb: PerturbSettings = field(default_factory=PerturbSettings)  # how far from the log a drift may end
    traffic: TrafficSettings = field(default_factory=TrafficSettings)
    pdm: PdmSettings = field(default_factory=PdmSettings)
    reward: ExpertGate = field(default_factory=ExpertGate)  # what a drive of the planner must reach not to fail
    render: RenderSettings = field(default_factory=RenderSettings)

    def __post_init__(self) -> None:
        """Raises ValueError for what cannot be explored."""
        for name in ("workers", "limit"):
            if getattr(self, name) is not None and getattr(self, name) < 1:
                raise ValueError(f"{name}={getattr(self, name)}: must be positive, or null for no bound")
        half, last_s = PLAN_STEPS * STEP_S, (HORIZON_STEPS - PLAN_STEPS) * STEP_S
        for after_s in self.handover_s:
            if not 0.0 <= after_s <= last_s or abs(after_s / half - round(after_s / half)) > 1e-9:
                raise ValueError(f"handover_s={after_s}: a multiple of {half} s from 0 to {last_s}")
        if len(set(self.handover_s)) < len(self.handover_s):
            raise ValueError(f"handover_s={list(self.handover_s)}: each time once")

    @property
    def ways(self) -> tuple[Handover, ...]:
        """In which the planner is let drive, in the order of their numbers."""
        return ways_of(self.open_loop, self.handover_s)

    @property
    def judging(self) -> Judging:
        """By what and among whom."""
        return Judging(self.perturb, self.traffic, self.pdm, self.reward)


def settings_of(argv: Sequence[str]) -> ExploreSettings:
    """The settings of a command line. Raises ConfigError."""
    settings = fill(ExploreSettings, composed("explore", argv, ExploreSettings, with_clips), "")
    refuse_missing_root(settings.clips)
    return settings
