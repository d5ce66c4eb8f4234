"""What a drive is measured by."""

from dataclasses import dataclass

import numpy as np

from planners.drive.drivers import DriveEnd
from planners.drive.loop import ClosedLoop
from tasks.reward.comfort import comfortable
from tasks.world.clip import STEP_S
from tasks.world.frames import X, Y


@dataclass(frozen=True)
class DriveMeasures:
    """Numbers of one drive."""

    duration_s: float
    distance_m: float  # that the rear axle moved
    progress_m: float  # gained along the route, 0 or more
    route_m: float  # from the start to where the road, or what is known of it, ends
    route_completed: float  # progress over route, 0 .. 1; 1 where there was no route to complete
    collision: bool  # with anything, whoever is to blame; it ends the drive
    at_fault_collision: bool
    off_road_s: float  # some corner of the body in no drivable area
    off_road_m: float  # driven meanwhile
    off_road_events: int  # how often it left the drivable area, counting a start outside of it
    comfortable: float  # share of the drive's instants within the six limits of history comfort, 0 .. 1

    @property
    def failures(self) -> int:
        """Collisions at fault and departures from the road."""
        return self.off_road_events + self.at_fault_collision


def measures_of(drive: ClosedLoop) -> DriveMeasures:
    """Comfort is judged with the start's own history, since its filters are as long as 1.5 s."""
    states, off = drive.ego_states, drive.off_road
    steps_m = np.hypot(*np.diff(states[:, [X, Y]], axis=0).T)
    progress_m = max(0.0, float(drive.along_m[-1] - drive.along_m[0]))
    route_m = drive.road.length_m
    history = drive.start.scene.ego_history
    within = comfortable(np.concatenate([history, states[1:]]))[len(history) - 1 :]
    return DriveMeasures(
        duration_s=drive.n_steps * STEP_S,
        distance_m=float(steps_m.sum()),
        progress_m=progress_m,
        route_m=route_m,
        route_completed=min(1.0, progress_m / route_m) if route_m > 0.0 else 1.0,
        collision=drive.ended is DriveEnd.COLLISION,
        at_fault_collision=drive.hit is not None and drive.hit.at_fault,
        off_road_s=float(off[1:].sum() * STEP_S),
        off_road_m=float(steps_m[off[1:]].sum()),
        off_road_events=int((off & ~np.append(False, off[:-1])).sum()),
        comfortable=float(within.mean()),
    )
