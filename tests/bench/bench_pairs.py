"""What a pair costs where it is paid: `python -m tests.bench.bench_pairs clips=av2 clips.root=<logs> limit=6 ...`

A run of one worker, by the words of `python -m factory.run`, into a folder that is there for it alone. Every call of
the reward on its way is timed (CPU time), between the rollouts, plans and labels that empty the processor's caches, and
told by how many trajectories it scored; PDM-Closed and one drive are two. Simulating the clip's whole vocabulary, in
which a trajectory costs least, is `track`, told beside.
"""

import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from typing import Any

import numpy as np

import tasks.attempt
import tasks.perturb
from factory.run import main as run

MOST_LISTED = 8
PERCENT = (0, 25, 50, 75)


def timed(function: Callable[..., Any], count: Callable[..., int], times: dict[int, list[float]]) -> Callable[..., Any]:
    """The function, whose seconds are kept under how many trajectories a call is about."""

    def called(*words: Any, **named: Any) -> Any:
        start = time.thread_time()
        found = function(*words, **named)
        times[count(*words)].append(time.thread_time() - start)
        return found

    return called


def table(title: str, times: dict[int, list[float]]) -> str:
    """Microseconds for each trajectory of a call."""
    lines = [f"| {title} | calls | least | a quarter | median | three quarters | mean |", "|---" * 7 + "|"]
    for k in sorted(times)[:MOST_LISTED]:
        each = 1e6 * np.array(times[k]) / k
        told = " | ".join(f"{value:.0f}" for value in (*np.percentile(each, PERCENT), each.mean()))
        lines.append(f"| {k} | {len(each)} | {told} |")
    return "\n".join(lines)


def main(words: list[str]) -> int:
    """Runs, and prints the tables."""
    scored: dict[int, list[float]] = defaultdict(list)
    tracked: dict[int, list[float]] = defaultdict(list)
    for module in (tasks.attempt, tasks.perturb):
        module.score = timed(module.score, lambda prepared, states: len(states), scored)  # type: ignore[attr-defined]
    tasks.perturb.track = timed(tasks.perturb.track, lambda state, plans: len(plans), tracked)  # type: ignore[attr-defined]
    with tempfile.TemporaryDirectory() as folder:
        code = run([*words, "executor=local", "workers=1", "render=none", f"out={folder}"])
    print(table("trajectories of a call of `score`, us each", scored))
    print(table("of `track`", tracked))
    return code


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
