"""Times reactive rollouts on real logs and prints the table of it: one core, CPU time, the median of several calls.

python -m tests.bench.bench_rollout ../shared/data/av2/sensor/val
"""

import sys
from functools import partial
from pathlib import Path

from factory.clips.av2 import AV2Reader
from tasks.kinematic_vocabulary import kinematic_trajectories
from tasks.rollout.lqr import track_local
from tasks.rollout.simulate import TrafficSettings, prepare_traffic, roll_out, roll_out_many
from tasks.world.clip import NOW, scene_of_clip
from tests.bench.timing import cpu_milliseconds

N_EGOS = 256


def main(root: Path) -> None:
    """One row per third clip: who is there, and milliseconds per part of a rollout."""
    reader, settings = AV2Reader(root), TrafficSettings()
    trajectories = kinematic_trajectories(N_EGOS, 0)
    print(f"| log | start s | agents now | with a path | prepare ms | one ego ms | {N_EGOS} egos ms |")
    print("|---|---|---|---|---|---|---|")
    for ref in reader.index().refs[::3]:
        clip = reader.read(ref)
        scene = scene_of_clip(clip)
        traffic = prepare_traffic(scene, settings)
        states = track_local(scene.ego_state, trajectories)
        paths = sum(path is not None for path in traffic.lane_paths)
        print(
            f"| {ref.log_id[:8]} | {ref.start_ms / 1e3:.0f} | {int(clip.agents.valid[NOW].sum())} | {paths} "
            f"| {cpu_milliseconds(partial(prepare_traffic, scene, settings), 5):.1f} "
            f"| {cpu_milliseconds(partial(roll_out, traffic, states[0]), 40):.2f} "
            f"| {cpu_milliseconds(partial(roll_out_many, traffic, states), 5):.0f} |",
            flush=True,
        )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
