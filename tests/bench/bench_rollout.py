"""Times reactive rollouts on real logs and prints the table of it: one core, CPU time, the median of several calls.

python -m tests.bench.bench_rollout ../shared/data/av2/sensor/val
"""

import sys
import time
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np

from factory.datasets.av2.reader import AV2Reader
from tasks.rollout.lqr import track
from tasks.rollout.simulate import TrafficSettings, prepare_traffic, roll_out
from tasks.world.arrays import Array
from tasks.world.clip import NOW, Scene, scene_of_clip
from tasks.world.vocabulary import kinematic_trajectories
from tests.bench.timing import cpu_milliseconds

NEAREST = 25


def among_nearest(scene: Scene) -> Scene:
    """The scene with only the NEAREST agents that are there now."""
    agents = scene.agents
    away = np.linalg.norm(agents.boxes[NOW, :, :2] - scene.ego_state[:2], axis=-1)
    rows = np.sort(np.argsort(np.where(agents.valid[NOW], away, np.inf), kind="stable")[:NEAREST])
    few = replace(
        agents,
        track_ids=tuple(agents.track_ids[row] for row in rows),
        kinds=tuple(agents.kinds[row] for row in rows),
        boxes=agents.boxes[:, rows],
        velocities=agents.velocities[:, rows],
        valid=agents.valid[:, rows],
        center_z=agents.center_z[:, rows],
        heights=agents.heights[rows],
    )
    return replace(scene, clip=replace(scene.clip, agents=few), agents=few)


def first_ego_milliseconds(scene: Scene, settings: TrafficSettings, ego_states: Array, repeats: int = 5) -> float:
    """Median CPU time of the first rollout of a scene: what public traffic is asked for is kept for the next."""
    times_s = []
    for _ in range(repeats):
        traffic = prepare_traffic(scene, settings)
        start_s = time.process_time()
        roll_out(traffic, ego_states)
        times_s.append(time.process_time() - start_s)
    return 1e3 * float(np.median(times_s))


def main(root: Path) -> None:
    """Rows of every third clip, 25 agents and all, of each kind of traffic: who is there, and milliseconds."""
    kinds = {
        "yields=false": TrafficSettings(yields=False),
        "idm": TrafficSettings(),
        "navsim": TrafficSettings(mode="navsim"),
    }
    reader = AV2Reader(root)
    trajectories = kinematic_trajectories(1, 0)
    print("| log | start s | agents now | with a path | traffic | prepare ms | first ego ms | one ego ms |")
    print("|---|---|---|---|---|---|---|---|")
    for ref in reader.index().refs[::3]:
        whole = scene_of_clip(reader.read(ref))
        for scene, (name, settings) in product((among_nearest(whole), whole), kinds.items()):
            traffic = prepare_traffic(scene, settings)
            states = track(scene.ego_state, trajectories, local=True)
            driven = traffic.navsim.driven if traffic.navsim else ()
            paths = int((traffic.roles.path >= 0).sum()) if traffic.roles else len(driven)
            print(
                f"| {ref.log_id[:8]} | {ref.start_ms / 1e3:.0f} | {int(scene.agents.valid[NOW].sum())} | {paths} "
                f"| {name} "
                f"| {cpu_milliseconds(partial(prepare_traffic, scene, settings), 5):.1f} "
                f"| {first_ego_milliseconds(scene, settings, states[0]):.1f} "
                f"| {cpu_milliseconds(partial(roll_out, traffic, states[0]), 40):.2f} |",
                flush=True,
            )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
