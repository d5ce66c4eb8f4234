"""The public code's half of the comparisons; it runs in the public code's own Python, which has torch, timm and NAVSIM.

    python beside.py outputs <checkout> <case> <picture width> <picture height> <out.npz> <train: 0 or 1> <.ckpt or "">
    python beside.py training <checkout> <lesson.npz> <out.npz>
    python beside.py start <checkout> <case> <picture width> <picture height> <out.ckpt>
    python beside.py targets <checkout> <out.npz>

The checkout and tests/planners/published, whose formula makes weights and inputs, are on PYTHONPATH. Nothing is
switched off but dropout.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from formula import CELLS, FROZEN, SCORES, SEED, Doubled, first_weight, inputs, street, told_of, weight

V2_99 = "gtrs_dense_v2_99"


def outputs(argv: list[str]) -> None:
    """The checkout's model of a case: what it plans and loses; where asked, as its trainer would have saved it."""
    code, case, width, height, out = argv[0], argv[1], int(argv[2]), int(argv[3]), argv[4]
    given = inputs(width, height)
    with tempfile.TemporaryDirectory() as folder:
        os.environ.setdefault("NAVSIM_DEVKIT_ROOT", code)
        agent = built(case, given, Path(folder), width, height)
    filled(model_of(agent), given)
    if argv[6]:
        save_as_lightning(agent, given, argv[6])
    without_dropout(agent)
    told = {
        "names": {name: list(value.shape) for name, value in model_of(agent).state_dict().items()},
        "parameters": sum(parameter.numel() for parameter in agent.parameters()),
        "picture": [width, height],
        "case": case,
        "code": origin(code),
        "versions": {"python": sys.version.split()[0], "torch": torch.__version__, "numpy": np.__version__},
    }
    said = evaluated(agent, case, given)  # first: training moves the statistics that evaluation normalises by
    losses, told["gradients"] = trained(agent, case, given) if argv[5] == "1" else ({}, [])
    np.savez_compressed(out, told=np.array(json.dumps(told)), **said, **losses)


def without_dropout(agent: Any) -> None:
    """Its random numbers are drawn in another order there."""
    for module in agent.modules():
        if isinstance(module, torch.nn.Dropout):
            module.p = 0.0


def origin(code: str) -> str:
    """The checkout's commit and its day, as git says."""
    words = ["git", "-C", code, "log", "-1", "--format=commit %H of %cs"]
    said = subprocess.run(words, capture_output=True, text=True, check=False)  # noqa: S603
    return f"{Path(code).name} {said.stdout.strip() or 'of no known commit'}"


def model_of(agent: Any) -> Any:
    """The network inside an agent."""
    return agent.model if hasattr(agent, "model") else agent._transfuser_model


def built(case: str, given: dict[str, Any], folder: Path, width: int, height: int, rate: float = 1e-4) -> Any:
    """The agent, around files of weights that it insists on and that `filled` replaces; rate: that it learns with."""
    import timm

    resnet = folder / "resnet34.bin"
    torch.save(timm.create_model("resnet34", pretrained=False).state_dict(), resnet)
    if case == "ltf":
        from navsim.agents.transfuser.transfuser_agent import TransfuserAgent
        from navsim.agents.transfuser.transfuser_config import TransfuserConfig

        return TransfuserAgent(TransfuserConfig(bkb_path=str(resnet)), lr=rate)
    if case == "diffusiondrive":
        from navsim.agents.diffusiondrive.transfuser_agent import TransfuserAgent
        from navsim.agents.diffusiondrive.transfuser_config import TransfuserConfig

        np.save(folder / "anchors.npy", given["anchors"])
        config = TransfuserConfig(bkb_path=str(resnet), plan_anchor_path=str(folder / "anchors.npy"))
        return TransfuserAgent(config, lr=rate)
    from navsim.agents.backbones.vov import VoVNet
    from navsim.agents.gtrs_dense.gtrs_agent import GTRSAgent
    from navsim.agents.gtrs_dense.hydra_config import HydraConfig

    np.save(folder / "vocabulary.npy", given["vocabulary"])
    # as navsim/planning/script/config/common/agent/gtrs_dense_vov.yaml has them
    values = {
        "vocab_path": str(folder / "vocabulary.npy"),
        "vocab_size": len(given["vocabulary"]),
        "lidar_seq_len": 4,
        "vocab_dropout": True,
        "normalize_vocab_pos": True,
        "camera_width": width,
        "camera_height": height,
        "bkb_path": str(resnet),
    }
    if case == V2_99:
        network = VoVNet("V-99-eSE", out_features=["stage5"])
        named = {f"img_backbone.{name}": value for name, value in network.state_dict().items()}
        torch.save({"state_dict": named}, folder / "vov.pth")
        cells = {"img_vert_anchors": height // 32, "img_horz_anchors": width // 32}
        values.update(backbone_type="vov", vov_ckpt=str(folder / "vov.pth"), **cells)
    agent = GTRSAgent(HydraConfig(**values), lr=rate)
    agent.vocab_pdm_score_full = {
        token: {name: given[f"score {name}"][i] for name in SCORES} for i, token in enumerate(tokens(given))
    }
    return agent


def filled(model: Any, given: dict[str, Any], formula: Any = weight) -> None:
    """Put a formula's weights into a model."""
    state = {}
    for name, value in model.state_dict().items():
        frozen = FROZEN.get(name.rpartition(".")[2])
        made = formula(name, tuple(value.shape)) if frozen is None else given[frozen]
        state[name] = torch.from_numpy(made)
    model.load_state_dict(state)


def tokens(given: dict[str, Any]) -> list[str]:
    """A name for each sample."""
    return [str(i) for i in range(len(given["image"]))]


def features(given: dict[str, Any], case: str, rows: Any = slice(None)) -> dict[str, Any]:
    """Inputs of some samples as the public feature builders make them: pictures are 0 .. 1."""
    image = torch.from_numpy(given["image"][rows]).float() / 255.0
    status = torch.from_numpy(given["status"][rows].copy())
    listed = case.startswith("gtrs")
    return {"camera_feature": [image] if listed else image, "status_feature": [status] if listed else status}


def targets(given: dict[str, Any], rows: Any = slice(None)) -> dict[str, Any]:
    """What the public target builders would have made of those samples."""
    return {
        "trajectory": torch.from_numpy(given["plan"][rows]),
        "agent_states": torch.from_numpy(given["agents"][rows]),
        "agent_labels": torch.from_numpy(given["agents_valid"][rows]),
        "bev_semantic_map": torch.from_numpy(given["bev"][rows]),
    }


def evaluated(agent: Any, case: str, given: dict[str, Any]) -> dict[str, Any]:
    """Outputs in evaluation mode, sample by sample: the noise that DiffusionDrive draws is then the same for each."""
    agent.eval()
    outputs = []
    with torch.no_grad():
        for i in range(len(given["image"])):
            torch.manual_seed(SEED)
            outputs.append(agent.forward(features(given, case, slice(i, i + 1))))
    results = {f"eval {name}": torch.cat([one[name] for one in outputs]).numpy() for name in wanted(outputs[0])}
    if (cells := results.get("eval bev_semantic_map")) is not None:
        results["eval bev_semantic_map"] = cells[..., ::CELLS, ::CELLS]
    return results


def wanted(output: dict[str, Any]) -> list[str]:
    """The outputs that are held against ours."""
    plain = ("trajectory", "agent_states", "agent_labels", "bev_semantic_map", "scores", "imi", *SCORES)
    return [name for name in plain if name in output]


def trained(agent: Any, case: str, given: dict[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """Loss and its terms in training mode, norms of the matrices' gradients, and whose those are."""
    agent.train()
    torch.manual_seed(SEED)
    shown, wanted_of_it = features(given, case), targets(given)
    if case == "diffusiondrive":
        predicted = agent.forward(shown, wanted_of_it)
    else:
        predicted = agent.forward(shown)
    if case.startswith("gtrs"):
        answer = agent.compute_loss(shown, wanted_of_it, predicted, tokens(given))
    else:
        answer = agent.compute_loss(shown, wanted_of_it, predicted)
    if isinstance(answer, dict):
        answer = answer.pop("loss"), answer
    loss, terms = answer if isinstance(answer, tuple) else (answer, {})
    loss.backward()
    values = {
        f"train {name}": np.float64(float(torch.as_tensor(value).detach()))
        for name, value in {"loss": loss, **terms}.items()
    }
    names, norms = gradients(model_of(agent))
    return {**values, "gradients": norms}, names


def gradients(model: Any) -> tuple[list[str], Any]:
    """Names of the matrices that have a gradient, and its norms."""
    learned = {name: p.grad for name, p in model.named_parameters() if p.grad is not None and p.dim() > 1}
    return list(learned), np.array([float(gradient.double().norm()) for gradient in learned.values()])


def save_as_lightning(agent: Any, given: dict[str, Any], path: str) -> None:
    """The agent as the public trainer saves it: a Lightning module with its optimiser, schedule and callbacks."""
    import pytorch_lightning as pl

    class AgentModule(pl.LightningModule):
        """As AgentLightningModule, whose file imports what is not public."""

        def __init__(self) -> None:
            super().__init__()
            self.agent = agent

        def training_step(self, batch: Any, index: int) -> Any:
            return sum(parameter.sum() for parameter in self.agent.parameters()) * 0.0

        def configure_optimizers(self) -> Any:
            return agent.get_optimizers()

    callback = pl.callbacks.ModelCheckpoint(dirpath=str(Path(path).parent), filename=Path(path).stem, save_top_k=1)
    trainer = pl.Trainer(
        max_steps=1, accelerator="cpu", logger=False, callbacks=[callback], enable_progress_bar=False, num_nodes=1
    )
    trainer.fit(AgentModule(), torch.utils.data.DataLoader(torch.utils.data.TensorDataset(torch.zeros(1))))
    filled(model_of(agent), given)  # a step, even one of no loss, decays weights
    trainer.save_checkpoint(path)
    agent.zero_grad()


def training(argv: list[str]) -> None:
    """Train the agent by its own Lightning module, optimiser and schedule, on the batches of a lesson."""
    import pytorch_lightning as pl

    code, lesson, out = argv
    with np.load(lesson, allow_pickle=False) as stored:
        given = {name: stored[name] for name in stored.files}
    told = json.loads(str(given.pop("told")))
    width, height = told["picture"]
    with tempfile.TemporaryDirectory() as folder:
        os.environ.setdefault("NAVSIM_DEVKIT_ROOT", code)
        agent = built(told["case"], given, Path(folder), width, height, told["rate"])
    filled(model_of(agent), given, first_weight)
    without_dropout(agent)
    watch = watched(pl.Callback)(given["seeds"])
    trainer = pl.Trainer(
        max_steps=len(given["order"]),
        accelerator="cpu",
        devices=1,
        precision="64-true" if told["double"] else "32-true",
        callbacks=[watch],
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
    )
    module = lightning_module(told["case"])(agent=agent)
    lessons = LessonBatches(given, told["case"], told["epoch_steps"], trainer)
    with Doubled() if told["double"] else nullcontext():
        trainer.fit(module, torch.utils.data.DataLoader(lessons, batch_size=None))
    told.update(
        names={name: list(value.shape) for name, value in model_of(agent).state_dict().items()},
        code=origin(code),
        versions={"torch": torch.__version__, "lightning": pl.__version__, "numpy": np.__version__},
        matrices=watch.matrices,
        optimiser=watch.optimiser,
    )
    losses, rates = np.array(watch.losses), np.array(watch.rates)
    np.savez_compressed(out, told=np.array(json.dumps(told)), losses=losses, rates=rates, gradients=watch.gradients)


def lightning_module(case: str) -> Any:
    """The class that the public training script of a family wraps its agent in."""
    if case == "ltf":
        from navsim.planning.training.agent_lightning_module_transfuser import AgentLightningModule
    elif case == "diffusiondrive":
        from navsim.planning.training.agent_lightning_module_diffusiondrive import AgentLightningModule
    else:
        from navsim.planning.training.agent_lightning_module import AgentLightningModule
    return AgentLightningModule


class LessonBatches(torch.utils.data.Dataset):  # type: ignore[misc,unused-ignore]
    """An epoch's batches as the public data sets collate them: features, targets, tokens."""

    def __init__(self, given: dict[str, Any], case: str, epoch_steps: int, trainer: Any) -> None:
        self.given, self.case, self.epoch_steps, self.trainer = given, case, epoch_steps, trainer

    def __len__(self) -> int:
        return self.epoch_steps

    def __getitem__(self, index: int) -> Any:
        rows = self.given["order"][self.trainer.current_epoch * self.epoch_steps + index]
        names = tokens(self.given)
        return features(self.given, self.case, rows), targets(self.given, rows), [names[row] for row in rows]


def watched(callback: Any) -> Any:
    """A Lightning callback (of the base class given) that seeds every step, and keeps what is compared."""

    class Seeing(callback):  # type: ignore[misc,unused-ignore]
        def __init__(self, seeds: Any) -> None:
            self.seeds = seeds
            self.losses: list[float] = []
            self.rates: list[list[float]] = []

        def on_train_batch_start(self, trainer: Any, module: Any, batch: Any, index: int) -> None:
            torch.manual_seed(int(self.seeds[trainer.global_step]))

        def on_after_backward(self, trainer: Any, module: Any) -> None:
            if trainer.global_step == 0:
                self.matrices, self.gradients = gradients(model_of(module.agent))

        def on_before_optimizer_step(self, trainer: Any, module: Any, optimiser: Any) -> None:
            if trainer.global_step == 0:
                self.optimiser = told_of(optimiser)
            self.rates.append([group["lr"] for group in optimiser.param_groups])

        def on_train_batch_end(self, trainer: Any, module: Any, outputs: Any, batch: Any, index: int) -> None:
            self.losses.append(float(outputs["loss"]))

    return Seeing


def start(argv: list[str]) -> None:
    """What an agent draws its weights to be before a training."""
    code, case, width, height, out = argv[0], argv[1], int(argv[2]), int(argv[3]), argv[4]
    torch.manual_seed(SEED)
    with tempfile.TemporaryDirectory() as folder:
        os.environ.setdefault("NAVSIM_DEVKIT_ROOT", code)
        model = model_of(built(case, inputs(width, height), Path(folder), width, height))
    torch.save({"state_dict": dict(model.state_dict()), "origin": origin(code)}, out)


def targets_of_a_street(argv: list[str]) -> None:
    """What the target builder makes of a made-up street."""
    import cv2
    from navsim.agents.diffusiondrive.transfuser_config import TransfuserConfig
    from navsim.agents.diffusiondrive.transfuser_features import TransfuserTargetBuilder
    from nuplan.common.actor_state.state_representation import StateSE2

    code, out = argv
    around = street()
    builder = TransfuserTargetBuilder(TransfuserConfig())
    told = annotated(around)
    bev = builder._compute_bev_semantic_map(told, Map(around), StateSE2(0.0, 0.0, 0.0))
    agents, there = builder._compute_agent_targets(told)
    versions = {"python": sys.version.split()[0], "numpy": np.__version__, "opencv": cv2.__version__}
    record = json.dumps({"code": origin(code), "versions": versions})
    np.savez_compressed(
        out, told=np.array(record), bev=bev.numpy().astype(np.uint8), agents=agents.numpy(), there=there.numpy()
    )


def annotated(around: dict[str, Any]) -> Any:
    """The boxes as a frame's annotations hold them: x, y, z, length, width, height, heading."""
    boxes = np.zeros((len(around["boxes"]), 7), np.float32)
    boxes[:, [0, 1, 6, 3, 4]] = around["boxes"]
    boxes[:, 5] = 1.0
    return SimpleNamespace(boxes=boxes, names=around["kinds"])


class Map:
    """A map of nothing but lanes."""

    def __init__(self, around: dict[str, Any]) -> None:
        self.around = around

    def get_proximal_map_objects(self, point: Any, radius: float, layers: Any) -> dict[Any, list[Any]]:
        """All lanes, wherever the point is."""
        from nuplan.common.maps.abstract_map import SemanticMapLayer
        from shapely.geometry import LineString, Polygon

        found: dict[Any, list[Any]] = {layer: [] for layer in layers}
        if SemanticMapLayer.INTERSECTION in layers:
            found[SemanticMapLayer.LANE] = [SimpleNamespace(polygon=Polygon(ring)) for ring in self.around["rings"]]
        elif SemanticMapLayer.LANE in layers:
            paths = [SimpleNamespace(linestring=LineString(line)) for line in self.around["lines"]]
            found[SemanticMapLayer.LANE] = [SimpleNamespace(baseline_path=path) for path in paths]
        return found


if __name__ == "__main__":
    commands = {"outputs": outputs, "training": training, "start": start, "targets": targets_of_a_street}
    commands[sys.argv[1]](sys.argv[2:])
