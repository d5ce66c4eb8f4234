"""GTRS-Dense (Li et al. 2025): every trajectory of a large vocabulary is scored, the best one is driven.

A trajectory is a query that looks at the picture's tokens; one head for each sub-score of EPDMS learns what that
trajectory would score if it were driven, another how near it is to the label. A step trains a random half of the
vocabulary. Constants without another source are those of NVlabs/GTRS and OpenDriveLab/SimScale (04cda10),
navsim/agents/gtrs_dense: hydra_config.py, hydra_model.py, gtrs_agent.py, with SimScale's gtrs_dense_vov.yaml.

Different here, but in the variant `public`: there is a head for history comfort
as well (weight 1.0 in the published settings, which have no such head), noise on the velocity is drawn for each sample
instead of once for a batch, the trajectories' attention to each other has biases, and pictures are shifted. The
supplement says that inputs get "random spatial shifts"; neither code base shifts the pictures of this model, so how far
is ours: edge pixels are repeated as in DrQ (Kostrikov et al. 2021), few enough of them that the labels stand.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from planners.data.batch import Batch, ImageLayout, Needs
from planners.models.backbones import build_backbone
from planners.models.layers import Decoder, LatentFusion, Layer, initialise_as_public
from planners.models.planner import Planner, TrainingData, evaluating, read_array, visible_status
from planners.models.settings import STRIDES, BackboneSettings, FusionSettings, GtrsDenseSettings, WeightingName
from tasks.subscores import HALVES
from tasks.world.arrays import FloatArray
from tasks.world.vocabulary import Vocabulary, refuse_other_meaning

IMITATION = "imitation"


@dataclass(frozen=True)
class Weighting:
    """How a trajectory's predicted sub-scores p become the one number that it is chosen by.

        total = sum_i w_i log p_i + group log(sum_j v_j p_j)

    What multiplies in EPDMS and imitation in logarithms of their own, what is averaged there under one. `release` is
    that of hydra_model.py (also in woxihuanjiangguo/ZTRS 3593a03). It does not weigh history comfort, for which that
    model has no head. What is not named weighs nothing.
    """

    alone: Mapping[str, float]  # w
    group: float
    inside: Mapping[str, float]  # v


WEIGHTINGS: dict[WeightingName, Weighting] = {
    # HydraTrajHead.forward: what GTRS-Dense plans with; SimScale's scripts use it for navhard and navtest alike
    "release": Weighting(
        {IMITATION: 0.03, "tlc": 0.1, "nc": 0.1, "dac": 0.9, "ddc": 0.2}, 6.0, {"ttc": 7.0, "ep": 7.0, "lk": 3.0}
    ),
    # ours: `release` with ten times its imitation, for small planners over hundreds of trajectories
    "close": Weighting(
        {IMITATION: 0.3, "tlc": 0.1, "nc": 0.1, "dac": 0.9, "ddc": 0.2}, 6.0, {"ttc": 7.0, "ep": 7.0, "lk": 3.0}
    ),
}


def weighted_total(scores: Mapping[str, Tensor], weighting: Weighting) -> Tensor:
    """One number (B, K) from probabilities (B, K) by name, comparable within a row only."""
    inside = sum(weight * scores[name].float() for name, weight in weighting.inside.items())
    assert isinstance(inside, Tensor)
    result = weighting.group * _log(inside)
    for name, weight in weighting.alone.items():
        result = result + weight * _log(scores[name].float())
    return result


def choose(scores: Mapping[str, Tensor], weighting: Weighting) -> Tensor:
    """Index (B,) of the best of K; of equals the first."""
    return weighted_total(scores, weighting).argmax(dim=1)


def _log(x: Tensor) -> Tensor:
    return x.clamp_min(torch.finfo(torch.float32).tiny).log()  # a probability that underflowed must not be -inf


class PictureTokens(nn.Module):
    """The backbone's last map: what GTRS-Dense reads with V2-99."""

    def __init__(self, backbone: BackboneSettings, image: ImageLayout, width: int) -> None:
        super().__init__()
        stride = STRIDES[-1]
        if image.width % stride or image.height % stride:
            raise ValueError(f"image is {image.width} x {image.height}: both sides must be divisible by {stride}")
        self.backbone = build_backbone(backbone)
        self.narrow = nn.Conv2d(self.backbone.channels[-1], width, 1)
        self.places = nn.Parameter(torch.randn(image.height // stride * (image.width // stride), width))

    def forward(self, image: Tensor) -> Tensor:
        """Picture (B, 3, h, w) uint8 to (B, h / 32 x w / 32, width)."""
        return self.narrow(self.backbone(image)[-1]).flatten(2).transpose(1, 2) + self.places


class FusedTokens(nn.Module):
    """LTF's view from above, coarse and fine side by side: what GTRS-Dense reads with ResNet-34."""

    def __init__(self, fusion: FusionSettings, width: int) -> None:
        super().__init__()
        self.fusion = LatentFusion(fusion)
        self.narrow = nn.Conv2d(self.fusion.channels[-1] + fusion.bev_channels, width, 1)
        self.places = nn.Parameter(torch.randn((fusion.latent_size // STRIDES[0]) ** 2, width))

    def forward(self, image: Tensor) -> Tensor:
        """Picture (B, 3, h, w) uint8 to (B, (latent_size / 4)^2, width)."""
        fused = self.fusion(image)
        coarse = F.interpolate(fused.latent, fused.bev.shape[2:], mode="bilinear")
        return self.narrow(torch.cat([coarse, fused.bev], dim=1)).flatten(2).transpose(1, 2) + self.places


STATUS = 8
VELOCITY = slice(4, 6)  # of the status, after the one-hot command
AT_2HZ = slice(4, None, 5)  # of 40 poses at 10 Hz
LOSS_WEIGHTS = {"nc": 3.0, "dac": 3.0, "tlc": 3.0, "ttc": 4.0, "lk": 2.0, "ep": 2.0}  # of the others 1
SIGMA_M2 = 0.5  # of the imitated distribution


class TrajectoryScorer(nn.Module):
    """Trajectories that have seen each other, then a scene's tokens, to a logit for each head."""

    def __init__(self, settings: GtrsDenseSettings) -> None:
        super().__init__()
        sizes = settings.network
        width, hidden = sizes.width, sizes.hidden
        self.embed = nn.Sequential(nn.Linear(3 * 40, hidden), nn.ReLU(), nn.Linear(hidden, width))
        self.among = Layer(width, sizes.heads, 4 * width, crosses=False, bias=not settings.is_public)
        self.decoder = Decoder(width, sizes.heads, hidden, sizes.layers)
        self.status = nn.Linear(STATUS, width)
        self.heads = nn.ModuleDict(
            {
                name: nn.Sequential(nn.Linear(width, hidden), nn.ReLU(), nn.Linear(hidden, 1))
                for name in settings.sub_scores
            }
        )
        self.heads[IMITATION] = nn.Sequential(
            nn.Linear(width, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, 1)
        )

    def forward(self, trajectories: Tensor, tokens: Tensor, status: Tensor) -> dict[str, Tensor]:
        """Trajectories (K, 40, 3), tokens (B, N, width), status (B, 8) to float32 logits (B, K) by name."""
        queries = self.among(self.embed(trajectories.flatten(1))[None])
        if self.training:  # else what they have seen of each other is worked out once; gradients would round otherwise
            queries = queries.expand(len(tokens), -1, -1)
        seen = self.decoder(queries, tokens) + self.status(status)[:, None]
        return {name: head(seen).squeeze(-1).float() for name, head in self.heads.items()}


class GtrsDense(Planner):
    """See the module; plans are (B, 40, 3)."""

    name: ClassVar[str] = "gtrs_dense"
    settings_type: ClassVar[type] = GtrsDenseSettings
    free_settings = frozenset({"weighting", "inference_entries"})
    settings: GtrsDenseSettings

    def __init__(self, settings: GtrsDenseSettings, arrays: Mapping[str, FloatArray]) -> None:
        super().__init__(settings, arrays)
        vocabulary = Vocabulary(np.asarray(arrays["vocabulary"], np.float64), "vocabulary")
        choices = _choices(settings, arrays, vocabulary)
        self.label_digest, self.choice_digest = vocabulary.digest, choices.digest
        self.register_buffer("trajectories", torch.tensor(vocabulary.trajectories).float(), persistent=False)
        self.register_buffer("choices", torch.tensor(choices.trajectories).float(), persistent=False)
        self.tokens: nn.Module
        if settings.encoder == "fused":
            self.tokens = FusedTokens(settings.fusion, settings.network.width)
        else:
            self.tokens = PictureTokens(settings.backbone, settings.image, settings.network.width)
        self.scorer = TrajectoryScorer(settings)
        if settings.is_public:
            initialise_as_public(self)

    @classmethod
    def fixed_arrays(cls, settings: GtrsDenseSettings, data: TrainingData) -> dict[str, FloatArray]:
        """`vocabulary`, and `inference_vocabulary` where the settings name one.

        Raises ValueError where a file is missing or the samples are labelled with another vocabulary, or none.
        """
        labelled = data.label_vocabulary
        settings.check_labels(labelled)
        assert settings.vocabulary is not None
        vocabulary = _read_vocabulary(settings.vocabulary, "vocabulary")
        if vocabulary.digest != labelled:
            raise ValueError(
                f"vocabulary={settings.vocabulary} has digest {vocabulary.digest}, "
                f"the samples are labelled with {labelled}"
            )
        return {"vocabulary": vocabulary.trajectories, **inference_arrays(settings)}

    @property
    def needs(self) -> Needs:
        return Needs(image=self.settings.picture, labels=self.label_digest, command=self.settings.command)

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """`imitation`: cross-entropy with softmax(-d^2 / sigma^2) of the poses at 2 Hz; one binary one per sub-score.

        Half points count as none, as published. Raises ValueError where the batch has no image or labels.
        """
        if batch.labels is None:
            raise ValueError("gtrs_dense: a batch without labels cannot be learned from")
        status = self._noisy(batch.status) if self.training else batch.status
        picked = self._picked()
        trajectories = self.get_buffer("trajectories")[picked]
        logits = self.logits(batch, status, trajectories)
        target = imitation_target(trajectories[:, AT_2HZ], batch.plan_2hz, batch.imitate, SIGMA_M2)
        # masked by a product, also where nothing imitates: a distributed step wants a gradient for every parameter
        apart = -(target * logits[IMITATION].log_softmax(dim=1)).sum(dim=1)
        terms = {IMITATION: (apart * batch.imitate).sum() / len(batch)}
        for name in self.settings.sub_scores:
            score = batch.labels[name][:, picked]
            whole = (score == 1.0).float() if name in HALVES else score
            terms[name] = LOSS_WEIGHTS.get(name, 1.0) * F.binary_cross_entropy_with_logits(logits[name], whole)
        return terms

    def scores(self, batch: Batch) -> dict[str, Tensor]:
        """Probabilities (B, K) of every trajectory to choose from: the sub-scores, and `imitation` that sums to 1."""
        with evaluating(self):
            logits = self.logits(batch, batch.status, self.get_buffer("choices"))
        return {name: value.softmax(dim=1) if name == IMITATION else value.sigmoid() for name, value in logits.items()}

    def choose(self, scores: Mapping[str, Tensor]) -> Tensor:
        """Index (B,) by the weighting of the settings."""
        return choose(scores, WEIGHTINGS[self.settings.weighting])

    def plan(self, batch: Batch) -> Tensor:
        return self.get_buffer("choices")[self.choose(self.scores(batch))]

    def logits(self, batch: Batch, status: Tensor, trajectories: Tensor) -> dict[str, Tensor]:
        """Logits (B, K) by name of trajectories (K, 40, 3), for a status that may be another than the batch's."""
        if batch.image is None:
            raise ValueError("gtrs_dense: a batch without images")
        image = batch.image
        if self.training and not self.settings.is_public:
            image = random_shift(image, round(self.settings.image_shift * image.shape[-1]))
        return self.scorer(trajectories, self.tokens(image), visible_status(self.settings.status, status))

    def _noisy(self, status: Tensor) -> Tensor:
        deviation = status.new_tensor(self.settings.velocity_noise_mps)
        if self.settings.is_public:  # one draw for the batch, as there one number after the other
            drawn = torch.stack([torch.randn((), device=status.device) for _ in deviation])
        else:
            drawn = torch.randn_like(status[:, VELOCITY])
        noisy = status.clone()
        noisy[:, VELOCITY] += deviation * drawn
        return noisy

    def _picked(self) -> Tensor:
        """Sorted indices of the vocabulary for one training step; all of it in evaluation."""
        trajectories = self.get_buffer("trajectories")
        size, device = len(trajectories), trajectories.device
        if not self.training or self.settings.kept == 1.0:
            return torch.arange(size, device=device)
        return torch.randperm(size, device=device)[: max(1, round(self.settings.kept * size))].sort().values


def inference_arrays(settings: GtrsDenseSettings) -> dict[str, FloatArray]:
    """`inference_vocabulary` where the settings name one. Raises ValueError where its file is missing or unfit."""
    file = settings.inference_vocabulary
    if file is None:
        return {}
    return {"inference_vocabulary": _read_vocabulary(file, "inference_vocabulary").trajectories}


def _read_vocabulary(file: str, setting: str) -> Vocabulary:
    """Raises ValueError where the file is missing or unfit, or its numbers mean something else."""
    vocabulary = Vocabulary(read_array(file, setting), file)
    refuse_other_meaning(vocabulary.trajectories, file)
    return vocabulary


def _choices(settings: GtrsDenseSettings, arrays: Mapping[str, FloatArray], vocabulary: Vocabulary) -> Vocabulary:
    if settings.inference_vocabulary is not None:
        return Vocabulary(np.asarray(arrays["inference_vocabulary"], np.float64), settings.inference_vocabulary)
    count = settings.inference_entries
    if count is None:
        return vocabulary
    if not 1 <= count <= len(vocabulary):
        raise ValueError(f"inference_entries={count}: the vocabulary has {len(vocabulary)}")
    return Vocabulary(vocabulary.trajectories[[i * len(vocabulary) // count for i in range(count)]])


def imitation_target(at_2hz: Tensor, plans: Tensor, imitate: Tensor, sigma_m2: float) -> Tensor:
    """Distribution (B, K) over trajectories (K, 8, 3): softmax of -sum((x, y, heading apart)^2) / sigma.

    Plans (B, 8, 3) that are not to be imitated may be anything, also NaN; their rows mean nothing.
    """
    plans = torch.where(imitate[:, None, None], plans, 0.0)
    return (-(at_2hz[None] - plans[:, None]).square().sum(dim=(2, 3)) / sigma_m2).softmax(dim=1)


def random_shift(image: Tensor, most: int) -> Tensor:
    """Pictures (B, C, h, w), each moved by up to `most` pixels along both axes, edge pixels repeated."""
    if most == 0:
        return image
    n, _, height, width = image.shape
    moves = torch.randint(-most, most + 1, (2, n, 1), device=image.device)
    rows = (torch.arange(height, device=image.device) + moves[0]).clamp(0, height - 1)
    columns = (torch.arange(width, device=image.device) + moves[1]).clamp(0, width - 1)
    sample = torch.arange(n, device=image.device)[:, None, None]
    return image[sample, :, rows[:, :, None], columns[:, None, :]].permute(0, 3, 1, 2)


def average_scores(scores: Sequence[dict[str, Tensor]]) -> dict[str, Tensor]:
    """Mean probabilities (B, K) by name of several models' over the same trajectories (paper, supplement)."""
    return {name: torch.stack([one[name] for one in scores]).mean(dim=0) for name in scores[0]}


class Ensemble(nn.Module):
    """Plans (B, 40, 3) from the mean of its members' scores, by the first member's weighting.

    members: by the name they are spoken of in errors, such as a file's.
    Raises ValueError for no member, or members of different vocabularies or pictures.
    """

    def __init__(self, members: Sequence[tuple[str, GtrsDense]]) -> None:
        super().__init__()
        if not members:
            raise ValueError("an ensemble needs one model at least")
        first_name, first = members[0]
        for name, member in members[1:]:
            if member.choice_digest != first.choice_digest:
                raise ValueError(
                    f"{name} chooses from vocabulary {member.choice_digest} and {first_name} from "
                    f"{first.choice_digest}: scores of different trajectories have no mean"
                )
            if member.needs_to_plan != first.needs_to_plan:
                raise ValueError(f"{name} sees {member.needs_to_plan} and {first_name} sees {first.needs_to_plan}")
        self.models = [member for _, member in members]
        self.members = nn.ModuleList(self.models)  # for .to() and .eval()

    @property
    def needs(self) -> Needs:
        """The members' picture and command; an ensemble is not trained and reads no labels."""
        return self.models[0].needs_to_plan

    def scores(self, batch: Batch) -> dict[str, Tensor]:
        """Mean probabilities (B, K) by name."""
        return average_scores([member.scores(batch) for member in self.models])

    def plan(self, batch: Batch) -> Tensor:
        first = self.models[0]
        return first.get_buffer("choices")[first.choose(self.scores(batch))]
