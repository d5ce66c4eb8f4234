"""Pictures of clips and attempts: who was where, what was tried, what the expert drove."""

from collections.abc import Iterator, Sequence

from factory.views.bev import EXPERT, LOGGED, PERTURBED, Boxes, DrawnPath, MapShapes, draw_bev, write
from tasks.attempt import Judged
from tasks.perturb import Candidate, Considered
from tasks.world.arrays import Image
from tasks.world.clip import NOW, Clip
from tasks.world.lanes import LightState
from tasks.world.vehicle import HEADING

FATE_COLOURS = {  # what became of a gated vocabulary trajectory
    "reached_gate": (200, 200, 200),
    "white_cell": (190, 205, 220),
    "not_needed": (150, 180, 150),
    "score": (214, 90, 80),
    "reactive": (240, 150, 40),
    "kept": (20, 130, 60),
}


def map_shapes(clip: Clip, step: int) -> MapShapes:
    """The clip's map with the lights of one step."""
    lanes = clip.road_map.lanes
    red = {
        lane_id
        for lane_id, state in zip(clip.lights.lane_ids, clip.lights.states[step] if clip.lights.lane_ids else ())
        if state == LightState.RED
    }
    return MapShapes(
        roads=clip.road_map.road_rings,
        route=[lanes[i].ring for i in sorted(clip.route.lane_ids) if i in lanes],
        crossings=clip.road_map.crossings,
        lanes=[lane.ring for lane in lanes.values() if lane.drives_cars],
        red=[lanes[i].ring for i in sorted(red) if i in lanes],
    )


def attempt_picture(
    clip: Clip, candidate: Candidate | None, judged: Judged | None, title: str, size_px: tuple[int, int] = (480, 480)
) -> Image:
    """Logged, perturbed, planned and driven way of one attempt, with the agents at the scene's instant."""
    if judged is not None:
        step, ego, boxes = judged.scene.step, judged.scene.ego_state, judged.rollout.agents.boxes[0]
        kinds: Sequence[str] = judged.rollout.agents.kinds
    elif candidate is not None:
        rollout, kinds = candidate.rollout, clip.agents.kinds
        step, ego, boxes = rollout.start_step + 40, rollout.ego_states[-1], rollout.agents.boxes[-1]
    else:
        step, ego, boxes, kinds = NOW, clip.ego_states[NOW], clip.agents.boxes[NOW], clip.agents.kinds
    pose = ego[: HEADING + 1]
    ways = _ways(clip, candidate, judged, "expert (simulated)")
    return draw_bev(pose, map_shapes(clip, step), Boxes(boxes, kinds), pose, ways, title, size_px)


def _ways(clip: Clip, candidate: Candidate | None, judged: Judged | None, expert: str) -> list[DrawnPath]:
    ways = [DrawnPath(clip.ego_states[NOW:, : HEADING + 1], LOGGED, "logged", dashed=True)]
    if candidate is not None:
        ways.append(DrawnPath(candidate.rollout.ego_states, PERTURBED, "perturbed"))
    if judged is not None:
        ways.append(DrawnPath(judged.rollout.ego_states, EXPERT, expert))
    return ways


def candidates_picture(clip: Clip, considered: Considered, size_px: tuple[int, int] = (720, 720)) -> Image:
    """End poses of all gated trajectories around the logged pose at T+H, coloured by what became of them."""
    import cv2

    step = NOW + 40
    target = clip.ego_states[step, : HEADING + 1]
    image = draw_bev(
        target,
        map_shapes(clip, step),
        Boxes(clip.agents.boxes[step], clip.agents.kinds),
        target,
        [DrawnPath(clip.ego_states[NOW:, : HEADING + 1], LOGGED, "", dashed=True)],
        f"{len(considered.fate)} gated end poses at T+H",
        size_px,
        metres=60.0,
    )
    height, width = image.shape[:2]
    scale = height / 60.0
    for fate, colour in FATE_COLOURS.items():
        for pose in considered.end_pose[[f == fate for f in considered.fate]]:
            centre = (int(width / 2 - pose[1] * scale), int(height * 0.6 - pose[0] * scale))
            cv2.circle(image, centre, 3 if fate == "kept" else 2, colour, -1, cv2.LINE_AA)
    for row, (fate, colour) in enumerate(FATE_COLOURS.items()):
        count = sum(f == fate for f in considered.fate)
        cv2.circle(image, (14, height - 14 - 16 * row), 4, colour, -1, cv2.LINE_AA)
        write(image, f"{fate} {count}", (24, height - 10 - 16 * row))
    return image


def film(clip: Clip, candidate: Candidate, judged: Judged, size_px: tuple[int, int] = (480, 480)) -> Iterator[Image]:
    """Both rollouts at 10 Hz, T .. T+2H, one picture a step."""
    ways = _ways(clip, candidate, judged, "expert")
    for stage, rollout in enumerate((candidate.rollout, judged.rollout)):
        for row in range(stage, len(rollout.ego_states)):
            step = rollout.start_step + row
            pose = rollout.ego_states[row, : HEADING + 1]
            boxes = Boxes(rollout.agents.boxes[row], rollout.agents.kinds)
            shapes = map_shapes(clip, min(step, clip.agents.n_steps - 1))
            yield draw_bev(pose, shapes, boxes, pose, ways, f"stage {stage + 1}  t = {step * 0.1 - 1.5:.1f} s", size_px)
