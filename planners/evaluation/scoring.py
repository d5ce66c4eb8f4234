"""Plans scored on frames as the public benchmark does it (docs/reward.md 1, 2 and 3).

A frame's plan is driven by the tracker, the traffic answers to it or replays its log, and the drive is scored in the
two-row batch [PDM-Closed, plan]: progress is relative to PDM-Closed among the traffic that answered to the plan. Where
the frame is a logged one, what the logged human gets 0 for, driven and scored alone among traffic of its own, is
forgiven. Extended comfort compares a plan with the one made 0.5 s before and belongs to both.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from planners.evaluation.frames import ClipScenes, FrameKey, FramePair, Pair
from planners.evaluation.score_rows import FrameRow, ScoreStage
from tasks.experts.pdm_closed import plan_for
from tasks.reward.aggregate import COLUMNS, FrameScores, follow_up_weights, frame_scores
from tasks.reward.comfort import extended_comfort
from tasks.reward.epdms import N_TIMES, PreparedScene, Scores, prepare_scene, score, select_rows, with_objects
from tasks.rollout.lqr import track
from tasks.rollout.simulate import TrafficScene, TrafficSettings, prepare_traffic, roll_out
from tasks.trajectories import at_ten_hz
from tasks.world.arrays import Array
from tasks.world.clip import HORIZON_STEPS, Scene
from tasks.world.frames import HEADING, to_local, to_world

INTERVAL_S = 0.5  # between the two frames of a pair
COARSE_STEP = 5  # planners answer at 2 Hz: the human is judged by as much of his drive


@dataclass(frozen=True)
class Rules:
    """What plans are driven among and measured by."""

    one_stage: TrafficSettings = field(default_factory=lambda: TrafficSettings(mode="replay"))
    two_stage: TrafficSettings = field(default_factory=TrafficSettings)


@dataclass(frozen=True)
class PreparedFrame:
    """All that a frame's score needs and no plan changes."""

    scene: Scene
    traffic: TrafficScene
    world: PreparedScene  # map, centreline, lights, history; its objects are set for every drive
    reference: Array  # (41, 11) PDM-Closed as the tracker drives it
    pdm_poses: Array  # (40, 3) what PDM-Closed wants, ego frame
    human_poses: Array | None  # (40, 3) the logged drive from 2 Hz poses, ego frame; None: nobody drove from here
    human: Scores | None  # one row: the logged drive scored alone; None: nothing is forgiven


PreparedPair = Pair[PreparedFrame]


@dataclass(frozen=True)
class ScoredDrive:
    """A plan, driven and scored."""

    states: Array  # (41, 11)
    scores: Scores  # one row


def prepare_frame(scene: Scene, traffic: TrafficSettings, logged: bool) -> PreparedFrame:
    """Everything of a frame that does not depend on a plan. logged: whether the scene is the log's own."""
    plan = plan_for(scene)
    now = scene.agents.window(scene.step, scene.step + N_TIMES)
    frame = PreparedFrame(
        scene=scene,
        traffic=prepare_traffic(scene, traffic),
        world=prepare_scene(scene, now),
        reference=plan.driven,
        pdm_poses=to_local(scene.ego_state[: HEADING + 1], plan.poses),
        human_poses=logged_poses(scene) if logged else None,
        human=None,
    )
    return _with_human(frame)


def logged_poses(scene: Scene) -> Array:
    """(40, 3) the logged drive of the next 4 s in the ego frame, known every 0.5 s and linear between."""
    first = scene.step + COARSE_STEP
    poses = scene.clip.ego_states[first : first + HORIZON_STEPS : COARSE_STEP, : HEADING + 1]
    return at_ten_hz(to_local(scene.ego_state[: HEADING + 1], poses)[None])[0]


def drive(frame: PreparedFrame, poses: Array) -> ScoredDrive:
    """Drive and score a plan (40, 3) at 0.1 .. 4.0 s in the frame's ego frame. Raises ValueError if not finite."""
    states, world = _driven(frame, poses)
    return ScoredDrive(
        states, select_rows(score(world, np.stack([frame.reference, states]), normalise="pairs"), slice(1, 2))
    )


def _driven(frame: PreparedFrame, poses: Array) -> tuple[Array, PreparedScene]:
    """States (41, 11), and the world with the traffic that answered to them."""
    ego = frame.scene.ego_state
    states = track(ego, to_world(ego[: HEADING + 1], poses)[None])[0]
    touched_from = ego if frame.traffic.settings.leaves_out_touching else None
    return states, with_objects(frame.world, roll_out(frame.traffic, states).agents, touched_from)


def _with_human(frame: PreparedFrame) -> PreparedFrame:
    if frame.human_poses is None:
        return frame
    states, world = _driven(frame, frame.human_poses)
    return replace(frame, human=score(world, states[None], with_history=False))


def score_pair(pair: PreparedPair, plans: Sequence[Array]) -> list[tuple[FrameScores, ScoredDrive]]:
    """COLUMNS of the plans (40, 3) made now and 0.5 s before, with the extended comfort that they share."""
    drives = [drive(frame, plan) for frame, plan in zip(pair, plans)]
    ec = float(extended_comfort(drives[0].states[None], drives[1].states[None], INTERVAL_S).ec[0])
    return [(frame_scores(d.scores, frame.human, ec), d) for d, frame in zip(drives, pair)]


@dataclass(frozen=True)
class ClipFrames:
    """All frames of a clip."""

    clip_id: str
    alone: PreparedPair  # the logged frames among the one-stage evaluation's traffic
    logged: PreparedPair  # the same among the two-stage evaluation's
    follow_ups: Mapping[int, PreparedPair]  # candidate index -> frames

    @property
    def frames(self) -> dict[FrameKey, PreparedFrame]:
        """Every frame that is planned from."""
        pairs = [(FrameKey.logged(self.clip_id), self.logged)]
        pairs += [(FrameKey.follow_up(self.clip_id, i), pair) for i, pair in self.follow_ups.items()]
        return {key: frame for keys, pair in pairs for key, frame in zip(keys, pair)}


@dataclass(frozen=True)
class LoneFrame:
    """A clip of a one-stage benchmark."""

    key: FrameKey
    frame: PreparedFrame

    @property
    def frames(self) -> dict[FrameKey, PreparedFrame]:
        """It alone."""
        return {self.key: self.frame}


def prepare_lone(clip_id: str, scene: Scene, rules: Rules) -> LoneFrame:
    """Everything of a logged frame that does not depend on a plan. Raises ValueError naming the clip."""
    try:
        return LoneFrame(FrameKey.logged(clip_id).now, prepare_frame(scene, rules.one_stage, logged=True))
    except ValueError as error:
        raise ValueError(f"clip {clip_id}: {error}") from error


def prepare_clip(scenes: ClipScenes, rules: Rules) -> ClipFrames:
    """Everything of a clip's frames that does not depend on a plan. Raises ValueError naming clip and frame."""

    def pair(frames: FramePair, logged: bool, name: str) -> PreparedPair:
        try:
            return PreparedPair(*(prepare_frame(scene, rules.two_stage, logged) for scene in frames))
        except ValueError as error:
            raise ValueError(f"clip {scenes.clip_id}, {name}: {error}") from error

    logged = pair(scenes.logged, True, "the logged frames")
    alone = logged
    if rules.one_stage != rules.two_stage:
        changed = (replace(f, traffic=prepare_traffic(f.scene, rules.one_stage), human=None) for f in logged)
        alone = PreparedPair(*map(_with_human, changed))
    follow_ups = {i: pair(frames, False, f"follow-up {i}") for i, frames in scenes.follow_ups.items()}
    return ClipFrames(scenes.clip_id, alone, logged, follow_ups)


Plans = Mapping[FrameKey, Array]  # frame -> (40, 3) in its ego frame


def human_plans(frames: Mapping[FrameKey, PreparedFrame]) -> dict[FrameKey, Array]:
    """The log's drive where there is one: nobody drove from a follow-up frame."""
    return {key: frame.human_poses for key, frame in frames.items() if frame.human_poses is not None}


def pdm_plans(frames: Mapping[FrameKey, PreparedFrame]) -> dict[FrameKey, Array]:
    """PDM-Closed's proposal from every frame."""
    return {key: frame.pdm_poses for key, frame in frames.items()}


def score_lone(lone: LoneFrame, plans: Plans, before: Array | None) -> tuple[FrameRow, Array]:
    """The row of a one-stage benchmark's frame, and the states (41, 11) that its plan was driven to.

    before: those of the same planner's plan 0.5 s before; None: there is no such frame, the row has no extended comfort
    and its score goes without (docs/reward.md 2k). Raises ValueError as `score_clip`.
    """
    poses, start = _checked(lone.key, plans), lone.frame.scene.ego_state[: HEADING + 1]
    driven = drive(lone.frame, poses)
    ec = np.nan if before is None else float(extended_comfort(driven.states[None], before[None], INTERVAL_S).ec[0])
    scores = frame_scores(driven.scores, lone.frame.human, ec)
    return FrameRow("one_stage", lone.key, scores, *_way(driven, start, poses)), driven.states


def score_clip(clip: ClipFrames, plans: Plans) -> list[FrameRow]:
    """One row a frame: one stage now, stage one now and before, stage two of every follow-up pair.

    A follow-up frame without a plan gets a row of NaN. Raises ValueError, naming the frame, for a logged frame
    without a plan and for plans that are not (40, 3) finite numbers.
    """
    logged = FrameKey.logged(clip.clip_id)
    one_stage = _pair_rows("one_stage", logged, clip.alone, plans)[:1]
    stage_one = _pair_rows("stage_one", logged, clip.logged, plans)
    follow_ups = [
        _pair_rows("stage_two", FrameKey.follow_up(clip.clip_id, i), pair, plans) for i, pair in clip.follow_ups.items()
    ]
    groups = [_weighted(group, row.end) for group, row in zip(zip(*follow_ups), stage_one)]  # now, before
    return [*one_stage, *stage_one, *(row for pair in zip(*groups) for row in pair)]


def _weighted(group: Sequence[FrameRow], end: Array) -> list[FrameRow]:
    """Follow-up rows with their weights for a plan of stage one that ends at a pose (3,)."""
    weights = follow_up_weights(end[:2], np.array([row.start[:2] for row in group]))
    return [replace(row, weight=float(weight)) for row, weight in zip(group, weights)]


def _pair_rows(stage: ScoreStage, keys: Pair[FrameKey], pair: PreparedPair, plans: Plans) -> list[FrameRow]:
    starts = [frame.scene.ego_state[: HEADING + 1] for frame in pair]
    if stage == "stage_two" and not any(key in plans for key in keys):
        nothing = np.full(len(COLUMNS), np.nan)
        blank = FrameRow(stage, keys[0], FrameScores(nothing, nothing), np.nan, starts[0], np.full(3, np.nan))
        return [replace(blank, key=key, start=start) for key, start in zip(keys, starts)]
    made = [_checked(key, plans) for key in keys]
    scored = score_pair(pair, made)
    return [
        FrameRow(stage, key, scores, *_way(driven, start, poses))
        for key, start, poses, (scores, driven) in zip(keys, starts, made, scored)
    ]


def _way(driven: ScoredDrive, start: Array, poses: Array) -> tuple[float, Array, Array]:
    """Progress [m], and where a plan (40, 3) from a pose (3,) starts and ends in the world."""
    return float(driven.scores.ep_raw_m[0]), start, to_world(start, poses[-1])


def _checked(key: FrameKey, plans: Plans) -> Array:
    if key not in plans:
        raise ValueError(f"{key}: no plan for this frame")
    poses = np.asarray(plans[key], dtype=np.float64)
    if poses.shape != (HORIZON_STEPS, 3) or not np.isfinite(poses).all():
        raise ValueError(f"{key}: a plan must be ({HORIZON_STEPS}, 3) finite numbers, got {poses.shape}")
    return poses
