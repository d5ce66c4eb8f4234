"""The group `reward` of a run's settings."""

from dataclasses import dataclass
from typing import Literal

from tasks.attempt import ExpertGate


@dataclass(frozen=True)
class RewardSettings(ExpertGate):
    """What an expert's drive must reach, and the vocabulary labels that stand in every sample."""

    labels: Literal["vocabulary", "none"] = "vocabulary"
    traffic: Literal["replay", "idm"] = "replay"  # that of the sample's own judged drive, or one that answers to each
    label_vocabulary: str | None = None  # another .npy file (K, 40, 3); None: the run's vocabulary

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.labels == "none" and self.label_vocabulary is not None:
            raise ValueError(
                f"label_vocabulary={self.label_vocabulary} is for labels=vocabulary, but labels=none: leave one out"
            )
