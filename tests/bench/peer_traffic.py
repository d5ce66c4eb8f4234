"""The public reactive traffic beside ours: `PYTHON tests/bench/peer_traffic.py IN.npz OUT.npz`.

Needs the public packages navsim and nuplan-devkit, nothing of this project: tests.bench.bench_traffic starts it. IN
holds crowds as tests/tasks/rollout/crowds.py writes them, each name with the crowd's number before it; OUT gets the
boxes (41, N, 5), velocities (41, N, 2) and presence (41, N) that `NavsimIDMTrafficAgents` answers with, and the CPU
seconds that took. Where it fails there is its assertion's
text in their place. Only the map is another: the few look-ups that the traffic makes are answered from IN's lanes.
"""

import sys
import time
from types import SimpleNamespace

import numpy as np
import shapely
from navsim.planning.simulation.observation.navsim_idm_agents import NavsimIDMAgents
from navsim.traffic_agents_policies import navsim_IDM_traffic_agents as public
from nuplan.common.actor_state.agent import Agent
from nuplan.common.actor_state.ego_state import EgoState
from nuplan.common.actor_state.oriented_box import OrientedBox
from nuplan.common.actor_state.scene_object import SceneObjectMetadata
from nuplan.common.actor_state.state_representation import StateSE2, StateVector2D, TimePoint
from nuplan.common.actor_state.tracked_objects import TrackedObjects
from nuplan.common.actor_state.tracked_objects_types import TrackedObjectType
from nuplan.common.actor_state.vehicle_parameters import get_pacifica_parameters
from nuplan.common.maps.maps_datatypes import SemanticMapLayer
from nuplan.common.maps.nuplan_map.polyline_map_object import NuPlanPolylineMapObject
from nuplan.planning.simulation.observation.observation_type import DetectionsTracks
from nuplan.planning.simulation.trajectory.trajectory_sampling import TrajectorySampling

SAMPLING = TrajectorySampling(num_poses=40, interval_length=0.1)
SETTINGS = {  # navsim/planning/script/config/common/traffic_agents_policy/navsim_IDM_traffic_agents.yaml
    "target_velocity": 10,
    "min_gap_to_lead_agent": 1.0,
    "headway_time": 1.5,
    "accel_max": 1.0,
    "decel_max": 2.0,
    "open_loop_detections_types": [],
    "minimum_path_length": 20,
    "planned_trajectory_samples": None,
    "planned_trajectory_sample_interval": None,
    "radius": 100,
    "add_open_loop_parked_vehicles": True,
    "idm_snap_threshold": 3.0,
}


class Line:
    """A row of the layer of baselines."""

    def __init__(self, fid, geometry):
        self.fid, self.geometry = fid, geometry

    def __getitem__(self, key):
        assert key == "fid"
        return self.fid


class Lanes:
    """The look-ups of the public traffic."""

    def __init__(self, arrays):
        rings, lines = (np.split(arrays[f"{name}_xy"], arrays[f"{name}_ends"][:-1]) for name in ("ring", "line"))
        self.polygons = np.array([shapely.Polygon(ring) for ring in rings])
        self.is_connector = arrays["is_connector"]
        self.segments = [
            SimpleNamespace(
                baseline_path=NuPlanPolylineMapObject(Line(str(i), shapely.LineString(line))),
                speed_limit_mps=None if np.isnan(limit) else float(limit),
            )
            for i, (line, limit) in enumerate(zip(lines, arrays["limits"]))
        ]

    def _holding(self, point, layer):
        of_layer = ~self.is_connector if layer is SemanticMapLayer.LANE else self.is_connector
        return np.flatnonzero(of_layer & shapely.contains(self.polygons, shapely.Point(point.x, point.y)))

    def is_in_layer(self, point, layer):
        return bool(len(self._holding(point, layer)))

    def get_all_map_objects(self, point, layer):
        return [self.segments[i] for i in self._holding(point, layer)]


def answer(arrays):
    """Boxes, velocities, presence and CPU seconds of one crowd."""
    now, states = arrays["now"], arrays["ego_states"]
    tokens = [f"{i:016x}" for i in range(len(now))]
    vehicles = [
        Agent(
            TrackedObjectType.VEHICLE,
            OrientedBox(StateSE2(*row[:3]), row[3], row[4], 1.5),
            StateVector2D(row[5], row[6]),
            SceneObjectMetadata(0, token, None, token),
        )
        for token, row in zip(tokens, now.tolist())
    ]
    ego = EgoState.build_from_rear_axle(
        StateSE2(*states[0, :3].tolist()), StateVector2D(float(states[0, 3]), 0.0), StateVector2D(0.0, 0.0), 0.0,
        TimePoint(0), get_pacifica_parameters(),
    )  # fmt: skip
    cache = SimpleNamespace(
        current_tracked_objects=[DetectionsTracks(TrackedObjects(vehicles))],
        future_tracked_objects=[DetectionsTracks(TrackedObjects([]))] * SAMPLING.num_poses,
        ego_state=ego,
        map_parameters=SimpleNamespace(map_root="", map_version="", map_name=""),
    )
    lanes = Lanes(arrays)
    public.get_maps_api = lambda *_: lanes
    policy = public.NavsimIDMTrafficAgents(SAMPLING, NavsimIDMAgents(**SETTINGS))
    began = time.process_time()
    try:
        found = policy.simulate_environment(states, cache)
    except AssertionError as error:  # a scene that counts as failed in the public evaluation
        return {"failed": np.array(str(error))}
    took = time.process_time() - began
    boxes, velocities = np.full((len(found), len(now), 5), np.nan), np.full((len(found), len(now), 2), np.nan)
    valid = np.zeros((len(found), len(now)), bool)
    for step, frame in enumerate(found):
        for thing in frame.tracked_objects:
            i = tokens.index(thing.track_token)
            at, box = thing.center, thing.box
            boxes[step, i], valid[step, i] = (at.x, at.y, at.heading, box.length, box.width), True
            velocities[step, i] = thing.velocity.x, thing.velocity.y
    return {"boxes": boxes, "velocities": velocities, "valid": valid, "seconds": np.array(took)}


def main(given, out):
    with np.load(given) as file:
        arrays = dict(file)
    answers = {}
    for number in sorted({name.split("/")[0] for name in arrays}, key=int):
        own = {name.split("/")[1]: values for name, values in arrays.items() if name.startswith(f"{number}/")}
        answers |= {f"{number}/{name}": values for name, values in answer(own).items()}
        print(number, "done", file=sys.stderr, flush=True)
    np.savez(out, **answers)


if __name__ == "__main__":
    main(*sys.argv[1:])
