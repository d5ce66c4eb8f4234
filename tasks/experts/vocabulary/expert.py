"""The best of K trajectories of a vocabulary among traffic that answers to each, with the reward as its judge.

1. Of the vocabulary those are kept that start about as the ego moves; their start is blended into its speed.
2. The tracker drives them all, and they are scored as PDM-Closed scores its proposals: against a forecast of constant
   velocities, which is cheap. Of those whose drives end in the same place the best is kept, and of these the K best.
3. Traffic answers to each of the K, and they are scored in it as the attempt's own drive will be. The best by that
   score that passes the attempt's gate is the plan; within a hundredth or two of the score the smoother is the better.
4. Mode m is the m-th in that order that ends elsewhere than the modes before it. A sample has one label, so each mode
   that is wanted is an expert of its own, of the same vocabulary (conf/expert/vocabulary_2.yaml); what they make of one
   candidate are several labels of one state.
"""

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar

import numpy as np

from tasks.experts.pdm_closed.forecast import forecast
from tasks.experts.pdm_closed.path import MIN_PROGRESS_M, path_length_m
from tasks.experts.pdm_closed.planner import plan_for
from tasks.experts.pdm_closed.settings import PdmSettings
from tasks.experts.protocol import Plan
from tasks.experts.smoothness import best_first, roughness
from tasks.experts.vocabulary.settings import VocabularySettings
from tasks.experts.vocabulary.trajectories import Moving
from tasks.reward.ends import end_fault
from tasks.reward.epdms import Scores, rows, score
from tasks.reward.labels import scores_among_answers
from tasks.reward.prepare import prepare_scene
from tasks.rollout.lqr import track
from tasks.rollout.settings import TrafficSettings
from tasks.rollout.simulate import TrafficScene, prepare_traffic, roll_out
from tasks.settings import ExpertGate
from tasks.stages import Rejected
from tasks.world.arrays import Array, Bools, Ints
from tasks.world.clip import HORIZON_STEPS, Scene
from tasks.world.frames import to_local, to_world
from tasks.world.vehicle import HEADING, VX
from tasks.world.vocabulary import Vocabulary


@dataclass(frozen=True)
class Tried:
    """What was driven among answering traffic, best first."""

    poses: Array  # (K, 40, 3) world frame
    states: Array  # (K, 41, 11) as the tracker drives them
    scores: Scores  # (K,)
    passes: Bools  # (K,) every sub-score that the gate asks for; what the ends lead to is not asked yet
    traffic: TrafficScene


@dataclass(frozen=True)
class VocabularyExpert:
    """Drives what the reward likes best of a vocabulary."""

    vocabulary: Vocabulary
    settings: VocabularySettings = field(default_factory=VocabularySettings)
    traffic: TrafficSettings = field(default_factory=TrafficSettings)  # of the attempts
    gate: ExpertGate = field(default_factory=ExpertGate)  # of the attempts
    pdm: PdmSettings = field(default_factory=PdmSettings)  # of what progress is held against
    name: str = "vocabulary"
    kernels: ClassVar[tuple[str, ...]] = ("answers",)

    def digest(self) -> str:
        """Of the vocabulary and every setting."""
        settings = self.settings, self.traffic, self.gate, self.pdm
        return hashlib.sha256(f"{self.vocabulary.digest}\x1f{settings!r}".encode()).hexdigest()[:16]

    def plan(self, scene: Scene, rng: np.random.Generator) -> Plan | Rejected:
        """The mode that is asked for; "no_plan" where nothing starts like the ego, or there are fewer modes.

        Where nothing passes the gate, mode 1 is the best by score: the attempt says what it fails.
        """
        length_m = path_length_m(scene.centerline)
        if length_m <= MIN_PROGRESS_M:
            return Rejected("expert", "no_plan", f"the route ahead is {length_m:g} m long")
        tried = self.tried(scene)
        if tried is None:
            return Rejected("expert", "no_plan", f"none of {len(self.vocabulary)} trajectories starts like the ego")
        found: list[int] = []
        for member in self.modes(scene, tried):
            found.append(member)
            if len(found) == self.settings.mode:
                return Plan(tried.poses[member])
        if not found and self.settings.mode == 1:
            return Plan(tried.poses[0])
        return Rejected("expert", "no_plan", f"mode {self.settings.mode} of {len(found)} that pass the gate")

    def tried(self, scene: Scene) -> Tried | None:
        """Everything that was driven among answering traffic; None where no trajectory starts like the ego."""
        ego, chosen = scene.ego_state, self.settings
        members = self._moving.starting_like(ego, chosen)
        if len(members) == 0:
            return None
        local = self._moving.started_at(max(float(ego[VX]), 0.0), members, chosen.blend_s)
        poses = to_world(ego[: HEADING + 1], local)
        states = track(ego, poses)
        reference = plan_for(scene, self.pdm).driven[None]

        order = best_first(_foreseen(scene, np.concatenate([reference, states])), roughness(states), chosen.score_step)
        apart = chosen.apart_along_m, chosen.apart_across_m
        kept = spread(order, states[:, -1, : HEADING + 1], apart, chosen.rollouts)
        poses, states = poses[kept], states[kept]

        ready = prepare_traffic(scene, self.traffic)
        scores = rows(scores_among_answers(ready, np.concatenate([reference, states])), slice(1, None))
        order = best_first(scores.pdm_score, roughness(states), chosen.score_step)
        scores = rows(scores, order)
        passes = scores.ep > self.gate.progress_above
        for name in self.gate.full:
            passes &= getattr(scores, name) == 1.0
        return Tried(poses[order], states[order], scores, passes, ready)

    def modes(self, scene: Scene, tried: Tried) -> Iterator[int]:
        """Places of what passes the gate, best first, each ending elsewhere than those before it."""
        touching_out = self.traffic.leaves_out_touching
        ends, taken = tried.states[:, -1, : HEADING + 1], list[int]()
        apart = self.settings.mode_along_m, self.settings.mode_across_m
        for member in np.flatnonzero(tried.passes).tolist():
            if not is_apart(ends[member], ends[taken], apart):
                continue
            states = tried.states[member]
            prepared = prepare_scene(scene, roll_out(tried.traffic, states.copy()).agents, touching_out)
            if end_fault(tried.traffic, prepared, states, self.gate) is None:
                taken.append(member)
                yield member

    @cached_property
    def _moving(self) -> Moving:
        return Moving(self.vocabulary)


def _foreseen(scene: Scene, states: Array) -> Array:
    """Scores (K,) of states (1 + K, 41, 11), the reference first, where all others keep their velocity."""
    now = scene.agents.window(scene.step, scene.step + 1)
    others = forecast(scene.ego_state, now).tracks(now, HORIZON_STEPS + 1)
    prepared = prepare_scene(scene, others, drop_touching=False)  # the forecast is without them
    return score(prepared, states, normalise="pairs").pdm_score[1:]


def is_apart(end: Array, others: Array, apart_m: tuple[float, float]) -> bool:
    """Whether a pose (3,) lies farther than that along or across from each of the others (N, 3)."""
    off = np.abs(to_local(end, others)[..., :2])
    return bool((off > apart_m).any(axis=-1).all())


def spread(order: Ints, ends: Array, apart_m: tuple[float, float], at_most: int) -> Ints:
    """The first of `order` whose end poses (K, 3) are apart from those of all taken before, `at_most` of them."""
    taken: list[int] = []
    for member in order.tolist():
        if is_apart(ends[member], ends[taken], apart_m):
            taken.append(member)
            if len(taken) == at_most:
                break
    return np.array(taken, dtype=np.int64)
