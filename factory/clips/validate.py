"""The last look at a clip before anything is computed from it; every reader's clips pass here."""

import numpy as np

from factory.clips.reader import BadClip
from tasks.world.clip import CLIP_STEPS, Clip
from tasks.world.vehicle import EGO_STATE_SIZE


def validate_clip(clip: Clip, file: str) -> Clip:
    """The same clip. Raises BadClip naming `file` and the field that breaks a promise of the clip's types."""

    def require(holds: bool | np.bool_, field: str, problem: str) -> None:
        if not holds:
            raise BadClip(file, field, problem)

    require(clip.ego_states.shape == (CLIP_STEPS, EGO_STATE_SIZE), "ego_states", f"shape {clip.ego_states.shape}")
    require(np.isfinite(clip.ego_states).all(), "ego_states", "not finite")
    require(clip.world_from_ego.shape == (CLIP_STEPS, 4, 4), "world_from_ego", f"shape {clip.world_from_ego.shape}")
    require(np.isfinite(clip.world_from_ego).all(), "world_from_ego", "not finite")

    agents, n = clip.agents, len(clip.agents)
    for name, array, shape in (
        ("boxes", agents.boxes, (CLIP_STEPS, n, 5)),
        ("velocities", agents.velocities, (CLIP_STEPS, n, 2)),
        ("valid", agents.valid, (CLIP_STEPS, n)),
        ("center_z", agents.center_z, (CLIP_STEPS, n)),
        ("heights", agents.heights, (n,)),
    ):
        require(array.shape == shape, f"agents.{name}", f"shape {array.shape}, expected {shape}")
    require(len(agents.kinds) == n, "agents.kinds", "not one kind per track")
    require(len(set(agents.track_ids)) == n, "agents.track_ids", "a track id stands twice")
    for name in ("boxes", "velocities", "center_z"):
        require(np.isfinite(getattr(agents, name)[agents.valid]).all(), f"agents.{name}", "not finite where valid")
    require((agents.boxes[agents.valid][:, 3:] > 0.0).all(), "agents.boxes", "a length or width is not positive")

    require(any(lane.drives_cars for lane in clip.road_map.lanes.values()), "road_map.lanes", "no lane for cars")
    unknown = clip.route.lane_ids - clip.road_map.lanes.keys()
    require(bool(clip.route.lane_ids) and not unknown, "route.lane_ids", f"empty, or not on the map: {sorted(unknown)}")
    centerline = clip.centerline
    require(centerline.ndim == 2 and centerline.shape[0] >= 2 and centerline.shape[1] == 3, "centerline", "not (P, 3)")
    require(np.isfinite(centerline).all(), "centerline", "not finite")

    lights = clip.lights
    if lights.lane_ids:
        expected = (CLIP_STEPS, len(lights.lane_ids))
        require(lights.states.shape == expected, "lights.states", f"shape {lights.states.shape}, expected {expected}")
    known = {camera.name for camera in clip.cameras}
    strangers = {image.sensor for image in clip.images} - known
    require(not strangers, "images", f"no calibration of camera {sorted(strangers)}")
    return clip
