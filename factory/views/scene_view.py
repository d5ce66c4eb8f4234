"""A block's scene in the browser, with the drives through it that became samples."""

from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from io import StringIO
from typing import TYPE_CHECKING, Any

import numpy as np

from factory.stages.scene_file import BadScene
from factory.store.reader import SampleTable, decode_stored_image
from tasks.render.scene.asset import RenderAsset
from tasks.render.scene.movers import world_from_boxes
from tasks.render.splatting.gaussians import Gaussians, quats_of, rotations_of
from tasks.world.arrays import Array
from tasks.world.frames import to_world

if TYPE_CHECKING:
    import viser

    from factory.store.samples import Store

NO_VISER = "scene view needs viser: pip install 'driving-data-factory[view]'"
PERTURBED, LABEL, LOGGED = (230, 120, 20), (20, 160, 60), (40, 90, 220)  # colours of drives
ABOVE_ROAD_M = 0.1  # that drives are drawn
THICKNESS_M = 0.08
BOX = (200, 40, 40)
FRUSTUM_M = 0.6
_CORNERS = 0.5 * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
# (12, 2, 3) of a unit cube: corners that differ in one coordinate.
EDGES = np.array([(a, b) for a in _CORNERS for b in _CORNERS if (a != b).sum() == 1 and (a <= b).all()])
NOW = 15  # of a sample's 10 Hz boxes
COLUMNS = (
    "attempt_id", "clip_id", "log_id", "settings_hash", "clip_start_s", "now_s", "expert", "round", "now_pose",
    "world_from_ego", "perturbed_states", "label_10hz", "agent_ids", "agent_boxes", "agent_center_z", "agent_heights",
    "agent_valid", "cameras", "images", "asset_digest",
)  # fmt: skip


@dataclass(frozen=True)
class DrawnDrive:
    """A sample as it is drawn, in the scene's frame."""

    name: str
    perturbed: Array | None  # (41, 3) [m] T .. T+H
    label: Array  # (41, 3) [m] from now on
    boxes: Mapping[str, Array]  # track id -> (7,) centre, heading, size, now
    cameras: tuple[tuple[Array, Array, bytes], ...]  # intrinsics (3, 3), scene from camera (4, 4), JPEG, now


@dataclass(frozen=True)
class DrivesHere:
    """What of a run went through a scene."""

    samples: tuple[DrawnDrive, ...]
    logged: Mapping[str, Array]  # clip -> (81, 3) [m] the log from T to T+2H, where the run's cache still has it


NOTHING = DrivesHere((), {})


def drives_through(store: "Store", asset: RenderAsset) -> DrivesHere:
    """Samples whose now lies in the scene's block of its log; of a scene without a block, those drawn from it."""
    from factory.views.show import logged_drive

    samples, logged = [], {}
    for row in SampleTable(store.location.uri).iterate(COLUMNS):
        if not _is_here(row, asset):
            continue
        drive = drive_of(row, asset.origin)
        samples.append(drive)
        if row["clip_id"] not in logged and (path := logged_drive(store, row)) is not None:
            logged[row["clip_id"]] = _raised(path[:, :2], float(drive.label[0, 2]), asset.origin)
    return DrivesHere(tuple(samples), logged)


def _is_here(row: Mapping[str, Any], asset: RenderAsset) -> bool:
    if (block := asset.block) is None:
        return bool(row["asset_digest"] == asset.digest)
    now_s = row["clip_start_s"] + row["now_s"]
    return bool(row["log_id"] == block.log_id and block.start_s <= now_s <= block.end_s)


def drive_of(row: Mapping[str, Any], origin: Array) -> DrawnDrive:
    """A sample's row; `origin` (3,) is the scene's."""
    pose = np.asarray(row["world_from_ego"], np.float64).reshape(4, 4)
    height = pose[2, 3] - origin[2] + ABOVE_ROAD_M
    now = np.asarray(row["now_pose"], np.float64)
    label = np.concatenate([np.zeros((1, 3)), np.asarray(row["label_10hz"], np.float64).reshape(-1, 3)])
    perturbed = None if row["perturbed_states"] is None else np.asarray(row["perturbed_states"]).reshape(-1, 11)
    lenses = {camera["name"]: camera for camera in row["cameras"] or ()}
    return DrawnDrive(
        name=f"{row['expert']} {row['round']} {row['attempt_id']}",
        perturbed=None if perturbed is None else _raised(perturbed[:, :2], height, origin),
        label=_raised(to_world(now, label)[:, :2], height, origin),
        boxes=_boxes_now(row, now, origin),
        cameras=tuple(
            _placed(lenses[image["camera"]], image, origin)
            for image in row["images"] or ()
            if image["time_s"] == 0.0 and image["camera"] in lenses
        ),
    )


def shown(asset: RenderAsset, here: DrivesHere, host: str, port: int) -> "viser.ViserServer":
    """The server, running in threads of its own, on the first free port from `port` on.

    The browser draws colours as they are from all sides: coefficients beyond degree 0 stay out. Raises BadScene without
    viser.
    """
    try:
        import viser
    except ImportError as error:
        raise BadScene(NO_VISER) from error
    with redirect_stdout(StringIO()):  # a frame around addresses that we tell ourselves
        server = viser.ViserServer(host=host, port=port, label="scene", verbose=False)
    server.gui.configure_theme(show_share_button=False)
    server.request_share_url = _not_shared  # type: ignore[method-assign]  # a click would show it to the world
    server.scene.set_up_direction("+z")
    _splats(server, "/background", asset.background)
    drives = here.samples
    for clip, path in here.logged.items():
        _line(server, f"/logged/{clip}", path, LOGGED)
    for drive in drives:
        colour = LOGGED if drive.perturbed is None else LABEL
        _line(server, f"/drives/{drive.name}/label", drive.label, colour)
        if drive.perturbed is not None:
            _line(server, f"/drives/{drive.name}/perturbed", drive.perturbed, PERTURBED)
    if drives:
        chosen = server.gui.add_dropdown("sample", [drive.name for drive in drives])
        chosen.on_update(lambda _: _show(server, asset, drives, str(chosen.value)))
        _show(server, asset, drives, drives[0].name)
        start, towards = drives[0].label[0], drives[0].label[-1]
    else:
        start = np.zeros(3)
        towards = asset.background.means.mean(axis=0)

    ahead = (towards - start) / max(float(np.linalg.norm(towards - start)), 1e-6)
    server.initial_camera.position = start - 8.0 * ahead + np.array([0.0, 0.0, 4.0])
    server.initial_camera.look_at = start + 10.0 * ahead
    return server


def _not_shared(verbose: bool = True) -> None:
    """In place of viser's tunnel to a public address."""


def _show(server: "viser.ViserServer", asset: RenderAsset, drives: Sequence[DrawnDrive], name: str) -> None:
    """Vehicles, boxes and cameras of the sample's now."""
    drive = next(drive for drive in drives if drive.name == name)
    for there in ("/vehicles", "/boxes", "/cameras"):
        server.scene.remove_by_name(there)
    boxes = np.array(list(drive.boxes.values())).reshape(-1, 7)
    for track, box, pose in zip(drive.boxes, boxes, world_from_boxes(boxes)):
        if track in asset.nodes:
            _splats(server, f"/vehicles/{track}", asset.nodes[track], pose)
        else:
            edges = EDGES * box[4:] @ pose[:3, :3].T + pose[:3, 3]
            server.scene.add_line_segments(f"/boxes/{track}", edges, BOX, thickness=0.5 * THICKNESS_M)
    for k, (intrinsics, pose, jpeg) in enumerate(drive.cameras):
        picture = decode_stored_image({"jpeg": jpeg})
        height, width = picture.shape[:2]
        server.scene.add_camera_frustum(
            f"/cameras/{k}",
            fov=2.0 * float(np.arctan(0.5 * height / intrinsics[1, 1])),
            aspect=width / height,
            scale=FRUSTUM_M,
            image=picture,
            wxyz=quats_of(pose[None, :3, :3])[0],
            position=pose[:3, 3],
        )


def _splats(server: "viser.ViserServer", name: str, part: Gaussians, pose: Array | None = None) -> None:
    rotations, scales = rotations_of(part.quats), np.exp(part.log_scales)
    spread = rotations * scales[:, None, :]
    pose = np.eye(4) if pose is None else pose
    server.scene.add_gaussian_splats(
        name,
        centers=part.means,
        covariances=(spread @ spread.transpose(0, 2, 1)).astype(np.float32),
        rgbs=np.clip(part.colours, 0.0, 1.0),
        opacities=part.opacities[:, None],
        wxyz=quats_of(pose[None, :3, :3])[0],
        position=pose[:3, 3],
    )


def _line(server: "viser.ViserServer", name: str, points: Array, colour: tuple[int, int, int]) -> None:
    server.scene.add_line_segments(name, np.stack([points[:-1], points[1:]], 1), colour, thickness=THICKNESS_M)


def _raised(path: Array, height: float, origin: Array) -> Array:
    """(N, 3) of a path (N, 2) in the world."""
    return np.column_stack([path - origin[:2], np.full(len(path), height)])


def _boxes_now(row: Mapping[str, Any], now: Array, origin: Array) -> dict[str, Array]:
    """Track id -> (7,) x, y, z of the centre, heading, length, width, height of those that are there."""
    flat = np.asarray(row["agent_boxes"], np.float64).reshape(len(row["agent_ids"]), -1, 5)
    heights, at = np.asarray(row["agent_heights"], np.float64), np.asarray(row["agent_center_z"]).reshape(len(flat), -1)
    valid = np.asarray(row["agent_valid"]).reshape(len(flat), -1)
    poses = to_world(now, flat[:, NOW, :3])
    boxes = np.column_stack([poses[:, :2] - origin[:2], at[:, NOW] - origin[2], poses[:, 2], flat[:, NOW, 3:], heights])
    return {name: box for name, box, there in zip(row["agent_ids"], boxes, valid[:, NOW]) if there}


def _placed(camera: Mapping[str, Any], image: Mapping[str, Any], origin: Array) -> tuple[Array, Array, bytes]:
    ego = np.asarray(image["ego_pose"], np.float64).reshape(4, 4)
    pose = ego @ np.asarray(camera["ego_from_camera"], np.float64).reshape(4, 4)
    pose[:3, 3] -= origin
    return np.asarray(camera["intrinsics"], np.float64).reshape(3, 3), pose, image["jpeg"]
