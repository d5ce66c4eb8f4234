"""Where the time of a score goes, rule by rule, on one core: `python -m tests.bench.bench_rules`.

The first 1,024 of the 4,096 recorded proposals of the public metric's scenes (folder as the argument, by default
../shared). Microseconds of CPU per trajectory: a rule's is what a run takes longer with it, each the least of 40 runs
taken in turns, so that a machine that slows down for a while slows them all. The last column is the whole score, its
arrays and the normalisation of progress too.
"""

import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numba
import numpy as np
from numpy.typing import NDArray

from tasks.reward.epdms import score
from tasks.reward.rules.area_flags import areas_along
from tasks.reward.rules.centerline import progress_m
from tasks.reward.rules.comfort import comfort_along
from tasks.reward.rules.contacts import first_collision, first_time_to_collision
from tasks.reward.rules.ego import place
from tasks.reward.rules.lane_discipline import driving_direction, lane_keeping
from tasks.reward.rules.lights import first_red
from tasks.reward.verdicts import context_of, scratch_for
from tasks.rollout.lqr import track
from tests.real.reference_scenes import RECORDED_K, loader, prepared_scene

RECORDED, K, RUNS = 4096, 1024, 40
RULES = ("body", "areas", "NC", "TTC", "DDC", "TLC", "LK", "EP", "HC")


@numba.njit
def rules_up_to(last, context, obstacles, states, scratch, comfort):  # type: ignore[no-untyped-def]
    """The first `last` of RULES on all states, in the order of the score; a rule's time is a difference."""
    body, ego = scratch.body, context.ego
    total = 0.0
    for k in range(states.shape[0]):
        place(states[k], ego.rear_axle_to_center, body)
        if last > 1:
            areas_along(context.map_index, body, ego.half_length, ego.half_width)
        if last > 2:
            total += first_collision(obstacles, states[k], body, ego.half_length, ego.half_width, scratch.ignored)[0]
        if last > 3:
            total += first_time_to_collision(
                obstacles, states[k], body, context.map_index, ego.half_length, ego.half_width, scratch.ignored
            )
        if last > 4:
            total += driving_direction(body)[0]
        if last > 5:
            total += first_red(context.red_lanes, body, ego.half_length, ego.half_width)
        if last > 6:
            total += lane_keeping(context.centerline, body)
        if last > 7:
            total += progress_m(context.centerline, body.x[0], body.y[0], body.x[-1], body.y[-1])
        if last > 8:
            total += comfort_along(context.history, states[k], ego.rear_axle_to_center, scratch.comfort, comfort)
    return total


def least_us(calls: Sequence[Callable[[], object]]) -> NDArray[np.float64]:
    """CPU time [us] per trajectory of the quickest of RUNS runs of each call, the calls taken in turns."""
    times = np.empty((RUNS, len(calls)))
    for run in range(RUNS):
        for i, call in enumerate(calls):
            start = time.process_time()
            call()
            times[run, i] = time.process_time() - start
    return np.asarray(1e6 * times.min(axis=0) / K)


def main(root: Path) -> None:
    """Prints the table."""
    if not (root / "reference").is_dir():
        raise SystemExit(f"the recorded scenes are not at {root}")
    print("| scene | " + " | ".join(RULES) + " | score |")
    print("|---" * (len(RULES) + 2) + "|")
    for name in RECORDED_K:
        module = loader(root)
        inputs = module.inputs(name)
        prepared = prepared_scene(inputs)
        states = track(inputs["ego_state0"], module.proposals(name, RECORDED)[:K], local=True)
        obstacles, context = prepared.indexed_obstacles, context_of(prepared, with_history=True)
        scratch, comfort = scratch_for(obstacles.boxes.shape[1]), np.empty(6, np.bool_)
        given = (context, obstacles, states, scratch, comfort)
        calls = [partial(rules_up_to, last, *given) for last in range(1, len(RULES) + 1)]
        rules_up_to(len(RULES), *given)
        times = least_us([*calls, partial(score, prepared, states)])
        print(f"| {name} | " + " | ".join(f"{us:.2f}" for us in [*np.diff(times[:-1], prepend=0.0), times[-1]]) + " |")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "../shared"))
