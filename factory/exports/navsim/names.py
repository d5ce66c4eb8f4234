"""How logs, frames, splits and files are named, so that the public code finds them and tells real from simulated.

SimScale's own names (its scene filters): log `<source log>-<A>-00k`, sample `<B>-00k`, with A and B the frames of the
source log at T and at T+H, and k the round. A human sample of ours is `<source log>-<A>`, its token A.
"""

import hashlib
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

from tasks.world.clip import HORIZON_STEPS, STEP_S

HORIZON_S = HORIZON_STEPS * STEP_S
FRAME_S = 0.5
N_HISTORY, N_FUTURE = 4, 8  # frames; the history's last is now
N_FRAMES = N_HISTORY + N_FUTURE
NOW_FRAME = N_HISTORY - 1
HEX16 = re.compile(r"[0-9a-f]{16}")
RELEASED = {"pdm_closed": "pdm"}  # our names of experts by which SimScale's splits go
NAMING = ("dataset", "log_id", "clip_start_s", "now_s", "frame_tokens", "candidate_index", "expert", "round")


def hex16(*words: object) -> str:
    """16 hex digits of the words: the first of the SHA-256 of their texts with 0x1f between them."""
    return hashlib.sha256("\x1f".join(map(str, words)).encode()).hexdigest()[:16]


def is_simulated(row: Mapping[str, Any]) -> bool:
    """Whether the sample is of an attempt at a candidate, and not of the log's own drive."""
    return bool(row["candidate_index"] >= 0)


def source_log(dataset: str, log_id: str) -> str:
    """The source log's name with exactly one dash, from which WorldEngine cuts it off again.

    A log named so already (nuPlan's `..._veh-35_...`) keeps its name. Of another, what is no letter, digit, dot or _
    becomes _, and a dash and 8 digits of the hash of data set and log follow.
    """
    plain = re.sub(r"[^A-Za-z0-9._-]", "_", log_id)
    if plain == log_id and log_id.count("-") == 1:
        return log_id
    return f"{plain.replace('-', '_')}-{hex16(dataset, log_id)[:8]}"


def instant_token(row: Mapping[str, Any], time_s: float) -> str:
    """The name of the source log's frame at `time_s` since its first instant: the log's own at T and T+H, else a hash.

    The hash is of data set, log and milliseconds, so that overlapping windows agree on it.
    """
    start_s = float(row["clip_start_s"]) + float(row["now_s"]) - (HORIZON_S if is_simulated(row) else 0.0)
    given = row["frame_tokens"]
    if given is not None and all(HEX16.fullmatch(token) for token in given):
        for token, at_s in zip(given, (start_s, start_s + HORIZON_S)):
            if abs(time_s - at_s) < STEP_S / 2:
                return str(token)
    return hex16(row["dataset"], row["log_id"], round(1000.0 * time_s))


@dataclass(frozen=True)
class SampleNames:
    """What one sample is called."""

    log: str  # the pickle's stem and every frame's log_name
    scene: str  # scene_token and log_token
    tokens: tuple[str, ...]  # (N_FRAMES,)
    times_s: tuple[float, ...]  # (N_FRAMES,) since the source log's first instant
    suffix: str  # of every token: the round of a simulated sample, empty for a human one

    @property
    def token(self) -> str:
        """Of the sample."""
        return self.tokens[NOW_FRAME]

    @property
    def blobs(self) -> str:
        """The folder of its pictures."""
        return self.scene if self.suffix else self.log


def sample_names(row: Mapping[str, Any]) -> SampleNames:
    """Names of a row with the columns NAMING."""
    now_s = float(row["clip_start_s"]) + float(row["now_s"])
    times_s = tuple(now_s + (i - NOW_FRAME) * FRAME_S for i in range(N_FRAMES))
    suffix = f"-{int(row['round']):03d}" if is_simulated(row) else ""
    tokens = tuple(instant_token(row, time_s) + suffix for time_s in times_s)
    scene = instant_token(row, now_s - HORIZON_S if suffix else now_s) + suffix
    return SampleNames(f"{source_log(row['dataset'], row['log_id'])}-{scene}", scene, tokens, times_s, suffix)


@dataclass(frozen=True, order=True)
class SplitNames:
    """What the samples of one expert and round are called, all together."""

    folder: str  # of logs and of pictures: where SimScale's tools/move.sh puts a download
    yaml: str  # of the scene filter and the split; its cache is <yaml>_cache
    log_split: str  # of the training's list of logs ("reation" is how the public code spells it)
    rewards: str  # the file below NAVSIM_TRAJPDM_ROOT


def split_names(row: Mapping[str, Any], tag: str = "") -> SplitNames:
    """Of a row with the columns NAMING. The rewards' file is always named 16384, whatever K is (gtrs_agent.py:232)."""
    return _split_names(str(row["expert"]), int(row["round"]), is_simulated(row), tag)


@cache
def _split_names(expert: str, round_: int, simulated: bool, tag: str) -> SplitNames:
    who = RELEASED.get(expert, expert) + (f"_{tag}" if tag else "")
    if not simulated:
        name = f"navtrain_{who}"
        return SplitNames(name, name, f"default_log_split_{name}", f"ori/{name}_16384.pkl")
    name = f"{who}_v1.0-{round_}"
    return SplitNames(
        f"synthetic_reaction_{name}",
        f"navtrain_reaction_{name}",
        f"default_log_split_synthetic_reation_{name}",
        f"sim/simcale_16384_{name}.pkl",
    )
