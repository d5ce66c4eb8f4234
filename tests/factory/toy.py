"""A small, deterministic Work with real numbers: candidates and rows come from a Philox stream of (clip, candidate)."""

import errno
import hashlib
import os
import signal
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from factory.graph.execute import Execution, RunSummary, execute
from factory.graph.steps import (
    AcceptedDrive,
    BlockReport,
    PreparedClip,
    RejectedAttempt,
    SampleColumns,
    Spent,
    StopCheck,
    never_stop,
)
from factory.readers.base import BadClip, ClipRef
from factory.stages.rows import label_columns
from factory.store.samples import CandidateRow, Store
from factory.store.schema import BOOKKEEPING, FIELDS, UNLISTED, Column, RunIdentity
from tasks.reward.label_bytes import HALVES, WHOLES, VocabularyLabels
from tasks.stages import Rejected

VERSIONS = {"clip": 1, "perturb": 1, "rollout": 1, "expert": 1, "reward": 1, "render": 1, "write": 1}
PICTURES = ("cameras", "images", "image_source")
RAGGED = {"F": 2, "B": 2, "N": 3, "L": 4, "P": 5, "D": 2, "X": 1, "S": 1, "R": 2, "C": 1, "I": 2, "T": 1}


def executed(
    work: Any, clips: Sequence[ClipRef], experts: Sequence[str], rounds: int, store: Store, how: Execution | None = None
) -> RunSummary:
    """A run that prints nothing; how: in this process, where none is given."""
    return execute(work, clips, experts, rounds, store, how or Execution("local"), say=lambda line: None)


def refs(n: int) -> list[ClipRef]:
    """n clips of two logs."""
    return [ClipRef("toy", f"log{i % 2}", 1000 * i) for i in range(n)]


def where() -> str:
    """The node of a cluster and the GPUs that this process sees, for a journal."""
    ray = sys.modules.get("ray")
    node = ray.get_runtime_context().get_node_id() if ray is not None and ray.is_initialized() else "here"
    return f"node {node} gpu {os.environ.get('CUDA_VISIBLE_DEVICES', '')}"


def stream(*words: object) -> np.random.Generator:
    key = int.from_bytes(hashlib.sha256(repr(words).encode()).digest()[:16], "little")
    return np.random.Generator(np.random.Philox(key=key))


def value_of(column: Column, shape: Sequence[int | str], rng: np.random.Generator) -> object:
    """Any value that fits the column."""
    if shape and (column.dtype in ("struct", "string", "binary") or any(isinstance(s, str) for s in shape[1:])):
        first = shape[0]
        return [value_of(column, shape[1:], rng) for _ in range(RAGGED[first] if isinstance(first, str) else first)]
    if column.dtype == "struct":
        return {member.name: value_of(member, member.shape, rng) for member in column.members}
    if column.dtype == "string":
        return f"word{rng.integers(9)}"
    if column.dtype == "binary":
        return rng.bytes(12)
    sizes = [RAGGED[s] if isinstance(s, str) else s for s in shape]
    value = rng.random(sizes) * 3.0
    if column.nan:
        value[value > 2.5] = np.nan
    return value.astype(column.dtype)


def labels_of_stream(rng: np.random.Generator, k: int = 20) -> VocabularyLabels:
    """Any scores of k trajectories."""
    scores = {name: rng.integers(0, 3, k) / 2.0 for name in HALVES}
    scores |= {name: rng.integers(0, 2, k) * 1.0 for name in WHOLES}
    return VocabularyLabels("vocabulary-1", 20.0, ep_raw_m=rng.random(k) * 60.0, **scores)


def row_of(rng: np.random.Generator) -> dict[str, object]:
    """A full row less the bookkeeping."""
    row = {f.name: value_of(f, f.shape, rng) for f in FIELDS if f.name not in BOOKKEEPING}
    return row | label_columns(labels_of_stream(rng))


@cache
def any_row() -> dict[str, object]:
    """Always the same, for who has no time to make one for each sample."""
    return row_of(stream("any"))


@dataclass(frozen=True)
class ToyWork:
    """Accepts a candidate by its own chance; `trouble` maps log_id:start_ms[:candidate] to what goes wrong there."""

    n_candidates: int = 6
    threshold: float = 0.5
    settings: Mapping[str, object] = field(default_factory=dict)
    versions: Mapping[str, int] = field(default_factory=lambda: dict(VERSIONS))
    prepare_digest: str = "perturb-1"
    digests: Mapping[str, str] = field(default_factory=dict)
    trouble: Mapping[str, str] = field(default_factory=dict)
    content: str = "content"
    tells_content: bool = True  # before it prepares
    seconds: float = 0.0  # of sleep per task
    blocks: bool = False  # a log is a block
    journal: str = ""  # a file that gets one line per task that really ran

    @property
    def identity(self) -> RunIdentity:
        settings = {"reward.threshold": self.threshold, **self.settings}
        return RunIdentity(settings, self.versions, "vocabulary-1", self.prepare_digest)

    def warm(self, draws: bool = True) -> None:
        self._note("warm")

    def once(self, expert: str) -> bool:
        return expert == "human"

    def expert_digest(self, expert: str) -> str:
        return self.digests.get(expert, f"{expert}-1")

    def content_digest(self, ref: ClipRef) -> str | None:
        return self.content if self.tells_content else None

    def block(self, ref: ClipRef) -> str | None:
        return ref.log_id if self.blocks else None

    def reconstruct(self, ref: ClipRef, threads: int, stopped: StopCheck = never_stop) -> BlockReport:
        self._note(f"reconstruct {ref.log_id}")
        time.sleep(self.seconds)
        self._trouble(ref.log_id)
        return BlockReport({"reconstruct": Spent(0.5)}, from_cache=False, psnr_db=28.0)

    def doing(self) -> str:
        return ""

    def prepare(self, ref: ClipRef) -> PreparedClip | Rejected:
        self._note(f"prepare {ref.log_id}:{ref.start_ms}")
        time.sleep(self.seconds)
        trouble = self._trouble(f"{ref.log_id}:{ref.start_ms}")
        if trouble == "standing":
            return Rejected("clip", "ego_standing")
        empty = trouble == "no_candidates"
        rng = stream(ref.clip_id, "perturb")
        scores = rng.random((0 if empty else self.n_candidates, 2))
        candidates = tuple(
            CandidateRow(i, 10 * i, float(a), float(b), 0.1, 5.0, (i, -i), float(a), float(b))
            for i, (a, b) in enumerate(scores)
        )
        if self.prepare_digest == UNLISTED:
            candidates = ()
        payload = {"name": f"{ref.log_id}:{ref.start_ms}", "states": rng.random((6, 41, 3)), "kinds": ("a", "b")}
        dropped = Rejected("perturb", "no_gated_candidate") if empty else None
        counts = {"heading": 7, "lateral": 3}
        return PreparedClip(ref.clip_id, self.content, candidates, counts, payload, dropped, {"perturb": Spent(0.1)})

    def drive(self, prepared: PreparedClip, candidate: int, expert: str) -> AcceptedDrive | RejectedAttempt:
        payload = prepared.payload
        assert isinstance(payload, dict)
        name = f"{payload['name']}:{expert}:{candidate}"
        self._note(f"attempt {name} on {where()}")
        time.sleep(self.seconds)
        self._trouble(name)
        rng = stream(prepared.clip_id, "attempt", expert, candidate)
        chance = float(rng.random())
        if expert != "human" and chance < self.threshold:
            return RejectedAttempt(Rejected("reward", "nc" if chance < self.threshold / 2 else "ep"), {"nc": chance})
        row = row_of(rng)
        row["clip_id"], row["content_digest"] = prepared.clip_id, prepared.content_digest
        row["label_10hz"] = payload["states"][candidate % 6, 1:].astype(np.float32)
        return AcceptedDrive((name, row), {"reward": Spent(0.01)})

    def draw(self, driven: Sequence[AcceptedDrive]) -> list[SampleColumns | RejectedAttempt]:
        return [self.drawn(one) for one in driven]

    def drawn(self, driven: AcceptedDrive) -> SampleColumns | RejectedAttempt:
        name, row = driven.payload  # type: ignore[misc]
        self._note(f"render {name} on {where()}")
        if self._trouble(f"{name}:render") == "unfit":
            return RejectedAttempt(Rejected("render", "blank"), {"nc": 1.0}, {"render": Spent(0.02)})
        return SampleColumns({key: row[key] for key in PICTURES} | {"tags": ["drawn"]}, {"render": Spent(0.02)}, True)

    def label(self, driven: AcceptedDrive) -> SampleColumns:
        name, row = driven.payload  # type: ignore[misc]
        self._note(f"label {name} on {where()}")
        self._trouble(f"{name}:label")
        return SampleColumns({key: value for key, value in row.items() if key not in PICTURES}, {"labels": Spent(0.03)})

    def _note(self, line: str) -> None:
        if self.journal:
            with open(self.journal, "a") as file:
                file.write(line + "\n")

    def _trouble(self, name: str) -> str:
        trouble = self.trouble.get(name, "")
        if trouble == "bad":
            raise BadClip("toy.feather", "tx_m", "holds NaN; take the log out")
        if trouble == "bug":
            raise ZeroDivisionError("a bug in a stage")
        if trouble == "disk":
            raise OSError("no space left")
        if trouble == "die":
            os.kill(os.getpid(), signal.SIGKILL)
        return trouble


def ran(journal: str, word: str) -> int:
    """Tasks of a kind that really ran; a journal that nobody began holds none."""
    path = Path(journal)
    return sum(line.startswith(word) for line in path.read_text().splitlines()) if path.exists() else 0


COLD = "/kernels/of/mine"


@dataclass(frozen=True)
class ColdWork(ToyWork):
    """Its kernels cannot be written."""

    number: int = errno.ENOSPC

    def warm(self, draws: bool = True) -> None:
        raise OSError(self.number, os.strerror(self.number), COLD)


@dataclass(frozen=True)
class DyingWork(ToyWork):
    """Where its kernels are to be compiled the process dies."""

    def warm(self, draws: bool = True) -> None:
        os.kill(os.getpid(), signal.SIGKILL)
