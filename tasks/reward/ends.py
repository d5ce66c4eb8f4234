"""Whether a drive's end leads on as the gate asks (docs/reward.md 2m)."""

import math

from tasks.reward.off_route import way_on_m
from tasks.reward.prepare import PreparedScene
from tasks.reward.second_after import BRAKING_MPS2, hit_after_s
from tasks.rollout.simulate import TrafficScene
from tasks.settings import ExpertGate
from tasks.stages import Rejected
from tasks.world.arrays import Array
from tasks.world.vehicle import HEADING


def end_fault(traffic: TrafficScene, prepared: PreparedScene, states: Array, gate: ExpertGate) -> Rejected | None:
    """None where a drive with states (41, 11) leads on; traffic: as it met it; prepared: the scene it was judged in."""
    clip = traffic.scene.clip
    if gate.off_route:
        metres = way_on_m(clip.road_map, clip.route, states[-1, : HEADING + 1])
        if metres is None:
            return Rejected("reward", "off_route", "ends on no lane of the route")
        if metres < math.inf:
            return Rejected("reward", "off_route", f"ends on a lane that leaves the route within {metres:.1f} m")
    if gate.after:
        going_on = hit_after_s(traffic, prepared, states)
        if going_on < math.inf:
            braking = hit_after_s(traffic, prepared, states, BRAKING_MPS2)
            if braking < math.inf:
                when = f"after {going_on:.1f} s, after {braking:.1f} s when it brakes"
                return Rejected("reward", "after", f"hits somebody {when}")
    return None
