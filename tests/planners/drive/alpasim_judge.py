"""Rollouts on the street of tests.tasks.streets with AlpaSim's columns, and plans with where its controller leads.

    git clone https://github.com/NVlabs/alpasim && cd alpasim && git checkout 9177bd0
    git show 6f1029c:src/eval/src/eval/scorers/ground_truth.py > october_ground_truth.py
    git show 6f1029c:src/eval/src/eval/aggregation/scene_score.py > october_scene_score.py
    pip install do_mpc==5.1.2 casadi==3.8.2
    python -m tests.planners.drive.alpasim_judge alpasim > tests/planners/drive/alpasim_judged.json

AlpaSim's scorers, aggregation and controllers run as they are; stand-ins here are its Rust trajectory (float32, as
there) and trajdata's map.
"""

import json
import sys
import types
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

N_ROLLOUTS, N_INSTANTS, N_OTHERS = 20, 9, 3
SIZES = [[5.176, 2.297], [4.6, 1.9], [4.6, 1.9], [0.7, 0.7]]  # m, the ego's first
COLUMNS = (
    *(f"collision_{how}" for how in ("front", "rear", "lateral", "any", "at_fault")),
    *("offroad", "offroad_or_collision", "offroad_or_collision_at_fault", "progress", "progress_rel_to_total"),
    *("dist_to_gt_trajectory", "lateral_dist_to_gt_trajectory", "left_corridor_laterally", "dist_to_gt_location"),
    *("dist_traveled_m", "gt_dist_traveled_m"),
)
JULY = ("wrong_lane", "min_distance_to_lane_boundary_m", "min_distance_to_obstacle_m", "progress_rel")
STAMPS_US = [0, *(17_000 + 500_000 * np.arange(N_INSTANTS - 1)).tolist()]


def rollouts() -> list[dict[str, Any]]:
    """Poses x, y [m], heading [rad] in 1/64: the ego (T, 3), others (T, N, 3), and the recording (R, 3)."""
    rng, made = np.random.default_rng(5), []
    time = np.array(STAMPS_US)[:, None] / 1e6
    recorded_us = [*STAMPS_US, 3_900_000]
    for _ in range(N_ROLLOUTS):
        speed, wanted = rng.uniform(2.0, 12.0, 2)
        side = rng.uniform(-1.5, 5.0)
        ego = np.concatenate([speed * time, side + time**2 * rng.normal(0.0, 0.3), 0.02 * time], axis=1)
        seconds = np.array(recorded_us)[:, None] / 1e6
        recorded = np.concatenate([wanted * seconds, seconds**2 * rng.normal(0.0, 0.15), 0.0 * seconds], axis=1)
        others = []
        for _ in range(N_OTHERS):
            start, moves = rng.uniform([-20.0, -6.0, -3.0], [40.0, 9.0, 3.0]), rng.normal(0.0, [5.0, 0.8, 0.1])
            others.append(start + time * moves)
        rounded = (np.round(64 * part) / 64 for part in (ego, np.stack(others, axis=1), recorded))
        made.append(dict(zip(("ego", "others", "recorded"), (part.tolist() for part in rounded))))
    return [one | {"recorded_us": recorded_us} for one in made]


class Pose:
    """A stand-in, on the plane."""

    def __init__(self, vec3: Any, quat: Any) -> None:
        self.vec3, self.quat = np.asarray(vec3, np.float32), np.asarray(quat, np.float32)

    def yaw(self) -> float:
        return float(2.0 * np.arctan2(self.quat[2], self.quat[3]))


class Trajectory:
    """A stand-in for utils_rs.Trajectory, on the plane."""

    def __init__(self, stamps: Any, positions: Any, quaternions: Any) -> None:
        self.timestamps_us = np.asarray(stamps, np.uint64)
        self.positions, self.quaternions = np.asarray(positions, np.float32), np.asarray(quaternions, np.float32)

    @property
    def yaws(self) -> Any:
        return 2.0 * np.arctan2(self.quaternions[:, 2], self.quaternions[:, 3])

    @property
    def time_range_us(self) -> range:
        return range(int(self.timestamps_us[0]), int(self.timestamps_us[-1]) + 1)

    def __len__(self) -> int:
        return len(self.timestamps_us)

    def is_empty(self) -> bool:
        return len(self) == 0

    def interpolate(self, stamps: Any) -> "Trajectory":
        def at(values: Any) -> Any:
            return np.interp(np.asarray(stamps, float), self.timestamps_us.astype(float), values)

        return of_poses(stamps, np.stack([*map(at, self.positions[:, :2].T), at(np.unwrap(self.yaws))], axis=1))

    def get_pose(self, index: int) -> Pose:
        return Pose(self.positions[index], self.quaternions[index])

    def interpolate_poses_list(self, stamps: Any) -> list[Pose]:
        found = self.interpolate(stamps)
        return [found.get_pose(index) for index in range(len(found))]


def of_poses(stamps: Any, poses: Any) -> Trajectory:
    """poses: (T, 3) x, y, heading."""
    x, y, yaw = np.asarray(poses, float).T
    nothing = np.zeros_like(x)
    quaternions = np.stack([nothing, nothing, np.sin(yaw / 2.0), np.cos(yaw / 2.0)], axis=1)
    return Trajectory(stamps, np.stack([x, y, nothing], axis=1), quaternions)


class StreetMap:
    """A stand-in for trajdata's VectorMap: it finds lanes and areas by the points they are drawn with."""

    def __init__(self) -> None:
        import shapely

        from tests.tasks.streets import street_clip

        road_map = street_clip().road_map
        self._lanes = []
        for lane in road_map.lanes.values():
            left, right = lane.ring[2:4][::-1], lane.ring[:2]
            edges = {
                f"{side}_edge": types.SimpleNamespace(points=edge) for side, edge in (("left", left), ("right", right))
            }
            self._lanes.append(types.SimpleNamespace(center=types.SimpleNamespace(points=lane.centerline), **edges))
        self._areas = {area.token: shapely.Polygon(area.ring) for area in road_map.drivable_areas}
        self.search_kdtrees = {"ROAD_LANE": None, "ROAD_AREA": None}

    def get_current_lane(self, xyzh: Any, max_dist: float, max_heading_error: float) -> list[Any]:
        def away(lane: Any) -> float:
            return float(np.hypot(*(lane.center.points[:, :2] - xyzh[:2]).T).min())

        return [lane for lane in self._lanes if away(lane) <= max_dist]

    def get_road_areas_within(self, xyz: Any, dist: float) -> list[Any]:
        import shapely

        near = [name for name, area in self._areas.items() if area.boundary.distance(shapely.Point(xyz[:2])) <= dist]
        return [types.SimpleNamespace(id=name) for name in near]

    def get_road_area_polygon_2d(self, name: str) -> Any:
        return self._areas[name]


def stand_in(name: str, **members: Any) -> None:
    """A module by that name."""
    module = types.ModuleType(name)
    module.__dict__.update({"__path__": [], **members})
    sys.modules[name] = module


def load(path: Path) -> Any:
    spec = spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def prepare(alpasim: Path) -> None:
    """Make `eval` importable."""
    from carla_driver_interface import protocol

    sys.path.insert(0, str(alpasim / "src/eval/src"))
    controller = alpasim / "src/controller/alpasim_controller"  # whose own __init__ wants CasADi
    stand_in("alpasim_controller", __path__=[str(controller)])
    stand_in("alpasim_controller.mpc_impl", __path__=[str(controller / "mpc_impl")])
    stand_in("utils_rs", Trajectory=Trajectory, Pose=Pose, DynamicTrajectory=None, Polyline=None)
    geometry = {"Trajectory": Trajectory, "Pose": Pose, "pose_from_grpc": None, "trajectory_from_grpc": None}
    stand_in("alpasim_utils", geometry=types.SimpleNamespace(**geometry))
    stand_in("alpasim_utils.geometry", **geometry)
    stand_in("alpasim_grpc")
    stand_in("alpasim_grpc.v0", common_pb2=protocol.common_pb2)
    stand_in("alpasim_grpc.v0.common_pb2", AABB=protocol.AABB)
    stand_in("alpasim_grpc.v0.egodriver_pb2", **vars(protocol.egodriver_pb2))
    stand_in("alpasim_grpc.v0.sensorsim_pb2", **vars(protocol.sensorsim_pb2))
    metadata = types.SimpleNamespace(SessionMetadata=types.SimpleNamespace)
    stand_in("alpasim_grpc.v0.logging_pb2", RolloutMetadata=metadata, ActorPoses=None, LogEntry=None)
    kinds = types.SimpleNamespace(ROAD_EDGE="ROAD_EDGE", ROAD_AREA="ROAD_AREA")
    elements = types.SimpleNamespace(MapElementType=kinds, RoadLane=None, RoadArea=None)
    stand_in("trajdata", maps=types.SimpleNamespace(VectorMap=StreetMap))
    stand_in("trajdata.maps", VectorMap=StreetMap, vec_map_elements=elements)
    stand_in("seaborn")
    stand_in("seaborn_polars")


def judged(alpasim: Path, october: bool) -> list[dict[str, Any]]:
    """AlpaSim's entries of results-summary.json."""
    import polars as pl
    from eval.aggregation import modifiers, processing
    from eval.data import ScenarioEvalInput, SimulationResult, create_metrics_dataframe
    from eval.schema import EvalConfig, MetricAggregationModifiersConfig, MetricVehicleConfig
    from eval.scorers.collision import CollisionScorer
    from eval.scorers.ground_truth import GroundTruthScorer
    from eval.scorers.min_distance_to_obstacle import MinDistanceToObstacleScorer
    from eval.scorers.offroad import OffRoadScorer

    truth: Any = GroundTruthScorer
    if october:
        truth = load(alpasim / "october_ground_truth.py").GroundTruthScorer
        processing.score_rollout = load(alpasim / "october_scene_score.py").score_rollout
    processing.plot_metrics_results = lambda *_: None
    limits = MetricAggregationModifiersConfig(max_dist_to_gt_trajectory=4.0)
    cfg = EvalConfig(vehicle=MetricVehicleConfig(0.5, 0.02), aggregation_modifiers=limits)
    frames = []
    for number, one in enumerate(rollouts()):
        poses = [one["ego"], *np.moveaxis(np.array(one["others"]), 1, 0).tolist()]
        names = ["EGO", *map(str, range(N_OTHERS))]
        actors = {n: (of_poses(STAMPS_US, p), (*size, 1.5)) for n, p, size in zip(names, poses, SIZES)}
        session = types.SimpleNamespace(start_timestamp_us=0, control_timestep_us=500_000)
        recorded = of_poses(one["recorded_us"], one["recorded"])
        given = ScenarioEvalInput(
            session,
            "run",
            "run",
            None,
            *SIZES[0],
            1.5,
            actors,
            recorded,
            None,
            StreetMap(),
            force_gt_duration_us=500_000,
        )
        result = SimulationResult.from_scenario_input(given, cfg)
        metrics = [
            m
            for kind in (CollisionScorer, OffRoadScorer, MinDistanceToObstacleScorer, truth)
            for m in kind(cfg).calculate(result)
        ]
        relevant = [float(stamp >= result.first_driven_timestamp_us) for stamp in STAMPS_US]
        flag = type(metrics[0])("eval_relevant", STAMPS_US, relevant, [True] * N_INSTANTS, metrics[0].time_aggregation)
        frames.append(create_metrics_dataframe([*metrics, flag], f"{number:02d}", "0", "run", "run"))
    cut = modifiers.RemoveTimestepsAfterEvent(pl.col("dist_to_gt_trajectory") >= 4.0)
    with TemporaryDirectory() as folder:
        processing.aggregate_and_write_metrics_results_txt(
            pl.concat(frames), output_path=folder, additional_modifiers=[cut]
        )
        entries: list[dict[str, Any]] = json.loads(Path(folder, "results-summary.json").read_text())["rollouts"]
    return entries


def followed() -> list[dict[str, Any]]:
    """Cars, plans at 0.1 s steps, and where AlpaSim's linear MPC and vehicle model lead in 0.5 s."""
    from alpasim_controller.mpc_impl.linear_mpc import LinearMPC

    rng, told, time = np.random.default_rng(2), [], 0.1 * np.arange(26)
    for speed in (0.0, 2.0, 4.5, 5.5, 9.0, 14.0):
        along = max(speed, 1.0) * time * rng.uniform(0.7, 1.2) + rng.normal(0.0, 0.5) * time**2
        bend = rng.normal(0.0, 0.01)
        told.append(_followed(LinearMPC(), speed, np.stack([along, bend * along**2 / 2.0, bend * along], axis=1), 5))
    return told


def followed_by_nonlinear() -> list[dict[str, Any]]:
    """The same of its nonlinear MPC, for up to 3 s: across 5 m/s, into a stop, and round bends up to its bounds."""
    from alpasim_controller.mpc_impl.nonlinear_mpc import NonlinearMPC

    told, time = [], 0.1 * np.arange(60)
    for speed, accel, bend, steps in (
        *((0.0, 1.5, 1e-9, 20), (2.0, 0.5, 0.02, 5), (4.5, 0.8, -0.01, 10), (5.5, -0.6, 0.03, 10), (9.0, 0.5, 0.01, 5)),
        *((14.0, -1.0, -0.004, 5), (6.0, -3.0, 1e-9, 30), (1.0, -0.5, 1e-9, 20), (7.0, 0.0, 0.05, 10)),
        *((4.0, 0.0, 0.125, 15), (3.0, 0.0, -0.2, 15), (11.0, -4.0, 0.002, 10)),
    ):
        driven = np.minimum(time, -speed / accel) if accel < 0.0 else time
        turned = bend * (speed * driven + accel / 2.0 * driven**2)
        plan = np.stack([np.sin(turned) / bend, (1.0 - np.cos(turned)) / bend, turned], axis=1)
        told.append(_followed(NonlinearMPC(), speed, plan, steps))
    return told


def _followed(controller: Any, speed: float, plan: Any, steps: int) -> dict[str, Any]:
    """plan: x, y, heading, the first where the car is."""
    from alpasim_controller.mpc_controller import ControllerInput
    from alpasim_controller.vehicle_model import VehicleModel

    from tasks.world.frames import to_local, to_world

    plan, pose, poses = np.round(64 * plan) / 64, np.zeros(3), []
    model = VehicleModel(np.array([speed, 0.0]), 0.02 * speed)
    car = model.state.tolist()
    for step in range(steps):
        model.reset_origin()
        reference = of_poses(100_000 * np.arange(len(plan)), to_local(pose, plan))
        asked = ControllerInput(model.state.copy(), reference, 100_000 * step)
        moved = model.advance(controller.compute_control(asked).control, 0.1)
        pose = to_world(pose, np.array([*moved.vec3[:2], moved.yaw()], float))
        poses.append(np.round(pose, 9).tolist())
    return {"car": car, "plan": plan[1:].tolist(), "poses": poses}


def main() -> None:
    alpasim = Path(sys.argv[1])
    prepare(alpasim)
    told = []
    sys.stdout, own = sys.stderr, sys.stdout
    july, october = judged(alpasim, october=False), judged(alpasim, october=True)
    sys.stdout = own
    for given, old, new in zip(rollouts(), july, october):
        columns = {name: round(new["metrics"][name], 9) for name in COLUMNS}
        columns |= {name: round(old["metrics"][name], 9) for name in JULY}
        told.append(given | {"columns": columns, "score": new["score"], "score_july": old["score"]})
    by_both = {"followed": followed(), "followed_by_nonlinear": followed_by_nonlinear()}
    print(json.dumps({"scored": told, **by_both}, separators=(",", ":")))


if __name__ == "__main__":
    main()
