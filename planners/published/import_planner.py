"""`python -m planners import <checkpoint> planner=<name>_public out=<folder>`: a released planner as one of ours.

    python -m planners import ltf.ckpt planner=ltf_public out=runs/ltf_public
    python -m planners import diffusiondrive.ckpt planner=diffusiondrive_public out=runs/diffusiondrive_public
    python -m planners import gtrs.ckpt planner=gtrs_dense_public out=runs/gtrs_public \\
        planner.settings.inference_vocabulary=8192.npy
    python -m planners import gtrs_vov.ckpt planner=gtrs_dense_v2_99_public out=runs/gtrs_v2_99_public

Takes the Lightning checkpoints of NAVSIM's and SimScale's training (Latent TransFuser, DiffusionDrive, GTRS-Dense).
Every weight of the file is moved or told of. What comes out is a training's folder: `python -m planners evaluate
planner=<out>`, `train init_from=<out>` and NAVSIM's agent take it. GTRS-Dense chooses from the vocabulary that it was
trained with unless another one is named. Nothing of the file runs: it is read as tensors and plain values.
"""

import hashlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from factory.config.arguments import command
from factory.config.compose import ConfigError, compose, fill
from factory.config.words import SHOW, without_show
from planners.models.gtrs_dense import GtrsDenseSettings, inference_arrays
from planners.models.planner import Planner, PlannerChoice, build_planner, settings_of
from planners.published.weights import FAMILIES, Moves, read_public
from planners.training.checkpoint import FOLDER, put_weights, save_checkpoint
from planners.training.train import PlannerEntry

FROZEN_IN = "_trajectory_head"  # what of it is no weight of ours is not learned there either


@dataclass(frozen=True)
class ImportConfig:
    """Everything on the command line."""

    planner: PlannerEntry
    checkpoint: str
    out: str  # folder; it may not hold a training


@command("import_planner", ImportConfig)
def main(argv: Sequence[str]) -> None:
    """The command."""
    import_to(config_of(argv))


def config_of(argv: Sequence[str]) -> ImportConfig:
    """The settings of a command line. Raises ConfigError."""
    argv, shows = without_show(argv)
    # Lightning's names hold equals signs
    files = [word for word in argv if Path(word).is_file() or not ("=" in word or word.startswith("-"))]
    if len(files) > 1:
        raise ConfigError(f"{' and '.join(files)}: one checkpoint at a time")
    words = [*(f"checkpoint='{name}'" for name in files), *(word for word in argv if word not in files)]
    words += [SHOW[0]] if shows else []
    return fill(ImportConfig, compose("import_planner", words, ImportConfig), "import")


def import_to(config: ImportConfig) -> Path:
    """Write the checkpoint's planner under `out` and say what became of every weight. Raises ConfigError."""
    out, path = Path(config.out).absolute(), Path(config.checkpoint)
    if (out / FOLDER).exists():
        raise ConfigError(f"out={config.out} holds a training already: choose another folder")
    if not path.is_file():
        raise ConfigError(f"checkpoint={config.checkpoint}: there is no such file")
    public = read_public(path)
    found = imported(config.planner, public, str(path))
    with path.open("rb") as file:
        source = f"{path.name} {hashlib.file_digest(file, 'sha256').hexdigest()}"
    record = {
        "trained": {"imported": source},
        "backbones": {"all": source},
        "parameters": sum(parameter.numel() for parameter in found.planner.parameters()),
    }
    folder = save_checkpoint(out, 0, found.planner, record, {})
    print(account(found, public))
    print(f"imported: {folder}")
    return folder


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


def account(found: Imported, public: dict[str, Tensor]) -> str:
    """How many numbers of a public model went where."""
    moved = {name for names in found.came_from.values() for name in names}
    count = sum(public[name].numel() for name in moved)
    lines = [f"{count:,} numbers in {len(moved)} arrays are the planner's weights"]
    parts: Counter[str] = Counter()
    for name, value in found.aside.items():
        words = name.split(".")
        is_frozen = words[0] == FROZEN_IN
        part = ".".join(words[:2]) if is_frozen else words[0]
        parts[f"{part}: {'what the planner is built around' if is_frozen else 'in no forward pass'}"] += value.numel()
    return "\n".join([*lines, *(f"{count:,} of {name}" for name, count in parts.items())])
