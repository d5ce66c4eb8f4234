"""Where the time of a score goes, rule by rule, on one core: `python -m tests.bench.bench_rules`.

The public metric's recorded scenes at K = 4,096 (folder as the argument, by default ../shared). Microseconds of CPU per
trajectory, the least of many runs: a rule's is what the run takes longer with it. The last column is the whole score,
its arrays and the normalisation of progress too.
"""

import sys
import time
from collections.abc import Callable
from pathlib import Path

import numba
import numpy as np

from tasks.reward.area_flags import areas_along
from tasks.reward.centerline import progress_m
from tasks.reward.comfort import comfort_along
from tasks.reward.contacts import first_collision, first_time_to_collision
from tasks.reward.ego import place
from tasks.reward.epdms import score
from tasks.reward.lane_discipline import driving_direction, lane_keeping
from tasks.reward.lights import first_red
from tasks.reward.verdicts import scratch_for, world_of
from tasks.rollout.lqr import track_local
from tests.real.reference_scenes import RECORDED_K, loader, prepared_scene

K = 4096
RULES = ("body", "areas", "NC", "TTC", "DDC", "TLC", "LK", "EP", "HC")


@numba.njit
def rules_up_to(last, world, obstacles, states, scratch, comfort):  # type: ignore[no-untyped-def]
    """The first `last` of RULES on all states, in the order of the score; a rule's time is a difference."""
    body, ego = scratch.body, world.ego
    total = 0.0
    for k in range(states.shape[0]):
        place(states[k], ego.rear_axle_to_center, body)
        if last > 1:
            areas_along(world.map_index, body, ego.half_length, ego.half_width)
        if last > 2:
            total += first_collision(obstacles, states[k], body, ego.half_length, ego.half_width, scratch.ignored)[0]
        if last > 3:
            total += first_time_to_collision(
                obstacles, states[k], body, world.map_index, ego.half_length, ego.half_width, scratch.ignored
            )
        if last > 4:
            total += driving_direction(body)[0]
        if last > 5:
            total += first_red(world.red_lanes, body, ego.half_length, ego.half_width)
        if last > 6:
            total += lane_keeping(world.centerline, body)
        if last > 7:
            total += progress_m(world.centerline, body.x[0], body.y[0], body.x[-1], body.y[-1])
        if last > 8:
            total += comfort_along(world.history, states[k], ego.rear_axle_to_center, scratch.comfort, comfort)
    return total


def least_ms(call: Callable[[], object]) -> float:
    """CPU time of the quickest of 15 calls."""
    times = []
    for _ in range(15):
        start = time.process_time()
        call()
        times.append(time.process_time() - start)
    return 1e3 * min(times)


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
        states = track_local(inputs["ego_state0"], module.proposals(name, K))
        obstacles, world = prepared.indexed_obstacles, world_of(prepared, with_history=True)
        scratch = scratch_for(obstacles.boxes.shape[1])

        def up_to(last: int, *given: object) -> Callable[[], object]:
            return lambda: rules_up_to(last, *given, np.empty(6, np.bool_))

        rules_up_to(len(RULES), world, obstacles, states[:1], scratch, np.empty(6, np.bool_))
        sums = [least_ms(up_to(last, world, obstacles, states, scratch)) for last in range(1, len(RULES) + 1)]
        whole = least_ms(lambda scene=prepared, rows=states: score(scene, rows))  # type: ignore[misc]
        each = [*np.diff([0.0, *sums]), whole]
        print(f"| {name} | " + " | ".join(f"{1e3 * ms / K:.2f}" for ms in each) + " |", flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "../shared"))
