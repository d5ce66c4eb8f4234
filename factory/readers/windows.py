"""Which windows of a log become clips, and why the others do not."""

import numpy as np

from factory.readers.settings import WindowSettings
from tasks.world.agents import AgentTracks
from tasks.world.arrays import Array, Bools
from tasks.world.clip import CLIP_STEPS, STEP_S
from tasks.world.vehicle import VX, VY, X, Y

EGO_STANDING, BROKEN_TRACKS = "ego_standing", "broken_tracks"  # reasons of the stage "clip"


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
