"""What labels' ends lead to, with and without the gates on them: `python -m tests.bench.bench_label_ends clips=av2 ...`

By the words of `python -m factory.run`. Every candidate of every clip is driven by every expert, whatever `rounds`
says; told are those with full marks, which is all that the published gate asks. Beside what the gates take stand
measures that they do not use: ends in a junction farther than 2 m from the route, labels that take another turn than
the command says, and collisions at fault in the second after it at the label's last speed. The human drives are
measured, too, and never refused.
"""

import math
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from factory.config.run import load_config
from factory.graph.steps import HUMAN_CANDIDATE
from factory.pipeline import FactoryWork
from factory.readers.base import ClipRef
from factory.setup.settings import assemble
from tasks.attempt import Judged, end_verdict, hit_after_s, verdict
from tasks.rollout.simulate import TrafficScene, TrafficSettings, prepare_traffic
from tasks.settings import ExpertGate
from tasks.stages import END_FAULTS, Rejected
from tasks.world.frames import HEADING
from tasks.world.road_map import LOOKAHEAD_M, Rings, arc_lengths, driving_command

FAR_M = 2.0
LANE_M = 3.5
NO_ENDS = dict.fromkeys(END_FAULTS, False)
MEASURES = {
    "off": f"end > {FAR_M:g} m off the route in a junction",
    "turn": "another turn than commanded",
    "hit": "a hit within 1 s at their speed",
}


def is_far_off(judged: Judged) -> bool:
    """The rear axle ends in a junction, farther than FAR_M from every lane of the route."""
    clip, end = judged.scene.clip, judged.rollout.ego_states[-1, :2]
    lanes = clip.road_map.lanes
    inside = [lane.ring for lane in lanes.values() if lane.is_intersection and lane.drives_cars]
    on_route = [lanes[name].ring for name in clip.route.lane_ids if name in lanes]
    in_junction = bool(inside) and bool(Rings(inside).contains(end).any())
    return in_junction and float(Rings(on_route).distances(end).min()) > FAR_M


def turns_elsewhere(judged: Judged) -> bool:
    """Its first 20 m, seen from the route beside its start, ask for another command than the sample has.

    And lead more than a lane's width off the route: a change of lanes is no turn.
    """
    line, own = judged.scene.centerline, judged.rollout.ego_states[:, : HEADING + 1].copy()
    given = driving_command(line, own[0])
    own[0] = line[int(np.argmin(np.hypot(*(line[:, :2] - own[0, :2]).T)))]
    taken = driving_command(own, own[0])
    there = own[min(int(np.searchsorted(arc_lengths(own), LOOKAHEAD_M)), len(own) - 1), :2]
    aside_m = float(np.hypot(*(line[:, :2] - there).T).min())
    return "unknown" not in (given, taken) and given != taken and aside_m > LANE_M


def drives(work: FactoryWork, refs: Sequence[ClipRef]) -> Iterator[tuple[str, float, Judged, TrafficScene]]:
    """Every attempt: expert, seconds it took, its drive and the traffic that met it."""
    for ref in refs:
        prepared = work.prepare(ref)
        if isinstance(prepared, Rejected):
            continue
        for name in work.names:
            once = work.once(name)
            for candidate in [HUMAN_CANDIDATE] if once else range(len(prepared.candidates)):
                start = time.thread_time()
                judged = work.trace(prepared, candidate, name).judged
                took = time.thread_time() - start
                if judged is not None:
                    traffic = TrafficSettings(mode="replay") if once else work.traffic
                    yield name, took, judged, prepare_traffic(judged.scene, traffic)


def main(words: Sequence[str]) -> int:
    """Drives, and prints the tables."""
    counts: dict[str, Counter[str]] = defaultdict(Counter)
    seconds: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        run = assemble(load_config([*words, "executor=local", "render=none", "reward.labels=none", f"out={folder}"]))
        work = replace(run.work, gate=replace(run.work.gate, **NO_ENDS))
        work.warm(draws=False)
        for name, took, judged, traffic in drives(work, run.index.refs[: run.config.limit]):
            counts[name]["tried"] += 1
            seconds["attempts"] += took
            if work.once(name) or verdict(judged.scores, work.gate) is None:
                counts[name].update(told(judged, traffic, seconds))
    keys = ["tried", "full", *MEASURES, *END_FAULTS, "kept", *(f"kept {key}" for key in MEASURES)]
    heads = ["tried", "full marks", *MEASURES.values(), *(f"refused: `{gate}`" for gate in END_FAULTS), "kept"]
    print("|", " | ".join(["expert", *heads, *(f"of these: {words}" for words in MEASURES.values())]), "|")
    print("|---" * (len(keys) + 1) + "|")
    for name, found in counts.items():
        print(f"| {name} |", " | ".join(str(found[key]) for key in keys), "|")
    tried, full = (sum(found[key] for found in counts.values()) for key in ("tried", "full"))
    costs = [f"{gate} {1e3 * seconds[gate] / max(full, 1):.2f}" for gate in END_FAULTS]
    share = 100.0 * sum(seconds[gate] for gate in END_FAULTS) / seconds["attempts"]
    print(f"\nms of CPU a drive with full marks: {', '.join(costs)}; of all {tried} attempts' time {share:.1f} %")
    return 0


def told(judged: Judged, traffic: TrafficScene, seconds: Counter[str]) -> Iterator[str]:
    """What is counted of a drive with full marks; the time that each gate took is added to `seconds`."""
    yield "full"
    hit = hit_after_s(traffic, judged.prepared, judged.rollout.ego_states) < math.inf
    measured = {"off": is_far_off(judged), "turn": turns_elsewhere(judged), "hit": hit}
    yield from (key for key, holds in measured.items() if holds)
    refused = []
    for gate in END_FAULTS:
        start = time.thread_time()
        found = end_verdict(judged, traffic, ExpertGate(**{**NO_ENDS, gate: True}))
        seconds[gate] += time.thread_time() - start
        refused += [gate] if found is not None else []
    yield from refused[:1]  # as the funnel counts them: under the first
    if not refused:
        yield "kept"
        yield from (f"kept {key}" for key, holds in measured.items() if holds)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
