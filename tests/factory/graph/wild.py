"""A plug-in's ways to fail: loop, swallow memory, crash, leave, change what it is given."""

import os
import signal
import sys
import time
from dataclasses import dataclass

import numba
import numpy as np

from factory.graph.steps import AcceptedDrive, PreparedClip, RejectedAttempt
from tests.factory.toy import ToyWork


@numba.njit
def _for_ever(counted: np.ndarray) -> None:
    """Holds the interpreter's lock: neither a signal's handler nor another thread gets in."""
    while counted[0] >= 0.0:
        counted[0] += 1.0


@dataclass(frozen=True)
class WildWork(ToyWork):
    """`wild` maps the toy's names of attempts to what the expert does there."""

    wild: tuple[tuple[str, str], ...] = ()

    def drive(self, prepared: PreparedClip, candidate: int, expert: str) -> AcceptedDrive | RejectedAttempt:
        payload = prepared.payload
        assert isinstance(payload, dict)
        match dict(self.wild).get(f"{payload['name']}:{expert}:{candidate}"):
            case "loop":
                self._note("loop begins")
                while True:
                    time.sleep(0.01)
            case "compiled loop":
                self._note("loop begins")
                _for_ever(np.zeros(1))
            case "memory":
                held = np.ones(150_000_000)  # 1.2 GB, far above what a process has without
                time.sleep(60.0 * held[0])
            case "segfault":
                os.kill(os.getpid(), signal.SIGSEGV)
            case "os._exit":
                os._exit(0)
            case "sys.exit":
                sys.exit(0)
            case "mutate":
                payload["states"] += 1.0
        return super().drive(prepared, candidate, expert)
