"""A vocabulary's labels as SimScale's reward pickles: {token: {metric: float16 (K,)}}."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from factory.exports.navsim.pickles import write_dict
from factory.store.reader import labels_of

# The public name of each sub-score, in the order of SimScale's gen_vocab_score (navsim/evaluate/pdm_score.py:309-319).
METRICS = {
    "no_at_fault_collisions": "nc",
    "drivable_area_compliance": "dac",
    "driving_direction_compliance": "ddc",
    "traffic_light_compliance": "tlc",
    "ego_progress": "ep",
    "time_to_collision_within_bound": "ttc",
    "lane_keeping": "lk",
    "history_comfort": "hc",
    "pdm_score": "score",
}


def reward_arrays(row: Mapping[str, Any]) -> dict[str, NDArray[np.float16]]:
    """Every metric of every trajectory of the vocabulary, from the row's label columns.

    Progress is divided as SimScale labels its vocabulary (PROGRESS_MODE=gen_gt). Raises ValueError for a row without
    labels.
    """
    labels = labels_of(row)
    values = {"ep": labels.ep("masked"), "score": labels.pdm_score("masked")}
    return {
        name: np.asarray(values[ours] if ours in values else getattr(labels, ours), np.float16)
        for name, ours in METRICS.items()
    }


def write_rewards(draft: Path, labelled: Iterable[tuple[str, Mapping[str, Any]]], earlier: Path | None) -> None:
    """The rewards of tokens and their rows after those of the rounds before.

    A file is cumulative because SimScale opens the last round's for each of the rounds (gtrs_agent.py:231-235).
    """
    with draft.open("w+b") as file:
        write_dict(file, ((token, reward_arrays(row)) for token, row in labelled), earlier)
