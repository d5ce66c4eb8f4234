"""The public metric beside ours: `PYTHON tests/bench/peer_navsim.py FOLDER`, with an environment's PYTHON that has it.

Needs numpy and the public packages navsim and nuplan-devkit, nothing of this project: tests.bench.peer starts it, puts
the scene into FOLDER/scene.npz and then asks for one run after another, a line each on standard input. A run drives and
scores all trajectories once; the answer is a line with the CPU seconds that took. The first run leaves the scores in
FOLDER/scores.npz. What is made once per scene (map, occupancy maps of all instants, centreline) is not in the time.
"""

import os
import sys
import time
from pathlib import Path

import numpy as np
from navsim.planning.simulation.planner.pdm_planner.observation.pdm_observation import PDMObservation
from navsim.planning.simulation.planner.pdm_planner.observation.pdm_occupancy_map import PDMDrivableMap
from navsim.planning.simulation.planner.pdm_planner.scoring.pdm_scorer import PDMScorer
from navsim.planning.simulation.planner.pdm_planner.simulation.pdm_simulator import PDMSimulator
from navsim.planning.simulation.planner.pdm_planner.utils.pdm_path import PDMPath
from nuplan.common.actor_state.agent import Agent
from nuplan.common.actor_state.ego_state import EgoState
from nuplan.common.actor_state.oriented_box import OrientedBox
from nuplan.common.actor_state.scene_object import SceneObjectMetadata
from nuplan.common.actor_state.state_representation import StateSE2, StateVector2D, TimePoint
from nuplan.common.actor_state.static_object import StaticObject
from nuplan.common.actor_state.tracked_objects import TrackedObjects
from nuplan.common.actor_state.tracked_objects_types import AGENT_TYPES, TrackedObjectType
from nuplan.common.actor_state.vehicle_parameters import get_pacifica_parameters
from nuplan.common.maps.maps_datatypes import SemanticMapLayer
from nuplan.planning.simulation.observation.observation_type import DetectionsTracks
from nuplan.planning.simulation.trajectory.interpolated_trajectory import InterpolatedTrajectory
from nuplan.planning.simulation.trajectory.trajectory_sampling import TrajectorySampling
from shapely import Polygon

SAMPLING = TrajectorySampling(num_poses=40, interval_length=0.1)
NOW_US, PAST_US = 1_500_000, 500_000  # the clock stands at 0 where the history begins; a past state every half second


def ego_state(row, time_us):
    """One of our state rows (11,) as the public ego state."""
    return EgoState.build_from_rear_axle(
        StateSE2(*row[:3]),
        rear_axle_velocity_2d=StateVector2D(*row[3:5]),
        rear_axle_acceleration_2d=StateVector2D(*row[5:7]),
        tire_steering_angle=row[7],
        time_point=TimePoint(int(time_us)),
        vehicle_parameters=get_pacifica_parameters(),
        tire_steering_rate=row[8],
        angular_vel=row[9],
        angular_accel=row[10],
    )


def tracked(token, kind, box, velocity):
    """One object at one instant; box: centre x, y, heading, length, width."""
    metadata = SceneObjectMetadata(timestamp_us=0, token=token, track_id=None, track_token=token)
    body = OrientedBox(StateSE2(*box[:3]), length=box[3], width=box[4], height=1.5)
    if kind in AGENT_TYPES:
        return Agent(kind, body, StateVector2D(*velocity), metadata)
    return StaticObject(kind, body, metadata)


def observation_of(scene):
    """The 41 occupancy maps."""
    kinds = [TrackedObjectType[kind.upper()] for kind in scene["kinds"]]
    tokens = [str(token) for token in scene["object_tokens"]]
    frames = [
        [tracked(tokens[i], kinds[i], scene["boxes"][t, i], scene["velocities"][t, i]) for i in np.flatnonzero(there)]
        for t, there in enumerate(scene["valid"])
    ]
    observation = PDMObservation(
        SAMPLING, SAMPLING, map_radius=100, observation_sample_res=1, extend_observation_for_ttc=False
    )
    tracks = [DetectionsTracks(TrackedObjects(frame)) for frame in frames]
    observation.update_detections_tracks(tracks, [[] for _ in tracks], {}, compute_traffic_light_data=True)
    return observation


def drivable_map(scene):
    """The polygons around the ego; the first ring of each is its outline, others are holes."""
    rings = np.split(scene["ring_points"], scene["ring_ends"][:-1])
    shapes = [[] for _ in scene["layers"]]
    for owner, ring in zip(scene["ring_owners"], rings):
        shapes[owner].append(ring)
    polygons = np.array([Polygon(outline, holes) for outline, *holes in shapes], dtype=object)
    layers = [SemanticMapLayer[layer] for layer in scene["layers"]]
    return PDMDrivableMap([str(token) for token in scene["polygon_tokens"]], layers, polygons)


def main(folder):
    """Answers line by line until the input ends."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # whatever the packages print
    with np.load(folder / "scene.npz") as arrays:
        scene = dict(arrays)
    past = [ego_state(row, i * PAST_US) for i, row in enumerate(scene["past_states"])]
    start = ego_state(scene["ego_state0"], NOW_US)
    given = {
        "observation": observation_of(scene),
        "centerline": PDMPath([StateSE2(*pose) for pose in scene["centerline"]]),
        "route_lane_ids": [str(lane) for lane in scene["route_lane_ids"]],
        "drivable_area_map": drivable_map(scene),
        "human_past_trajectory": InterpolatedTrajectory(past),
    }
    states = np.zeros((len(scene["poses"]), 41, 11))
    states[:, 0], states[:, 1:, :3] = scene["ego_state0"], scene["poses"]
    simulator, scorer = PDMSimulator(SAMPLING), PDMScorer(SAMPLING)
    print("ready", file=answers, flush=True)
    for turn, _ in enumerate(sys.stdin):
        begun = time.process_time()
        results = scorer.score_proposals(simulator.simulate_proposals(states, start), **given)
        cpu_s = time.process_time() - begun
        if turn == 0:
            columns = [name for name in results[0].columns if isinstance(results[0][name][0], float)]
            np.savez(folder / "scores.npz", **{name: [row[name][0] for row in results] for name in columns})
        print(cpu_s, file=answers, flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
