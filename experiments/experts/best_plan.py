"""What the best of recovery's plans that pass would bring beside the first: `python -m experiments.experts.best_plan
clips=scenarionet clips.root=<logs> vocabulary.file=<human_8192x40x3.npy>`

Every plan of the first six candidates of each clip is driven and judged as a run does it.
"""

import sys

import numpy as np

from factory.config.run import load_config
from factory.graph.steps import PreparedClip
from factory.pipeline import FactoryWork, perturbed_clip_of
from factory.setup.settings import assemble
from tasks.attempt import Judged, ReadyScene, attempt, has_route, off_log, perturbed_scene
from tasks.experts.protocol import Plan, plans_of
from tasks.stages import Rejected
from tasks.world.clip import Scene, random_stream

CANDIDATES = 6
Outcome = tuple[int, float, float, float]  # number of the plan, EPDMS, distance [m] and speed [m/s] off the log


class OnePlan:
    """An expert with the one plan that it was given."""

    name = "recovery"

    def __init__(self, plan: Plan) -> None:
        self._plan = plan

    def digest(self) -> str:
        """It is asked for none."""
        return ""

    def plan(self, scene: Scene, rng: np.random.Generator) -> Plan:
        """That plan."""
        return self._plan


def outcomes(work: FactoryWork, prepared: PreparedClip, candidate: int) -> list[Outcome] | None:
    """Of the plans that pass; None where there is no plan."""
    payload = perturbed_clip_of(prepared)
    scene = perturbed_scene(payload.clip, payload.candidates[candidate].rollout)
    if not has_route(scene.centerline):
        return None
    rng = random_stream(work.seed, prepared.clip_id, "expert.recovery", candidate)
    plans = [plan for plan in plans_of(work.experts["recovery"], scene, rng) if not isinstance(plan, Rejected)]
    found = []
    for number, plan in enumerate(plans):
        result = attempt(ReadyScene(scene, work.traffic), OnePlan(plan), work.gate, rng)
        if not isinstance(result, Rejected) and result[1] is None:
            judged: Judged = result[0]
            end = off_log(judged)[-1]
            found.append((number, float(judged.scores.pdm_score[1]), float(end[0]), float(end[2])))
    return found if plans else None


def main() -> None:
    """Prints a line for each way to choose among the plans that pass."""
    own = ["experts=[recovery]", "render=none", "reward.labels=none", "executor=local", "out=out/best_plan"]
    run = assemble(load_config([*sys.argv[1:], *own]))
    every = []
    for ref in run.refs:
        prepared = run.work.prepare(ref)
        if isinstance(prepared, PreparedClip):
            every += [outcomes(run.work, prepared, row.index) for row in prepared.candidates[:CANDIDATES]]
    driven = [found for found in every if found is not None]
    passing = [found for found in driven if found]
    several = sum(len(found) > 1 for found in passing)
    print(f"{len(driven)} starts with a plan, {len(passing)} of which pass, {several} with several plans")
    ways = {
        "the first": [found[0] for found in passing],
        "the best by EPDMS": [max(found, key=lambda one: (one[1], -one[2])) for found in passing],
        "the nearest at the end": [min(found, key=lambda one: one[2]) for found in passing],
    }
    for name, chosen in ways.items():
        tried, epdms, metres, speed = np.mean(np.array(chosen), axis=0)
        print(f"{name}: plan {tried:.1f}, EPDMS {epdms:.3f}, {metres:.2f} m and {speed:.2f} m/s off the log at the end")


if __name__ == "__main__":
    main()
