"""How like the logs the traffic is, in the features of the public sim-agents challenge, and what goes wrong in it.

python -m tests.bench.bench_realism [SHARED] [--features]

SHARED (../shared) holds two Argoverse 2 logs and seven nuScenes scenes. Every clip among the logged ego. Likelihoods
are of the first 4 s and of vehicles that are there at T and do not stand over their whole log; faults are of 8 s in two
rollouts, the second from where the first leads. A row for each traffic: constant velocity, the public reactive traffic
(traffic=navsim) and ours.
PEER=<python> names one that can import the challenge's own code, as tests/bench/peer_simagents.py says: then that code
judges some rollouts of every tenth clip too, and a table says by how much features and likelihoods differ.
"""

import os
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from factory.datasets.av2.reader import AV2Reader
from factory.datasets.scenarionet.reader import ScenarioNetReader
from factory.readers.base import ClipReader
from tasks.rollout.lane_following import stands_always
from tasks.rollout.simulate import TrafficSettings, next_scene, prepare_traffic, roll_out
from tasks.world.clip import HORIZON_STEPS, STEP_S, AgentKind, AgentTracks, Clip, Rollout, scene_of_clip
from tasks.world.frames import PACIFICA, ego_boxes
from tasks.world.road_map import RoadMap
from tests.bench.realism import (
    FEATURES,
    GROUPS,
    Array,
    Faults,
    RoadEdge,
    by_group,
    faults_of,
    features_of,
    likelihood,
    with_ego,
)

CONSTANT_VELOCITY = "constant velocity"
LOGS = {"av2": "av2/sensor/val", "scenarionet": "scenarionet/nuscenes"}
TRAFFIC: dict[str, TrafficSettings | None] = {
    CONSTANT_VELOCITY: None,
    "public IDM": TrafficSettings(mode="navsim"),
    "IDM, yields=false": TrafficSettings(yields=False),
    "IDM": TrafficSettings(),
}
ADAPTER = Path(__file__).with_name("peer_simagents.py")
BESIDE = (CONSTANT_VELOCITY, "IDM")  # the one drives into others and off the road, the other does not
BESIDE_EVERY = 10  # clips
EDGE_EVERY = 20  # steps at which the peer looks for the road's edge, which takes it long


def constant_velocity(agents: AgentTracks) -> AgentTracks:
    """Vehicles go on as they move in row 0; everybody else is as logged."""
    vehicle = np.array([kind == AgentKind.VEHICLE for kind in agents.kinds]) & agents.valid[0]
    boxes, velocities, valid = agents.boxes.copy(), agents.velocities.copy(), agents.valid.copy()
    time = STEP_S * np.arange(len(boxes))[:, None, None]
    boxes[:, vehicle] = boxes[0, vehicle]
    boxes[:, vehicle, :2] += time * velocities[0, vehicle]
    velocities[:, vehicle], valid[:, vehicle] = velocities[0, vehicle], True
    return replace(agents, boxes=boxes, velocities=velocities, valid=valid)


def rollouts(clip: Clip, settings: TrafficSettings | None) -> Iterator[tuple[AgentTracks, AgentTracks, Array]]:
    """(logged, simulated, ego's boxes) of the first H seconds, and of H more."""
    scene = scene_of_clip(clip)
    for _ in range(2):
        steps = slice(scene.step, scene.step + HORIZON_STEPS + 1)
        states = clip.ego_states[steps]
        if settings is None:
            agents = constant_velocity(scene.agents.window(steps.start, steps.stop))
            rollout = Rollout(scene.step, states, agents, np.zeros(len(agents), dtype=bool))
        else:
            rollout = roll_out(prepare_traffic(scene, settings), states)
        yield clip.agents.window(steps.start, steps.stop), rollout.agents, ego_boxes(states, PACIFICA)
        scene = next_scene(scene, rollout, clip.centerline)


def _judged_rows(clip: Clip, logged: AgentTracks) -> NDArray[np.intp]:
    """Vehicles that are there at T and do not stand over their whole log."""
    drives = np.array([kind == AgentKind.VEHICLE for kind in logged.kinds]) & logged.valid[0]
    return np.flatnonzero(drives & ~stands_always(clip.agents))


def judged(clip: Clip, settings: TrafficSettings | None, edge: RoadEdge) -> tuple[dict[str, float], float, Faults]:
    """Likelihoods, mean displacement [m] and faults of one clip; no likelihoods where nobody drives."""
    (logged, simulated, ego), second = rollouts(clip, settings)
    rows = _judged_rows(clip, logged)
    faults = faults_of(logged, simulated, ego) + faults_of(*second)
    if not len(rows):
        return {}, np.nan, faults
    wanted, found = (features_of(agents, ego, rows, edge) for agents in (logged, simulated))
    both = (logged.valid & simulated.valid)[:, rows]
    off = np.hypot(*np.moveaxis(simulated.boxes[:, rows, :2] - logged.boxes[:, rows, :2], -1, 0))[both]
    return {name: likelihood(of, wanted[name], found[name]) for name, of in FEATURES.items()}, float(off.mean()), faults


@dataclass
class Apart:
    """By how much ours and the challenge's own differ, over everything that was compared."""

    most: float = 0.0
    values: int = 0
    other: int = 0  # values farther apart than a thousandth

    def add(self, ours: Array, theirs: Array) -> None:
        both = np.isfinite(ours) & np.isfinite(theirs)
        if both.any():
            off = np.abs(ours - theirs)[both]
            self.most, self.other = max(self.most, float(off.max())), self.other + int((off > 1e-3).sum())
            self.values += int(both.sum())


def beside(python: str, clip: Clip, settings: TrafficSettings | None, edge: RoadEdge, apart: dict[str, Apart]) -> None:
    """The same rollout by the challenge's own code. Raises CalledProcessError where it stops."""
    logged, simulated, ego = next(iter(rollouts(clip, settings)))
    rows = _judged_rows(clip, logged)
    if not len(rows):
        return
    tracks = [with_ego(agents, ego) for agents in (logged, simulated)]
    edge_steps = np.arange(0, len(ego), EDGE_EVERY)
    with tempfile.TemporaryDirectory() as folder:
        given, answer = Path(folder) / "in.npz", Path(folder) / "out.npz"
        rings = edge.rings()
        np.savez(
            given,
            boxes=np.stack([boxes for boxes, _ in tracks]),
            valid=np.stack([valid for _, valid in tracks]),
            rows=rows,
            edge_xy=np.concatenate(rings),
            edge_ends=np.cumsum([len(ring) for ring in rings]),
            edge_steps=edge_steps,
        )
        subprocess.run([python, "-W", "ignore", str(ADAPTER), str(given), str(answer)], check=True)
        with np.load(answer) as loaded:
            theirs = dict(loaded)
    ours = [features_of(agents, ego, rows, edge) for agents in (logged, simulated)]
    for name in FEATURES:
        if name in theirs and ours[0][name].shape == theirs[name][0].shape:
            apart[name].add(np.stack([of[name] for of in ours]), theirs[name])
    whole = np.stack([valid[:, rows] for _, valid in tracks]).all(axis=(0, 1))
    for name, feature in FEATURES.items():
        if f"likelihood {name}" in theirs:
            value = likelihood(feature, *(of[name][:, whole] for of in ours))
            apart[f"likelihood of {name}"].add(np.array([value]), theirs[f"likelihood {name}"][None])


def table(reader: ClipReader, stride: int, all_features: bool) -> None:
    """A row for each traffic."""
    refs = reader.index().refs[::stride]
    likelihoods: dict[str, list[dict[str, float]]] = defaultdict(list)
    off: dict[str, list[float]] = defaultdict(list)
    faults: dict[str, Faults] = defaultdict(lambda: Faults(0, 0, 0, 0, 0, 0, 0))
    refused: dict[str, int] = defaultdict(int)
    edges: dict[int, tuple[RoadMap, RoadEdge]] = {}  # clips of one log share their map
    apart: dict[str, Apart] = defaultdict(Apart)
    python = os.environ.get("PEER", "")
    for number, ref in enumerate(refs):
        clip = reader.read(ref)
        key = id(clip.road_map)
        if key not in edges:
            edges[key] = (clip.road_map, RoadEdge(clip.road_map))
        for name, settings in TRAFFIC.items():
            try:
                of, displacement, wrong = judged(clip, settings, edges[key][1])
            except ValueError:  # as the public code, which cannot go on from everywhere
                refused[name] += 1
                continue
            faults[name] += wrong
            if of:
                likelihoods[name].append(of)
                off[name].append(displacement)
            if python and name in BESIDE and number % BESIDE_EVERY == 0:
                beside(python, clip, settings, edges[key][1], apart)
    names = list(FEATURES) if all_features else []
    print(
        f"| {len(refs)} clips | {' | '.join((*GROUPS, *names))} | displacement m | new overlaps (with ego) | deep "
        "| brakes above 8 m/s2 | standing that roll | refused |"
    )
    print("|---" * (8 + len(GROUPS) - 1 + len(names)) + "|")
    for name in TRAFFIC:
        of = {feature: float(np.mean([one[feature] for one in likelihoods[name]])) for feature in FEATURES}
        scores = [f"{value:.3f}" for value in (*by_group(of).values(), *(of[feature] for feature in names))]
        f = faults[name]
        print(
            f"| {name} | {' | '.join(scores)} | {np.mean(off[name]):.2f} | {f.overlaps} ({f.with_ego}) | {f.deep} "
            f"| {f.hard_brakes} of {f.vehicles} | {f.rolling} of {f.standing} | {refused[name]} |",
            flush=True,
        )
    if apart:
        print("\n| beside the challenge's own code | values | farther apart than 1e-3 | most |\n|---|---|---|---|")
        for name, of in apart.items():
            print(f"| {name} | {of.values} | {of.other} | {of.most:.2g} |", flush=True)


def main(shared: Path, all_features: bool = False, stride: int = 1) -> None:
    for of, kind in (("av2", AV2Reader), ("scenarionet", ScenarioNetReader)):
        print(f"\n{LOGS[of]}, {stride} of its clips\n" if stride > 1 else f"\n{LOGS[of]}\n", flush=True)
        table(kind(shared / "data" / LOGS[of]), stride, all_features)


if __name__ == "__main__":
    words = [word for word in sys.argv[1:] if not word.startswith("--")]
    main(Path(words[0]) if words else Path("../shared"), "--features" in sys.argv, int(words[1]) if words[1:] else 1)
