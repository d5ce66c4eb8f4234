"""A public model's weights as a planner of ours."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from factory.config.compose import ConfigError
from planners.models.gtrs_dense import GtrsDenseSettings, inference_arrays
from planners.models.planner import Planner
from planners.models.registry import PlannerChoice, build_planner, settings_of
from planners.published.families import FAMILIES
from planners.published.weights import Moves
from planners.training.checkpoint import put_weights


@dataclass(frozen=True)
class Imported:
    """A planner, and an account of every number of the public model."""

    planner: Planner
    aside: dict[str, Tensor]  # public names that are no weights of ours: frozen arrays and unused parts
    came_from: dict[str, tuple[str, ...]]  # our weight -> the public ones it was made of


def imported(choice: PlannerChoice, public: Mapping[str, Tensor], source: str) -> Imported:
    """The planner of a choice with the weights of a public model, in evaluation.

    source: for messages. Raises ConfigError where a weight is missing, unknown, or of another shape.
    """
    if choice.name not in FAMILIES:
        raise ConfigError(f"planner.name={choice.name}: only {', '.join(FAMILIES)} have public checkpoints")
    settings = settings_of(choice)
    moves = Moves(dict(public), source)
    try:
        arrays = FAMILIES[choice.name](moves, settings)
        moves.done()
    except ConfigError as error:
        raise ConfigError(f"{error}; its weights look like planner={looks_like(public)}") from error
    planner = build_planner(choice, {**arrays, **_chosen_from(settings)})
    put_weights(planner, moves.ours, f"{source} does not fit planner={choice.name} with these settings")
    return Imported(planner.eval(), moves.aside, moves.came_from)


def looks_like(public: Mapping[str, Tensor]) -> str:
    """The file of conf/planner whose public model has such weights."""
    if any(name.startswith("_backbone.image_encoder.stem.") for name in public):
        return "gtrs_dense_v2_99_public"
    if "_trajectory_head.vocab" in public:
        return "gtrs_dense_public"
    return "diffusiondrive_public" if "_trajectory_head.plan_anchor" in public else "ltf_public"


def _chosen_from(settings: Any) -> dict[str, Any]:
    return dict(inference_arrays(settings)) if isinstance(settings, GtrsDenseSettings) else {}
