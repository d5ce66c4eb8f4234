"""Several GTRS-Dense models as one: their sub-scores are averaged, then weighted as one model's (paper, supplement)."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from planners.data.batch import Batch, Needs
from planners.models.gtrs_dense.planner import GtrsDense
from planners.models.gtrs_dense.weighting import WEIGHTINGS, WeightingName, choose


def mean_scores(scores: Sequence[dict[str, Tensor]]) -> dict[str, Tensor]:
    """Mean probabilities (B, K) by name of several models' over the same trajectories."""
    return {name: torch.stack([one[name] for one in scores]).mean(dim=0) for name in scores[0]}


class Ensemble(nn.Module):
    """Plans (B, 40, 3) from the mean of its members' scores.

    members: by the name they are spoken of in errors, such as a file's. weighting: the first member's where not given.

    Raises ValueError for no member, or members of different vocabularies or pictures.
    """

    def __init__(self, members: Sequence[tuple[str, GtrsDense]], weighting: WeightingName | None = None) -> None:
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
            if member.needs.image != first.needs.image:
                raise ValueError(f"{name} sees {member.needs.image} and {first_name} sees {first.needs.image}")
        self.models = [member for _, member in members]
        self.members = nn.ModuleList(self.models)  # for .to() and .eval()
        self.weighting = WEIGHTINGS[weighting or first.settings.weighting]

    @property
    def needs(self) -> Needs:
        """The members' picture; an ensemble is not trained and reads no labels."""
        return Needs(image=self.models[0].needs.image)

    def scores(self, batch: Batch) -> dict[str, Tensor]:
        """Mean probabilities (B, K) by name."""
        return mean_scores([member.scores(batch) for member in self.models])

    def plan(self, batch: Batch) -> Tensor:
        return self.models[0].get_buffer("choices")[choose(self.scores(batch), self.weighting)]
