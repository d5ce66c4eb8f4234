"""The stages, on one screen: what the graph, the metrics, the funnel and the docs are drawn from.

`clip -> perturb -> [ rollout -> expert -> rollout -> reward -> render -> write ] per attempt`
A stage is a pure function `stage(inputs, settings, rng) -> output | Rejected`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

from tasks.subscores import SUBSCORES


@dataclass(frozen=True)
class Stage:
    """One stage of the graph."""

    name: str
    version: int  # raised by hand whenever the stage's output changes; a golden test watches
    fan_out: str  # "clip" once per clip, "attempt" once per attempt
    reasons: tuple[str, ...]  # every reason it may reject with


@dataclass(frozen=True)
class Rejected:
    """A drop with its reason: data, not an error."""

    stage: str
    reason: str
    detail: str = ""
    counts: Mapping[str, int] = field(default_factory=dict)  # what was counted on the way, such as drops by gate


HUMAN = "human"  # the expert that is the log itself
# The frames of a benchmark (tasks.hard_scenes): they stand where an expert's name does, in settings and tables.
HUMAN_BEFORE, FOLLOW_UP, FOLLOW_UP_BEFORE = FRAMES = ("human_before", "follow_up", "follow_up_before")
END_FAULTS = ("off_route", "after")  # of a drive that reaches every sub-score: what its end leads to (tasks.attempt)
NEAR_LOG = "near_log"  # a drive that passes all else and is the log's own
NOT_RECOVERED = "not_recovered"  # a drive that passes all else and ends too far from where its plan was to end
PICTURE_FAULTS = ("holes", "lens_covered", "blank", "blurred", "guessed", "unlike_photos")  # tasks.render.gate

STAGES: tuple[Stage, ...] = (
    Stage("clip", 5, "clip", ("ego_standing", "broken_tracks", "route_ended", "no_earlier_frame")),
    Stage("perturb", 3, "clip", ("no_gated_candidate", "no_good_candidate")),
    Stage("rollout", 4, "attempt", ("route_ended",)),
    Stage("expert", 3, "attempt", ("no_plan", "out_of_reach")),
    Stage("reward", 2, "attempt", (*SUBSCORES, *END_FAULTS, NEAR_LOG, NOT_RECOVERED)),
    Stage("render", 16, "attempt", ("psnr", *PICTURE_FAULTS)),
    Stage("write", 6, "attempt", ()),
)


@dataclass(frozen=True)
class Task:
    """What a machine is asked to do at once; Ray, the metrics and docs/concepts.md know it by this name."""

    name: str
    stages: tuple[str, ...]  # as their seconds are told
    per: str  # block, clip, attempt, batch
    memory_gb: float  # that its worker holds meanwhile; claimed of its node, as is a core
    limit_s: float  # what takes longer is ended
    limit_gb: float | None = 8.0  # what holds more is ended; None: more than nine tenths of the machine's
    may_draw: bool = False  # or fits what is drawn: claims its share of a GPU where that is done on one


TASKS: tuple[Task, ...] = (
    Task(
        "reconstruct", ("reconstruct",), "block", 2.0, 86_400.0, None, may_draw=True
    ),  # on as many cores as it is told
    Task("perturb", ("clip", "render", "perturb"), "clip", 1.0, 3600.0),
    Task("drive", ("rollout", "expert", "reward"), "attempt", 1.0, 600.0),
    Task("render", ("render",), "attempt", 1.0, 1200.0, may_draw=True),  # only of drives that the reward accepts
    Task("label", ("labels",), "attempt", 1.0, 1200.0),
    Task("write", (), "batch", 1.0, 1200.0),
)
# Fused into one task, `drive+render+label`, unless drawing claims a GPU: a task costs Ray some 40 ms, and what a drive
# hands on is up to 5 MB. With a GPU they are tasks of their own, so that nothing but pictures holds it.
ATTEMPT = tuple(task.name for task in TASKS if task.per == "attempt")


def stage_versions() -> dict[str, int]:
    """Name -> version, as stored beside every row."""
    return {stage.name: stage.version for stage in STAGES}
