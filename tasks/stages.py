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


PICTURE_FAULTS = ("holes", "lens_covered", "blank", "blurred", "unlike_photos")  # tasks.render.gate

STAGES: tuple[Stage, ...] = (
    Stage("clip", 2, "clip", ("ego_standing", "broken_tracks", "route_ended", "no_earlier_frame")),
    Stage("perturb", 1, "clip", ("no_gated_candidate", "no_good_candidate")),
    Stage("rollout", 2, "attempt", ("route_ended",)),
    Stage("expert", 1, "attempt", ("no_plan",)),
    Stage("reward", 1, "attempt", SUBSCORES),
    Stage("render", 3, "attempt", ("psnr", *PICTURE_FAULTS)),
    Stage("write", 2, "attempt", ()),
)


def stage_versions() -> dict[str, int]:
    """Name -> version, as stored beside every row."""
    return {stage.name: stage.version for stage in STAGES}
