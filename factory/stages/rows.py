"""A judged drive as a sample row (columns of factory.store.schema): the world in the frame of the ego at now."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import lru_cache, partial
from itertools import compress
from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

from factory.store.schema import AGENT_STEPS, MAP_RADIUS_M, NOW_INDEX
from tasks.attempt import Judged, off_log
from tasks.perturb import Candidate, end_speed_mps
from tasks.render.settings import ImageSource
from tasks.reward.epdms import Scores
from tasks.reward.label_bytes import VocabularyLabels, encode
from tasks.subscores import OF_ONE_PLAN, SUBSCORES
from tasks.world.arrays import Array, Bools
from tasks.world.clip import HORIZON_STEPS, NOW, STEP_S, AgentKind, AgentTracks, Clip, Scene
from tasks.world.frames import AX, AY, HEADING, VX, VY, points_to_local, pose_on_ground, to_local
from tasks.world.repair.records import repair_counts
from tasks.world.road_map import Lane, RoadMap, driving_command

NEAR_M = 30.0  # for the tags
NO_IMAGES: dict[str, object] = {"cameras": None, "images": None, "image_source": str(ImageSource.NONE)}


def sample_row(clip: Clip, candidate: Candidate | None, judged: Judged) -> dict[str, object]:
    """Everything of a sample but images, vocabulary labels and bookkeeping; candidate None: the human row.

    The label of a simulated row is the simulated drive, of the human row the log itself.
    """
    scene, pose = judged.scene, judged.scene.ego_state[: HEADING + 1]
    human = candidate is None
    label = judged.plan.poses if human else judged.rollout.ego_states[1:, : HEADING + 1]
    off = None if human else off_log(judged)
    command = driving_command(scene.centerline, pose)
    place = pose_on_ground(clip.world_from_ego, scene.ego_state[None])[0]
    return {
        **scene_columns(scene, scene.agents.overwritten(scene.step, judged.rollout.agents), place, command),
        "vocabulary_index": None if candidate is None else candidate.vocabulary_index,
        "parent_states": clip.ego_states[[NOW, NOW + HORIZON_STEPS]],
        "label_10hz": to_local(pose, label),
        "label_2hz": to_local(pose, label[4::5]),
        "proposal_10hz": None if human else to_local(pose, judged.plan.poses),
        "perturbed_states": None if candidate is None else candidate.rollout.ego_states,
        "candidate_end": None if candidate is None else np.append(candidate.end_pose, end_speed_mps(candidate)),
        "off_log_end": None if off is None else off[-1],
        "off_log_most": None if off is None else off.max(axis=0),
        **({} if candidate is None else score_columns("stage1", candidate.reactive_scores)),
        **score_columns("stage2", judged.scores),
    }


def scene_columns(scene: Scene, agents: AgentTracks, world_from_ego: Array, command: str) -> dict[str, object]:
    """What a row says of its scene, whoever drives on from it.

    agents: with those that drive by other tracks than the clip's; world_from_ego: (4, 4), of now.
    """
    clip, pose, history = scene.clip, scene.ego_state[: HEADING + 1], scene.ego_history[:, : HEADING + 1]
    return {
        "clip_id": clip.clip_id,
        "dataset": clip.dataset,
        "log_id": clip.log_id,
        "split": clip.split,
        "clip_start_s": clip.start_s,
        "now_s": scene.step * STEP_S,
        "content_digest": clip.content_digest,
        "licence": clip.licence,
        "frame_tokens": None if clip.frame_tokens is None else list(clip.frame_tokens),
        "repairs": [vars(count) for count in repair_counts(clip.repairs)],
        "now_pose": pose,
        "world_from_ego": world_from_ego,
        "ego_history_10hz": to_local(pose, history),
        "ego_history_2hz": to_local(pose, history[::5]),
        "ego_status": scene.ego_state[[VX, VY, AX, AY]],
        "command": command,
        **agent_columns(agents, scene.step, pose),
        **map_columns(scene, pose),
        "tags": scene_tags(scene, command),
    }


def label_columns(labels: VocabularyLabels) -> dict[str, object]:
    """The scores of a vocabulary from the sample's scene; factory.store.reader.labels_of reads them."""
    subscores, progress = encode(labels)
    return {
        "label_vocabulary": labels.vocabulary,
        "label_traffic": "replay",
        "label_reference_progress_m": labels.reference_progress_m,
        "label_subscores": subscores,
        "label_progress": progress,
    }


def score_columns(prefix: str, scores: Scores) -> dict[str, object]:
    """Of row 1: sub-scores, EPDMS (/14: there is no earlier plan to compare comfort with) and first failing times."""
    columns: dict[str, object] = {f"{prefix}_score": float(scores.pdm_score[1])}
    for name in SUBSCORES:
        columns[f"{prefix}_{name}"] = float(getattr(scores, name)[1]) if name in OF_ONE_PLAN else None
    for name, indices in scores.first_failures.items():
        index = float(indices[1])
        columns[f"{prefix}_{name}_fails_s"] = index * STEP_S if np.isfinite(index) else None
    return columns


def agent_columns(tracks: AgentTracks, now: int, pose: Array) -> Mapping[str, object]:
    """Tracks from 1.5 s before step `now` to 4 s after it, in the frame of `pose`; only those that are there."""
    window = tracks.window(now - NOW_INDEX, now - NOW_INDEX + AGENT_STEPS)
    seen = np.flatnonzero(window.valid.any(axis=0))
    boxes = window.boxes[:, seen].copy()
    boxes[..., :3] = to_local(pose, boxes[..., :3])
    absent = ~window.valid[:, seen]
    boxes[absent] = np.nan
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    velocity = window.velocities[:, seen] @ np.array([[cos, -sin], [sin, cos]])  # into the axes of the ego
    velocity[absent] = np.nan
    center_z = window.center_z[:, seen].copy()
    center_z[absent] = np.nan
    return {
        "agent_ids": [window.track_ids[i] for i in seen],
        "agent_kinds": [str(window.kinds[i]) for i in seen],
        "agent_boxes": boxes.transpose(1, 0, 2),
        "agent_velocities": velocity.transpose(1, 0, 2),
        "agent_valid": window.valid[:, seen].T,
        "agent_heights": window.heights[seen],
        "agent_center_z": center_z.T,
    }


class _Shapes(NamedTuple):
    """Of a map, as shapely has them."""

    lanes: list[Lane]  # that cars drive on
    centerlines: NDArray[np.object_]
    crossings: NDArray[np.object_]
    rings: NDArray[np.object_]  # of the drivable areas
    areas: NDArray[np.object_]


@lru_cache(maxsize=4)  # clips of one log share the map
def _shapes(road_map: RoadMap) -> _Shapes:
    def lines(of: Iterable[Array]) -> NDArray[np.object_]:
        return np.array([shapely.linestrings(line[:, :2]) for line in of], object)

    lanes = [lane for lane in road_map.lanes.values() if lane.drives_cars]
    centerlines, crossings = lines(lane.centerline for lane in lanes), lines(road_map.crossings)
    areas = np.array([shapely.polygons(ring[:, :2]) for ring in road_map.road_rings], object)
    return _Shapes(lanes, centerlines, crossings, lines(road_map.road_rings), areas)


def map_columns(scene: Scene, pose: Array) -> Mapping[str, object]:
    """What of the map is near, the lights of its lanes and the route, in the frame of `pose`."""
    road_map, clip = scene.clip.road_map, scene.clip
    shapes, x, y = _shapes(road_map), *pose[:2]

    def near(lines: NDArray[np.object_]) -> Bools:
        return np.asarray(shapely.dwithin(lines, shapely.Point(x, y), MAP_RADIUS_M), bool)

    lanes = list(compress(shapes.lanes, near(shapes.centerlines)))
    # A large drivable area may have no edge near the ego and hold it all the same.
    areas = compress(road_map.road_rings, near(shapes.rings) | shapely.contains_xy(shapes.areas, x, y))

    def local_rings(rings: Iterable[Array]) -> list[Array]:
        return _moved(partial(points_to_local, pose), [ring[:, :2] for ring in rings])

    shown = {lane.lane_id for lane in lanes}
    lights = [i for i, lane_id in enumerate(clip.lights.lane_ids) if lane_id in shown]
    steps = slice(scene.step - NOW_INDEX, scene.step - NOW_INDEX + AGENT_STEPS)
    return {
        "lane_ids": [lane.lane_id for lane in lanes],
        "lane_polygons": local_rings(lane.ring for lane in lanes),
        "lane_centerlines": _moved(partial(to_local, pose), [lane.centerline for lane in lanes]),
        "lane_is_intersection": [lane.is_intersection for lane in lanes],
        "drivable_rings": local_rings(areas),
        "crossing_rings": local_rings(compress(road_map.crossings, near(shapes.crossings))),
        "light_lane_ids": [clip.lights.lane_ids[i] for i in lights],
        "light_states": clip.lights.states[steps, lights].T if lights else np.zeros((0, AGENT_STEPS), np.int8),
        "map_location": road_map.location,
        "route_roadblock_ids": list(clip.route.roadblock_ids),
        "route_lane_ids": sorted(clip.route.lane_ids),
        "route_centerline": to_local(pose, scene.centerline),
    }


def _moved(move: Callable[[Array], Array], lines: Sequence[Array]) -> list[Array]:
    """Every one of the lines (P, C) moved, all in one call."""
    if not lines:
        return []
    return np.split(move(np.concatenate(lines)), np.cumsum([len(line) for line in lines])[:-1])


def scene_tags(scene: Scene, command: str) -> list[str]:
    """What is in the scene, for filters and weights."""
    pose, now = scene.ego_state[: HEADING + 1], scene.agents.window(scene.step, scene.step + 1)
    distance = np.where(now.valid[0], np.hypot(*(now.boxes[0, :, :2] - pose[:2]).T), np.inf)
    kinds = {now.kinds[i] for i in np.flatnonzero(distance < NEAR_M)}
    tags = {
        f"command_{command}": True,
        "near_pedestrian": AgentKind.PEDESTRIAN in kinds,
        "near_cyclist": AgentKind.BICYCLE in kinds,
        "slow": abs(float(scene.ego_state[VX])) < 2.0,
    }
    return [name for name, present in tags.items() if present]
