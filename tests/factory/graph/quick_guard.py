"""The guard beside a process, with less patience than it has."""

from pathlib import Path

from factory.graph import guard

SHOWN_S, ASKED_S, KILLED_S = 0.5, 1.5, 2.5


def quick_guard(folder: Path) -> Path:
    """A copy of its script that waits for a tenth of the time, or less."""
    text = Path(guard.__file__).read_text()
    own = {
        f"SHOWN_S = {guard.SHOWN_S}": f"SHOWN_S = {SHOWN_S}",
        f"ASKED_S, KILLED_S = {guard.ASKED_S}, {guard.KILLED_S}": f"ASKED_S, KILLED_S = {ASKED_S}, {KILLED_S}",
    }
    for there, here in own.items():
        assert text.count(there) == 1, there
        text = text.replace(there, here)
    copy = folder / "quick_guard_copy.py"
    copy.write_text(text)
    return copy
