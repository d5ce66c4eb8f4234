"""Processes below one of ours, found in /proc, for who is to kill them one by one."""

import os
import signal
import time
from pathlib import Path

PROGRAMS = {"raylet": "/raylet/raylet ", "gcs": "/gcs_server", "agent": "ray::DashboardAgent"}


def below(pid: int) -> dict[int, str]:
    """Pid -> command line of every process that descends from one, itself left out."""
    parents: dict[int, list[int]] = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
        except OSError:  # gone meanwhile
            continue
        parents.setdefault(parent, []).append(int(folder.name))
    found: dict[int, str] = {}
    left = [pid]
    while left:
        children = parents.get(left.pop(), [])
        left += children
        found |= {child: command(child) for child in children}
    return found


def command(pid: int) -> str:
    """Empty for one that is gone."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace").strip()
    except OSError:
        return ""


def workers_below(pid: int) -> list[int]:
    """Ray's workers, at work or idle; its agents have names like theirs, and a raylet ends with either of them."""
    named = ((child, line) for child, line in below(pid).items() if line.startswith("ray::"))
    return sorted(child for child, line in named if not line.endswith("Agent"))


def kill(pid: int) -> bool:
    """SIGKILL; False where it is gone."""
    try:
        os.kill(pid, signal.SIGKILL)
    except ProcessLookupError:
        return False
    return True


def put_away(processes: dict[int, str]) -> None:
    """What a killed driver had started, where it did not go with it."""
    end = time.monotonic() + 5.0
    while time.monotonic() < end and any(command(pid) == line for pid, line in processes.items()):
        time.sleep(0.1)
    for pid, line in processes.items():
        if line and command(pid) == line:
            kill(pid)
