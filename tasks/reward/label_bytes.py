"""The scores of a whole vocabulary from one scene, and the bytes a sample keeps of them. Needs numpy only.

Sub-scores are planes of ceil(K / 8) bytes, one bit a trajectory, the first trajectory in the highest bit: two planes
for NC and DDC (whether it is 1, whether it is 0.5), one for each of the others. Progress counts 1/128 m in two bytes;
all low bytes come first, then all high bytes, because only the high ones compress. It is rounded up: a progress is
above a whole number of metres, such as the 5 m below which nobody's EP counts, exactly when its count is. A CRC-32
ends either string. EC is not in it: it compares with an earlier plan, and a vocabulary has none.
"""

import zlib
from collections.abc import Iterator
from dataclasses import dataclass, make_dataclass
from typing import Any, Literal

import numpy as np

from tasks.subscores import HALVES, JUDGED, PROGRESS_THRESHOLD_M, TOTAL_WEIGHT, WHOLES, multiplier_product, weighted_sum
from tasks.world.arrays import Array, Bools, Bytes

Normalise = Literal["pairs", "batch", "masked"]

ARRAYS = (*JUDGED, "ep_raw_m")  # of VocabularyLabels, and by the same names of Scores
N_PLANES = 2 * len(HALVES) + len(WHOLES)
UNITS_PER_M = 128
MAX_PROGRESS_M = 65535 / UNITS_PER_M
CRC_BYTES = 4


_HEADER = (("vocabulary", str), ("reference_progress_m", float))
_FIELDS = [*_HEADER, *((name, Array) for name in ARRAYS)]
_Labels: Any = make_dataclass("_Labels", _FIELDS, frozen=True, eq=False)  # types are known where the record is read


@dataclass(frozen=True, eq=False)
class VocabularyLabels(_Labels):
    """What every trajectory of a vocabulary scores when it is driven from one scene.

    First the vocabulary's digest (tasks.world.vocabulary.trajectories_digest) and the compliant progress of PDM-Closed
    [m]; then ARRAYS (K,): the sub-scores that fail at an instant, and `ep_raw_m`, progress along the route.
    """

    def __len__(self) -> int:
        return len(self.ep_raw_m)

    @property
    def multiplier(self) -> Array:
        """(K,) what the weighted mean is multiplied by."""
        return multiplier_product(vars(self))

    def ep(self, normalise: Normalise = "pairs") -> Array:
        """(K,) ego progress, 0 .. 1 (docs/reward.md 2k): in pairs with PDM-Closed, or in one batch of it and all K.

        "masked" is in pairs too, but what is divided is the compliant progress, as SimScale labels its vocabulary
        (PROGRESS_MODE=gen_gt): 0 for a trajectory with a multiplier of 0, unless nothing counts as progress.
        """
        compliant_m = self.ep_raw_m * self.multiplier
        best = np.maximum(compliant_m, self.reference_progress_m)
        if normalise == "batch":
            best = np.full_like(best, best.max())
        gained_m = compliant_m if normalise == "masked" else self.ep_raw_m
        far_enough = best > PROGRESS_THRESHOLD_M
        return np.where(far_enough, np.clip(gained_m / np.where(far_enough, best, 1.0), 0.0, 1.0), 1.0)

    def pdm_score(self, normalise: Normalise = "pairs") -> Array:
        """(K,) the multiplier times the weighted mean, without EC."""
        return self.multiplier * weighted_sum(vars(self) | {"ep": self.ep(normalise)}) / TOTAL_WEIGHT


def encode(labels: VocabularyLabels) -> tuple[bytes, bytes]:
    """Sub-scores and progress as bytes.

    Raises ValueError naming the field whose length differs, or that holds a value the bytes cannot say.
    """
    for name in ARRAYS:
        if (shape := getattr(labels, name).shape) != (len(labels),):
            raise ValueError(f"{name}: ({len(labels)},) expected, got {shape}")
    units = np.ceil(labels.ep_raw_m * UNITS_PER_M)
    if not ((labels.ep_raw_m >= 0.0) & (units <= 65535)).all():  # also for NaN
        raise ValueError(f"ep_raw_m: must lie within 0 .. {MAX_PROGRESS_M:.2f} m, got {_strange(labels.ep_raw_m)}")
    low_high = np.divmod(units.astype(np.uint16), 256)[::-1]
    planes = np.packbits(np.stack(list(_planes(labels))), axis=1)
    return _sealed(planes.tobytes()), _sealed(np.stack(low_high).astype(np.uint8).tobytes())


def decode(subscores: bytes, progress: bytes, *, vocabulary: str, reference_progress_m: float) -> VocabularyLabels:
    """The labels that `encode` made the bytes of, progress rounded up to 1/128 m.

    Raises ValueError for bytes of a wrong length or with a wrong checksum, naming the field.
    """
    counts = _opened("progress", progress)
    k = len(counts) // 2
    row_bytes = -(-k // 8)
    if k == 0 or len(counts) % 2:
        raise ValueError(f"progress: {len(counts)} bytes are not two for each trajectory of a vocabulary")
    bits = _opened("subscores", subscores)
    if len(bits) != N_PLANES * row_bytes:
        raise ValueError(f"subscores: {len(bits)} bytes, {N_PLANES * row_bytes} expected for {k} trajectories")
    planes = np.unpackbits(bits.reshape(N_PLANES, row_bytes), axis=1, count=k).astype(np.float64)
    whole, half = planes[0 : 2 * len(HALVES) : 2], planes[1 : 2 * len(HALVES) : 2]
    scores = dict(zip((*HALVES, *WHOLES), (*(whole + 0.5 * half), *planes[2 * len(HALVES) :])))
    low, high = counts.reshape(2, k).astype(np.float64)
    ep_raw_m = (low + 256.0 * high) / UNITS_PER_M
    return VocabularyLabels(vocabulary, reference_progress_m, ep_raw_m=ep_raw_m, **scores)


def _planes(labels: VocabularyLabels) -> Iterator[Bools]:
    """Each (K,), in their order. Raises ValueError."""
    for name in HALVES:
        score = getattr(labels, name)
        whole, half = score == 1.0, score == 0.5
        if not (whole | half | (score == 0.0)).all():
            raise ValueError(f"{name}: must be 0, 0.5 or 1, got {_strange(score)}")
        yield whole
        yield half
    for name in WHOLES:
        score = getattr(labels, name)
        if not ((score == 0.0) | (score == 1.0)).all():
            raise ValueError(f"{name}: must be 0 or 1, got {_strange(score)}")
        yield score == 1.0


def _strange(values: Array) -> str:
    return f"values from {values.min():g} to {values.max():g}"


def _sealed(body: bytes) -> bytes:
    return body + zlib.crc32(body).to_bytes(CRC_BYTES, "little")


def _opened(name: str, sealed: bytes) -> Bytes:
    """The bytes before their checksum. Raises ValueError."""
    body, crc = sealed[:-CRC_BYTES], sealed[-CRC_BYTES:]
    if len(sealed) < CRC_BYTES or zlib.crc32(body).to_bytes(CRC_BYTES, "little") != crc:
        raise ValueError(f"{name}: {len(sealed)} bytes do not match their checksum: the row is damaged, make it again")
    return np.frombuffer(body, np.uint8)
