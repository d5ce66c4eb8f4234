"""The frames of a small benchmark, made of one street: logged frames and follow-ups of drives that went elsewhere."""

from dataclasses import replace

import numpy as np

from planners.frames import ClipScenes, FrameKey, FramePair
from tasks.attempt import perturbed_scene
from tasks.rollout.simulate import TrafficSettings, simulate
from tasks.world.clip import HISTORY_STEPS, NOW, STEP_S, Clip, Rollout, Scene, scene_of_clip
from tasks.world.vehicle import HEADING, VX, X
from tests.tasks.streets import street_clip

BEFORE_STEPS = 5
HORIZON = np.arange(1, 41) * STEP_S


def earlier(clip: Clip) -> Clip:
    """The street's clip 0.5 s before: everything drives at a steady speed."""
    states, agents = clip.ego_states.copy(), clip.agents
    states[:, X] -= BEFORE_STEPS * STEP_S * states[:, VX]
    boxes = agents.boxes.copy()
    boxes[..., :2] -= BEFORE_STEPS * STEP_S * agents.velocities
    return replace(clip, ego_states=states, agents=replace(agents, boxes=boxes))


def straight(speed_mps: float, aside_m: float = 0.0) -> np.ndarray:
    """(40, 3) a plan at a steady speed that ends `aside_m` to the left, ego frame."""
    share = HORIZON / HORIZON[-1]
    aside = aside_m * share**2 * (3.0 - 2.0 * share)
    along = speed_mps * HORIZON
    slope = np.gradient(aside, along) if speed_mps else np.zeros(40)
    return np.column_stack([along, aside, np.arctan(slope)])


def earlier_scene(clip: Clip, rollout: Rollout, scene: Scene) -> Scene:
    """The follow-up's world 0.5 s before."""
    row = len(rollout.ego_states) - 1 - BEFORE_STEPS
    past = rollout.agents.window(0, row + 1)
    return Scene(
        clip=clip,
        step=rollout.start_step + row,
        ego_history=rollout.ego_states[row - HISTORY_STEPS : row + 1],
        agents=clip.agents.overwritten(rollout.start_step, past),
        centerline=scene.centerline,
        ever_simulated=rollout.simulated,
    )


def clip_scenes(
    clip: Clip | None = None, drives: tuple[tuple[float, float], ...] = ((7.0, 0.0), (8.0, 0.5))
) -> ClipScenes:
    """Frames of a clip with a follow-up after each drive (speed [m/s], metres aside)."""
    clip = street_clip() if clip is None else clip
    logged = FramePair(scene_of_clip(clip), scene_of_clip(earlier(clip)))
    follow_ups = {}
    for i, (speed, aside) in enumerate(drives):
        rollout = simulate(logged.now, _in_world(clip, straight(speed, aside)), TrafficSettings())
        scene = perturbed_scene(clip, rollout)
        follow_ups[i] = FramePair(scene, earlier_scene(clip, rollout, scene))
    return ClipScenes(clip.clip_id, logged, follow_ups)


def _in_world(clip: Clip, poses: np.ndarray) -> np.ndarray:
    from tasks.world.frames import to_world

    return to_world(clip.ego_states[NOW, : HEADING + 1], poses)


def same_plan_everywhere(scenes: ClipScenes, poses: np.ndarray) -> dict[FrameKey, np.ndarray]:
    """One plan from every frame."""
    keys = [*FrameKey.logged(scenes.clip_id)]
    for i in scenes.follow_ups:
        keys += FrameKey.follow_up(scenes.clip_id, i)
    return dict.fromkeys(keys, poses)
