"""Memory of processes over the time of a run: read from /proc, told by quarters, drawn."""

import csv
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

COLUMNS = ("seconds", "what", "pid", "rss_mb")
YOUNG_S = 120.0  # of a process that still loads what it works with


class Held(NamedTuple):
    """What a process held at a time since the start."""

    seconds: float
    what: str  # driver, worker
    pid: int
    rss_mb: float


class Flatness(NamedTuple):
    """Of all processes of a kind, less their first YOUNG_S."""

    processes: int
    second_mb: float  # median over the run's second quarter
    last_mb: float  # over its last one
    slope_mb_h: float  # within processes: of how each departs from its own mean


def rss_mb(pid: int) -> float | None:
    """None for one that is gone."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:
        return None
    return next((int(line.split()[1]) / 1024.0 for line in lines if line.startswith("VmRSS:")), None)


def write(path: Path, rows: Iterable[Held]) -> None:
    """As CSV; into a file that is there, behind what it holds."""
    is_new = not path.exists()
    with path.open("a", newline="") as file:
        writer = csv.writer(file)
        if is_new:
            writer.writerow(COLUMNS)
        writer.writerows((f"{row.seconds:.1f}", row.what, row.pid, f"{row.rss_mb:.1f}") for row in rows)


def read(path: Path) -> list[Held]:
    with path.open(newline="") as file:
        return [Held(float(a), b, int(c), float(d)) for a, b, c, d in list(csv.reader(file))[1:]]


def flatness(rows: Sequence[Held], what: str, whole_s: float) -> Flatness | None:
    """None where no process of the kind lived long enough."""
    grown, processes = [], 0
    for pid in {row.pid for row in rows if row.what == what}:
        mine = [(row.seconds, row.rss_mb) for row in rows if row.pid == pid]
        mine = [(t, mb) for t, mb in mine if t >= mine[0][0] + YOUNG_S]
        if len(mine) > 1:
            times, held = np.array(mine).T
            grown.append(np.column_stack([times, held, times - times.mean(), held - held.mean()]))
            processes += 1
    if not grown:
        return None
    times, held, since, more = np.concatenate(grown).T
    quarters = [held[(times >= a * whole_s) & (times < b * whole_s)] for a, b in ((0.25, 0.5), (0.75, 1.0))]
    medians = [float(np.median(part)) if len(part) else float("nan") for part in quarters]
    return Flatness(processes, *medians, 3600.0 * float(since @ more) / float(since @ since))


def draw(rows: Sequence[Held], kills: Sequence[tuple[float, str]], path: Path) -> None:
    """A PNG: a line a process, a tick a kill."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    colours = {"driver": "tab:blue", "worker": "tab:orange"}
    figure, panel = pyplot.subplots(figsize=(9.0, 3.6), layout="constrained")
    for pid, what in dict.fromkeys((row.pid, row.what) for row in rows):
        mine = np.array([(row.seconds / 60.0, row.rss_mb) for row in rows if row.pid == pid])
        panel.plot(*mine.T, color=colours[what], linewidth=1.0)
    for seconds, what in kills:
        panel.annotate(what, (seconds / 60.0, 1.0), (0, 2), ("data", "axes fraction"), "offset points", rotation=90)
        panel.axvline(seconds / 60.0, color="0.8", linewidth=0.8, zorder=0)
    panel.set(xlabel="minutes", ylabel="resident memory [MB]", ylim=(0, None))
    for what, colour in colours.items():
        panel.plot([], [], color=colour, label=what)
    panel.legend(loc="lower right")
    figure.savefig(path, dpi=110)
    pyplot.close(figure)
