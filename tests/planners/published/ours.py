"""Our half of a comparison: a planner with the public model's weights, shown and told the same as it was."""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from factory.config.compose import ConfigError, compose, fill
from planners.data.batch import Batch
from planners.models.diffusiondrive import DiffusionDrive, EncodedScene
from planners.models.gtrs_dense import IMITATION, WEIGHTINGS, GtrsDense, weighted_total
from planners.models.ltf import Ltf
from planners.models.planner import Planner, evaluating
from planners.models.settings import PlannerChoice
from planners.published.import_planner import SCORES, ImportedPlanner, import_weights
from planners.training.train import PlannerEntry
from tasks.world.arrays import Array
from tests.planners.published.formula import CELLS, FROZEN, SEED, inputs, weight

GRADIENTS = "gradients"
ROUNDING_OF_GRADIENTS = 100.0  # in float32 ours are up to 8e-4 of themselves away from ours in float64 (LTF)
ROUNDING_OF_BOXES = 10.0  # their metres are 32 times what a head says
CASES = ("ltf", "diffusiondrive", "gtrs_dense", "gtrs_dense_v2_99")
TERMS = {  # of the public losses and ours, where both tell them apart
    "trajectory_loss": ("confidence", "regression"),
    "agent_class_loss": ("agent_class",),
    "agent_box_loss": ("agent_box",),
    "bev_semantic_loss": ("bev",),
    "imi_loss": (IMITATION,),
    **{f"pdm_{name}_loss": (ours,) for name, ours in {"noc": "nc", "da": "dac", "progress": "ep", "tl": "tlc"}.items()},
    **{f"pdm_{name}_loss": (name,) for name in ("ddc", "ttc", "lk")},
}


@dataclass(frozen=True)
class PublicRecord:
    """What the public model said, as experiments.parity writes it."""

    case: str
    picture: tuple[int, int]  # width, height
    names: dict[str, list[int]]  # of its weights, with their shapes
    parameters: int
    gradients: list[str]  # whose norms `results["gradients"]` are
    origin: str
    results: dict[str, Array]  # "eval <output>", "train <loss>", "gradients"


def read_recorded(path: Path) -> PublicRecord:
    """A file of experiments.parity."""
    with np.load(path, allow_pickle=False) as stored:
        told = json.loads(str(stored["told"]))
        results = {name: stored[name] for name in stored.files if name != "told"}
    versions = ", ".join(f"{name} {version}" for name, version in told["versions"].items())
    width, height = told["picture"]
    origin = f"{told['code']} ({versions})"
    return PublicRecord(
        told["case"], (width, height), told["names"], told["parameters"], told["gradients"], origin, results
    )


def formula_weights(
    names: Mapping[str, list[int]], given: Mapping[str, Array], formula: Callable[..., Any] = weight
) -> dict[str, Tensor]:
    """The public state dict of these names, as the public side filled it."""
    state = {}
    for name, shape in names.items():
        frozen = FROZEN.get(name.rpartition(".")[2])
        values = formula(name, tuple(shape)) if frozen is None else given[frozen]
        state[name] = torch.from_numpy(values)
    return state


def preset_entry(case: str, picture: tuple[int, int], *changed: str) -> PlannerEntry:
    """conf/planner/<case>_public.yaml for pictures of another size; words change it."""
    size = [f"planner.settings.image.{name}={n}" for name, n in zip(("width", "height"), picture)]
    words = [f"planner={case}_public", "checkpoint=none", "out=none", *size, *changed]
    return fill(PlannerEntry, compose("import_planner", words)["planner"], "planner")


def preset(case: str, picture: tuple[int, int], *changed: str) -> PlannerChoice:
    """The planner of it, without its training."""
    entry = preset_entry(case, picture, *changed)
    return PlannerChoice(entry.name, entry.settings)


def planner_of(recorded: PublicRecord, public: Mapping[str, Tensor] | None = None) -> ImportedPlanner:
    """Our planner with the weights of a recorded model; public: those of a file, else the formula's."""
    if public is None:
        public = formula_weights(recorded.names, inputs(*recorded.picture))
    return import_weights(preset(recorded.case, recorded.picture), public, f"the recorded {recorded.case}")


def batch_of(arrays: Mapping[str, Any]) -> Batch:
    """Inputs of the formula's kind as a batch."""
    given = {name: torch.from_numpy(values) for name, values in arrays.items()}
    n = len(given["image"])
    return Batch(
        tuple(map(str, range(n))),
        status=given["status"],
        history=torch.zeros(n, 4, 3),
        plan_2hz=given["plan"],
        plan_10hz=torch.zeros(n, 40, 3),
        simulated=torch.zeros(n, dtype=torch.bool),
        imitate=torch.ones(n, dtype=torch.bool),
        image=given["image"],
        bev=given["bev"][:, None],
        agents=given["agents"],
        agents_valid=given["agents_valid"],
        labels={ours: given[f"score {name}"] for name, ours in SCORES.items()},
    )


def evaluated(planner: Planner, batch: Batch) -> dict[str, Tensor]:
    """Outputs in evaluation by their public names. Raises TypeError for a planner without public model."""
    with evaluating(planner):
        if isinstance(planner, Ltf):
            plan, queries, above = planner.decoded(batch)
        elif isinstance(planner, DiffusionDrive):
            scene = planner.scene(batch)
            plan, queries, above = _denoised(planner, scene), scene.agents, scene.bev
        elif isinstance(planner, GtrsDense):
            return _scored(planner, batch)
        else:
            raise TypeError(f"{type(planner).__name__} has no public model")
        boxes, there = planner.agent_head(queries)
        cells = planner.bev_head(above)[..., ::CELLS, ::CELLS]
    return {"trajectory": plan, "agent_states": boxes, "agent_labels": there, "bev_semantic_map": cells}


def _denoised(planner: DiffusionDrive, scene: EncodedScene) -> Tensor:
    """Plans, the noise of each scene drawn from the same seed, as beside."""
    plans = []
    for i in range(len(scene.ego)):
        torch.manual_seed(SEED)
        plans.append(planner.denoised(EncodedScene(*(part[i : i + 1] for part in scene))))
    return torch.cat(plans)


def _scored(planner: GtrsDense, batch: Batch) -> dict[str, Tensor]:
    logits = planner.logits(batch, batch.status, planner.get_buffer("choices"))
    chance = {name: x.softmax(dim=1) if name == IMITATION else x.sigmoid() for name, x in logits.items()}
    named = {name: logits[ours] for name, ours in SCORES.items() if ours in logits}
    scores = weighted_total(chance, WEIGHTINGS[planner.settings.weighting])
    return {"trajectory": planner.plan(batch), "imi": logits[IMITATION], "scores": scores, **named}


def trained(found: ImportedPlanner, batch: Batch) -> tuple[dict[str, float], dict[tuple[str, ...], float]]:
    """The loss and its terms by public names, and norms of gradients by the public matrices that they belong to."""
    torch.manual_seed(SEED)
    losses, norms = _stepped_back(found, batch)
    values = {"loss": sum(losses.values())}
    for name, ours in TERMS.items():
        if all(one in losses for one in ours):
            values[name] = sum(losses[one] for one in ours)
    return values, norms


def without_dropout(planner: Planner) -> Planner:
    """The same planner: generators differ, and dropout with them."""
    for module in planner.modules():
        if isinstance(module, torch.nn.Dropout):
            module.p = 0.0
        elif hasattr(module, "dropout") and isinstance(module.dropout, float):
            module.dropout = 0.0
    return planner


def gradient_norms(found: ImportedPlanner, batch: Batch) -> dict[tuple[str, ...], float]:
    """Norms of gradients by the public matrices that they belong to; the gradients stay."""
    return _stepped_back(found, batch)[1]


def _stepped_back(found: ImportedPlanner, batch: Batch) -> tuple[dict[str, float], dict[tuple[str, ...], float]]:
    planner = without_dropout(found.planner).train()
    losses = planner.losses(batch)
    torch.stack(list(losses.values())).sum().backward()
    squares: dict[tuple[str, ...], float] = {}
    for name, parameter in planner.named_parameters():
        if parameter.grad is not None and name in found.came_from:
            key = found.came_from[name]
            squares[key] = squares.get(key, 0.0) + float(parameter.grad.double().square().sum())
    planner.eval()
    terms = {name: float(loss.detach()) for name, loss in losses.items()}
    return terms, {key: square**0.5 for key, square in squares.items()}


@dataclass(frozen=True)
class Difference:
    """How far one thing is from the public model's."""

    what: str
    largest: float  # absolute; of losses and gradients relative
    size: float  # the largest number compared
    rounding: float = 1.0  # how many times the tolerance rounding alone may make of it

    def is_within(self, tolerance: float) -> bool:
        """Whether it is not more than the tolerance and rounding explain."""
        return self.largest <= tolerance * self.rounding


def differences(recorded: PublicRecord, found: ImportedPlanner) -> list[Difference]:
    """Everything recorded against ours. Raises ConfigError where one side has what the other lacks."""
    batch, theirs = batch_of(inputs(*recorded.picture)), recorded.results
    rows = []
    outputs = {f"eval {name}": values.numpy() for name, values in evaluated(found.planner, batch).items()}
    if missing := sorted(outputs.keys() ^ {name for name in theirs if name.startswith("eval ")}):
        raise ConfigError(f"{recorded.case}: only one side has {', '.join(missing)}")
    for name, values in outputs.items():
        largest, size = float(np.abs(values - theirs[name]).max()), float(np.abs(theirs[name]).max())
        rows.append(Difference(name, largest, size, ROUNDING_OF_BOXES if name == "eval agent_states" else 1.0))
    return rows + (_differences_in_training(recorded, found, batch) if recorded.gradients else [])


def _differences_in_training(recorded: PublicRecord, found: ImportedPlanner, batch: Batch) -> list[Difference]:
    rows, theirs = [], recorded.results
    losses, gradients = trained(found, batch)
    for name, value in losses.items():
        if f"train {name}" in theirs:
            wanted = float(theirs[f"train {name}"])
            rows.append(Difference(f"train {name}", abs(value - wanted) / max(abs(wanted), 1e-9), abs(wanted)))
    norms: dict[tuple[str, ...], float] = {
        (name,): norm for name, norm in zip(recorded.gradients, theirs["gradients"].tolist())
    }
    return [*rows, gradient_difference(norms, gradients)]


def gradient_difference(norms: Mapping[tuple[str, ...], float], ours: Mapping[tuple[str, ...], float]) -> Difference:
    """Norms of the public matrices, one each, against ours, whose matrices may be several of theirs."""
    apart = [
        (abs(norm - wanted) / max(wanted, 1e-9), wanted)
        for key, norm in ours.items()
        if all((name,) in norms for name in key)
        for wanted in [sum(norms[name,] ** 2 for name in key) ** 0.5]
    ]
    largest, size = max(off for off, _ in apart), max(size for _, size in apart)
    return Difference(f"{GRADIENTS} of {len(apart)} matrices", largest, size, ROUNDING_OF_GRADIENTS)
