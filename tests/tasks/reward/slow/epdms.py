"""The slow, obvious twin of the reward: numpy and shapely, one rule after the other (docs/reward.md 2)."""

import numpy as np
from numpy.typing import NDArray

from tasks.reward.epdms import Normalise, Scores, relative_progress
from tasks.world.frames import ego_boxes
from tests.tasks.reward.slow.areas import ego_areas
from tests.tasks.reward.slow.collisions import no_at_fault_collision, time_to_collision, traffic_light_compliance
from tests.tasks.reward.slow.comfort import history_comfort
from tests.tasks.reward.slow.prepare import PreparedScene
from tests.tasks.reward.slow.progress import driving_direction_compliance, first_true, lane_keeping, progress_along

Array = NDArray[np.float64]


def score(
    prepared: PreparedScene, states: Array, *, normalise: Normalise = "batch", with_history: bool = True
) -> Scores:
    """Score simulated ego states (K, 41, 11).

    normalise: "batch" relates progress to the best compliant progress of all rows, as the public scorer does with its
    batch; "pairs" scores each row as if in a two-row batch with row 0 (its reference, usually PDM-Closed), and row 0
    as if alone. with_history=False leaves history comfort at 1, as the public passes over the human and PDM-Closed do.
    """
    raw = _rules(prepared, states, with_history)
    multiplier = np.prod([raw[name] for name in ("nc", "dac", "tlc", "ddc")], axis=0)
    ep = relative_progress(raw["ep_raw_m"], multiplier, normalise == "pairs")
    weighted = (5.0 * ep + 5.0 * raw["ttc"] + 2.0 * raw["lk"] + 2.0 * raw["hc"]) / 14.0
    return Scores(ep=ep, multiplier=multiplier, pdm_score=multiplier * weighted, **raw)


def _rules(prepared: PreparedScene, states: Array, with_history: bool) -> dict[str, NDArray[np.generic]]:
    """Everything in Scores that does not depend on the other rows."""
    boxes = ego_boxes(states, prepared.vehicle)
    areas = ego_areas(prepared.regions, states, boxes)
    nc, collision_index = no_at_fault_collision(prepared.obstacles, states, boxes, areas)
    tlc, tlc_index = traffic_light_compliance(prepared.red_lanes, boxes)
    ddc, ddc_index = driving_direction_compliance(boxes, areas)
    ttc, ttc_index = time_to_collision(prepared.obstacles, states, boxes, areas)
    lk, lk_index = lane_keeping(prepared.centerline, boxes, areas)
    hc, comfort, hc_index = history_comfort(prepared.history if with_history else None, states, prepared.vehicle)
    return {
        "nc": nc,
        "dac": np.where(areas.non_drivable.any(axis=1), 0.0, 1.0),
        "ddc": ddc,
        "tlc": tlc,
        "ttc": ttc,
        "lk": lk,
        "hc": hc,
        "ep_raw_m": progress_along(prepared.centerline, boxes),
        "collision_index": collision_index,
        "dac_index": first_true(areas.non_drivable),
        "ddc_index": ddc_index,
        "tlc_index": tlc_index,
        "ttc_index": ttc_index,
        "lk_index": lk_index,
        "hc_index": hc_index,
        "comfort": comfort,
    }
