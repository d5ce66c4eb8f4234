"""What candidates and experts' drives must come up to. Light: importing it loads no numpy."""

import math
from dataclasses import Field, dataclass, field, fields
from typing import Any, Literal, TypeVar

from tasks.subscores import JUDGED

T = TypeVar("T")
FIXED = "fixed"  # in the metadata of a field


def fixed(value: T) -> T:
    """The default of a field that no configuration sets: a constant with its reason behind it, recorded with the rest.

    Code that makes the settings itself, such as a test or a bench, may give another value.
    """
    constant: Any = field(default=value, metadata={FIXED: True})
    return constant


def offered(shape: type[Any]) -> list[Field[Any]]:
    """The fields of a dataclass of settings that configuration may set."""
    return [each for each in fields(shape) if FIXED not in each.metadata]


@dataclass(frozen=True)
class PerturbSettings:
    """Paper, supplement, table of the curation pipeline."""

    max_heading_deg: float = 20.0
    max_longitudinal_m: float = 20.0
    max_lateral_m: float = 2.0
    step_longitudinal_m: float = 5.0
    step_lateral_m: float = 0.5
    epdms_min: float = 0.8  # /14 score, without EC
    interleaved: bool = True  # every second cell of the grid, as on a chessboard; False: every cell
    order: Literal["drawn", "spread"] = "drawn"  # of the candidates: as drawn, or see spread_out
    at_most: int | None = None  # candidates a clip; None: all there are
    at_log: bool = False  # the only candidate is the log itself, whatever it scores: what is made of no perturbation

    def __post_init__(self) -> None:
        gates = ("max_heading_deg", "max_longitudinal_m", "max_lateral_m")
        for name in (*gates, "step_longitudinal_m", "step_lateral_m"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ValueError(f"perturb {name} must be positive and finite, not {getattr(self, name)}")
        if not 0.0 <= self.epdms_min <= 1.0:
            raise ValueError(f"perturb epdms_min must be from 0 to 1, not {self.epdms_min}")
        if self.at_most is not None and self.at_most < 1:
            raise ValueError(f"perturb at_most must be positive, or null for no bound, not {self.at_most}")


@dataclass(frozen=True)
class ExpertGate:
    """Which sub-scores an expert's rollout must reach (paper, supplement: S_m = 1 for all but EP, EP > 0.5).

    And what its end must lead to (docs/reward.md 2m), of which the paper says nothing.
    """

    full: tuple[str, ...] = JUDGED  # EC needs an earlier plan: there is none
    progress_above: float = 0.5  # EP that a drive must exceed
    off_route: bool = True  # refuse a drive that ends beside the route's lanes, or where none of them goes on
    after: bool = True  # refuse one after which somebody is hit within a second, at its speed and braking alike

    def __post_init__(self) -> None:
        unknown = [name for name in self.full if name not in JUDGED]
        if unknown:
            raise ValueError(f"full names {', '.join(unknown)}; an expert's drive is judged by {', '.join(JUDGED)}")
