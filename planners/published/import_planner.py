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

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from factory.config.arguments import command
from factory.config.compose import ConfigError, compose, fill
from factory.config.words import SHOW, split_off_cfg
from factory.files import file_digest
from factory.readers.pickles import load_tensors
from factory.wording import listed
from planners.models.settings import DiffusionDriveSettings, GtrsDenseSettings, LtfSettings, PlannerChoice, settings_of
from planners.training.checkpoint import checkpoints, put_weights, save_checkpoint
from planners.training.train import PlannerEntry
from tasks.subscores import RECORDS
from tasks.world.arrays import FloatArray
from tasks.world.vocabulary import refuse_other_meaning

if TYPE_CHECKING:
    from torch import Tensor

    from planners.models.planner import Planner

# A public state dict read into a planner's: every number of it is moved, or named as left aside.
#
# `WeightMoves` refuses what nobody spoke of. Below it, family by family, what of a public model goes where in ours; a
# call is a sentence: theirs, then ours. Names are those of OpenDriveLab/SimScale 04cda10,
# navsim/agents/{transfuser,diffusiondrive,gtrs_dense}.

Arrays = dict[str, FloatArray]

# GTRS's heads and scores by the names that they have here
SCORES = {record.long_name: record.name for record in RECORDS if record.plans == 1}
ANCHOR = "_status_encoding.weight"  # in every family's model, at its top


@dataclass
class WeightMoves:
    """Public names still to be told of, and what ours have become so far."""

    public: dict[str, Tensor]
    source: str = "checkpoint"  # for messages
    ours: dict[str, Tensor] = field(default_factory=dict)
    aside: dict[str, Tensor] = field(default_factory=dict)  # what a planner of ours does not have
    came_from: dict[str, tuple[str, ...]] = field(default_factory=dict)  # ours -> public names

    def move(self, name: str, ours: str, turned: Callable[[Tensor], Tensor] = lambda x: x) -> None:
        """One number array. Raises ConfigError where the checkpoint lacks it."""
        self.ours[ours], self.came_from[ours] = turned(self._taken(name)), (name,)

    def move_all(self, prefix: str, ours: str) -> None:
        """All that begins with a prefix, under the same words behind another. Raises ConfigError where nothing does."""
        for name in self._under(prefix):
            self.move(name, ours + name.removeprefix(prefix))

    def move_layer(self, name: str, ours: str, turned: Callable[[Tensor], Tensor] = lambda x: x) -> None:
        """Weight and bias of a linear map; `turned` is for the weight."""
        self.move(f"{name}.weight", f"{ours}.weight", turned)
        self.move(f"{name}.bias", f"{ours}.bias")

    def move_joined(self, names: Sequence[str], ours: str) -> None:
        """Weights and biases of several linear maps as those of one, their outputs one after the other."""
        import torch

        for kind in ("weight", "bias"):
            parts = tuple(f"{name}.{kind}" for name in names)
            self.ours[f"{ours}.{kind}"] = torch.cat([self._taken(part) for part in parts])
            self.came_from[f"{ours}.{kind}"] = parts

    def move_attention(self, name: str, ours: str) -> None:
        """torch's MultiheadAttention, whose three maps are one, as planners.models.layers.Attention."""
        for kind in ("weight", "bias"):
            whole = self._taken(f"{name}.in_proj_{kind}")
            for part, values in zip(("query", "key", "value"), whole.chunk(3)):
                self.ours[f"{ours}.{part}.{kind}"] = values.clone()
                self.came_from[f"{ours}.{part}.{kind}"] = (f"{name}.in_proj_{kind}",)
        self.move_layer(f"{name}.out_proj", f"{ours}.out")

    def move_decoder(self, name: str, ours: str) -> None:
        """torch's TransformerDecoder as planners.models.layers.Decoder."""
        numbers = sorted({int(key.removeprefix(f"{name}.layers.").split(".")[0]) for key in self._under(name)})
        for number in numbers:
            theirs, here = f"{name}.layers.{number}", f"{ours}.layers.{number}"
            self.move_attention(f"{theirs}.self_attn", f"{here}.own")
            self.move_attention(f"{theirs}.multihead_attn", f"{here}.cross")
            for other, own in (("norm1", "own_norm"), ("norm2", "cross_norm"), ("norm3", "feedforward_norm")):
                self.move_layer(f"{theirs}.{other}", f"{here}.{own}")
            self.move_layer(f"{theirs}.linear1", f"{here}.feedforward.0")
            self.move_layer(f"{theirs}.linear2", f"{here}.feedforward.3")

    def set_aside(self, prefix: str) -> None:
        """All that begins with a prefix is no part of our planner."""
        for name in self._under(prefix):
            self.aside[name] = self._taken(name)

    def take_frozen(self, name: str) -> Tensor:
        """What is not learned and becomes an array that our planner is built around."""
        self.aside[name] = self._taken(name)
        return self.aside[name]

    def check_complete(self) -> None:
        """Raises ConfigError where something was not told of."""
        if self.public:
            raise ConfigError(f"{self.source} holds {listed(list(self.public))}, of which this planner knows nothing")

    def _taken(self, name: str) -> Tensor:
        if name not in self.public:
            raise ConfigError(f"{self.source} lacks {name}: it is of another planner, or damaged")
        return self.public.pop(name)

    def _under(self, prefix: str) -> list[str]:
        found = [name for name in self.public if name.startswith(prefix)]
        if not found:
            raise ConfigError(f"{self.source} lacks {prefix}...: it is of another planner, or damaged")
        return found


def read_public_weights(path: Path) -> dict[str, Tensor]:
    """The weights of a Lightning checkpoint under the names of the public model, without what wraps it.

    Only tensors and plain values are read back; nothing of the file runs. Raises ConfigError.
    """
    try:
        content = load_tensors(path)
    except OSError as error:
        raise ConfigError(f"{path}: {error}") from error
    except ValueError as error:
        raise ConfigError(str(error)) from error
    return unwrapped_weights(content, str(path))


def unwrapped_weights(content: object, source: str) -> dict[str, Tensor]:
    """`content` of a Lightning checkpoint, or a bare state dict, as names of the public model. Raises ConfigError."""
    from torch import Tensor

    if isinstance(content, Mapping) and isinstance(content.get("state_dict"), Mapping):
        content = content["state_dict"]
    if not isinstance(content, Mapping) or not all(isinstance(value, Tensor) for value in content.values()):
        raise ConfigError(f"{source} holds no state_dict of tensors: give a checkpoint of the public training")
    found = [name.removesuffix(ANCHOR) for name in content if isinstance(name, str) and name.endswith(ANCHOR)]
    if len(found) != 1:
        raise ConfigError(
            f"{source}: {len(found)} of its {len(content)} weights are named ...{ANCHOR}, not one: it is no checkpoint "
            "of the public Latent TransFuser, DiffusionDrive or GTRS-Dense"
        )
    prefix = found[0]
    other = [name for name in content if not name.startswith(prefix)]
    if other:
        raise ConfigError(f"{source} holds {listed(other)} beside the model {prefix.rstrip('.')}")
    return {name.removeprefix(prefix): value for name, value in content.items()}


def move_fusion(moves: WeightMoves, ours: str) -> None:
    """TransfuserBackbone as LatentFusion: two residual networks, four exchanges of tokens, the upsampled view."""
    moves.move_all("_backbone.image_encoder.", f"{ours}image.")
    moves.move_all("_backbone.lidar_encoder.", f"{ours}latent.")
    moves.move("_backbone.lidar_latent", f"{ours}picture")
    moves.move_all("_backbone.lidar_channel_to_img.", f"{ours}to_image.")
    moves.move_all("_backbone.img_channel_to_lidar.", f"{ours}to_latent.")
    for scale in range(4):
        theirs, here = f"_backbone.transformers.{scale}", f"{ours}exchanges.{scale}"
        moves.move(f"{theirs}.pos_emb", f"{here}.position")
        moves.move_layer(f"{theirs}.ln_f", f"{here}.norm")
        block = 0
        while f"{theirs}.blocks.{block}.ln1.weight" in moves.public:
            name, own = f"{theirs}.blocks.{block}", f"{here}.blocks.{block}"
            moves.move_layer(f"{name}.ln1", f"{own}.norm_attention")
            moves.move_layer(f"{name}.ln2", f"{own}.norm_forward")
            moves.move_joined([f"{name}.attn.{part}" for part in ("query", "key", "value")], f"{own}.query_key_value")
            moves.move_layer(f"{name}.attn.proj", f"{own}.project")
            moves.move_layer(f"{name}.mlp.0", f"{own}.feed_forward.0")
            moves.move_layer(f"{name}.mlp.2", f"{own}.feed_forward.2")
            block += 1
    moves.move_layer("_backbone.c5_conv", f"{ours}lateral")
    moves.move_layer("_backbone.up_conv5", f"{ours}up.0")
    moves.move_layer("_backbone.up_conv4", f"{ours}up.1")


def move_heads(moves: WeightMoves) -> None:
    """What is learnt beside planning: boxes of vehicles and classes of cells."""
    moves.move_layer("_agent_head._mlp_states.0", "agent_head.box.0")
    moves.move_layer("_agent_head._mlp_states.2", "agent_head.box.2")
    moves.move_layer("_agent_head._mlp_label.0", "agent_head.there")
    moves.move_layer("_bev_semantic_head.0", "bev_head.layers.0")
    moves.move_layer("_bev_semantic_head.2", "bev_head.layers.2")


def move_ltf(moves: WeightMoves, settings: LtfSettings) -> Arrays:
    """TransfuserModel as Ltf."""
    move_fusion(moves, "fusion.")
    moves.move_layer("_bev_downscale", "reduce")
    moves.move_layer("_status_encoding", "status")
    moves.move("_keyval_embedding.weight", "key_position", lambda x: x[None])
    moves.move("_query_embedding.weight", "queries", lambda x: x[None])
    moves.move_all("_tf_decoder.", "decoder.")
    moves.move_layer("_trajectory_head._mlp.0", "plan_head.0")
    moves.move_layer("_trajectory_head._mlp.2", "plan_head.2")
    move_heads(moves)
    return {}


def move_diffusiondrive(moves: WeightMoves, settings: DiffusionDriveSettings) -> Arrays:
    """V2TransfuserModel as DiffusionDrive."""
    from planners.models.diffusiondrive import REFINEMENTS

    move_fusion(moves, "encoder.fusion.")
    moves.move_layer("_bev_downscale", "encoder.narrow")
    moves.move_layer("_status_encoding", "encoder.status")
    moves.move("_keyval_embedding.weight", "encoder.places")
    moves.move("_query_embedding.weight", "encoder.queries")
    moves.move_decoder("_tf_decoder", "encoder.decoder")
    moves.move_all("bev_proj.", "encoder.join.")
    head = "_trajectory_head"
    moves.move_layer(f"{head}.plan_anchor_encoder.0", "decoder.feature.0", _points_reordered)
    moves.move_layer(f"{head}.plan_anchor_encoder.2", "decoder.feature.2")
    moves.move_layer(f"{head}.plan_anchor_encoder.3", "decoder.feature.3")
    moves.move_layer(f"{head}.time_mlp.1", "decoder.step.0")
    moves.move_layer(f"{head}.time_mlp.3", "decoder.step.2")
    for number in range(REFINEMENTS):
        name, own = f"{head}.diff_decoder.layers.{number}", f"decoder.layers.{number}"
        moves.move_layer(f"{name}.cross_bev_attention.attention_weights", f"{own}.along.weights")
        moves.move_layer(f"{name}.cross_bev_attention.value_proj.0", f"{own}.along.value.0")
        moves.move_layer(f"{name}.cross_bev_attention.output_proj", f"{own}.along.out")
        moves.move_attention(f"{name}.cross_agent_attention", f"{own}.agents")
        moves.move_attention(f"{name}.cross_ego_attention", f"{own}.ego")
        for theirs, here in (("norm1", "agents_norm"), ("norm2", "ego_norm"), ("norm3", "norm")):
            moves.move_layer(f"{name}.{theirs}", f"{own}.{here}")
        moves.move_all(f"{name}.ffn.", f"{own}.feedforward.")
        moves.move_layer(f"{name}.time_modulation.scale_shift_mlp.1", f"{own}.modulation.1")
        moves.move_all(f"{name}.task_decoder.plan_cls_branch.", f"{own}.confidence.")
        moves.move_all(f"{name}.task_decoder.plan_reg_branch.", f"{own}.offsets.")
    move_heads(moves)
    return {"anchors": moves.take_frozen(f"{head}.plan_anchor").double().numpy()}


def move_gtrs_dense(moves: WeightMoves, settings: GtrsDenseSettings) -> Arrays:
    """HydraModel as GtrsDense. Its decoder and agents' head at the top are in the file and in no forward pass."""
    from planners.models.gtrs_dense import IMITATION

    if settings.encoder == "fused":
        move_fusion(moves, "tokens.fusion.")
        moves.move_layer("_bev_downscale", "tokens.narrow")
    else:
        moves.move_all("_backbone.image_encoder.", "tokens.backbone.")
        moves.move_layer("downscale_layer", "tokens.narrow")
    moves.move("_keyval_embedding.weight", "tokens.places")
    moves.move_layer("_status_encoding", "scorer.status")
    head = "_trajectory_head"
    moves.move_all(f"{head}.pos_embed.", "scorer.embed.")
    for theirs, here in (("to_q", "query"), ("to_k", "key"), ("to_v", "value"), ("to_out", "out")):
        moves.move(f"{head}.encoder.self_attn.{theirs}.weight", f"scorer.among.own.{here}.weight")
    for theirs, here in (("norm1", "own_norm"), ("norm3", "feedforward_norm")):
        moves.move_layer(f"{head}.encoder.{theirs}", f"scorer.among.{here}")
    moves.move_layer(f"{head}.encoder.linear1", "scorer.among.feedforward.0")
    moves.move_layer(f"{head}.encoder.linear2", "scorer.among.feedforward.3")
    moves.move_decoder(f"{head}.transformer", "scorer.decoder")
    moves.move_all(f"{head}.heads.imi.", f"scorer.heads.{IMITATION}.")
    for theirs, here in SCORES.items():
        if here in settings.sub_scores:
            moves.move_all(f"{head}.heads.{theirs}.", f"scorer.heads.{here}.")
    moves.set_aside("_tf_decoder.")
    moves.set_aside("_agent_head.")
    return {"vocabulary": moves.take_frozen(f"{head}.vocab").double().numpy()}


FAMILIES: Mapping[str, Callable[[WeightMoves, Any], Arrays]] = {  # each takes its own planner's settings
    "ltf": move_ltf,
    "diffusiondrive": move_diffusiondrive,
    "gtrs_dense": move_gtrs_dense,
}


def _points_reordered(weight: Tensor) -> Tensor:
    """Columns of the first map over a plan's points, from y before x and sines and cosines in turn to x, y, all sines.

    A point's numbers there (gen_sineembed_for_position) and here (planners.models.diffusiondrive.waves) are the same.
    """
    import torch

    from planners.models.diffusiondrive import POINT_FEATURES, WAYPOINTS

    pairs = POINT_FEATURES // 4
    columns = torch.arange(WAYPOINTS * POINT_FEATURES).view(WAYPOINTS, 2, pairs, 2)
    ours = columns.flip(1).transpose(2, 3)  # points, (x, y), (sine, cosine), frequency
    return weight[:, ours.flatten()]


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
    argv, shows = split_off_cfg(argv)
    # Lightning's names hold equals signs
    files = [word for word in argv if Path(word).is_file() or not ("=" in word or word.startswith("-"))]
    if len(files) > 1:
        raise ConfigError(f"{' and '.join(files)}: one checkpoint at a time")
    words = [*(f"checkpoint='{name}'" for name in files), *(word for word in argv if word not in files)]
    words += [SHOW[0]] if shows else []
    return fill(ImportConfig, compose("import_planner", words, ImportConfig), "import")


def import_to(config: ImportConfig) -> Path:
    """Write the checkpoint's planner under `out` and say what became of every weight.

    Raises ConfigError, and ValueError where the numbers of its vocabulary or anchors mean something else.
    """
    out, path = Path(config.out).absolute(), Path(config.checkpoint)
    if checkpoints(out):
        raise ConfigError(f"out={config.out} holds a training already: choose another folder")
    if not path.is_file():
        raise ConfigError(f"checkpoint={config.checkpoint}: there is no such file")
    public = read_public_weights(path)
    found = import_weights(config.planner, public, str(path))
    for name, trajectories in found.planner.arrays.items():
        refuse_other_meaning(trajectories, f"{path}: {name}")
    source = f"{path.name} {file_digest(path)}"
    record = {
        "trained": {"imported": source},
        "backbones": {"all": source},
        "parameters": sum(parameter.numel() for parameter in found.planner.parameters()),
    }
    print(describe_import(found, public), flush=True)  # before it is there: a full disk may hold what is printed
    folder = save_checkpoint(out, 0, found.planner, record, {})
    print(f"imported: {folder}")
    return folder


@dataclass(frozen=True)
class ImportedPlanner:
    """A planner, and an account of every number of the public model."""

    planner: Planner
    aside: dict[str, Tensor]  # public names that are no weights of ours: frozen arrays and unused parts
    came_from: dict[str, tuple[str, ...]]  # our weight -> the public ones it was made of


def import_weights(choice: PlannerChoice, public: Mapping[str, Tensor], source: str) -> ImportedPlanner:
    """The planner of a choice with the weights of a public model, in evaluation.

    source: for messages. Raises ConfigError where a weight is missing, unknown, or of another shape.
    """
    from planners.models.gtrs_dense import inference_arrays
    from planners.models.planner import build_planner

    if choice.name not in FAMILIES:
        raise ConfigError(f"planner.name={choice.name}: only {', '.join(FAMILIES)} have public checkpoints")
    settings = settings_of(choice)
    moves = WeightMoves(dict(public), source)
    try:
        arrays = FAMILIES[choice.name](moves, settings)
        moves.check_complete()
    except ConfigError as error:
        raise ConfigError(f"{error}; its weights look like planner={likely_preset(public)}") from error
    chosen = inference_arrays(settings) if isinstance(settings, GtrsDenseSettings) else {}
    planner = build_planner(choice, {**arrays, **chosen})
    put_weights(planner, moves.ours, f"{source} does not fit planner={choice.name} with these settings")
    return ImportedPlanner(planner.eval(), moves.aside, moves.came_from)


def likely_preset(public: Mapping[str, Tensor]) -> str:
    """The file of conf/planner whose public model has such weights."""
    if any(name.startswith("_backbone.image_encoder.stem.") for name in public):
        return "gtrs_dense_v2_99_public"
    if "_trajectory_head.vocab" in public:
        return "gtrs_dense_public"
    return "diffusiondrive_public" if "_trajectory_head.plan_anchor" in public else "ltf_public"


def describe_import(found: ImportedPlanner, public: dict[str, Tensor]) -> str:
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
