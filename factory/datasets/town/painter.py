"""The synthetic town as its painter shows it, from wherever a simulation has come to: pictures without a scene.

A log of the town is planned again from its name, as it was when it was written; who is painted is who the simulation
has there, each as the log's own figure. The town's lights go on beyond the log.
"""

import re
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np

from factory.datasets.town.draw import Theatre, build_rig, paint, world_from_ego
from factory.datasets.town.drive import TownDrive, TownTrack
from factory.datasets.town.settings import TownSettings
from factory.datasets.town.town import Town, log_name, plan_log
from tasks.world.arrays import Array, Bytes
from tasks.world.clip import STEP_S, AgentTracks, Camera, Clip
from tasks.world.frames import HEADING, X, Y
from tasks.world.road_map import TrafficLights

_LOG = re.compile(r"town-(\d+)-(\d{4})-")  # log_name


def town_log(log_id: str) -> tuple[int, int]:
    """Seed and number of a town's log. Raises ValueError for the log of another data set."""
    found = _LOG.match(log_id)
    if found is None or log_name(int(found[1]), int(found[2])) != log_id:
        raise ValueError(f"log {log_id} is not of the synthetic town: there is no painter of it")
    return int(found[1]), int(found[2])


class TownPainter:
    """The painter of the synthetic town (factory.readers.base.Painter). Raises ValueError for a clip of no town."""

    def rig(self, clip: Clip, width: int, height: int) -> tuple[Camera, ...]:
        """The clip's cameras, or the town's usual ones where it has none."""
        return clip.cameras or build_rig(TownSettings().cameras, width, height)

    def lights(self, clip: Clip, n_steps: int) -> TrafficLights:
        """The clip's lights over `n_steps` steps from its first one, beyond the log too."""
        town, drive = _planned(*town_log(clip.log_id))
        times_s = _time_of(drive, clip, np.arange(n_steps))
        groups = [town.streets.lanes[int(lane_id)].light_group for lane_id in clip.lights.lane_ids]
        states = [[drive.signals.state(group, float(time_s)) for group in groups] for time_s in times_s]
        return replace(clip.lights, states=np.array(states, np.int8).reshape(n_steps, len(groups)))

    def pictures(
        self, clip: Clip, cameras: Sequence[Camera], agents: AgentTracks, step: int, state: Array
    ) -> tuple[Array, list[Bytes]]:
        """The pose (4, 4) of an ego in a state (11,), and what each camera sees from there at a step of the clip."""
        log = town_log(clip.log_id)
        _, drive = _planned(*log)
        time_s = float(_time_of(drive, clip, np.array([step]))[0])
        lit = _theatre(*log).among(_tracks(drive, agents), step, state[[X, Y]], time_s)
        pose = world_from_ego(state[: HEADING + 1])
        return pose, [paint(lit, camera, pose) for camera in cameras]


def _tracks(drive: TownDrive, agents: AgentTracks) -> list[TownTrack]:
    """The log's figures where the simulation has them."""
    figures = {track.track_id: track for track in drive.tracks}
    poses = np.where(agents.valid[..., None], agents.boxes[..., :3], np.nan)
    return [replace(figures[name], poses=poses[:, i]) for i, name in enumerate(agents.track_ids)]


def _time_of(drive: TownDrive, clip: Clip, steps: np.ndarray) -> np.ndarray:
    """Times of the town's clock at steps of a clip."""
    return float(drive.times_s[0]) + clip.start_s + steps * STEP_S


@lru_cache(maxsize=4)
def _planned(seed: int, number: int) -> tuple[Town, TownDrive]:
    return plan_log(seed, number)


@lru_cache(maxsize=1)
def _theatre(seed: int, number: int) -> Theatre:
    """Hundreds of megabytes, and seconds to build: pictures of one log come one after the other."""
    town, drive = _planned(seed, number)
    return Theatre(town.scenery, drive, town.sun_azimuth, town.sun_elevation, town.sky_seed)
