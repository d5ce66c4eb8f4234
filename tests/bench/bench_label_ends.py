"""What labels' ends lead to, before and after the gates: `python -m tests.bench.bench_label_ends clips=av2 clips.root=<logs> ...`

By the words of `python -m factory.run`. Every candidate of every clip is driven by every expert, whatever `rounds` says;
told of those with full marks, which is all that the published gate asks. Beside the gates' own verdicts stand measures
that no gate uses: ends farther than 2 m from the route inside a junction, and labels whose own path asks for another
command than the sample's. The human drives are measured and never refused.
"""

import math
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from factory.config.run import load_config
from factory.graph.work import HUMAN_CANDIDATE
from factory.setup.settings import assemble
from factory.stages.pipeline import FactoryWork, drive_of  # noqa: F401
from tasks.attempt import Judged, end_verdict, verdict
from tasks.reward.second_after import BRAKING_MPS2, hit_after_s
from tasks.rollout.simulate import TrafficScene, TrafficSettings, prepare_traffic
from tasks.settings import ExpertGate
from tasks.stages import Rejected
from tasks.world.clip import Clip
from tasks.world.command import driving_command
from tasks.world.polygons import Rings
from tasks.world.vehicle import HEADING

OPEN = {"off_route": False, "after": False}
COLUMNS = {
    "full marks": "",
    "far": "> 2 m off in a junction",
    "command": "another command",
    "hit": "hit at its speed",
    "off_route": "`off_route`",
    "after": "`after`",
    "kept": "kept",
    "far kept": "> 2 m off in a junction",
    "command kept": "another command",
    "hit kept": "hit at its speed",
}


def far_off(clip: Clip, judged: Judged) -> bool:
    """The rear axle ends in a junction, farther than 2 m from every lane of the route."""
    lanes, end = clip.road_map.lanes, judged.rollout.ego_states[-1, :2]
    inside = [lane.ring for lane in lanes.values() if lane.is_intersection and lane.drives_cars]
    on_route = [lanes[name].ring for name in clip.route.lane_ids if name in lanes]
    return bool(inside) and bool(Rings(inside).contains(end).any()) and float(Rings(on_route).distances(end).min()) > 2.0


def other_command(judged: Judged) -> bool:
    """Its first 20 m, taken for a route, ask for another command than the sample's."""
    states, scene = judged.rollout.ego_states[:, : HEADING + 1], judged.scene
    own, given = driving_command(states, states[0]), driving_command(scene.centerline, states[0])
    return "unknown" not in (own, given) and own != given


def drives(work: FactoryWork, names: tuple[str, ...], refs: list) -> Iterator[tuple[str, Judged, TrafficScene]]:
    """Expert, drive and its traffic of all that have full marks; of the human all."""
    for ref in refs:
        prepared = work.prepare(ref)
        if isinstance(prepared, Rejected):
            continue
        for name in names:
            once = work.once(name)
            for candidate in [HUMAN_CANDIDATE] if once else range(len(prepared.candidates)):
                drive = work.trace(prepared, candidate, name)
                if drive.judged is not None:
                    traffic = TrafficSettings(mode="replay") if once else work.traffic
                    yield name, drive.judged, prepare_traffic(drive.judged.scene, traffic)


def main(words: list[str]) -> int:
    """Drives, and prints the table."""
    counts: dict[str, Counter[str]] = defaultdict(Counter)
    seconds: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        run = assemble(load_config([*words, "executor=local", "render=none", "reward.labels=none", f"out={folder}"]))
        work = replace(run.work, gate=replace(run.work.gate, **OPEN))
        refs = run.index.refs[: run.config.limit]
        for name, judged, traffic in drives(work, run.config.experts, refs):
            tally = counts[name]
            tally["tried"] += 1
            if verdict(judged.scores, work.gate) is not None and not work.once(name):
                continue
            tally["full marks"] += 1
            clip, states = judged.scene.clip, judged.rollout.ego_states
            found = {"far": far_off(clip, judged), "command": other_command(judged)}
            found["hit"] = hit_after_s(traffic, judged.prepared, states) < math.inf
            refused = []
            for gate in ("off_route", "after"):
                start = time.thread_time()
                said = end_verdict(judged, traffic, ExpertGate(**(OPEN | {gate: True})))
                seconds[gate] += time.thread_time() - start
                refused += [] if said is None else [said]
            tally.update(said.reason for said in refused)
            tally.update(key for key, holds in found.items() if holds)
            if not refused:
                tally.update(f"{key} kept" for key, holds in found.items() if holds)
            tally["kept"] += not refused
            seconds["drives"] += 1
    keys = ["tried", *COLUMNS]
    for name, tally in counts.items():
        print(name, {key: tally[key] for key in keys})
    print({gate: 1e3 * seconds[gate] / seconds["drives"] for gate in ("off_route", "after")})
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
