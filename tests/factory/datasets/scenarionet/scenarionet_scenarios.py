"""Small scenarios as ScenarioNet's public converters write them: a street with a junction, in three dialects.

The street runs along x with two eastbound lanes (E1 the right one, E2) and one westbound (W1), 3.5 m wide, interrupted
by a junction at 100..120 m with connectors straight on (C...), to the left (CL) and to the right (CR). The ego follows
E2 with its rear axle at x = 20 + 8 t, y = -1.75.
"""

import pickle
from pathlib import Path

import numpy as np

N_FRAMES = 121
EGO_START, EGO_SPEED, EGO_Y = 20.0, 8.0, -1.75
REAR_AXLE_TO_CENTER = 1.461

STRAIGHT = {
    "E1": ((0, -5.25), (100, -5.25)),
    "E2": ((0, -1.75), (100, -1.75)),
    "W1": ((100, 1.75), (0, 1.75)),
    "E1b": ((120, -5.25), (320, -5.25)),
    "E2b": ((120, -1.75), (320, -1.75)),
    "W1b": ((320, 1.75), (120, 1.75)),
    "N": ((113, 12), (113, 60)),
    "S": ((107, -15), (107, -60)),
}
CONNECTORS = {
    "C1": ("E1", "E1b"),
    "C2": ("E2", "E2b"),
    "CW": ("W1b", "W1"),
    "CL": ("E2", "N"),
    "CR": ("E1", "S"),
}
INT_ID = {name: 100 + k for k, name in enumerate([*STRAIGHT, *CONNECTORS])}  # Waymo's lane ids are numbers


def _line(start, end, n=40):
    return np.linspace(start, end, n)


def centerline(name):
    """(P, 2) of any lane; connectors are quadratic Bezier curves."""
    if name in STRAIGHT:
        return _line(*STRAIGHT[name])
    before, after = (np.array(STRAIGHT[lane], float) for lane in CONNECTORS[name])
    start, end = before[1], after[0]
    direction = (before[1] - before[0]) / np.hypot(*(before[1] - before[0]))
    corner = start + direction * (direction @ (end - start))
    t = np.linspace(0, 1, 25)[:, None]
    return (1 - t) ** 2 * start + 2 * t * (1 - t) * corner + t**2 * end


def polygon(name, half=1.75):
    line = centerline(name)
    step = np.gradient(line, axis=0)
    left = np.stack([-step[:, 1], step[:, 0]], axis=1) / np.hypot(*step.T)[:, None]
    return np.concatenate([line + half * left, (line - half * left)[::-1]])


def _graph(name):
    exits = [c for c, (before, _) in CONNECTORS.items() if before == name]
    entries = [c for c, (_, after) in CONNECTORS.items() if after == name]
    if name in CONNECTORS:
        entries, exits = [CONNECTORS[name][0]], [CONNECTORS[name][1]]
    return entries, exits


def _track(kind, xy, heading=0.0, size=(4.5, 1.9, 1.6), valid=None, z=0.0):
    n = len(xy)
    valid = np.ones(n) if valid is None else np.asarray(valid, float)
    velocity = np.zeros((n, 2))
    velocity[:-1] = np.diff(xy, axis=0) / 0.1  # as the converters do: the last one stays 0
    position = np.column_stack([xy, np.full(n, z)])
    return {
        "type": kind,
        "state": {
            "position": position * valid[:, None],
            "heading": np.full(n, heading) * valid,
            "velocity": velocity * valid[:, None],
            "valid": valid,
            **{
                name: np.full((n, 1), value) * valid[:, None]
                for name, value in zip(("length", "width", "height"), size)
            },
        },
        "metadata": {"track_length": n, "type": kind, "object_id": "?"},
    }


def ego_xy(n=N_FRAMES):
    return np.column_stack([EGO_START + EGO_SPEED * 0.1 * np.arange(n), np.full(n, EGO_Y)])


def _tracks(sdc, ego, n):
    t = 0.1 * np.arange(n)
    seen = (np.arange(n) >= 20) & (np.arange(n) <= 60)
    return {
        sdc: _track("VEHICLE", ego, size=(4.08, 1.73, 1.56)),
        "lead": _track("VEHICLE", np.column_stack([60 + 9.0 * t, np.full(n, -5.25)]), z=0.8),
        "oncoming": _track("VEHICLE", np.column_stack([200 - 7.0 * t, np.full(n, 1.75)]), np.pi, valid=seen, z=0.8),
        "walker": _track(
            "PEDESTRIAN", np.column_stack([np.full(n, 50.0), 6 + 1.2 * t]), np.pi / 2, (0.6, 0.7, 1.8), z=0.9
        ),
        "rider": _track("CYCLIST", np.column_stack([30 + 4.0 * t, np.full(n, -6.5)]), size=(1.8, 0.6, 1.7), z=0.8),
        "cone": _track("TRAFFIC_CONE", np.tile([90.0, -8.0], (n, 1)), size=(0.4, 0.4, 0.7), z=0.35),
        "fence": _track("TRAFFIC_BARRIER", np.tile([95.0, -8.0], (n, 1)), size=(0.5, 2.0, 1.0), z=0.5),
    }


def _scenario(dataset, sdc, tracks, features, lights, n, **metadata):
    return {
        "id": "s",
        "version": "v",
        "length": n,
        "metadata": {
            "dataset": dataset,
            "sdc_id": sdc,
            "ts": np.arange(n) * 0.1,
            "coordinate": "right-handed",
            "map": "town",
            "metadrive_processed": False,
            **metadata,
        },
        "tracks": tracks,
        "map_features": features,
        "dynamic_map_states": lights,
    }


def nuscenes(n=N_FRAMES, ego=None, newer=False):
    """Polygon-less connectors; no graph in older files; ego = rear axle; the drivable surface's rings."""
    ego = ego_xy(n) if ego is None else ego
    features = {}
    for name in STRAIGHT:
        features[name] = {
            "type": "LANE_SURFACE_STREET",
            "polyline": [tuple(p) for p in centerline(name)],
            "polygon": [tuple(p) for p in polygon(name)],
        }
    for name in CONNECTORS:
        features[name] = {
            "type": "LANE_SURFACE_UNSTRUCTURE" if newer else "LANE_SURFACE_STREET",
            "polyline": [tuple(p) for p in centerline(name)],
            "speed_limit_kmh": 100,
        }
    if newer:
        for name in (*STRAIGHT, *CONNECTORS):
            features[name]["entry_lanes"], features[name]["exit_lanes"] = _graph(name)
            features[name]["left_neighbor"], features[name]["right_neighbor"] = [], []
    outer = [(0, -12), (320, -12), (320, 10), (0, 10), (0, -12)]
    island = [(150, 6), (160, 6), (160, 8), (150, 8), (150, 6)]
    for k, ring in enumerate((outer, island)):
        features[f"boundary_{k}"] = {"type": "ROAD_LINE_SOLID_SINGLE_WHITE", "polyline": np.array(ring, float)}
    features["divider"] = {"type": "ROAD_LINE_BROKEN_SINGLE_WHITE", "polyline": np.array([(0, -3.5), (100, -3.5)])}
    features["zebra"] = {"type": "CROSSWALK", "polygon": np.array([(98, -7), (100, -7), (100, 3.5), (98, 3.5)])}
    return _scenario("nuscenes", "ego", _tracks("ego", ego, n), features, {}, n)


def waymo(n=N_FRAMES, ego=None):
    """Centrelines only, `interpolating`, integer graph, neighbours as dicts, lights; ego = box centre; float32."""
    ego = (ego_xy(n) if ego is None else ego) + [REAR_AXLE_TO_CENTER, 0.0]
    beside = {"E1": ("E2", None), "E2": (None, "E1"), "E1b": ("E2b", None), "E2b": (None, "E1b")}
    features = {}
    for name in (*STRAIGHT, *CONNECTORS):
        entries, exits = _graph(name)
        line = np.column_stack([centerline(name), np.full(len(centerline(name)), 12.5)]).astype(np.float32)
        left, right = beside.get(name, (None, None))
        features[str(INT_ID[name])] = {
            "type": "LANE_SURFACE_STREET",
            "polyline": line,
            "interpolating": name in CONNECTORS,
            "speed_limit_mph": 30.0,
            "speed_limit_kmh": 30.0 * 1.609344,
            "entry_lanes": [INT_ID[e] for e in entries],
            "exit_lanes": [INT_ID[e] for e in exits],
            "left_boundaries": [],
            "right_boundaries": [],
            "left_neighbor": [_waymo_neighbour(left)] if left else [],
            "right_neighbor": [_waymo_neighbour(right)] if right else [],
            "width": np.zeros((len(line), 2), np.float32),
        }
    features["7"] = {"type": "LANE_BIKE_LANE", "polyline": np.array([(0, -8, 0), (100, -8, 0)], np.float32)}
    features["8"] = {"type": "ROAD_EDGE_BOUNDARY", "polyline": np.array([(0, -9, 0), (100, -9, 0)], np.float32)}
    features["9"] = {"type": "STOP_SIGN", "lane": [1], "position": np.zeros(3, np.float32)}
    tracks = _tracks("17", ego, n)
    tracks["17"]["state"]["position"][:, 2] = 1.56 / 2  # the centre of the ego's box
    for track in tracks.values():
        state = track["state"]
        state["position"][:, 2] += 12.5 * state["valid"]  # metres above the sea
        for name in ("length", "width", "height"):
            state[name] = state[name][:, 0]
        track["state"] = {k: v.astype(np.float32) for k, v in state.items()} | {"valid": state["valid"] > 0}
    phases = ["LANE_STATE_STOP"] * 50 + ["LANE_STATE_GO"] * (n - 51) + [None]
    lights = {
        str(INT_ID["C2"]): {
            "type": "TRAFFIC_LIGHT",
            "state": {"object_state": phases},
            "lane": INT_ID["C2"],
            "stop_point": np.zeros(3, np.float32),
            "metadata": {},
        }
    }
    return _scenario("waymo", "17", tracks, features, lights, n)


def _waymo_neighbour(name):
    return {
        "feature_id": str(INT_ID[name]),
        "self_start_index": "0",
        "self_end_index": "39",
        "neighbor_start_index": "0",
        "neighbor_end_index": "39",
        "boundaries": [],
    }


def nuplan(n=N_FRAMES, ego=None, newer=True):
    """Polygons everywhere; newer: graph, neighbours and LANE_SURFACE_UNSTRUCTURE; ego = box centre; no heights."""
    ego = (ego_xy(n) if ego is None else ego) + [REAR_AXLE_TO_CENTER, 0.0]
    sides = {"E1": (["E2"], []), "E2": ([], ["E1"]), "E1b": (["E2b"], []), "E2b": ([], ["E1b"])}
    features = {}
    for name in (*STRAIGHT, *CONNECTORS):
        features[name] = {
            "type": "LANE_SURFACE_UNSTRUCTURE" if newer and name in CONNECTORS else "LANE_SURFACE_STREET",
            "polyline": centerline(name),
            "polygon": polygon(name),
        }
        if newer:
            features[name]["entry_lanes"], features[name]["exit_lanes"] = _graph(name)
            features[name]["left_neighbor"], features[name]["right_neighbor"] = sides.get(name, ([], []))
    tracks = _tracks("ego", ego, n)
    for track in tracks.values():
        track["state"]["position"][:, 2] = 0.0
    lights = {
        "C2": {
            "type": "TRAFFIC_LIGHT",
            "state": {"object_state": ["TRAFFIC_LIGHT_GREEN"] * (n // 2) + ["TRAFFIC_LIGHT_RED"] * (n - n // 2)},
            "stop_point": [108.0, -1.75],
            "lane": "C2",
            "metadata": {},
        }
    }
    return _scenario("nuplan", "ego", tracks, features, lights, n, log_name="2021.01.01", sample_rate=0.1)


def save(scenario, folder: Path, name="sd_test_scene-0001.pkl") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / name
    path.write_bytes(pickle.dumps(scenario))
    return path
