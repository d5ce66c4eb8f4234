"""Which windows of a log become clips, and why the others do not."""

from dataclasses import dataclass

import numpy as np

from tasks.world.agents import AgentTracks
from tasks.world.arrays import Array, Bools
from tasks.world.clip import CLIP_STEPS, STEP_S
from tasks.world.vehicle import VX, VY, X, Y

EGO_STANDING, BROKEN_TRACKS = "ego_standing", "broken_tracks"  # reasons of the stage "clip"


@dataclass(frozen=True)
class WindowSettings:
    """What a window must be like."""

    stride_s: float = 1.0  # between the starts of two windows of one log
    min_top_speed_mps: float = 0.5  # an ego that never reaches it stands
    first: int = 0  # window of a log that is taken; those before it are skipped
    max_speed_mps: float = 100.0  # a track that moves faster between two steps has changed its object

    def __post_init__(self) -> None:
        """Raises ValueError where the stride is no positive multiple of 0.1 s, or the first window is none."""
        if self.stride_steps < 1 or abs(self.stride_steps * STEP_S - self.stride_s) > 1e-6:
            raise ValueError(f"stride_s must be a positive multiple of {STEP_S} s, not {self.stride_s}")
        if self.first < 0:
            raise ValueError(f"first_window must be 0 or more, not {self.first}")

    @property
    def stride_steps(self) -> int:
        """The stride in steps of 0.1 s."""
        return round(self.stride_s / STEP_S)

    @property
    def first_step(self) -> int:
        """Where the first window begins that is taken."""
        return self.first * self.stride_steps


def window_starts(n_steps: int, settings: WindowSettings) -> range:
    """First steps of the windows that fit into a log of n_steps steps of 0.1 s."""
    return range(settings.first_step, n_steps - CLIP_STEPS + 1, settings.stride_steps)


def drop_reason(
    ego_states: Array,
    agents: AgentTracks,
    observed: Bools,
    settings: WindowSettings,
) -> str | None:
    """Why the window with ego_states (96, 11), agents (96 steps) and observed (96,) is dropped; None keeps it.

    observed: False at steps for which the log has no annotated frame.
    """
    if np.hypot(ego_states[:, VX], ego_states[:, VY]).max() < settings.min_top_speed_mps:
        return EGO_STANDING
    longest_step = settings.max_speed_mps * STEP_S
    ego_steps = np.hypot(*np.diff(ego_states[:, [X, Y]], axis=0).T)
    agent_steps = np.hypot(*np.moveaxis(np.diff(agents.boxes[..., :2], axis=0), -1, 0))  # NaN next to absent steps
    if not observed.all() or (ego_steps > longest_step).any() or (agent_steps > longest_step).any():
        return BROKEN_TRACKS
    return None
