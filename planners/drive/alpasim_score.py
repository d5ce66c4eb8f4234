"""A drive by AlpaSim's columns, and its scene score as its nuPlan track had it in July and has it since October 2026.

The rules are those of NVlabs/alpasim, src/eval/src/eval: 9177bd0 (July), and ground_truth.py and scene_score.py of
6f1029c (October). What is judged are the instants it logs: 17 ms before the first question, the first question, and
every 0.5 s from there. Bodies are boxes shrunk by 2 % with rounded corners. What comes before the car is the driver's
(1.0 s), after the first collision or departure from the road, or after 4 m to the recording, is cut off.

Ours: lanes within 6 m and areas within 15 m are found by their shapes, not by the points these are drawn with; a lane's
polygon is the map's; every map is judged by its areas, also one with road edges.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from hashlib import sha256
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from planners.drive.loop import FIRST_QUESTION_S, PLAN_STEPS, ClosedLoopDrive, first_pose
from tasks.world.arrays import Array, Bools, Ints
from tasks.world.clip import STEP_S
from tasks.world.frames import EGO_STATE_SIZE, HEADING, PACIFICA, box_corners, ego_boxes
from tasks.world.road_map import RoadMap

SHRUNK, ROUNDED = 0.98, 0.5  # of a side; of half the shorter one
CORNER = {"quad_segs": 16}  # of a circle, as AlpaSim has it by default
LANES_M, AREAS_M = 6.0, 15.0  # around the body's centre
CORRIDOR_M = 4.0  # from the recording
RELEVANT_FROM_US = 1_000_000  # after the first instant: the forced 0.5 s and a step
FULL_PROGRESS, SHORT_M = 0.8, 5.0  # of the recording; recordings so short need none
FAILURES = ("collision_at_fault", "offroad", "left_corridor_laterally")  # the last one since October
SETTLED = 2  # instants whose distances AlpaSim sets by hand
LAST = ("progress", "progress_rel_to_total", "dist_traveled_m")  # told by their last instant
LEAST = ("progress_rel", "min_distance_to_lane_boundary_m", "min_distance_to_obstacle_m")  # by the least, all else most
WRONG_LANE_RAD, BESIDE_M = 2.0 * math.pi / 3.0, 0.01  # to a lane's direction, which is taken from so far to both sides


@dataclass(frozen=True)
class LoggedRollout:
    """What AlpaSim would have logged of a drive: T instants, N others. Boxes: centre x, y, heading, length, width."""

    stamps_us: Ints  # (T,) increasing
    ego: Array  # (T, 5)
    others: Array  # (T, N, 5)
    present: Bools  # (T, N)
    recorded_us: Ints  # (R,) increasing, from the first instant to the last or beyond
    recorded: Array  # (R, 2) centre of the ego's body in the log [m]
    road_map: RoadMap


@dataclass(frozen=True)
class AlpasimColumns:
    """Of one drive, each over its instants that count: flags and distances by their maximum, progress by its last."""

    collision_front: float
    collision_rear: float
    collision_lateral: float
    collision_any: float
    collision_at_fault: float  # front or lateral
    offroad: float
    wrong_lane: float  # on a lane of the other direction; AlpaSim's, who wraps no angle: also where both look west
    offroad_or_collision: float
    offroad_or_collision_at_fault: float
    progress: float  # along the whole recording, 0 .. 1
    progress_rel_to_total: float  # along what of it was driven by the last instant; above 1 beyond it
    progress_rel: float  # along what of the recording was driven by the time
    min_distance_to_lane_boundary_m: float  # of all lanes nearby together; 0 outside of them
    min_distance_to_obstacle_m: float  # NaN: there was nobody
    dist_to_gt_trajectory: float  # m
    lateral_dist_to_gt_trajectory: float  # m; beyond the recording's end only across
    left_corridor_laterally: float
    dist_to_gt_location: float  # m from where the recording is at the time
    dist_traveled_m: float
    gt_dist_traveled_m: float  # of the whole recording
    score_july: float
    score: float  # October's


def logged_rollout(made: ClosedLoopDrive, seconds: float) -> LoggedRollout:
    """Of a drive along a recording that is `seconds` long, or ends with the log."""
    scene, at = made.start.scene, np.arange(0, made.n_steps + 1, PLAN_STEPS)
    logged = scene.clip.ego_states[scene.step - 1 :]
    log, driven = _from_first_pose(logged[:2], logged[1:]), _from_first_pose(scene.ego_history, made.ego_states[at])
    log_s = np.append(0.0, FIRST_QUESTION_S + STEP_S * np.arange(len(log) - 1))
    recorded_s = np.append(log_s[log_s < seconds], min(seconds, log_s[-1]))
    centres = ego_boxes(log, PACIFICA)
    return LoggedRollout(
        stamps_us=_microseconds(np.append(0.0, FIRST_QUESTION_S + STEP_S * at)),
        ego=ego_boxes(driven, PACIFICA),
        others=made.agents.boxes[[0, *at]],
        present=made.agents.valid[[0, *at]],
        recorded_us=_microseconds(recorded_s),
        recorded=np.stack([np.interp(recorded_s, log_s, centres[:, i]) for i in (0, 1)], axis=-1),
        road_map=scene.clip.road_map,
    )


def _from_first_pose(before: Array, states: Array) -> Array:
    """States (T + 1, 11) with the recording's first pose before them; before: (>= 2, 11) up to the first of them."""
    first = np.zeros((1, EGO_STATE_SIZE))
    first[0, : HEADING + 1] = first_pose(before)
    return np.concatenate([first, states])


def _microseconds(seconds: Array) -> Ints:
    return np.round(seconds * 1e6).astype(np.int64)


def score_drive(rollout: LoggedRollout) -> AlpasimColumns:
    """All columns. Raises ValueError for fewer instants than a step makes."""
    if len(rollout.stamps_us) <= SETTLED:
        raise ValueError(f"{len(rollout.stamps_us)} instants: AlpaSim's columns are of a step of 0.5 s at least")
    hit, road, along = collisions(rollout), on_the_road(rollout), along_the_recording(rollout)
    off, along["min_distance_to_obstacle_m"] = road["offroad"], hit.pop("min_distance_to_obstacle_m")
    along["min_distance_to_lane_boundary_m"] = road["min_distance_to_lane_boundary_m"]
    anywhere, at_fault = np.any(list(hit.values()), axis=0), hit["collision_front"] | hit["collision_lateral"]
    counts = counted(rollout.stamps_us, anywhere | off, along["dist_to_gt_trajectory"])
    flags = hit | {
        "collision_any": anywhere,
        "collision_at_fault": at_fault,
        "offroad": off,
        "wrong_lane": road["wrong_lane"],
        "offroad_or_collision": anywhere | off,
        "offroad_or_collision_at_fault": at_fault | off,
        "left_corridor_laterally": along["lateral_dist_to_gt_trajectory"] >= CORRIDOR_M,
    }
    found = {name: float(values[counts].max()) for name, values in flags.items()}
    found |= {name: _over_time(name, values[counts]) for name, values in along.items()}
    return AlpasimColumns(**found, score_july=scene_score(found, october=False), score=scene_score(found, october=True))


def _over_time(name: str, values: Array) -> float:
    if name in LAST:
        return float(values[-1])
    known = values[~np.isnan(values)]
    return math.nan if not len(known) else float(known.min() if name in LEAST else known.max())


def scene_score(columns: Mapping[str, float], october: bool) -> float:
    """0 for a failure, else progress up to 80 % of the recording; October's rule adds failures and rescales it."""
    if failure_reason(columns, october) is not None:
        return 0.0
    if columns["gt_dist_traveled_m"] < SHORT_M:
        return 1.0
    progress = columns["progress_rel_to_total" if october else "progress"]
    return min(min(max(progress, 0.0), 1.0) / FULL_PROGRESS, 1.0)


def failure_reason(columns: Mapping[str, float], october: bool = True) -> str | None:
    """The first column that makes the score 0; None: none does."""
    return next((name for name in FAILURES[: 3 if october else 2] if columns[name] != 0.0), None)


def counted(stamps_us: Ints, incident: Bools, distance_m: Array) -> Bools:
    """(T,) instants that count: from the driver's first on, up to the first incident and the first 4 m."""
    counts: Bools = stamps_us >= stamps_us[0] + RELEVANT_FROM_US
    if not counts.any():
        counts = np.ones(len(stamps_us), bool)
    for ends in (incident, distance_m >= CORRIDOR_M):
        first = np.flatnonzero(counts & ends)
        if len(first):
            counts = counts & (np.arange(len(counts)) <= first[0])
    return counts


# Bodies and collisions.


def bodies(boxes: Array) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Shapes (...,) of boxes (..., 5): the whole body, and its ends at the front and the rear bumper."""
    small = boxes.copy()
    small[..., 3:] *= SHRUNK
    radius = ROUNDED * small[..., 3:].min(axis=-1) / 2.0
    front_left, rear_left, rear_right, front_right = np.moveaxis(box_corners(small), -2, 0)
    whole = shapely.polygons(np.stack([front_left, front_right, rear_right, rear_left], axis=-2))
    whole = shapely.buffer(shapely.buffer(whole, -radius, **CORNER), radius, **CORNER)
    front = shapely.buffer(shapely.linestrings(np.stack([front_left, front_right], axis=-2)), radius, **CORNER)
    rear = shapely.buffer(shapely.linestrings(np.stack([rear_right, rear_left], axis=-2)), radius, **CORNER)
    return whole, shapely.intersection(front, whole), shapely.intersection(rear, whole)


def collisions(rollout: LoggedRollout) -> dict[str, Any]:
    """(T,) whether another body meets the ego's front, else its rear, else its sides; and how far the nearest is [m].

    Of several that touch it at once the tree's last is told, as AlpaSim does.
    """
    whole, front, rear = bodies(rollout.ego)
    found, nearest = np.zeros((3, len(whole)), bool), np.full(len(whole), np.nan)
    for t, present in enumerate(rollout.present):
        others = bodies(rollout.others[t][present])[0]
        nearest[t] = shapely.distance(whole[t], others).min() if len(others) else np.nan
        tree = shapely.STRtree([whole[t], *others])
        touching = [i for i in tree.query(whole[t], predicate="intersects") if i != 0]
        if touching:
            other = tree.geometries[touching[-1]]
            place = 0 if other.intersects(front[t]) else 1 if other.intersects(rear[t]) else 2
            found[place, t] = True
    flags = {f"collision_{where}": flags for where, flags in zip(("front", "rear", "lateral"), found)}
    return flags | {"min_distance_to_obstacle_m": nearest}


# The road.


@lru_cache(maxsize=4)
def _shapes(road_map: RoadMap) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Lanes that cars drive: centrelines and polygons; and the areas that may be driven on."""
    lanes = [lane for lane in road_map.lanes.values() if lane.drives_cars]
    areas = (*road_map.drivable_areas, *(road_map.intersections or ()))
    return (
        np.array([shapely.LineString(lane.centerline[:, :2]) for lane in lanes], object),
        shapely.make_valid(np.array([shapely.Polygon(lane.ring) for lane in lanes], object)),
        shapely.make_valid(np.array([shapely.Polygon(area.ring, area.holes) for area in areas], object)),
    )


def on_the_road(rollout: LoggedRollout) -> dict[str, Any]:
    """(T,) off the road: neither a lane nor the lanes nearby hold the body, and no areas nearby cover it; on a lane of
    the other direction; and how far the boundary of the lanes nearby is [m], 0 outside of them."""
    centerlines, lanes, areas = _shapes(rollout.road_map)
    (outside, wrong), gap = np.zeros((2, len(rollout.ego)), bool), np.zeros(len(rollout.ego))
    for t, body in enumerate(bodies(rollout.ego)[0]):
        centre = shapely.Point(rollout.ego[t, :2])
        close = shapely.dwithin(centerlines, centre, LANES_M)
        near, middle = lanes[close], body.centroid
        turned = _directions(centerlines[close][shapely.contains(near, middle)], middle) - rollout.ego[t, 2]
        wrong[t] = (np.abs(turned) > WRONG_LANE_RAD).any()
        together = shapely.union_all(near)
        if together.contains(body):
            gap[t] = body.distance(together.boundary)
        elif not shapely.contains(near, body).any():
            outside[t] = not shapely.union_all(areas[shapely.dwithin(areas, centre, AREAS_M)]).covers(body)
    return {"offroad": outside, "wrong_lane": wrong, "min_distance_to_lane_boundary_m": gap}


def _directions(lines: NDArray[Any], place: shapely.Point) -> Array:
    """(L,) of lines beside a place [rad]."""
    along = shapely.line_locate_point(lines, place)
    ahead = shapely.line_interpolate_point(lines, np.minimum(along + BESIDE_M, shapely.length(lines)))
    behind = shapely.line_interpolate_point(lines, np.maximum(along - BESIDE_M, 0.0))
    x, y = (shapely.get_coordinates(ahead) - shapely.get_coordinates(behind)).T
    return np.arctan2(y, x)


# Along the recording.


def along_the_recording(rollout: LoggedRollout) -> dict[str, Array]:
    """(T,) progress and distances; those of the first two instants are AlpaSim's own, as set there."""
    path, driven = shapely.LineString(rollout.recorded), shapely.LineString(rollout.ego[:, :2])
    centres, total = shapely.points(rollout.ego[:, :2]), path.length
    progress = shapely.line_locate_point(path, centres, normalized=True)
    progress[:SETTLED] = np.linspace(0.0, progress[SETTLED], SETTLED + 1)[:SETTLED]
    recorded = np.stack(
        [np.interp(rollout.stamps_us, rollout.recorded_us, rollout.recorded[:, i]) for i in (0, 1)], axis=-1
    )
    reached = path.project(shapely.Point(recorded[-1]))
    found = {
        "dist_to_gt_trajectory": shapely.distance(path, centres),
        "lateral_dist_to_gt_trajectory": _across(rollout.recorded, path, rollout.ego[:, :2]),
        "dist_to_gt_location": np.hypot(*(recorded - rollout.ego[:, :2]).T),
        "dist_traveled_m": shapely.line_locate_point(driven, centres),
    }
    for values in found.values():
        values[:SETTLED] = 0.0
    by_now = [shapely.LineString(recorded[: t + 1]) for t in range(SETTLED, len(recorded))]
    return found | {
        "progress": progress,
        "progress_rel": np.append(
            np.ones(SETTLED), shapely.line_locate_point(by_now, centres[SETTLED:], normalized=True)
        ),
        "progress_rel_to_total": progress * (total / reached if reached > 0.0 else 1.0),
        "gt_dist_traveled_m": np.full(len(progress), total),
    }


def _across(recorded: Array, path: shapely.LineString, places: Array) -> Array:
    """(T,) distance of places (T, 2) to the recording; beyond its end across its last direction alone."""
    points, last = shapely.points(places), recorded[-1] - recorded[-2]
    distance: Array = shapely.distance(path, points)
    length = math.hypot(*last)
    if length == 0.0:
        return distance
    beyond = shapely.line_locate_point(path, points) >= path.length - 1e-9
    x, y = (places - recorded[-1]).T
    return np.where(beyond, np.abs(x * last[1] - y * last[0]) / length, distance)


# The summary, in AlpaSim's form.


@dataclass(frozen=True)
class SummaryEntry:
    """A rollout in the summary; columns: None where it failed, and `error` says why."""

    run_name: str
    clipgt_id: str
    rollout_id: str
    columns: AlpasimColumns | None
    error: str | None = None


def results_summary(drives: Sequence[SummaryEntry]) -> str:
    """`results-summary.json` (processing.py of 6f1029c): a line a drive, and the means of each run of one planner."""
    payload = {
        "schema_version": 1,
        "scene_score_enabled": True,
        "rollouts": [_rollout_entry(drive) for drive in drives],
        "metrics_results": [_run_entry(name, drives) for name in dict.fromkeys(one.run_name for one in drives)],
        "score_criteria": {
            "progress_score": f"min(clamp(progress_clipped_rel, 0, 1) / {FULL_PROGRESS}, 1.0)",
            "short_gt_distance_override": f"progress_score = 1.0 when gt_dist_traveled_m < {SHORT_M}",
            **dict.fromkeys(FAILURES, "== 0"),
        },
    }
    return json.dumps(payload, indent=2, sort_keys=True, allow_nan=False)


def _metrics(columns: AlpasimColumns) -> dict[str, float]:
    """AlpaSim's own columns, by its names, as far as they are known."""
    told = asdict(columns).items()
    found = {name: value for name, value in told if not name.startswith("score") and not math.isnan(value)}
    return found | {"progress_clipped_rel": columns.progress_rel_to_total}


def _run_uuid(run_name: str) -> str:
    return sha256(run_name.encode()).hexdigest()


def _rollout_entry(drive: SummaryEntry) -> dict[str, Any]:
    names = {"run_name": drive.run_name, "clipgt_id": drive.clipgt_id, "rollout_id": drive.rollout_id}
    names["run_uuid"] = _run_uuid(drive.run_name)
    distances = ("dist_to_gt_trajectory", "lateral_dist_to_gt_trajectory", "gt_dist_traveled_m")
    told = ("progress_clipped_rel", *FAILURES, *distances)
    if drive.columns is None:
        nothing = dict.fromkeys(told) | {"progress_score": 0.0}
        entry = {"score": 0.0, "failure_reason": drive.error, "score_metrics": nothing}
        return names | entry | {"status": "fail", "passed": False, "metrics": names | {"error": drive.error}}
    metrics, reason = _metrics(drive.columns), failure_reason(asdict(drive.columns))
    never_failed = metrics | dict.fromkeys(FAILURES, 0.0)
    progress = {"progress_score": scene_score(never_failed, october=True)}
    return names | {
        "status": "pass" if reason is None else "fail",
        "passed": reason is None,
        "score": drive.columns.score,
        "failure_reason": reason,
        "score_metrics": {name: metrics[name] for name in told} | progress,
        "metrics": metrics | names,
    }


def _run_entry(name: str, drives: Sequence[SummaryEntry]) -> dict[str, Any]:
    """Means over a run's drives that did not fail, and km per incident; null where there was none."""
    made = [_metrics(one.columns) for one in drives if one.run_name == name and one.columns is not None]
    means: dict[str, float | None] = {
        key: float(np.mean([one[key] for one in made if key in one])) for key in set().union(*made)
    }
    km = sum(one["dist_traveled_m"] for one in made) / 1000.0
    for ending in ("", "_at_fault"):
        incidents = sum(one[f"offroad_or_collision{ending}"] for one in made)
        means[f"avg_dist_between_incidents{ending}"] = km / incidents if incidents else None
    return means | {"run_name": name, "run_uuid": _run_uuid(name), "n_clips": len(made), "n_rollouts": 1}
