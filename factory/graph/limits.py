"""What a task may take, and a task under watch: beyond its seconds or its memory it is ended (factory.graph.guard)."""

import hashlib
import os
import secrets
import tempfile
from collections import defaultdict
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from factory.graph.guard import OVER, WORK, WatchedProcess, read_note
from factory.graph.steps import Failure
from factory.readers.base import ClipRef
from factory.store.attempts import ErrorKind
from factory.store.location import Location
from factory.store.schema import Stamp
from tasks.stages import TASKS

SEEN = 20  # tasks of a name that must have ended before their cost says what another may take
TIMES = 30.0  # the longest so far, a task may take
LEAST_S = 300.0  # and never less than this


@dataclass(frozen=True)
class Limits:
    """Most that a task may take, by its name, where it is not what tasks.stages says."""

    seconds: Mapping[str, float] = field(default_factory=dict)
    gb: Mapping[str, float] = field(default_factory=dict)

    def of(self, name: str) -> tuple[float | None, float | None]:
        """(seconds, GB) of a task; of stages fused into one the sum of their seconds, the most of their memory."""
        parts = [task for task in TASKS if task.name in name.split("+")]
        seconds = [self.seconds.get(task.name, task.limit_s) for task in parts]
        memory = [self.gb.get(task.name, task.limit_gb) for task in parts]
        known = [gb for gb in memory if gb is not None]
        return sum(seconds) or None, max(known) if known and len(known) == len(memory) else None


NO_LIMITS = Limits()


class Costs:
    """How long tasks have taken in this run, and so what the next may take."""

    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        self._seen: dict[str, list[float]] = defaultdict(lambda: [0, 0.0, 0.0])  # how many, the longest, all together

    def took(self, name: str, seconds: float) -> None:
        """A task that ended well."""
        n, longest, together = self._seen[name]
        self._seen[name] = [n + 1, max(longest, seconds), together + seconds]

    def within(self, name: str, seconds: float) -> int:
        """How many of this name usually end in so many seconds; 1 until that is known."""
        n, _, together = self._seen[name]
        return max(1, int(seconds * n / together)) if n >= SEEN and together > 0.0 else 1

    def limits(self, name: str) -> dict[str, float | None]:
        """Of the next task of this name; what the settings give is not tightened."""
        seconds, gb = self._limits.of(name)
        n, longest, _ = self._seen[name]
        given = set(name.split("+")) & set(self._limits.seconds)
        if seconds is not None and n >= SEEN and not given:
            seconds = min(seconds, max(LEAST_S, TIMES * longest))
        return {"seconds": seconds, "gb": gb}


def notes_folder(out: Location) -> Path:
    """Where guards write: in a local store, which all nodes see; of a remote one on each machine."""
    if out.is_local:
        return Path(out.uri) / "in_work"
    name = hashlib.sha256(out.uri.encode()).hexdigest()[:16]
    return Path(tempfile.gettempdir()) / f"driving-data-factory-{os.getuid()}" / name


def cleared(folder: Path) -> str:
    """A new run's name in the notes of its guards; those of earlier runs go, but for what was in hand at a crash."""
    for path in (*folder.glob(f"*{OVER}"), *folder.glob(f"*{WORK}")):
        path.unlink(missing_ok=True)
    return secrets.token_hex(8)


def put_away(folder: Path) -> None:
    """The folder of notes, where a run leaves none."""
    with suppress(OSError):  # there is none, or something in it
        folder.rmdir()


def described(step: str, name: str, args: tuple[Any, ...]) -> dict[str, Any]:
    """Key and words of a task, and which clip, expert and candidate it is of."""
    stamp = next((arg for arg in args if isinstance(arg, Stamp)), None)
    ref = next((arg for arg in args if isinstance(arg, ClipRef)), None)
    if stamp is not None:
        of = {"attempt_id": stamp.attempt_id, "expert": stamp.expert, "candidate": stamp.candidate_index}
        what = f"{name} of expert {stamp.expert}, candidate {stamp.candidate_index}, attempt {stamp.attempt_id}"
        return {"key": f"{name}-{stamp.attempt_id}", "what": what, **of}
    if ref is not None:
        return {"key": f"{name}-{ref.clip_id}", "what": f"{name} of clip {ref.clip_id}", "clip_id": ref.clip_id}
    return {"key": f"{name}-{os.getpid()}", "what": name}


_GUARDS: dict[Path, WatchedProcess] = {}  # of this process


def watched(folder: Path, task: dict[str, Any], call: Callable[..., tuple[Any, Any]], *given: Any) -> tuple[Any, Any]:
    """(report, result) of a task of a supervised process; a Failure where an earlier try was ended over its limits."""
    over = folder / f"{task['key']}{OVER}"
    if (found := read_note(over)) is not None and found["run"] == task["run"]:
        over.unlink(missing_ok=True)
        where = found["stack"] or "where it stood is not known"
        return Failure(ErrorKind.LIMIT, f"{where}\n{found['what']} {found['why']}"), None
    if folder not in _GUARDS:
        _GUARDS[folder] = WatchedProcess(folder, alone=False)
    with _GUARDS[folder].watching(task):
        return call(*given)
