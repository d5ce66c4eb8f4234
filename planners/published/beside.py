"""The public code's half of a comparison; it runs in the public code's own Python, which has torch, timm and NAVSIM.

    main([<checkout>, <case>, <picture width>, <picture height>, <out.npz>, <train: 0 or 1>, <out.ckpt, or nothing>])

Builds the checkout's model of a case with the weights and inputs of planners.published.formula, and writes what it
plans and loses; and, where asked, the model as its trainer would have saved it. Nothing is switched off but dropout.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch

from planners.published.formula import CELLS, FROZEN, SCORES, SEED, inputs, weight

V2_99 = "gtrs_dense_v2_99"


def main(argv: list[str]) -> None:
    """See the module."""
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
    outputs = evaluated(agent, case, given)  # first: training moves the statistics that evaluation normalises by
    losses, told["gradients"] = trained(agent, case, given) if argv[5] == "1" else ({}, [])
    np.savez_compressed(out, told=np.array(json.dumps(told)), **outputs, **losses)


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
