"""`python -m planners replay benchmark=<out> planner=<who> clip=0`: a clip as a film, from above and the front camera.

First the logged frame at T: 1.5 s of history, then the planner's plan driven for 4 s among traffic that answers to it.
Then the same from the follow-up that starts nearest to where the plan ended, or follow_up=<candidate>. The camera
stands still at now: that is the last picture the planner has seen when it plans.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from factory.config.arguments import command
from factory.config.compose import ConfigError, fill
from factory.store.reader import Sample, decode_stored_image
from factory.views.pictures import (
    EXPERT,
    LOGGED,
    PERTURBED,
    Boxes,
    DrawnPath,
    draw_bev,
    front_camera,
    letterboxed,
    map_shapes,
    write_mp4,
)
from planners.evaluation.benchmark_folder import BenchmarkFolder
from planners.evaluation.evaluate import check_needs
from planners.evaluation.frames import FrameKey, Pair
from planners.evaluation.planner_names import EvaluatedPlanner, compose_with_planner, find_planner
from planners.evaluation.planning import plan_samples
from planners.evaluation.scoring import ClipFrames, PreparedPair, Rules, prepare_clip, score_pair
from tasks.reward.aggregate import COLUMNS, FrameScores
from tasks.rollout.simulate import TrafficSettings, roll_out
from tasks.world.arrays import Array, Image
from tasks.world.clip import HISTORY_STEPS, HORIZON_STEPS, STEP_S, Rollout
from tasks.world.frames import HEADING, to_world

BEV_PX, CAMERA_PX = (560, 560), (720, 405)  # width, height
PAPER, INK = (246, 246, 243), (30, 30, 30)
HOLD = 10  # pictures that the end of a stage is shown for


@dataclass(frozen=True)
class ReplaySettings:
    """Everything on the command line of `planners replay`."""

    benchmark: str  # the folder that factory.run preset=hard_benchmark made
    out: str = "replay.mp4"
    planner: str = "pdm_closed"  # a training's folder, human, pdm_closed, constant_velocity, or my.module:MyPlanner
    clip: int | str = 0  # clip id or its beginning, or the clip's place
    follow_up: int | None = None  # a candidate; null: the one that starts nearest to where the plan ends
    two_stage_traffic: TrafficSettings = field(default_factory=TrafficSettings)


@dataclass(frozen=True)
class ReplayStage:
    """One frame, planned from and driven."""

    title: str
    sample: Sample
    pair: PreparedPair
    plan: Array  # (40, 3) world
    rollout: Rollout
    scores: FrameScores


def film_frames(shown: ReplayStage, logged: Array | None) -> Iterator[Image]:
    """Pictures (560, 1280, 3) RGB at 10 Hz, -1.5 .. 4 s; logged: (M, >= 3) what the human drove, world."""
    frame = shown.pair.now
    scene, drive = frame.scene, shown.rollout
    camera = front_camera(shown.sample)
    mine = [image for image in shown.sample["images"] or () if image["camera"] == camera and image["time_s"] < 0.1]
    pictures = sorted(mine, key=lambda image: float(image["time_s"]))  # of one camera up to now
    ways = [DrawnPath(drive.ego_states, PERTURBED, "drive"), DrawnPath(shown.plan, EXPERT, "plan", dashed=True)]
    ways += [] if logged is None else [DrawnPath(logged, LOGGED, "logged", dashed=True)]
    for row in range(-HISTORY_STEPS, HORIZON_STEPS + 1):
        step = scene.step + row
        ego = (scene.ego_history[HISTORY_STEPS + row] if row < 0 else drive.ego_states[row])[: HEADING + 1]
        agents = scene.agents.boxes[step] if row < 0 else drive.agents.boxes[row]
        shapes = map_shapes(scene.clip, min(step, scene.clip.agents.n_steps - 1))
        title = f"{shown.title}  t = {row * STEP_S:+.1f} s"
        bev = draw_bev(
            ego, shapes, Boxes(agents, drive.agents.kinds), ego, ways if row >= 0 else ways[2:], title, BEV_PX
        )
        seen = [image for image in pictures if image["time_s"] <= row * STEP_S + 1e-6] or pictures[:1]
        yield _sheet(bev, decode_stored_image(seen[-1]) if seen else None, camera, shown.scores)


def _sheet(bev: Image, picture: Image | None, camera: str | None, scores: FrameScores) -> Image:
    """The top-down view, the camera beside it, sub-scores below that."""
    sheet = np.full((BEV_PX[1], BEV_PX[0] + CAMERA_PX[0], 3), PAPER, np.uint8)
    sheet[:, : BEV_PX[0]] = bev
    left = BEV_PX[0]
    if picture is not None:
        sheet[: CAMERA_PX[1], left:] = letterboxed(picture, *CAMERA_PX)
    lines = [f"camera {camera}, up to now" if picture is not None else "no images"]
    lines += [f"{name.upper()} {_number(value)}" for name, value in zip(COLUMNS, scores.unfiltered)]
    for i, line in enumerate(lines):
        at = (
            (left + 12 + 140 * ((i - 1) % 5), CAMERA_PX[1] + 60 + 28 * ((i - 1) // 5))
            if i
            else (left + 12, CAMERA_PX[1] + 24)
        )
        cv2.putText(sheet, line, at, cv2.FONT_HERSHEY_SIMPLEX, 0.5, INK, 1, cv2.LINE_AA)
    return sheet


def _number(value: float) -> str:
    return "-" if np.isnan(value) else f"{value:.2f}"


def replay(
    benchmark: BenchmarkFolder, one: EvaluatedPlanner, clip_id: str, rules: Rules, follow_up: int | None = None
) -> Iterator[Image]:
    """Both stages of one clip, picture by picture. Raises ConfigError for a follow-up that the clip does not have."""
    prepared = prepare_clip(benchmark.scenes(clip_id), rules)
    plans = _plans(benchmark, one, prepared)
    stages = [_shown(benchmark, f"{one.label}, stage one", FrameKey.logged(clip_id), prepared.logged, plans)]
    chosen = _nearest(prepared, stages[0].plan) if follow_up is None else follow_up
    if chosen is not None and chosen not in prepared.follow_ups:
        raise ConfigError(f"follow_up={chosen}: clip {clip_id} has {sorted(prepared.follow_ups)}")
    keys = FrameKey.follow_up(clip_id, -1 if chosen is None else chosen)
    if chosen is not None and keys[0] in plans:
        title = f"{one.label}, follow-up {chosen}"
        stages.append(_shown(benchmark, title, keys, prepared.follow_ups[chosen], plans))
    clip = prepared.logged.now.scene.clip
    for shown in stages:
        last = None
        for last in film_frames(shown, clip.ego_states[shown.pair.now.scene.step :]):
            yield last
        if last is not None:
            yield from [last] * HOLD


def _plans(benchmark: BenchmarkFolder, one: EvaluatedPlanner, prepared: ClipFrames) -> Mapping[FrameKey, Array]:
    if one.privileged is not None:
        return one.privileged(prepared.frames)
    keys = [key for key in benchmark.keys if key.clip_id == prepared.clip_id]
    if one.submitted is not None:
        return one.plans_of(benchmark.tokens, keys)
    made = one.made()
    return dict(zip(keys, plan_samples(made, [benchmark.sample(key) for key in keys])))


def _shown(
    benchmark: BenchmarkFolder, title: str, keys: Pair[FrameKey], pair: PreparedPair, plans: Mapping[FrameKey, Array]
) -> ReplayStage:
    (scores, drive), _ = score_pair(pair, [plans[key] for key in keys])
    plan = to_world(pair.now.scene.ego_state[: HEADING + 1], plans[keys[0]])
    rollout = roll_out(pair.now.traffic, drive.states)
    return ReplayStage(title, benchmark.sample(keys[0]), pair, plan, rollout, scores)


def _nearest(prepared: ClipFrames, plan: Array) -> int | None:
    """The follow-up that weighs most for a plan (40, 3), world; None: the clip has none."""

    def away(candidate: int) -> float:
        start = prepared.follow_ups[candidate].now.scene.ego_state
        return float(np.hypot(*(start[:2] - plan[-1, :2])))

    return min(prepared.follow_ups, key=away, default=None)


def find_clip(benchmark: BenchmarkFolder, wanted: str) -> str:
    """The clip of that id, beginning of an id, or place. Raises ConfigError."""
    clips = list(dict.fromkeys(key.clip_id for key in benchmark.keys))
    if wanted.isdigit() and int(wanted) < len(clips):
        return clips[int(wanted)]
    found = [clip_id for clip_id in clips if clip_id.startswith(wanted)]
    if len(found) != 1:
        raise ConfigError(
            f"clip={wanted}: {len(found)} of {len(clips)} clips fit; give an id or a number below the count"
        )
    return found[0]


def settings_of(argv: Sequence[str]) -> ReplaySettings:
    """The settings of a command line. Raises ConfigError."""
    return fill(ReplaySettings, compose_with_planner("replay", argv, ReplaySettings), "replay")


@command("replay", ReplaySettings)
def main(argv: Sequence[str]) -> None:
    """The command."""
    settings = settings_of(argv)
    benchmark = BenchmarkFolder(settings.benchmark)
    one = find_planner(settings.planner)
    clip_id = find_clip(benchmark, str(settings.clip))
    check_needs(benchmark, [key for key in benchmark.keys if key.clip_id == clip_id], [one])
    rules = Rules(two_stage=settings.two_stage_traffic)
    write_mp4(Path(settings.out), replay(benchmark, one, clip_id, rules, settings.follow_up))
    print(f"look at {settings.out}")
