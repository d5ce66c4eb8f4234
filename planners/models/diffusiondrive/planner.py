"""DiffusionDrive (Liao et al. 2025): a truncated diffusion from 20 anchors, in two denoising steps.

In training each anchor is noised by a random one of the first 50 of 1,000 steps and decoded to a plan and a confidence;
the anchor nearest to the label learns the label, and all learn to say whether they are the nearest. Planning noises the
anchors to step 8 and decodes twice, at steps 10 and 0. Constants are those of the public code (hustvl/DiffusionDrive,
also OpenDriveLab/SimScale 04cda10, navsim/agents/diffusiondrive: transfuser_model_v2.py, transfuser_config.py,
modules/multimodal_loss.py), without lidar as in SimScale. The scene comes from LTF's encoder.

Different here: the noise to plan from is drawn once, so that a scene has one plan whatever else is in the batch. And
plans may be offsets from the anchors (`offsets_from`) instead of the noisy points. As noise is added to anchors and not
to labels, it says nothing about the label, and all that offsets from noisy points do with it is take it out again:
that a wide network learns in 100 epochs, a narrow one does not in 30.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar, Literal, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from planners.data.batch import Batch, BevLayout, ImageLayout, Needs
from planners.models.anchors import checked_anchors, cluster_anchors, read_array
from planners.models.attention import Decoder
from planners.models.auxiliary import AgentHead, BevHead, agent_losses, bev_loss
from planners.models.diffusiondrive.ddim import kept, noised, stepped
from planners.models.diffusiondrive.decoder import DiffusionDecoder
from planners.models.planner import Planner, TrainingData, evaluating
from planners.models.transfuser import FusionSettings, LatentFusion
from tasks.world.arrays import FloatArray

TRUNCATED = 50  # noise steps 0 .. 49 are trained
NOISED_TO = 8  # where planning starts
DENOISED_AT = (10, 0)  # noise steps told to the decoder; each result is taken one step back, as in the public code
LOW_M, SPAN_M = (-1.2, -20.0), (56.9, 46.0)  # of x, y, which become -1 .. 1
FOCAL_ALPHA, FOCAL_GAMMA = 0.25, 2.0
NOISE_SEED = 0  # of what planning starts from
STATUS = 8


def to_unit(points: Tensor) -> Tensor:
    """Positions (..., 2) in m to where most plans are within -1 .. 1."""
    return 2.0 * (points - points.new_tensor(LOW_M)) / points.new_tensor(SPAN_M) - 1.0


def from_unit(points: Tensor) -> Tensor:
    """The inverse of `to_unit`."""
    return (points + 1.0) / 2.0 * points.new_tensor(SPAN_M) + points.new_tensor(LOW_M)


def focal(logits: Tensor, target: Tensor) -> Tensor:
    """Sigmoid focal loss (Lin et al. 2017), elementwise."""
    chance = logits.sigmoid()
    wrong = (1.0 - chance) * target + chance * (1.0 - target)
    balance = FOCAL_ALPHA * target + (1.0 - FOCAL_ALPHA) * (1.0 - target)
    return balance * wrong**FOCAL_GAMMA * F.binary_cross_entropy_with_logits(logits, target, reduction="none")


@dataclass(frozen=True)
class DiffusionDriveSettings:
    """The defaults are the paper's size."""

    anchors: str | None = None  # .npy (A, 8, 2); null: clusters of the plans to be trained on
    n_anchors: int = 20  # of them
    anchors_seed: int = 0
    image: ImageLayout = field(default_factory=ImageLayout)
    bev: BevLayout = field(default_factory=BevLayout)
    fusion: FusionSettings = field(default_factory=FusionSettings)
    width: int = 256  # of the decoders
    hidden: int = 1024
    heads: int = 8
    layers: int = 3  # of the queries' decoder
    refinements: int = 2  # layers of the cascade
    dropout: float = 0.1  # in the cascade
    offsets_from: Literal["noisy", "anchors"] = "noisy"  # what the first refinement's plans are told from
    agents: int = 30
    trajectory_weight: float = 12.0  # of all refinements together
    confidence_weight: float = 10.0  # within it
    regression_weight: float = 8.0
    agent_class_weight: float = 10.0
    agent_box_weight: float = 1.0
    bev_weight: float = 14.0


class Scene(NamedTuple):
    """What the decoder of plans reads of a sample."""

    ego: Tensor  # (B, 1, width)
    agents: Tensor  # (B, N, width)
    above: Tensor  # (B, width, rows, columns): the map that plans look at
    bev: Tensor  # (B, bev_channels, rows, columns): the map that is segmented


class SceneEncoder(nn.Module):
    """LTF's fused view from above, the ego's query and those of the agents."""

    def __init__(self, settings: DiffusionDriveSettings) -> None:
        super().__init__()
        width = settings.width
        self.fusion = LatentFusion(settings.fusion)
        cells = (settings.fusion.latent_size // 32) ** 2
        self.narrow = nn.Conv2d(self.fusion.channels[-1], width, 1)
        self.status = nn.Linear(STATUS, width)
        self.places = nn.Parameter(torch.randn(cells + 1, width))
        self.queries = nn.Parameter(torch.randn(1 + settings.agents, width))
        self.decoder = Decoder(width, settings.heads, settings.hidden, settings.layers)
        self.join = nn.Sequential(
            nn.Linear(width + settings.fusion.bev_channels, width), nn.ReLU(), nn.LayerNorm(width)
        )

    def forward(self, image: Tensor, status: Tensor) -> Scene:
        """Picture (B, 3, h, w) uint8 and status (B, 8)."""
        fused = self.fusion(image)
        coarse = self.narrow(fused.latent)
        tokens = torch.cat([coarse.flatten(2).transpose(1, 2), self.status(status)[:, None]], dim=1) + self.places
        queries = self.decoder(self.queries.expand(len(image), -1, -1), tokens)
        placed = tokens[:, :-1].transpose(1, 2).unflatten(2, coarse.shape[2:])
        wide = F.interpolate(placed, fused.bev.shape[2:], mode="bilinear")
        joined = self.join(torch.cat([wide, fused.bev], dim=1).movedim(1, -1)).movedim(-1, 1)
        return Scene(queries[:, :1], queries[:, 1:], joined, fused.bev)


class DiffusionDrive(Planner):
    """See the module; plans are (B, 8, 3)."""

    name: ClassVar[str] = "diffusiondrive"
    settings_type: ClassVar[type] = DiffusionDriveSettings
    settings: DiffusionDriveSettings

    def __init__(self, settings: DiffusionDriveSettings, arrays: Mapping[str, FloatArray]) -> None:
        super().__init__(settings, arrays)
        anchors = torch.tensor(checked_anchors(arrays["anchors"], "anchors")).float()
        fixed = torch.Generator().manual_seed(NOISE_SEED)
        self.register_buffer("anchors", anchors, persistent=False)
        self.register_buffer("first_noise", torch.randn(anchors.shape, generator=fixed), persistent=False)
        self.register_buffer("kept", kept(), persistent=False)
        self.encoder = SceneEncoder(settings)
        self.decoder = DiffusionDecoder(
            settings.width, settings.heads, settings.hidden, settings.refinements, settings.dropout, settings.bev
        )
        reach_m = max(settings.bev.ahead_m, settings.bev.side_m)
        self.agent_head = AgentHead(settings.width, settings.hidden, reach_m)
        self.bev_head = BevHead(settings.fusion.bev_channels, settings.bev.shape)

    @classmethod
    def fixed_arrays(cls, settings: DiffusionDriveSettings, data: TrainingData) -> dict[str, FloatArray]:
        """`anchors`. Raises ValueError for an unfit file, or fewer distinct plans than anchors."""
        if settings.anchors is not None:
            return {"anchors": checked_anchors(read_array(settings.anchors, "anchors"), settings.anchors)}
        return {"anchors": cluster_anchors(data.labels_2hz(), settings.n_anchors, settings.anchors_seed)}

    @property
    def needs(self) -> Needs:
        return Needs(image=self.settings.image, bev=self.settings.bev, n_agents=self.settings.agents)

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """`confidence` and `regression` of all refinements, `agent_class`, `agent_box`, `bev`.

        Raises ValueError where the batch lacks its picture, view from above or agents.
        """
        if batch.bev is None or batch.agents is None or batch.agents_valid is None:
            raise ValueError("diffusiondrive: a batch without view from above or agents cannot be learned from")
        s, scene = self.settings, self._scene(batch)
        anchors = self.get_buffer("anchors")
        step = torch.randint(0, TRUNCATED, (len(batch),), device=anchors.device)
        noise = torch.randn((len(batch), *anchors.shape), device=anchors.device)
        at = noised(to_unit(anchors), noise, self.get_buffer("kept")[step].view(-1, 1, 1, 1))
        decoded = self._decoded(at, step, scene)
        label = torch.where(batch.imitate[:, None, None], batch.plan_2hz, 0.0)
        nearest = (label[:, None, :, :2] - anchors).norm(dim=-1).mean(dim=-1).argmin(dim=1)
        surest = F.one_hot(nearest, len(anchors)).float()
        counted = batch.imitate / len(batch)  # (B,): a mean over the batch to which the others add nothing
        rows = torch.arange(len(batch), device=anchors.device)
        confidence = sum((focal(logits, surest).mean(dim=1) * counted).sum() for _, logits in decoded)
        apart = sum(((plans[rows, nearest] - label).abs().mean(dim=(1, 2)) * counted).sum() for plans, _ in decoded)
        boxes, there = self.agent_head(scene.agents)
        agent_class, agent_box = agent_losses(
            boxes, there, batch.agents, batch.agents_valid, s.agent_class_weight, s.agent_box_weight
        )
        return {
            "confidence": s.trajectory_weight * s.confidence_weight * torch.as_tensor(confidence),
            "regression": s.trajectory_weight * s.regression_weight * torch.as_tensor(apart),
            "agent_class": s.agent_class_weight * agent_class,
            "agent_box": s.agent_box_weight * agent_box,
            "bev": s.bev_weight * bev_loss(self.bev_head(scene.bev), batch.bev),
        }

    def plan(self, batch: Batch) -> Tensor:
        with evaluating(self):
            return self._denoised(self._scene(batch))

    def _scene(self, batch: Batch) -> Scene:
        if batch.image is None:
            raise ValueError("diffusiondrive: a batch without images")
        return self.encoder(batch.image, batch.status)

    def _decoded(self, at: Tensor, step: Tensor, scene: Scene) -> list[tuple[Tensor, Tensor]]:
        """Plans and logits of every refinement from positions (B, A, 8, 2) in -1 .. 1 at noise step (B,)."""
        points = from_unit(at.clamp(-1.0, 1.0))
        base = points if self.settings.offsets_from == "noisy" else self.get_buffer("anchors").expand_as(points)
        return self.decoder(points, base, step, scene.above, scene.agents, scene.ego)

    def _denoised(self, scene: Scene) -> Tensor:
        n, levels = len(scene.ego), self.get_buffer("kept")
        start = noised(to_unit(self.get_buffer("anchors")), self.get_buffer("first_noise"), levels[NOISED_TO])
        at = start.expand(n, -1, -1, -1)
        for step in DENOISED_AT:
            steps = torch.full((n,), step, device=at.device)
            plans, logits = self._decoded(at, steps, scene)[-1]
            before = levels[step - 1] if step else torch.ones_like(levels[0])
            at = stepped(at, to_unit(plans[..., :2]), levels[step], before)
        return plans[torch.arange(n, device=at.device), logits.argmax(dim=1)]
