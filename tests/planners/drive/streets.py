"""The street of tests.tasks.streets to be driven along, and drivers that are no planners."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from factory.store.reader import Sample
from planners.drive.loop import LoopSettings
from planners.drive.starts import DriveStart, extend_clip, logged_start
from tasks.world.clip import CLIP_STEPS, HORIZON_STEPS, NOW, STEP_S, AgentKind, AgentTracks, Clip, Scene
from tasks.world.frames import HEADING, VX, to_world
from tests.tasks.streets import street_clip


@dataclass(frozen=True)
class Steady:
    """Straight on at one speed, `turn_rad` to the left of where the ego looks."""

    speed_mps: float
    turn_rad: float = 0.0
    needs_pictures: bool = False

    def plan(self, scene: Scene, look: Callable[[], Sample]) -> np.ndarray:
        along = self.speed_mps * STEP_S * np.arange(1, HORIZON_STEPS + 1)
        cos, sin = np.cos(self.turn_rad), np.sin(self.turn_rad)
        local = np.column_stack([cos * along, sin * along, np.full(HORIZON_STEPS, self.turn_rad)])
        return to_world(scene.ego_state[: HEADING + 1], local)


def car(x: float, speed_mps: float = 0.0, y: float = 0.0, name: str = "car") -> AgentTracks:
    """One vehicle of 4.6 m by 1.9 m that is at x, y at T and keeps its speed along the street."""
    time = (np.arange(CLIP_STEPS) - NOW)[:, None] * STEP_S
    boxes = np.zeros((CLIP_STEPS, 1, 5))
    boxes[..., 0], boxes[..., 1], boxes[..., 3:] = x + speed_mps * time, y, (4.6, 1.9)
    return AgentTracks(
        track_ids=(name,),
        kinds=(AgentKind.VEHICLE,),
        boxes=boxes,
        velocities=np.broadcast_to([speed_mps, 0.0], (CLIP_STEPS, 1, 2)).copy(),
        valid=np.ones((CLIP_STEPS, 1), bool),
        center_z=np.full((CLIP_STEPS, 1), 0.8),
        heights=np.array([1.6]),
    )


def nobody() -> AgentTracks:
    """No agents."""
    return replace(
        car(0.0),
        track_ids=(),
        kinds=(),
        boxes=np.zeros((CLIP_STEPS, 0, 5)),
        velocities=np.zeros((CLIP_STEPS, 0, 2)),
        valid=np.zeros((CLIP_STEPS, 0), bool),
        center_z=np.zeros((CLIP_STEPS, 0)),
        heights=np.zeros(0),
    )


def street_with(agents: AgentTracks, speed_mps: float = 8.0) -> Clip:
    """The street with these agents; the ego is at the origin at T."""
    clip = street_clip()
    states = clip.ego_states.copy()
    states[:, 0] *= speed_mps / states[0, VX]
    states[:, VX] = speed_mps
    return replace(clip, agents=agents, ego_states=states)


def start_on(clip: Clip, settings: LoopSettings) -> DriveStart:
    """From T of the clip."""
    return logged_start(extend_clip(clip, settings.clip_steps(NOW)))
