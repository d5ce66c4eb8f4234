"""Planners by name: the built-in ones, those that installed packages offer, or a class of a user's own package."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from factory.config.classes import object_named
from factory.config.compose import ConfigError, fill
from factory.config.plugins import installed, names
from factory.config.shapes import defaults_of, merged
from factory.config.words import nearest
from planners.models.planner import Planner
from tasks.world.arrays import FloatArray

BUILT_IN = {
    "constant_velocity": "planners.models.constant_velocity:ConstantVelocity",
    "ego_mlp": "planners.models.ego_mlp:EgoMlp",
    "ego_mlp_bev": "planners.models.ego_mlp:EgoMlpBev",
    "ltf": "planners.models.ltf:Ltf",
    "diffusiondrive": "planners.models.diffusiondrive:DiffusionDrive",
    "gtrs_dense": "planners.models.gtrs_dense:GtrsDense",
}
OWN = "my.module:MyPlanner"  # how a class of the user's own is named


@dataclass(frozen=True)
class PlannerChoice:
    """A planner and its settings, as conf/planner/*.yaml and checkpoints name it."""

    name: str  # one of BUILT_IN, of an installed package's, or my.module:MyPlanner
    settings: dict[str, Any] = field(default_factory=dict)


def planner_class(name: str) -> type[Planner]:
    """The class of a planner. Raises ConfigError where there is none of that name."""
    plugin = installed("planner", name, BUILT_IN)
    target = BUILT_IN.get(name, name) if plugin is None else plugin.reference
    if ":" not in target:
        known = [*BUILT_IN, *names("planner")]
        meant = nearest(name, known)
        raise ConfigError(f"planner.name={name}: none of {', '.join(known)}{meant}; or name a class, {OWN}")
    cls: Any = object_named(target, "planner.name", OWN)
    if not (isinstance(cls, type) and issubclass(cls, Planner)):
        raise ConfigError(f"planner.name={name} is not a planners.models.planner.Planner")
    return cls


def settings_of(choice: PlannerChoice) -> Any:
    """The planner's own settings, its defaults for what is not named. Raises ConfigError for one it does not have."""
    shape = planner_class(choice.name).settings_type
    return fill(shape, merged(defaults_of(shape), choice.settings), "planner.settings")


def build_planner(choice: PlannerChoice, arrays: Mapping[str, FloatArray]) -> Planner:
    """The planner around its fixed arrays. Raises ConfigError."""
    try:
        planner = planner_class(choice.name)(settings_of(choice), arrays)
    except ValueError as error:
        raise ConfigError(f"planner {choice.name}: {error}") from error
    planner.chosen_as = choice.name
    return planner
