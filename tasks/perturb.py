"""Perturbation: which vocabulary trajectories take the ego somewhere new, near the log, and lawfully.

Paper, section "Trajectory Perturbation" and the configuration table of its supplement: gates on the raw end pose, LQR,
gates on the reached end pose, an interleaved grid over those, per cell the first trajectory in seeded order with a
non-reactive EPDMS at the threshold (log replay), then the same threshold under reactive traffic on the kept ones only.
Scores are needed only until a cell is filled, so cells are walked abreast: the same result at a fraction of the scores.

A clip may have starts of its own: trajectories, in the order in which they are wanted. They pass the same gates and
scores, one a cell, of any cell, and are tried before the vocabulary's, which stay what they are without them.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import islice

import numpy as np

from tasks.experts.pdm_closed import plan_for
from tasks.kernels.simd import LANES
from tasks.reward.epdms import Scores, prepare_scene, score, with_objects
from tasks.rollout.lqr import track
from tasks.rollout.simulate import TrafficSettings, prepare_traffic, roll_out
from tasks.settings import PerturbSettings
from tasks.stages import Rejected
from tasks.world.arrays import Array, Bools, Ints
from tasks.world.clip import HORIZON_STEPS, NOW, Clip, Rollout, scene_of_clip
from tasks.world.frames import HEADING, VX, to_local, to_world
from tasks.world.vocabulary import FIRST_START, OF_LOG, Vocabulary

NO_STARTS = np.empty((0, HORIZON_STEPS, 3))
AT_ONCE = LANES - 1  # scored together: with PDM-Closed one block of the reward
START_FATES = ("reached_gate", "score", "reactive")  # what drops starts, counted where a clip has some


@dataclass(frozen=True)
class Candidate:
    """A perturbation of one clip, with the reactive rollout that proved it."""

    vocabulary_index: int  # row of the vocabulary; OF_LOG: the log itself; FIRST_START - n: start n
    end_pose: Array  # (3,) reached at T+H, in the frame of the logged pose at T+H
    cell: tuple[int, int]  # longitudinal, lateral index of the grid
    score: float  # EPDMS (/14) under log replay
    reactive_score: float  # EPDMS (/14) under reactive traffic
    reactive_scores: Scores  # row 1 is the candidate, row 0 PDM-Closed
    rollout: Rollout


@dataclass(frozen=True)
class Perturbation:
    """The ordered candidate list of a clip, and what each gate dropped."""

    candidates: tuple[Candidate, ...]
    gate_counts: dict[str, int]
    considered: "ConsideredTrajectories"


@dataclass(frozen=True)
class ConsideredTrajectories:
    """Every vocabulary trajectory that passed the raw gates, then the clip's own starts, and what became of them.

    For `explain` and pictures.
    """

    vocabulary_index: Ints  # (G,) as a candidate's
    end_pose: Array  # (G, 3) reached, in the frame of the logged pose at T+H
    fate: tuple[str, ...]  # (G,) "reached_gate", "white_cell", "not_needed", "score", "reactive", "kept"
    score: Array  # (G,) EPDMS under log replay, NaN where it was not needed


def gate_failures(end_poses: Array, settings: PerturbSettings) -> dict[str, Bools]:
    """Which end poses (..., 3), in the frame of the logged pose at T+H, each gate drops."""
    return {
        "longitudinal": np.abs(end_poses[..., 0]) > settings.max_longitudinal_m,
        "lateral": np.abs(end_poses[..., 1]) > settings.max_lateral_m,
        "heading": np.abs(end_poses[..., 2]) > np.deg2rad(settings.max_heading_deg),
    }


def grid_cells(end_poses: Array, settings: PerturbSettings) -> Ints:
    """Cell (..., 2) of end poses (..., 3): longitudinal and lateral index; cell (0, 0) is centred on the log."""
    steps = np.array([settings.step_longitudinal_m, settings.step_lateral_m])
    return np.floor(end_poses[..., :2] / steps + 0.5).astype(np.int64)


def first_good_per_cell(cell_of: Ints, order: Ints, is_good: Callable[[Ints], Bools]) -> tuple[Ints, Ints]:
    """Per cell the first of `order`, (G',) in seeded order, that is good (C,); cells in the order of their first.

    And all that were needed to know, those up to the first good one of each cell. cell_of: (G, 2) cell of each
    trajectory; is_good: asked for a batch at a time, at most once for each, also for some beyond those needed.
    """
    queues: dict[tuple[int, int], list[int]] = {}
    for member in order:
        queues.setdefault((int(cell_of[member, 0]), int(cell_of[member, 1])), []).append(int(member))
    chosen: dict[tuple[int, int], int] = {}
    needed: list[int] = []
    rank = 0
    while waiting := [cell for cell, queue in queues.items() if cell not in chosen and rank < len(queue)]:
        ranks = max(1, AT_ONCE // len(waiting))
        asked = {cell: queues[cell][rank : rank + ranks] for cell in waiting}
        members = [member for queue in asked.values() for member in queue]
        good = dict(zip(members, is_good(np.array(members, dtype=np.int64)).tolist()))
        for cell, queue in asked.items():
            first = next((k for k, member in enumerate(queue) if good[member]), len(queue))
            needed += queue[: first + 1]
            if first < len(queue):
                chosen[cell] = queue[first]
        rank += ranks
    found = [chosen[cell] for cell in queues if cell in chosen]
    return np.array(found, dtype=np.int64), np.array(needed, dtype=np.int64)


def spread_out(points: Array, is_good: Callable[[int], bool], at_most: int) -> list[int]:
    """Good points (P, 2) in farthest-point order: the nearest to the origin, then always the farthest from those taken.

    So that any first few lie all over the place (Gonzalez 1985). Ties go to the first. Points are asked about once, in
    that order, until `at_most` are taken.
    """
    taken: list[int] = []
    reach = -np.hypot(points[:, 0], points[:, 1])  # how much a point is wanted; -inf once it was asked about
    while len(taken) < at_most and np.isfinite(reach).any():
        member = int(np.argmax(reach))
        reach[member] = -np.inf
        if not is_good(member):
            continue
        distance = np.hypot(*(points - points[member]).T)
        asked = np.isneginf(reach)
        reach = np.where(asked, -np.inf, np.minimum(reach, distance) if taken else distance)
        taken.append(member)
    return taken


def perturb(
    clip: Clip,
    vocabulary: Vocabulary,
    settings: PerturbSettings,
    traffic: TrafficSettings,
    rng: np.random.Generator,
    starts: Array = NO_STARTS,
) -> Perturbation | Rejected:
    """The ordered candidates of a clip, or Rejected "no_gated_candidate" or "no_good_candidate".

    traffic: of the reactive check; PDM-Closed is the first row of every two-row batch that normalises progress;
    rng: the clip's `perturb` stream, which draws one permutation of the vocabulary; starts: (S, 40, 3) of this clip, as
    a vocabulary's.
    """
    if settings.at_log:
        return log_as_candidate(clip, traffic)
    scene = scene_of_clip(clip)
    start = scene.ego_state
    target = clip.ego_states[NOW + HORIZON_STEPS, : HEADING + 1]  # the logged pose at T+H
    walk_order = rng.permutation(len(vocabulary.trajectories))

    # Only end poses are moved for all K; whole trajectories for the few that stay.
    raw_ends = to_local(target, to_world(start[: HEADING + 1], vocabulary.trajectories[:, -1]))
    raw_fails = gate_failures(raw_ends, settings)
    gated = np.flatnonzero(~np.logical_or.reduce(list(raw_fails.values())))
    counts = {f"raw_{name}": int(fails.sum()) for name, fails in raw_fails.items()}
    n_gated = len(gated)  # starts stand behind them
    if n_gated + len(starts) == 0:
        detail = f"none of {len(raw_ends)} trajectories ends near the log"
        return Rejected("perturb", "no_gated_candidate", detail, counts)

    trajectories = np.concatenate([vocabulary.trajectories[gated], starts])
    states = track(start, to_world(start[: HEADING + 1], trajectories))
    index = np.concatenate([gated, FIRST_START - np.arange(len(starts))])
    ends = to_local(target, states[:, -1, : HEADING + 1])
    end_fails = gate_failures(ends, settings)
    reached = ~np.logical_or.reduce(list(end_fails.values()))
    counts |= {f"reached_{name}": int(fails[:n_gated].sum()) for name, fails in end_fails.items()}
    cells = grid_cells(ends, settings)
    is_start = np.arange(len(index)) >= n_gated
    # The interleaved half of the grid; of starts all of it.
    black = (cells.sum(axis=1) % 2 == 0) | (not settings.interleaved) | is_start
    counts["white_cell"] = int((reached & ~black).sum())

    replay = prepare_scene(scene, scene.agents.window(NOW, NOW + HORIZON_STEPS + 1))
    pdm_states = plan_for(scene).driven[None]
    scores = np.full(len(index), np.nan)

    def passes_replay(members: Ints) -> Bools:
        result = score(replay, np.concatenate([pdm_states, states[members]]), normalise="pairs")
        scores[members] = result.pdm_score[1:]
        return scores[members] >= settings.epdms_min

    rank = np.empty(len(walk_order), dtype=np.int64)
    rank[walk_order] = np.arange(len(walk_order))
    usable = np.flatnonzero((reached & black)[:n_gated])
    kept, needed = first_good_per_cell(cells, usable[np.argsort(rank[gated[usable]])], passes_replay)
    kept_starts, needed_starts = first_good_per_cell(cells, np.flatnonzero(reached & is_start), passes_replay)
    scores[np.setdiff1d(np.arange(len(index)), np.concatenate([needed, needed_starts]))] = np.nan
    counts["replay_score"] = int((scores[:n_gated] < settings.epdms_min).sum())

    fate = np.where(~reached, "reached_gate", np.where(~black, "white_cell", "not_needed")).astype(object)
    fate[np.isfinite(scores)] = "score"
    traffic_scene = prepare_traffic(scene, traffic)
    touched_from = start if traffic.leaves_out_touching else None
    proven: dict[int, Candidate] = {}

    def passes_reactive(member: int) -> bool:
        rollout = roll_out(traffic_scene, states[member].copy())
        pair = np.concatenate([pdm_states, rollout.ego_states[None]])
        reactive = score(with_objects(replay, rollout.agents, touched_from), pair, normalise="pairs")
        good = bool(reactive.pdm_score[1] >= settings.epdms_min)
        fate[member] = "kept" if good else "reactive"
        if good:
            proven[member] = Candidate(
                vocabulary_index=int(index[member]),
                end_pose=ends[member],
                cell=(int(cells[member, 0]), int(cells[member, 1])),
                score=float(scores[member]),
                reactive_score=float(reactive.pdm_score[1]),
                reactive_scores=reactive,
                rollout=rollout,
            )
        return good

    fate[kept] = fate[kept_starts] = "not_needed"
    at_most = len(index) if settings.at_most is None else settings.at_most
    chosen = list(islice(filter(passes_reactive, kept_starts.tolist()), at_most))
    at_most -= len(chosen)
    if settings.order == "spread":
        spread = spread_out(ends[kept, :2], lambda place: passes_reactive(int(kept[place])), at_most)
        chosen += kept[spread].tolist()
    else:
        chosen += islice(filter(passes_reactive, kept.tolist()), at_most)
    candidates = [proven[member] for member in chosen]
    counts["reactive_score"] = int((fate[:n_gated] == "reactive").sum())
    if len(starts):
        counts |= {f"start_{what}": int((fate[n_gated:] == what).sum()) for what in START_FATES}
    if not candidates:
        return Rejected("perturb", "no_good_candidate", ", ".join(f"{k} {v}" for k, v in counts.items()), counts)
    return Perturbation(tuple(candidates), counts, ConsideredTrajectories(index, ends, tuple(fate), scores))


def log_as_candidate(clip: Clip, traffic: TrafficSettings) -> Perturbation:
    """The log's own drive as the only candidate, among the traffic that answers to it; no score keeps it out."""
    scene, states = scene_of_clip(clip), clip.ego_states[NOW : NOW + HORIZON_STEPS + 1]
    pdm_states = plan_for(scene).driven[None]
    replay = prepare_scene(scene, scene.agents.window(NOW, NOW + HORIZON_STEPS + 1))
    rollout = roll_out(prepare_traffic(scene, traffic), states.copy())
    touched_from = scene.ego_state if traffic.leaves_out_touching else None
    pair = np.concatenate([pdm_states, states[None]])
    reactive = score(with_objects(replay, rollout.agents, touched_from), pair, normalise="pairs")
    logged = Candidate(
        vocabulary_index=OF_LOG,
        end_pose=np.zeros(3),
        cell=(0, 0),
        score=float(score(replay, pair, normalise="pairs").pdm_score[1]),
        reactive_score=float(reactive.pdm_score[1]),
        reactive_scores=reactive,
        rollout=rollout,
    )
    known = ConsideredTrajectories(np.array([OF_LOG]), np.zeros((1, 3)), ("kept",), np.array([logged.score]))
    return Perturbation((logged,), {}, known)


def end_speed_mps(candidate: Candidate) -> float:
    """Ego speed at T+H [m/s]."""
    return float(candidate.rollout.ego_states[-1, VX])
