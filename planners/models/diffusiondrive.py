"""DiffusionDrive (Liao et al. 2025): a truncated diffusion from 20 anchors, in two denoising steps.

In training each anchor is noised by a random one of the first 50 of 1,000 steps and decoded to a plan and a confidence;
the anchor nearest to the label learns the label, and all learn to say whether they are the nearest. Planning noises the
anchors to step 8 and decodes twice, at steps 10 and 0. Constants are those of the public code (hustvl/DiffusionDrive,
also OpenDriveLab/SimScale 04cda10, navsim/agents/diffusiondrive: transfuser_model_v2.py, transfuser_config.py,
modules/multimodal_loss.py), without lidar as in SimScale. The scene comes from LTF's encoder.

Different here, but in the variant `public`: the noise to plan from is drawn once, so that a scene has one plan whatever
else is in the batch, and not for every scene and call. A point reads the cell of the raster from above that it lies in
(`BevLayout`); the public code reads a raster supervised for 0 .. 32 m ahead as if it reached from -32 to 32 m
(`centred`). The slowest wave of its noise step is the last of a closed range (`closed`). And plans may be offsets from
the anchors (`offsets_from`) instead of the noisy points. As noise is added to anchors and not to labels, it says
nothing about the label, and all that offsets from noisy points do with it is take it out again: that a wide network
learns in 100 epochs, a narrow one does not in 30.

As there, the feed-forward has no shortcut, every layer starts from the same feature of the noisy plan, and a layer's
plans lie where the layer before put them.
"""

import math
from collections.abc import Mapping
from itertools import pairwise
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from planners.data.batch import Batch, BevLayout, Needs
from planners.models.layers import (
    AgentHead,
    Attention,
    BevHead,
    Decoder,
    LatentFusion,
    auxiliary_losses,
    copy_first_layer,
    initialise_as_public,
)
from planners.models.planner import Planner, TrainingData, evaluating, read_array, visible_status
from planners.models.settings import DiffusionDriveSettings
from tasks.world.arrays import FloatArray
from tasks.world.vocabulary import refuse_other_meaning

WAYPOINTS = 8  # 0.5 .. 4.0 s


def checked_anchors(values: NDArray[Any], source: str) -> FloatArray:
    """`values` as float64 (A, 8, 2). Raises ValueError naming `source`."""
    if values.ndim != 3 or values.shape[1:] != (WAYPOINTS, 2) or len(values) == 0:
        raise ValueError(f"{source}: anchors have shape {values.shape}, expected (A >= 1, {WAYPOINTS}, 2)")
    if not np.isfinite(values).all():
        raise ValueError(f"{source}: anchors hold NaN or infinity")
    return values.astype(np.float64)


def cluster_anchors(plans: FloatArray, count: int, seed: int, iterations: int = 100) -> FloatArray:
    """Means (count, 8, 2) of k-means over the positions of plans (n, 8, >= 2), from a k-means++ start.

    Equal arguments give equal results. Raises ValueError where there are fewer distinct plans than anchors.
    """
    points = plans[:, :, :2].reshape(len(plans), -1).astype(np.float64)
    distinct = np.unique(points, axis=0)
    if len(distinct) < count:
        raise ValueError(f"{count} anchors cannot be made of {len(distinct)} distinct plans")
    rng = np.random.Generator(np.random.Philox(key=seed))
    centers = distinct[[int(rng.integers(len(distinct)))]]
    while len(centers) < count:
        mass = _squared(distinct, centers).min(axis=1)
        centers = np.concatenate([centers, distinct[[rng.choice(len(distinct), p=mass / mass.sum())]]])
    owner = np.full(len(points), -1)
    for _ in range(iterations):
        nearest = _squared(points, centers).argmin(axis=1)
        if np.array_equal(nearest, owner):
            break
        owner = nearest
        members = np.bincount(owner, minlength=count)
        sums = np.zeros_like(centers)
        np.add.at(sums, owner, points)
        centers = np.where(members[:, None] > 0, sums / np.maximum(members, 1)[:, None], centers)
    return centers.reshape(count, WAYPOINTS, 2)


def _squared(points: FloatArray, centers: FloatArray) -> FloatArray:
    """Squared distances (n, k)."""
    return np.stack([((points - center) ** 2).sum(axis=1) for center in centers], axis=1)


STEPS = 1000
BETA_FIRST, BETA_LAST = 1e-4, 0.02


def alphas_cumprod() -> Tensor:
    """A_t = prod_{s <= t} (1 - beta_s) for t = 0 .. 999, float32 (1000,); x_t = sqrt(A_t) x_0 + sqrt(1 - A_t) e.

    DDPM (Ho et al. 2020) with the beta of diffusers' "scaled_linear", which the public code's scheduler has.
    """
    betas = torch.linspace(BETA_FIRST**0.5, BETA_LAST**0.5, STEPS, dtype=torch.float64) ** 2
    return (1.0 - betas).cumprod(0).float()


def add_noise(x0: Tensor, noise: Tensor, alpha_at: Tensor) -> Tensor:
    """x_t from x_0 and e of one shape; alpha_at is A_t, broadcast against them."""
    return alpha_at.sqrt() * x0 + (1.0 - alpha_at).sqrt() * noise


def ddim_step(x_t: Tensor, x0: Tensor, alpha_at: Tensor, alpha_before: Tensor) -> Tensor:
    """x at an earlier step from x_t and a prediction of x_0 (DDIM with eta = 0, Song et al. 2021).

    The prediction is clipped to -1 .. 1 for where it leads.

    The noise direction comes from the prediction as it is, as in diffusers (`use_clipped_model_output=False`).
    """
    noise = (x_t - alpha_at.sqrt() * x0) / (1.0 - alpha_at).sqrt()
    return add_noise(x0.clamp(-1.0, 1.0), noise, alpha_before)


REFINEMENTS = 2  # layers of the cascade
POINT_FEATURES = 64  # of a point: sines and cosines of its two coordinates
RARE = 0.01  # confidence that the classifiers start from


def sinusoids(x: Tensor, count: int, per_unit: float = 1.0, closed: bool = False) -> Tensor:
    """`count` sines and cosines of (...,), their frequencies from per_unit to 1e-4 per_unit rad: (..., count).

    The last frequency is that of the end where the range is `closed`, else one step before it.
    """
    half = count // 2
    steps = half - 1 if closed else half
    rates = per_unit * 10000.0 ** (-torch.arange(half, device=x.device, dtype=torch.float32) / steps)
    angles = x[..., None].float() * rates
    return torch.cat([angles.sin(), angles.cos()], dim=-1)


def mlp(*widths: int, normalise: bool = False) -> nn.Sequential:
    """Linear layers with a ReLU between each two, followed by a layer norm where asked."""
    layers: list[nn.Module] = []
    for entering, leaving in pairwise(widths[:-1]):
        layers += [nn.Linear(entering, leaving), nn.ReLU()]
        layers += [nn.LayerNorm(leaving)] if normalise else []
    return nn.Sequential(*layers, nn.Linear(widths[-2], widths[-1]))


class TrajectoryAttention(nn.Module):
    """Attention to a map from above at a plan's own points; the plan's feature says how much each point counts."""

    def __init__(self, width: int, dropout: float, layout: BevLayout, centred: bool) -> None:
        super().__init__()
        self.layout, self.centred = layout, centred
        self.weights = nn.Linear(width, WAYPOINTS)
        self.value = nn.Sequential(nn.Conv2d(width, width, 3, padding=1), nn.ReLU())
        self.out = nn.Linear(width, width)
        self.drop = nn.Dropout(dropout)
        nn.init.zeros_(self.weights.weight)
        nn.init.zeros_(self.weights.bias)
        nn.init.xavier_uniform_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def forward(self, feature: Tensor, points: Tensor, above: Tensor) -> Tensor:
        """Features (B, A, width), points (B, A, 8, 2) in m, map (B, width, rows, columns); outside of it is zero."""
        grid = grid_coordinates(points, self.layout, self.centred)
        seen = F.grid_sample(self.value(above).float(), grid, align_corners=False)  # (B, width, A, 8)
        seen = torch.einsum("bcap,bap->bac", seen, self.weights(feature).float().softmax(dim=-1))
        return feature + self.drop(self.out(seen))


def grid_coordinates(points: Tensor, layout: BevLayout, centred: bool = False) -> Tensor:
    """Points (..., 2), x ahead and y left in m, as column and row in -1 .. 1 over a raster from above.

    centred: as if it reached behind as far as ahead.
    """
    x, y = points.float().unbind(dim=-1)
    reach = layout.ahead_m + (layout.ahead_m if centred else layout.behind_m)
    places = torch.stack([-y / layout.side_m, 2.0 * (layout.ahead_m - x) / reach - 1.0], dim=-1)
    return -places if layout.public else places


class DiffusionLayer(nn.Module):
    """One refinement: the map under the plan, agents, ego, feed-forward, scaled and shifted by the noise step."""

    def __init__(self, settings: "DiffusionDriveSettings") -> None:
        super().__init__()
        sizes, dropout = settings.network, settings.dropout
        width, heads, hidden = sizes.width, sizes.heads, sizes.hidden
        self.along = TrajectoryAttention(width, dropout, settings.bev, centred=settings.is_public)
        self.agents, self.ego = Attention(width, heads), Attention(width, heads)
        self.agents_norm, self.ego_norm, self.norm = (nn.LayerNorm(width) for _ in range(3))
        self.feedforward = mlp(width, hidden, width)
        self.modulation = nn.Sequential(nn.Mish(), nn.Linear(width, 2 * width))
        self.confidence = mlp(width, width, width, 1, normalise=True)
        self.offsets = mlp(width, width, width, 3 * WAYPOINTS)
        self.drop = nn.Dropout(dropout)
        last = self.confidence[-1]
        assert isinstance(last, nn.Linear)
        nn.init.constant_(last.bias, math.log(RARE / (1.0 - RARE)))

    def forward(
        self, feature: Tensor, points: Tensor, base: Tensor, above: Tensor, agents: Tensor, ego: Tensor, step: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Features (B, A, width) of points (B, A, 8, 2), map, agents (B, N, width), ego (B, 1, width), step (B, width).

        Gives float32 plans (B, A, 8, 3), as offsets from the base (B, A, 8, 2), and logits (B, A).
        """
        feature = self.along(feature, points, above)
        feature = self.agents_norm(feature + self.drop(self.agents(feature, agents)))
        feature = self.ego_norm(feature + self.drop(self.ego(feature, ego)))
        feature = self.norm(self.feedforward(feature))
        scale, shift = self.modulation(step)[:, None].chunk(2, dim=-1)
        feature = feature * (1.0 + scale) + shift
        moved = self.offsets(feature).float().unflatten(-1, (WAYPOINTS, 3))
        plans = torch.cat([base + moved[..., :2], math.pi * moved[..., 2:].tanh()], dim=-1)
        return plans, self.confidence(feature).squeeze(-1).float()


class DiffusionDecoder(nn.Module):
    """Noisy positions of every anchor to plans, in a cascade of layers."""

    def __init__(self, settings: "DiffusionDriveSettings") -> None:
        super().__init__()
        self.width, self.closed = (width := settings.network.width), settings.is_public
        self.feature = nn.Sequential(
            nn.Linear(WAYPOINTS * POINT_FEATURES, width), nn.ReLU(), nn.LayerNorm(width), nn.Linear(width, width)
        )
        self.step = nn.Sequential(nn.Linear(width, 4 * width), nn.Mish(), nn.Linear(4 * width, width))
        self.layers = nn.ModuleList(DiffusionLayer(settings) for _ in range(REFINEMENTS))

    def forward(
        self, points: Tensor, base: Tensor, step: Tensor, above: Tensor, agents: Tensor, ego: Tensor
    ) -> list[tuple[Tensor, Tensor]]:
        """Points (B, A, 8, 2) in m at noise step (B,): plans (B, A, 8, 3) and logits (B, A) of every layer.

        The first layer's plans are offsets from `base`, which is the points themselves or what the noise was added to.
        """
        feature = self.feature(sinusoids(points, POINT_FEATURES // 2, 2.0 * math.pi).flatten(2))
        noise = self.step(sinusoids(step, self.width, closed=self.closed))
        results = []
        for layer in self.layers:
            plans, logits = layer(feature, points, base, above, agents, ego, noise)
            results.append((plans, logits))
            points = base = plans[..., :2].detach()
        return results


TRUNCATED = 50  # noise steps 0 .. 49 are trained
NOISED_TO = 8  # where planning starts
DENOISED_AT = (10, 0)  # noise steps told to the decoder; each result is taken one step back, as in the public code
LOW_M, SPAN_M = (-1.2, -20.0), (56.9, 46.0)  # of x, y, which become -1 .. 1
FOCAL_ALPHA, FOCAL_GAMMA = 0.25, 2.0
NOISE_SEED = 0  # of what planning starts from
ANCHORS_SEED = 0
STATUS = 8


def normalise_points(points: Tensor) -> Tensor:
    """Positions (..., 2) in m to where most plans are within -1 .. 1."""
    return 2.0 * (points - points.new_tensor(LOW_M)) / points.new_tensor(SPAN_M) - 1.0


def denormalise_points(points: Tensor) -> Tensor:
    """The inverse of `normalise_points`."""
    return (points + 1.0) / 2.0 * points.new_tensor(SPAN_M) + points.new_tensor(LOW_M)


def focal_loss(logits: Tensor, target: Tensor) -> Tensor:
    """Sigmoid focal loss (Lin et al. 2017), elementwise."""
    chance = logits.sigmoid()
    wrong = (1.0 - chance) * target + chance * (1.0 - target)
    balance = FOCAL_ALPHA * target + (1.0 - FOCAL_ALPHA) * (1.0 - target)
    return balance * wrong**FOCAL_GAMMA * F.binary_cross_entropy_with_logits(logits, target, reduction="none")


class EncodedScene(NamedTuple):
    """What the decoder of plans reads of a sample."""

    ego: Tensor  # (B, 1, width)
    agents: Tensor  # (B, N, width)
    above: Tensor  # (B, width, rows, columns): the map that plans look at
    bev: Tensor  # (B, bev_channels, rows, columns): the map that is segmented


class SceneEncoder(nn.Module):
    """LTF's fused view from above, the ego's query and those of the agents."""

    def __init__(self, settings: DiffusionDriveSettings) -> None:
        super().__init__()
        sizes, fusion = settings.network, settings.fusion
        width = sizes.width
        self.fusion = LatentFusion(fusion)
        cells = (fusion.latent_size // 32) ** 2
        self.narrow = nn.Conv2d(self.fusion.channels[-1], width, 1)
        self.status = nn.Linear(STATUS, width)
        self.places = nn.Parameter(torch.randn(cells + 1, width))
        self.queries = nn.Parameter(torch.randn(1 + sizes.agents, width))
        self.decoder = Decoder(width, sizes.heads, sizes.hidden, sizes.layers)
        self.join = nn.Sequential(nn.Linear(width + fusion.bev_channels, width), nn.ReLU(), nn.LayerNorm(width))

    def forward(self, image: Tensor, status: Tensor) -> EncodedScene:
        """Picture (B, 3, h, w) uint8 and status (B, 8)."""
        fused = self.fusion(image)
        coarse = self.narrow(fused.latent)
        tokens = torch.cat([coarse.flatten(2).transpose(1, 2), self.status(status)[:, None]], dim=1) + self.places
        queries = self.decoder(self.queries.expand(len(image), -1, -1), tokens)
        placed = tokens[:, :-1].transpose(1, 2).unflatten(2, coarse.shape[2:])
        wide = F.interpolate(placed, fused.bev.shape[2:], mode="bilinear")
        joined = self.join(torch.cat([wide, fused.bev], dim=1).movedim(1, -1)).movedim(-1, 1)
        return EncodedScene(queries[:, :1], queries[:, 1:], joined, fused.bev)


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
        self.register_buffer("alphas_cumprod", alphas_cumprod(), persistent=False)
        self.encoder = SceneEncoder(settings)
        self.decoder = DiffusionDecoder(settings)
        reach_m = max(settings.bev.ahead_m, settings.bev.side_m)
        self.agent_head = AgentHead(settings.network.width, settings.network.hidden, reach_m)
        self.bev_head = BevHead(settings.fusion.bev_channels, settings.bev.shape)
        if settings.is_public:
            initialise_as_public(self)
            copy_first_layer(self.decoder.layers)

    @classmethod
    def fixed_arrays(cls, settings: DiffusionDriveSettings, data: TrainingData) -> dict[str, FloatArray]:
        """`anchors`.

        Raises ValueError for an unfit file, numbers of another meaning, or fewer distinct plans than anchors.
        """
        if settings.anchors is not None:
            anchors = checked_anchors(read_array(settings.anchors, "anchors"), settings.anchors)
            refuse_other_meaning(anchors, settings.anchors)
            return {"anchors": anchors}
        return {"anchors": cluster_anchors(data.labels_2hz(), settings.n_anchors, ANCHORS_SEED)}

    @property
    def needs(self) -> Needs:
        s = self.settings
        return Needs(s.picture, s.bev, s.network.agents, command=s.command)

    @property
    def needs_to_plan(self) -> Needs:
        return Needs(image=self.settings.picture, command=self.settings.command)

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """`confidence` and `regression` of all refinements, `agent_class`, `agent_box`, `bev`.

        Raises ValueError where the batch lacks its picture, view from above or agents.
        """
        return self.losses_seeing(self.scene(batch), batch)

    def losses_seeing(self, scene: EncodedScene, batch: Batch) -> dict[str, Tensor]:
        """The same of `scene(batch)`."""
        s = self.settings
        anchors = self.get_buffer("anchors")
        step = torch.randint(0, TRUNCATED, (len(batch),), device=anchors.device)
        noise = torch.randn((len(batch), *anchors.shape), device=anchors.device)
        at = add_noise(normalise_points(anchors), noise, self.get_buffer("alphas_cumprod")[step].view(-1, 1, 1, 1))
        decoded = self._decoded(at, step, scene)
        label = torch.where(batch.imitate[:, None, None], batch.plan_2hz, 0.0)
        nearest = self.nearest_anchor(label)
        surest = F.one_hot(nearest, len(anchors)).float()
        counted = batch.imitate / len(batch)  # (B,): a mean over the batch to which the others add nothing
        rows = torch.arange(len(batch), device=anchors.device)
        confidence = sum((focal_loss(logits, surest).mean(dim=1) * counted).sum() for _, logits in decoded)
        apart = sum(((plans[rows, nearest] - label).abs().mean(dim=(1, 2)) * counted).sum() for plans, _ in decoded)
        return {
            "confidence": s.trajectory_weight * s.confidence_weight * torch.as_tensor(confidence),
            "regression": s.trajectory_weight * s.regression_weight * torch.as_tensor(apart),
            **auxiliary_losses(s, batch, self.bev_head(scene.bev), *self.agent_head(scene.agents)),
        }

    def nearest_anchor(self, label: Tensor) -> Tensor:
        """(B,) of plans (B, 8, 3)."""
        return (label[:, None, :, :2] - self.get_buffer("anchors")).norm(dim=-1).mean(dim=-1).argmin(dim=1)

    def plan(self, batch: Batch) -> Tensor:
        with evaluating(self):
            return self.denoised(self.scene(batch))

    def scene(self, batch: Batch) -> EncodedScene:
        """What plans are decoded from. Raises ValueError for a batch without pictures."""
        if batch.image is None:
            raise ValueError("diffusiondrive: a batch without images")
        return self.encoder(batch.image, visible_status(self.settings.status, batch.status))

    def _decoded(self, at: Tensor, step: Tensor, scene: EncodedScene) -> list[tuple[Tensor, Tensor]]:
        """Plans and logits of every refinement from positions (B, A, 8, 2) in -1 .. 1 at noise step (B,)."""
        points = denormalise_points(at.clamp(-1.0, 1.0))
        base = points if self.settings.offsets_from == "noisy" else self._anchors_like(points)
        return self.decoder(points, base, step, scene.above, scene.agents, scene.ego)

    def _anchors_like(self, points: Tensor) -> Tensor:
        """(C * A, 8, 2) of points (B, C * A, 8, 2)."""
        anchors = self.get_buffer("anchors")
        return anchors.repeat(points.shape[1] // len(anchors), 1, 1)

    def denoised(self, scene: EncodedScene) -> Tensor:
        """Plans (B, 8, 3) from the noise that stays the same, or of a public planner is drawn here."""
        n, anchors = len(scene.ego), self.get_buffer("anchors")
        noise = self.get_buffer("first_noise").expand(n, -1, -1, -1)
        if self.settings.is_public:
            noise = torch.randn((n, *anchors.shape), device=anchors.device)
        plans, logits = self.denoised_from(noise, scene)
        return plans[torch.arange(n, device=plans.device), logits.argmax(dim=1)]

    def denoised_from(self, noise: Tensor, scene: EncodedScene) -> tuple[Tensor, Tensor]:
        """Plans (B, C * A, 8, 3) and logits (B, C * A) from noise (B, C * A, 8, 2): C draws, each of all anchors."""
        levels = self.get_buffer("alphas_cumprod")
        at = add_noise(normalise_points(self._anchors_like(noise)), noise, levels[NOISED_TO])
        for step in DENOISED_AT:
            steps = torch.full((len(noise),), step, device=at.device)
            plans, logits = self._decoded(at, steps, scene)[-1]
            before = levels[step - 1] if step else torch.ones_like(levels[0])
            at = ddim_step(at, normalise_points(plans[..., :2]), levels[step], before)
        return plans, logits
