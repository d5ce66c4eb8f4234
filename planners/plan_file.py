"""The plans of a planner for a whole benchmark, kept so that scoring may begin again without planning."""

import json
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from planners.frames import FrameKey

Array = NDArray[np.float64]

PLANS = "plans.npz"


def write_plans(folder: Path, identity: Mapping[str, Any], plans: Mapping[FrameKey, Array]) -> None:
    """`plans.npz`: who planned (JSON), frame by frame which, and poses (F, 40, 3) in the ego frame."""
    unfinished = folder / f".{os.getpid()}.{PLANS}"
    np.savez_compressed(
        unfinished,
        identity=np.array(json.dumps(identity, sort_keys=True)),
        clip_id=np.array([key.clip_id for key in plans]),
        kind=np.array([key.kind for key in plans]),
        candidate_index=np.array([key.candidate_index for key in plans]),
        poses=np.stack(list(plans.values())),
    )
    os.replace(unfinished, folder / PLANS)


def read_plans(folder: Path, identity: Mapping[str, Any] | None = None) -> dict[FrameKey, Array] | None:
    """The stored plans; None where there are none, or they are another's than `identity`, or damaged."""
    try:
        with np.load(folder / PLANS, allow_pickle=False) as stored:
            if identity is not None and json.loads(str(stored["identity"])) != dict(identity):
                return None
            keys = zip(stored["clip_id"].tolist(), stored["kind"].tolist(), stored["candidate_index"].tolist())
            return dict(zip((FrameKey(*key) for key in keys), stored["poses"]))
    except (FileNotFoundError, zipfile.BadZipFile, KeyError, ValueError):
        return None
