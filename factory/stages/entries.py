"""Calls that enter every kernel once, with the types that runs enter it with: what compiling a part executes."""

from collections.abc import Sequence

import numpy as np

from factory.graph.steps import NotReady
from factory.wording import one_line
from tasks.attempt import drive_and_judge, hit_after_s, vocabulary_labels
from tasks.experts.pdm_closed import forecast, proposals
from tasks.experts.protocol import Plan
from tasks.render.fit.reconstruct import finish_scene, run_iterations
from tasks.render.fit.start import prepare_fit
from tasks.render.gate import check_drive_pictures
from tasks.render.rig.adjust import N_CAMERA, AdjustedRig, CornerTracks, bundle_adjust, initial_rig
from tasks.render.scene.asset import Instant, RenderAsset
from tasks.render.scene.build import AssetSettings, build_asset
from tasks.render.scene.depth import confirm_depths
from tasks.render.scene.movers import NOBODY, agents_at_time
from tasks.render.scene.sensed import Photo, Sweep
from tasks.render.scene.sky import plain_sky
from tasks.render.scene.stereo import choose_partners, wide_baseline_depth
from tasks.render.seen import guessed_pixels, photo_sights, street_views
from tasks.render.settings import FitSettings, GateSettings
from tasks.render.splatting.gaussians import Gaussians
from tasks.render.splatting.sh import rotate_coefficients
from tasks.reward.epdms import INDEX_FROM_ROWS, prepare_scene, score
from tasks.rollout.simulate import SeenTraffic, TrafficSettings, prepare_traffic, simulate
from tasks.world.arrays import Array
from tasks.world.clip import (
    CLIP_STEPS,
    HORIZON_STEPS,
    NOW,
    AgentKind,
    AgentTracks,
    Camera,
    Clip,
    Pinhole,
    Scene,
    SensorFile,
    scene_of_clip,
)
from tasks.world.road_map import Lane, RoadMap, Route
from tasks.world.vocabulary import Vocabulary, kinematic_trajectories

REPLAY = TrafficSettings(mode="replay")


def enter_judge() -> None:
    """Scores, of a few trajectories and of many, and all that an attempt among the log's traffic enters.

    `plan` is compiled meanwhile and takes half as long: it is there when the attempt asks for it.
    """
    scene, ahead = _tiny_scene()
    prepared = prepare_scene(scene, scene.agents.window(scene.step, scene.step + HORIZON_STEPS + 1))
    standing = np.tile(scene.ego_state, (INDEX_FROM_ROWS, HORIZON_STEPS + 1, 1))
    score(prepared, standing, normalise="pairs")
    judged = drive_and_judge(scene, Plan(ahead), REPLAY)
    vocabulary_labels(Vocabulary(kinematic_trajectories(2, 0)), scene, judged.prepared, judged.reference)
    hit_after_s(prepare_traffic(scene, REPLAY), judged.prepared, judged.rollout.ego_states)


def enter_plan() -> None:
    """The tracker, and what PDM-Closed proposes."""
    scene, ahead = _tiny_scene()
    simulate(scene, ahead, REPLAY)
    seen = forecast(scene.ego_state, scene.agents.window(scene.step, scene.step + 1))
    proposals(scene.ego_state, scene.centerline, seen, None)


def enter_drive() -> None:
    """Traffic around one ego."""
    scene, ahead = _tiny_scene()
    simulate(scene, ahead, TrafficSettings())


def enter_navsim() -> None:
    """The public traffic around one ego."""
    scene, ahead = _tiny_scene()
    simulate(scene, ahead, TrafficSettings(mode="navsim"))


class _StandingPolicy:
    """A traffic policy that is none."""

    def digest(self) -> str:
        return ""

    def next_states(self, seen: SeenTraffic) -> Array:
        return np.pad(seen.boxes[-1, :-1, :3], ((0, 0), (0, 1)))


def enter_policy() -> None:
    """Traffic that a policy of a user's own drives around one ego."""
    scene, ahead = _tiny_scene()
    simulate(scene, ahead, TrafficSettings(mode="custom", policy=f"{__name__}:{_StandingPolicy.__name__}"))


# Every kernel of the render package, on the smallest scene that reaches all of them.

FRONT = np.array([[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 1.5], [0.0, 0.0, 0.0, 1.0]])
POINTS = ((8.0, 1.0, 1.0), (9.0, -1.0, 2.0))  # that the rig is adjusted to


def enter_render() -> RenderAsset:
    """Builds, measures and looks at a scene of two 32 x 32 photos, some ground and one box that drives."""
    rotate_coefficients(np.zeros((1, 3, 3), np.float32), np.diag([1.0, -1.0, 1.0]))
    photos, sweeps, agents = _tiny_recording()
    asset = build_asset(photos, sweeps, agents, AssetSettings(hold_out_every=3))
    files, rig = _files_and_rig(photos)
    check_drive_pictures(asset, rig, files[0].world_from_ego[None], agents, [0], (32, 32), GateSettings())
    ((eye, view),) = street_views(asset, [(rig[0], files[0].world_from_ego)])
    guessed_pixels(photo_sights(asset, files, rig), eye, view, agents_at_time(agents, 0.0).boxes)
    return asset


def _files_and_rig(photos: Sequence[Photo]) -> tuple[list[SensorFile], list[Camera]]:
    files = [SensorFile(p.camera, "", p.time_s, p.world_from_camera @ np.linalg.inv(FRONT)) for p in photos]
    return files, [Camera(photos[0].camera, 32, 32, photos[0].intrinsics, np.zeros(5), FRONT)]


def enter_rig() -> AdjustedRig:
    """Adjusts a rig of one camera at three places to two points that it sees, and looks for a photo's depth in others.

    What else a block without lidar enters, the other two compile.
    """
    photos, _, _ = _tiny_recording()
    photo, k = photos[1], photos[1].intrinsics
    rgb, nowhere, everywhere = (
        np.zeros((32, 32, 3), np.float32),
        np.zeros((32, 32), np.float32),
        np.ones((32, 32), bool),
    )
    wide_baseline_depth(
        rgb, nowhere, nowhere, choose_partners(photo, photos, 2), k, photo.world_from_camera, everywhere
    )
    confirm_depths(photos, [nowhere] * len(photos))
    files, cameras = _files_and_rig(photos)
    rig, shots = initial_rig(cameras, files)
    at = [[16.0 - 20.0 * y / (x - k), 16.0 + 20.0 * (1.5 - z) / (x - k)] for x, y, z in POINTS for k in range(3)]
    matched = CornerTracks(np.array([0, 3, 6]), np.tile(np.arange(3), 2), np.array(at), np.ones(6))
    return bundle_adjust(rig, shots, matched, np.ones(6 * len(files) + N_CAMERA))


def _tiny_recording() -> tuple[list[Photo], list[Sweep], AgentTracks]:
    x, y = np.meshgrid(np.linspace(2.0, 20.0, 40), np.linspace(-6.0, 6.0, 40))
    ground = np.stack([x, y, 0.0 * x], axis=-1).reshape(-1, 3).astype(np.float32)
    intrinsics = np.array([[20.0, 0.0, 16.0], [0.0, 20.0, 16.0], [0.0, 0.0, 1.0]])
    photos, sweeps = [], []
    for k in range(3):
        world_from_ego = np.eye(4)
        world_from_ego[0, 3] = k
        rgb = np.full((32, 32, 3), 90, np.uint8)
        photos.append(Photo("front", 0.1 * k, rgb, intrinsics, world_from_ego @ FRONT))
        sweeps.append(Sweep(0.1 * k, ground, world_from_ego))
    boxes = np.array([[[8.0 + 2.0 * k, 0.0, 0.0, 4.0, 2.0]] for k in range(3)])
    there, heights = np.ones((3, 1), bool), (np.full((3, 1), 0.8), np.array([1.6]))
    return photos, sweeps, AgentTracks(("a",), (AgentKind.VEHICLE,), boxes, np.zeros((3, 1, 2)), there, *heights)


def enter_fit() -> None:
    """Scenes that are built and drawn, and fitted: in one process, for they share kernels."""
    enter_render()
    settings = FitSettings(  # each step of the fit at least once
        iterations=4, start_gaussians=200, most_gaussians=300, refine_every=2, refine_from=2, pose_from=0
    )
    problem, state = prepare_fit(*_tiny_recording(), settings, held_out=[1])
    run_iterations(problem, state, settings, settings.iterations)
    finish_scene(problem, state)


def enter_gpu() -> None:
    """gsplat's CUDA sources, which its first call builds: of several at once each would delete the others' build.

    Raises NotReady where it cannot draw.
    """
    from tasks.render.scene import on_device  # torch is loaded only where it is asked for

    one = Gaussians(*(np.ones(shape, np.float32) for shape in ((1, 3), (1, 4), (1, 3), (1,), (1, 3))))
    scene = RenderAsset(np.zeros(3), one, {}, plain_sky(), float("nan"))
    eye = Pinhole(np.array([[20.0, 0.0, 16.0], [0.0, 20.0, 16.0], [0.0, 0.0, 1.0]]), np.eye(4), 32, 32)
    instant = Instant([eye], NOBODY, [np.eye(3, 4, dtype=np.float32)])
    try:
        next(on_device.pictures(on_device.cuda(packed=True), scene, [instant], [None]))
    except (
        RuntimeError,
        OSError,
        AttributeError,
        ImportError,
    ) as error:  # as a failed build, or one that is None, ends
        raise NotReady(
            f"gsplat does not draw here ({one_line(error)}): its CUDA sources need the nvcc of torch's CUDA and a C++ "
            "compiler, docs/gpu.md; or draw with render.backend=cpu"
        ) from error


def _tiny_scene() -> tuple[Scene, Array]:
    ahead = np.stack([np.arange(1, 41) * 0.5, np.zeros(40), np.zeros(40)], axis=1)
    return scene_of_clip(tiny_clip()), ahead


def tiny_clip() -> Clip:
    """A straight road with the ego and a car ahead, and a car that drives beside the road; all at 5 m/s."""
    steps = np.arange(CLIP_STEPS)
    way = np.arange(-50.0, 151.0, 1.0)
    centre = np.stack([way, np.zeros_like(way), np.zeros_like(way)], axis=1)
    ring = np.array([[-50.0, -2.0], [150.0, -2.0], [150.0, 2.0], [-50.0, 2.0], [-50.0, -2.0]])
    lane = Lane("lane", ring, centre, is_intersection=False, drives_cars=True)
    ego = np.zeros((CLIP_STEPS, 11))
    ego[:, 0], ego[:, 3] = (steps - NOW) * 0.5, 5.0
    pose = np.tile(np.eye(4), (CLIP_STEPS, 1, 1))
    pose[:, 0, 3] = ego[:, 0]
    boxes = np.tile([[0.0, 0.0, 0.0, 4.5, 2.0], [0.0, 30.0, 0.0, 4.5, 2.0]], (CLIP_STEPS, 1, 1))
    boxes[..., 0] = ego[:, :1] + 20.0
    cars = AgentTracks(
        track_ids=("ahead", "beside"),
        kinds=(AgentKind.VEHICLE, AgentKind.VEHICLE),
        boxes=boxes,
        velocities=np.tile([5.0, 0.0], (CLIP_STEPS, 2, 1)),
        valid=np.ones((CLIP_STEPS, 2), bool),
        center_z=np.full((CLIP_STEPS, 2), 0.75),
        heights=np.array([1.5, 1.5]),
    )
    return Clip(
        clip_id="warm",
        dataset="warm",
        log_id="warm",
        split="train",
        start_s=0.0,
        ego_states=ego,
        world_from_ego=pose,
        agents=cars,
        road_map=RoadMap({"lane": lane}, (), (), {"lane": "rb_lane"}),
        route=Route(("lane",), ("rb_lane",), frozenset({"lane"})),
        centerline=centre,
    )
