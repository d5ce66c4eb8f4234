"""Times a reactive rollout on real logs and prints the table of it.

python -m tests.bench.bench_rollout ../shared/data/av2/sensor/val
"""

import sys
from functools import partial
from pathlib import Path

from factory.clips.av2 import AV2Reader
from tasks.rollout.lqr import track
from tasks.rollout.simulate import TrafficSettings, prepare_traffic, roll_out
from tasks.world.clip import NOW, scene_of_clip
from tests.bench.timing import milliseconds


def main(root: Path) -> None:
    """One row per third clip: who is there, and milliseconds per part of a rollout."""
    reader, settings = AV2Reader(root), TrafficSettings()
    print("| log | start s | agents now | with a path | prepare ms | track ms | traffic ms |")
    print("|---|---|---|---|---|---|---|")
    for ref in reader.index().refs[::3]:
        clip = reader.read(ref)
        scene = scene_of_clip(clip)
        poses = clip.ego_states[None, NOW + 1 : NOW + 41, :3]
        traffic = prepare_traffic(scene, settings)
        states = track(scene.ego_state, poses)[0]
        roll_out(traffic, states)  # compiles
        paths = sum(path is not None for path in traffic.lane_paths)
        print(
            f"| {ref.log_id[:8]} | {ref.start_ms / 1e3:.0f} | {int(clip.agents.valid[NOW].sum())} | {paths} "
            f"| {milliseconds(partial(prepare_traffic, scene, settings), 15):.1f} "
            f"| {milliseconds(partial(track, scene.ego_state, poses), 15):.1f} "
            f"| {milliseconds(partial(roll_out, traffic, states), 15):.1f} |"
        )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
