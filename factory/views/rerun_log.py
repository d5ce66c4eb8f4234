"""A stored sample as a Rerun recording: what its MCAP episode holds, logged with Rerun's SDK, which draws all of it.

Rerun's own MCAP importer leaves SceneUpdate out (0.41), so boxes, map and drives are logged here as Boxes3D and
LineStrips3D. Frames become entity paths: `now` is the root, `now/ego` moves, the cameras hang below it. A sub-score of
the drive is 1 on the timeline until it first fails. The SDK is the optional extra `rerun`.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

from factory.views.episode_messages import EGO, NOW, WORLD, Row, episode_messages
from tasks.subscores import JUDGED, SUBSCORES
from tasks.world.arrays import Array

TIMELINE = "log"  # time since the log's first instant
INSTALL = "rerun-sdk is not installed: pip install rerun-sdk"


class RerunMissing(ImportError):
    """The optional SDK is not there; the message says how to install it."""


def load_rerun() -> ModuleType:
    """The SDK. Raises RerunMissing."""
    try:
        import rerun
    except ImportError as error:
        raise RerunMissing(INSTALL) from error
    return rerun


def write_recording(path: Path, row: Row, logged: Array | None = None) -> None:
    """The sample as an .rrd file, with a layout. Raises RerunMissing."""
    rr = load_rerun()
    stream = rr.RecordingStream("driving-data-factory", recording_id=str(row["attempt_id"]))
    stream.save(path, default_blueprint=_layout())
    stream.log(NOW, rr.ViewCoordinates.FLU, static=True)
    for message in episode_messages(row, logged):
        stream.set_time(TIMELINE, duration=np.timedelta64(message.time_ns, "ns"))
        for entity, what in _logged(rr, message.topic, message.content):
            stream.log(entity, what)
    for name, after_now_s, value in score_steps(row):
        at_ns = round(1e9 * (row["clip_start_s"] + row["now_s"] + after_now_s))
        stream.set_time(TIMELINE, duration=np.timedelta64(at_ns, "ns"))
        stream.log(f"scores/{name}", rr.Scalars(value))
    stream.flush()
    stream.disconnect()


def score_steps(row: Row) -> list[tuple[str, float, float]]:
    """(name, seconds after now, value) of what the drive's scores become; they stay until they change."""
    found: list[tuple[str, float, float]] = []
    for name in (*SUBSCORES, "score"):
        value = row[f"stage2_{name}"]
        fails_s = row[f"stage2_{name}_fails_s"] if name in JUDGED else None
        if value is None:
            continue
        if fails_s:
            found.append((name, 0.0, 1.0))
        found.append((name, fails_s or 0.0, float(value)))
    return sorted(found, key=lambda step: step[1])


def _path(frame: str) -> str:
    return {NOW: NOW, EGO: f"{NOW}/{EGO}"}.get(frame, f"{NOW}/{EGO}/{frame}")


def _logged(rr: ModuleType, topic: str, content: Any) -> Sequence[tuple[str, Any]]:
    """Entities and what is logged there."""
    match content:
        case Mapping():
            text = rr.TextDocument(f"```json\n{json.dumps(content, indent=1)}\n```", media_type="text/markdown")
            return [("sample", text)]
        case CompressedImage():
            picture = rr.EncodedImage(contents=content.data, media_type=f"image/{content.format}")
            return [(_path(content.frame_id), picture)]
        case CameraCalibration():
            matrix = np.reshape(content.K, (3, 3))
            pinhole = rr.Pinhole(image_from_camera=matrix, width=content.width, height=content.height)
            return [(_path(content.frame_id), pinhole)]
        case FrameTransforms():
            moved = [one for one in content.transforms if one.parent_frame_id != WORLD]
            return [(_path(one.child_frame_id), _transform(rr, one)) for one in moved]
        case SceneUpdate():
            return _scene(rr, topic, content)
        case _:  # the drives' poses stand in /trajectories as lines
            return []


def _transform(rr: ModuleType, one: Any) -> Any:
    t, q = one.translation, one.rotation
    return rr.Transform3D(translation=[t.x, t.y, t.z], quaternion=[q.x, q.y, q.z, q.w])


def _scene(rr: ModuleType, topic: str, update: SceneUpdate) -> list[tuple[str, Any]]:
    """Boxes of all entities as one, so that those that went are gone; lines of each by its name."""
    found = []
    boxed = [entity for entity in update.entities if entity.cubes]
    if boxed or update.deletions:
        cubes = [entity.cubes[0] for entity in boxed]
        path = _path(boxed[0].frame_id) if boxed else NOW
        boxes = rr.Boxes3D(
            centers=[[c.pose.position.x, c.pose.position.y, c.pose.position.z] for c in cubes],
            sizes=[[c.size.x, c.size.y, c.size.z] for c in cubes],
            quaternions=[[0.0, 0.0, c.pose.orientation.z, c.pose.orientation.w] for c in cubes],
            colors=[_rgba(c.color) for c in cubes],
            labels=[entity.metadata[0].value if entity.metadata else entity.id for entity in boxed],
            show_labels=False,
        )
        found.append((f"{path}{topic}" if topic != "/ego" else f"{path}/box", boxes))
    for entity in update.entities:
        if entity.lines:
            strips = rr.LineStrips3D(
                [_points(line) for line in entity.lines],
                colors=[_rgba(line.color) for line in entity.lines],
                radii=[line.thickness / 2.0 for line in entity.lines],
            )
            found.append((f"{_path(entity.frame_id)}{topic}/{entity.id.replace(' ', '_')}", strips))
    return found


def _points(line: LinePrimitive) -> list[list[float]]:
    points = [[p.x, p.y, p.z] for p in line.points]
    return [*points, points[0]] if line.type == LinePrimitive.Type.LINE_LOOP and points else points


def _rgba(colour: Any) -> list[int]:
    return [round(255 * part) for part in (colour.r, colour.g, colour.b, colour.a)]


def _layout() -> Any:
    """The world, the cameras, the scores by time and the facts."""
    import rerun.blueprint as rrb

    facts = rrb.Tabs(rrb.TimeSeriesView(origin="scores", name="Scores"), rrb.TextDocumentView(origin="sample"))
    cameras = rrb.Spatial2DView(origin=f"{NOW}/{EGO}", name="Cameras")
    side = rrb.Vertical(cameras, facts)
    return rrb.Blueprint(rrb.Horizontal(rrb.Spatial3DView(origin=NOW, name="World"), side), auto_views=True)
