"""`python -m planners.ensemble models=[a,b,...] benchmark=...`: several GTRS-Dense models as one.

    python -m planners.ensemble models=[runs/recovery,runs/pdm_closed,runs/rewards_only] benchmark=runs/hard out=eval

Their sub-scores are averaged, then weighted as one model's (paper, supplement). Models may differ in training, size
and backbone; they see one picture and choose from one vocabulary. The members are evaluated beside their ensemble; all
other keys are those of planners.evaluate, which takes `planner=a+b` for an ensemble as well.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor, nn

from planners.batch import Batch, Needs
from planners.gtrs_dense import GtrsDense
from planners.weighting import WEIGHTINGS, WeightingName, choose


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


def main(argv: Sequence[str]) -> int:
    """The command: evaluates the members and their ensemble; exit codes as planners.evaluate's."""
    from planners.evaluate import main as evaluate

    if {"-h", "--help"} & set(argv):
        print(__doc__)
        return 0
    named = [argument.removeprefix("models=") for argument in argv if argument.startswith("models=")]
    members = [name.strip() for name in named[-1].strip("[]").split(",")] if named else []
    if len(members) < 2:
        print("error: models is missing: give models=[<training>,<training>,...], two at least", file=sys.stderr)
        return 2
    names = [Path(member).name for member in members]
    labels = names if len(set(names)) == len(names) else [str(i) for i in range(len(names))]
    planners = {**dict(zip(labels, members)), "ensemble": "+".join(members)}
    chosen = ",".join(f"{label}: '{spec}'" for label, spec in planners.items())
    return evaluate([f"planners={{{chosen}}}", *(a for a in argv if not a.startswith("models="))])


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
