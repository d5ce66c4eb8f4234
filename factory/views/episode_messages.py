"""A stored sample as messages of protobuf, most of Foxglove's schemas, for Foxglove, Lichtblick and Rerun.

Times are nanoseconds since the log's first instant, from 1.5 s before the sample's now to 4 s after it. Frames: `world`
is the map's; `now` is the ego at now, in which everything is drawn, since coordinates of a map are too large for the
float32 of a screen; `ego` moves; each camera's frame hangs on `ego`.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto
from google.protobuf.message_factory import GetMessages
from google.protobuf.timestamp_pb2 import Timestamp
from scipy.spatial.transform import Rotation

from factory.store.episodes import Message, episode_bytes
from factory.store.schema import AGENT_STEPS, FIELDS, NOW_INDEX
from factory.views.pictures import AGENT_COLOURS, EXPERT, LOGGED, OBJECT, PERTURBED, Colour, ego_poses
from tasks.world.arrays import Array
from tasks.world.frames import PACIFICA, to_local

Row = Mapping[str, Any]

WORLD, NOW, EGO = "world", "now", "ego"
STEP_S = 0.1
IDENTITY = ("attempt_id", "clip_id", "dataset", "log_id", "split", "expert", "round", "settings_hash", "licence")
EGO_HEIGHT_M = 1.777  # of the body that PACIFICA is; nothing is scored by it
LINE_M, TRAJECTORY_M = 0.08, 0.25
ROAD, LANE, CENTRE, CROSSING, ROUTE = (120, 120, 120), (170, 170, 170), (90, 120, 150), (200, 180, 90), (90, 170, 110)
OURS: Colour = (60, 120, 220)

FACTS = tuple(  # columns that stand in /sample
    field
    for field in FIELDS
    if (not field.shape and field.dtype != "binary")
    or field.name in ("ego_status", "candidate_end", "tags", "now_pose")
)
PROTOBUF_TYPES = {
    "string": FieldDescriptorProto.TYPE_STRING,
    "int32": FieldDescriptorProto.TYPE_INT32,
    "float32": FieldDescriptorProto.TYPE_FLOAT,
    "float64": FieldDescriptorProto.TYPE_DOUBLE,
}


def _sample_message() -> type[Any]:
    """The protobuf class of /sample: FACTS under their own names; a scalar that is null is absent, not zero."""
    package = "driving_data_factory"
    file = FileDescriptorProto(name=f"{package}/Sample.proto", package=package, syntax="proto3")
    message = file.message_type.add(name="Sample")
    for number, column in enumerate(FACTS, start=1):
        field = message.field.add(name=column.name, number=number, type=PROTOBUF_TYPES[column.dtype])
        field.label = FieldDescriptorProto.LABEL_REPEATED if column.shape else FieldDescriptorProto.LABEL_OPTIONAL
        if column.nullable and not column.shape:  # `optional` of proto3: a oneof of this field alone
            field.proto3_optional, field.oneof_index = True, len(message.oneof_decl)
            message.oneof_decl.add(name=f"_{column.name}")
    return GetMessages([file])[f"{package}.Sample"]


SampleMessage = _sample_message()


def episode_messages(row: Row, logged: Array | None = None) -> list[Message]:
    """All of a sample, in order of time.

    row: every column of a sample; logged: (M, >=3) the log's drive from T on, world frame, where it is known.
    """
    facts = {column.name: row[column.name] for column in FACTS}  # lineage, licence, scores and tags
    found = [
        *_transforms(row),
        *_cameras(row),
        *_ego(row),
        *_agents(row),
        *_map(row),
        *_trajectories(row, logged),
        Message("/sample", _time_ns(row, -NOW_INDEX * STEP_S), SampleMessage(**facts)),
    ]
    return sorted(found, key=lambda message: message.time_ns)


def episode_of(row: Row, logged: Array | None = None) -> bytes:
    """The sample as one MCAP file."""
    return episode_bytes(episode_messages(row, logged), metadata_of(row))


def metadata_of(row: Row) -> dict[str, str]:
    """What tells a sample from others, and who may use it."""
    return {name: str(row[name]) for name in IDENTITY}


def _time_ns(row: Row, after_now_s: float) -> int:
    return round(1e9 * (row["clip_start_s"] + row["now_s"] + after_now_s))


def _stamp(time_ns: int) -> Timestamp:
    return Timestamp(seconds=time_ns // 10**9, nanos=time_ns % 10**9)


def _steps(row: Row) -> Iterator[tuple[int, int]]:
    """Index and time of every step at 10 Hz."""
    for step in range(len(row["ego_history_10hz"]) + len(row["label_10hz"])):
        yield step, _time_ns(row, (step - NOW_INDEX) * STEP_S)


def world_from_now(row: Row) -> Array:
    """4x4 pose of the ego at now; level, at height 0, where the log has no third dimension."""
    if row["world_from_ego"] is not None:
        return np.asarray(row["world_from_ego"], float).reshape(4, 4)
    x, y, heading = row["now_pose"]
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("z", heading).as_matrix()
    pose[:2, 3] = x, y
    return pose


def _transform(parent: str, child: str, pose: Array, time_ns: int) -> FrameTransform:
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
    transform = FrameTransform(timestamp=_stamp(time_ns), parent_frame_id=parent, child_frame_id=child)
    transform.translation.x, transform.translation.y, transform.translation.z = pose[:3, 3]
    transform.rotation.x, transform.rotation.y, transform.rotation.z, transform.rotation.w = x, y, z, w
    return transform


def _transforms(row: Row) -> Iterator[Message]:
    """Of every frame, at every step."""
    rig = {camera["name"]: np.reshape(camera["ego_from_camera"], (4, 4)) for camera in row["cameras"] or ()}
    now = world_from_now(row)
    poses = ego_poses(row)
    for step, time_ns in _steps(row):
        here = np.eye(4)
        here[:3, :3] = Rotation.from_euler("z", poses[step, 2]).as_matrix()
        here[:2, 3] = poses[step, :2]
        transforms = [_transform(WORLD, NOW, now, time_ns), _transform(NOW, EGO, here, time_ns)]
        transforms += [_transform(EGO, name, pose, time_ns) for name, pose in rig.items()]
        yield Message("/tf", time_ns, FrameTransforms(transforms=transforms))


def _cameras(row: Row) -> Iterator[Message]:
    """Pictures as they are stored, each with its calibration."""
    rig = {camera["name"]: camera for camera in row["cameras"] or ()}
    for image in row["images"] or ():
        name, time_ns = image["camera"], _time_ns(row, image["time_s"])
        picture = CompressedImage(timestamp=_stamp(time_ns), frame_id=name, data=image["jpeg"], format="jpeg")
        yield Message(f"/camera/{name}/image", time_ns, picture)
        camera = rig[name]
        intrinsics = np.asarray(camera["intrinsics"], float).reshape(3, 3)
        calibration = CameraCalibration(
            timestamp=_stamp(time_ns),
            frame_id=name,
            width=camera["width"],
            height=camera["height"],
            distortion_model="plumb_bob",
            D=list(camera["distortion"]),
            K=intrinsics.reshape(-1).tolist(),
            R=np.eye(3).reshape(-1).tolist(),
            P=np.hstack([intrinsics, np.zeros((3, 1))]).reshape(-1).tolist(),
        )
        yield Message(f"/camera/{name}/calibration", time_ns, calibration)


def _ego(row: Row) -> Iterator[Message]:
    """The ego's box, fixed to its frame."""
    time_ns = _time_ns(row, -NOW_INDEX * STEP_S)
    entity = SceneEntity(timestamp=_stamp(time_ns), frame_id=EGO, id="ego", frame_locked=True)
    at = (PACIFICA.rear_axle_to_center, 0.0, EGO_HEIGHT_M / 2.0)
    _add_cube(entity, at, 0.0, (PACIFICA.length, PACIFICA.width, EGO_HEIGHT_M), OURS)
    yield Message("/ego", time_ns, SceneUpdate(entities=[entity]))


def _agents(row: Row) -> Iterator[Message]:
    """A box for each agent that is there, at every step; those that went are deleted."""
    boxes, centre_z = np.asarray(row["agent_boxes"], float), np.asarray(row["agent_center_z"], float)
    ground = world_from_now(row)[2, 3]
    for step, time_ns in _steps(row):
        update = SceneUpdate(
            deletions=[SceneEntityDeletion(timestamp=_stamp(time_ns), type=SceneEntityDeletion.Type.ALL)]
        )
        for i in np.flatnonzero(np.asarray(row["agent_valid"], bool).reshape(-1, AGENT_STEPS)[:, step]):
            x, y, heading, length, width = boxes[i, step]
            kind, height = row["agent_kinds"][i], float(row["agent_heights"][i])
            z = centre_z[i, step] - ground
            entity = SceneEntity(timestamp=_stamp(time_ns), frame_id=NOW, id=row["agent_ids"][i])
            entity.metadata.add(key="kind", value=kind)
            at = (x, y, float(z) if np.isfinite(z) else height / 2.0)
            _add_cube(entity, at, heading, (length, width, height), AGENT_COLOURS.get(kind, OBJECT))
            update.entities.append(entity)
        yield Message("/agents", time_ns, update)


def _map(row: Row) -> Iterator[Message]:
    """Lane boundaries, centrelines, the drivable area's edges, crossings and the route, once."""
    time_ns = _time_ns(row, -NOW_INDEX * STEP_S)
    entities = [
        _lines(time_ns, "drivable area", row["drivable_rings"], ROAD, 2 * LINE_M, closed=True),
        _lines(time_ns, "lane boundaries", row["lane_polygons"], LANE, LINE_M, closed=True),
        _lines(time_ns, "lane centrelines", row["lane_centerlines"], CENTRE, LINE_M),
        _lines(time_ns, "crossings", row["crossing_rings"], CROSSING, LINE_M, closed=True),
        _lines(time_ns, "route", [row["route_centerline"]], ROUTE, 2 * LINE_M),
    ]
    yield Message("/map", time_ns, SceneUpdate(entities=entities))


def _trajectories(row: Row, logged: Array | None) -> Iterator[Message]:
    """What the log drove, how the ego was led away from it, and what the expert drove then."""
    time_ns = _time_ns(row, -NOW_INDEX * STEP_S)
    origin = np.asarray(row["now_pose"], float)
    drives: dict[str, tuple[Array, Colour]] = {}
    of_log = np.asarray(row["parent_states"] if logged is None else logged, float)[:, :3]
    drives["logged"] = (to_local(origin, of_log), LOGGED)
    if row["perturbed_states"] is not None:
        drives["perturbed"] = (to_local(origin, np.asarray(row["perturbed_states"], float)[:, :3]), PERTURBED)
    drives["expert"] = (np.vstack([np.zeros(3), row["label_10hz"]]).astype(float), EXPERT)
    entities = [_lines(time_ns, name, [poses], colour, TRAJECTORY_M) for name, (poses, colour) in drives.items()]
    yield Message("/trajectories", time_ns, SceneUpdate(entities=entities))
    for name, (poses, _) in drives.items():
        path = PosesInFrame(timestamp=_stamp(time_ns), frame_id=NOW)
        for x, y, heading in poses.tolist():
            pose = path.poses.add()
            pose.position.x, pose.position.y = x, y
            pose.orientation.z, pose.orientation.w = np.sin(heading / 2.0), np.cos(heading / 2.0)
        yield Message(f"/trajectories/{name}", time_ns, path)


def _colour(colour: Colour, alpha: float = 1.0) -> Color:
    r, g, b = (part / 255.0 for part in colour)
    return Color(r=r, g=g, b=b, a=alpha)


def _add_cube(
    entity: SceneEntity,
    at: tuple[float, float, float],
    heading: float,
    size: tuple[float, float, float],
    colour: Colour,
) -> None:
    cube = entity.cubes.add()
    cube.pose.position.x, cube.pose.position.y, cube.pose.position.z = at
    cube.pose.orientation.z, cube.pose.orientation.w = np.sin(heading / 2.0), np.cos(heading / 2.0)
    cube.size.x, cube.size.y, cube.size.z = size
    cube.color.CopyFrom(_colour(colour, 0.7))


def _lines(
    time_ns: int, name: str, lines: Sequence[Any], colour: Colour, thickness_m: float, closed: bool = False
) -> SceneEntity:
    """x, y of lines at the ground, in the frame `now`."""
    entity = SceneEntity(timestamp=_stamp(time_ns), frame_id=NOW, id=name)
    for points in (line for line in lines if len(line)):  # a sample without a map has an empty route
        line = entity.lines.add(type=LinePrimitive.Type.LINE_LOOP if closed else LinePrimitive.Type.LINE_STRIP)
        line.pose.orientation.w = 1.0
        line.thickness = thickness_m
        line.color.CopyFrom(_colour(colour))
        for x, y in np.asarray(points, float).reshape(len(points), -1)[:, :2].tolist():
            line.points.add(x=x, y=y)
    return entity
