"""Who is evaluated, by what `planner=` says.

    human, pdm_closed          bounds that know the world: the log's own drive, and the privileged planner
    constant_velocity          needs no training
    runs/my_training           a training's folder or one of its checkpoints; runs/my_training/best
    runs/a+runs/b              the ensemble of several trainings of gtrs_dense
    submission.pkl             the plans of any agent of NAVSIM, as its script for submissions wrote them
    mine                       what an installed package offers by that name (docs/extend.md)
    my.module:MyPlanner        a class, or anything called without arguments, of a user's own package

A user's planner has one of two faces:

    def plan(self, sample: Mapping[str, Any]) -> (8, 3) or (40, 3)       one sample, docs/formats.md, as_shown
    needs: planners.data.batch.Needs; def plan(self, batch: planners.data.batch.Batch) -> (B, 8 or 40, 3)

Poses are x, y [m], heading [rad] of the rear axle in the ego frame at now, at 0.5 .. 4.0 s or 0.1 .. 4.0 s. Where it
has a text `digest`, that tells its versions apart, else the bytes of its module's file do.
"""

import hashlib
import inspect
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from factory.config.compose import ConfigError, compose
from factory.config.plugins import import_object, plugin_named, plugins_by_name
from factory.config.shapes import required_keys
from factory.config.words import did_you_mean, expand_home
from factory.readers.base import BadClip
from planners.data.batch import Needs
from planners.evaluation.benchmark_folder import how_to_make
from planners.evaluation.frames import FrameKey
from planners.evaluation.scoring import Plans, PreparedFrame, human_plans, pdm_plans
from planners.models.settings import BUILT_IN, OWN, PlannerChoice
from planners.training import checkpoint
from tasks.world.arrays import Array

if TYPE_CHECKING:
    from planners.models.gtrs_dense import Ensemble
    from planners.models.planner import Planner

Privileged = Callable[[Mapping[FrameKey, PreparedFrame]], Plans]  # of a clip's frames

PRIVILEGED: Mapping[str, Privileged] = {"human": human_plans, "pdm_closed": pdm_plans}
UNTRAINED = ("constant_velocity",)


@dataclass(frozen=True)
class EvaluatedPlanner:
    """Someone to be evaluated."""

    label: str  # names its folder and its rows
    digest: str  # the same digest plans the same
    load: Callable[[], Any] | None = None  # with one of the faces above; None: privileged or submitted
    submitted: Mapping[str, Array] | None = None  # plans (40, 3) by NAVSIM's tokens, and nobody to ask for others
    privileged: Privileged | None = None
    spec: str = ""  # that named it

    def made(self) -> Any:
        """Who plans. Raises ConfigError where there are plans alone."""
        if self.load is None:
            raise ConfigError(f"planner={self.spec} plans nothing but what it holds: planners evaluate scores that")
        return self.load()

    def plans_of(self, tokens: Mapping[FrameKey, str], keys: Sequence[FrameKey]) -> dict[FrameKey, Array]:
        """What it holds of these frames. Raises ConfigError for one that it lacks."""
        assert self.submitted is not None
        if lacking := [key for key in keys if tokens.get(key) not in self.submitted]:
            named = f"token {tokens[lacking[0]]}" if lacking[0] in tokens else f"{lacking[0]}, which has no token"
            raise ConfigError(f"planner={self.spec}: no plan for {len(lacking)} of {len(keys)} frames, such as {named}")
        return {key: self.submitted[tokens[key]] for key in keys}


def find_planner(spec: str, label: str | None = None, changed: Mapping[str, Any] | None = None) -> EvaluatedPlanner:
    """Who `spec` names; changed: settings of trained planners, see load_planner. Raises ConfigError for nobody."""
    spec = "+".join(expand_home(member, "planner") for member in spec.split("+"))
    return replace(_named(spec, label, changed), spec=spec)


def _named(spec: str, label: str | None, changed: Mapping[str, Any] | None) -> EvaluatedPlanner:
    name = label or spec.strip("/").replace("/", "_").replace(":", ".")
    plugin = plugin_named("planner", spec, [*PRIVILEGED, *BUILT_IN])
    if plugin is not None:
        if Path(spec).is_dir():
            raise ConfigError(f"planner={spec} is a folder here and a planner of {plugin.package}: planner=./{spec}")
        return _plugged(name, plugin.reference)
    if spec in PRIVILEGED:
        return EvaluatedPlanner(name, spec, privileged=PRIVILEGED[spec])
    if spec in UNTRAINED:
        return EvaluatedPlanner(name, spec, partial(_imported, BUILT_IN[spec][0]))
    members = spec.split("+")
    if all(checkpoint.is_training(Path(member)) for member in members):
        newest = [
            checkpoint.newest_checkpoint(Path(member)) for member in members
        ]  # now: trainings may go on and write others
        parts = [*map(checkpoint.planner_digest, newest), *([json.dumps(changed, sort_keys=True)] if changed else [])]
        digest = parts[0] if len(parts) == 1 else hashlib.sha256(" ".join(parts).encode()).hexdigest()[:16]
        return EvaluatedPlanner(name, digest, partial(_trained, newest, changed))
    if spec.endswith(".pkl") and Path(spec).is_file():
        return _submission(name, Path(spec))
    if ":" in spec:
        return _plugged(name, spec)
    known = [*PRIVILEGED, *UNTRAINED, *plugins_by_name("planner")]
    listed = ", ".join(known)
    if spec in BUILT_IN:
        raise ConfigError(f"planner={spec} has to be trained first: name its training's folder; untrained: {listed}")
    raise ConfigError(
        f"planner={spec}: neither a folder nor one of {listed}{did_you_mean(spec, known)}; "
        "or name a class, my.module:MyPlanner"
    )


def _submission(label: str, path: Path) -> EvaluatedPlanner:
    from planners.evaluation.submission import read_submission

    try:
        plans = read_submission(path)
    except BadClip as error:
        raise ConfigError(str(error)) from error
    return EvaluatedPlanner(label, hashlib.sha256(path.read_bytes()).hexdigest()[:16], submitted=plans)


def _plugged(label: str, spec: str) -> EvaluatedPlanner:
    made = _imported(spec)
    return EvaluatedPlanner(label, _digest_of(made), lambda: made)


def find_planners(
    planner: str | None,
    planners: Sequence[str] | Mapping[str, str] | None,
    bounds: bool,
    changed: Mapping[str, Any] | None = None,
) -> list[EvaluatedPlanner]:
    """All that are asked for, each once, the bounds first. Raises ConfigError for nobody, or two of one label."""
    named: list[tuple[str | None, str]] = []
    if isinstance(planners, Mapping):
        named += planners.items()
    else:
        named += [(None, spec) for spec in planners or ()]
    named += [(None, planner)] if planner is not None else []
    if not named:
        raise ConfigError("planner is missing: give planner=<training folder> or planners=[human,...]")
    first = [(None, name) for name in (*PRIVILEGED, *UNTRAINED) if bounds]
    found = [find_planner(spec, label, changed) for label, spec in dict.fromkeys([*first, *named])]
    labels = [one.label for one in found]
    twice = sorted({label for label in labels if labels.count(label) > 1})
    if twice:
        raise ConfigError(f"planners: two are called {', '.join(twice)}: give planners={{a: folder, b: folder}}")
    return found


def compose_with_planner(
    name: str,
    argv: Sequence[str],
    shape: type[Any],
    completed: Callable[[dict[str, Any]], dict[str, Any]] = lambda values: values,
) -> dict[str, Any]:
    """The values of a command line and conf/<name>.yaml, typed by `shape`, with `planner=` as text.

    Hydra would take it for a choice among conf/planner, which are planners to be trained.
    completed: as of `compose`. Raises ConfigError, for a benchmark that is to be given and is not with the command that
    makes one; SettingsShown.
    """
    who = [argument for argument in argv if argument.startswith("planner=")]
    named = {"planner": who[-1].split("=", 1)[1]} if who else {}
    others = [argument for argument in argv if argument not in who]

    def told(values: dict[str, Any]) -> dict[str, Any]:
        if "benchmark" not in values and "benchmark" in required_keys(shape):
            raise ConfigError(f"benchmark is missing: give benchmark=runs/hard; {how_to_make('runs/hard')}")
        return completed(values | named)

    return compose(name, others, shape, told)


def needs_of(made: Any) -> Needs | None:
    """What a planner reads of a batch; None: it takes samples."""
    return getattr(made, "needs", None)


def _trained(folders: Sequence[Path], changed: Mapping[str, Any] | None) -> "Planner | Ensemble":
    """One planner, or the ensemble of several. Raises ConfigError where they cannot be one."""
    from planners.models.gtrs_dense import Ensemble, GtrsDense

    models = [(str(folder), checkpoint.load_planner(folder, changed)) for folder in folders]
    if len(models) == 1:
        return models[0][1]
    scoring = [(name, model) for name, model in models if isinstance(model, GtrsDense)]
    others = [f"{name} ({model.name})" for name, model in models if not isinstance(model, GtrsDense)]
    if others:
        raise ConfigError(f"an ensemble averages the scores of gtrs_dense models, not {', '.join(others)}")
    try:
        return Ensemble(scoring).eval()
    except ValueError as error:
        raise ConfigError(f"ensemble: {error}") from error


def _imported(spec: str) -> Any:
    """The user's planner. Raises ConfigError."""
    from planners.models.planner import Planner, build_planner

    target = import_object(spec, "planner", OWN)
    if isinstance(target, type) and issubclass(target, Planner):
        return build_planner(PlannerChoice(spec), {}).eval()
    if not callable(target):
        raise ConfigError(f"planner={spec} is a {type(target).__name__}: name a class or a function that makes one")
    try:
        made = target()
    except TypeError as error:
        raise ConfigError(f"planner={spec}: it must be made without arguments: {error}") from error
    if not callable(getattr(made, "plan", None)):
        raise ConfigError(f"planner={spec}: a {type(made).__name__} has no method plan(sample) or plan(batch)")
    return made


def _digest_of(made: Any) -> str:
    own = getattr(made, "digest", None)
    if isinstance(own, str):
        return own
    return hashlib.sha256(Path(inspect.getfile(type(made))).read_bytes()).hexdigest()[:16]
