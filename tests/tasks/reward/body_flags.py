"""The flags of bodies at all instants, their lanes' included, as the kernels find them."""

import numpy as np

from tasks.kernels.compiled import kernel
from tasks.reward.areas import N_CORNERS, empty_places, is_off_lane, set_area_flags
from tasks.reward.centerline import LANES_KNOWN, NON_DRIVABLE, Body, empty_body, place_body
from tasks.reward.map_index import MapIndex
from tasks.world.frames import PACIFICA, Vehicle


def flags_along(index: MapIndex, states: np.ndarray, vehicle: Vehicle = PACIFICA) -> np.ndarray:
    """(K, T) flags of states (K, T, 11)."""
    body = empty_body(states.shape[0] * states.shape[1])
    place_body(states.reshape(-1, states.shape[2]), vehicle.rear_axle_to_center, body)
    _set_all(index, body, vehicle.half_length, vehicle.half_width)
    return body.flags.reshape(states.shape[:2]) & ~np.uint8(LANES_KNOWN)


@kernel
def _set_all(index: MapIndex, body: Body, half_length: float, half_width: float) -> None:
    places = empty_places(index, N_CORNERS * len(body.x))
    set_area_flags(index, body, half_length, half_width, places)
    for t in range(len(body.x)):
        said = body.flags[t] & NON_DRIVABLE
        body.flags[t] &= ~np.uint8(NON_DRIVABLE)  # which spares it a look at the lanes
        is_off_lane(index, body, t, half_length, half_width, places)
        body.flags[t] |= said
