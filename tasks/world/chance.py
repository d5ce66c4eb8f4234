"""Random streams: a function of the run's seed and of what is drawn for, never of settings, code, round or order."""

import hashlib

import numpy as np


def stream(seed: int, clip_id: str, stage: str, candidate: int = -1) -> np.random.Generator:
    """The Philox stream of one stage of one clip (and candidate); equal arguments give equal numbers anywhere."""
    key = "\x1f".join((str(seed), clip_id, stage, str(candidate)))
    digest = hashlib.sha256(key.encode()).digest()
    return np.random.Generator(np.random.Philox(key=np.frombuffer(digest[:16], dtype=np.uint64)))
