"""Frames of NAVSIM whose numbers mean something else: told by what gives it away, at the index where that is known."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from factory.readers.base import BadClip
from tests.factory.datasets.navsim.logs import NAME
from tests.factory.datasets.navsim.small import reader_of, road_frames, write_blobs, write_city, write_log

Frames = list[dict[str, Any]]


def all_frames(change: Callable[[dict[str, Any]], object]) -> Callable[[Frames], object]:
    return lambda frames: [change(frame) for frame in frames]


def all_cameras(change: Callable[[dict[str, Any]], object]) -> Callable[[Frames], object]:
    return all_frames(lambda frame: [change(camera) for camera in frame["cams"].values()])


def stamped(factor: float) -> Callable[[Frames], object]:
    return all_frames(lambda frame: frame.update(timestamp=int(frame["timestamp"] * factor)))


def inverted(camera: dict[str, Any]) -> None:
    turn, place = camera["sensor2lidar_rotation"].T, camera["sensor2lidar_translation"]
    camera.update(sensor2lidar_rotation=turn, sensor2lidar_translation=-turn @ place)


def shifted(frame: dict[str, Any]) -> None:
    frame["ego2global_translation"] = frame["ego2global_translation"] - (331_000.0, 4_690_000.0, 0.0)


EAST_AS_NORTH = np.array([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])
KINDS: dict[str, tuple[Callable[[Frames], object], str]] = {
    "stamps in ns": (stamped(1e3), r"frames.timestamp: stamps are 500 s apart, and 0.5 s if they were in ns"),
    "stamps in ms": (stamped(1e-3), "frames.timestamp: stamps are 0.0005 s apart, and 0.5 s if they were in ms"),
    "stamps in s": (stamped(1e-6), "frames.timestamp: .* if they were in s: expected us"),
    "another frame": (all_frames(shifted), "road_map: the drive .* is nowhere nearer than .* to a lane of the map"),
    "compass": (all_frames(lambda f: f.update(ego2global_rotation=EAST_AS_NORTH)), "headings are 90 deg off the dir"),
    "camera from ego": (all_cameras(inverted), "cameras.CAM_F0: .* its inverse would be right"),
    "axes": (all_cameras(lambda c: c.update(sensor2lidar_rotation=np.eye(3))), "CAM_F0: looks at the sky, 90 deg"),
    "millimetres": (
        all_cameras(lambda c: c.update(sensor2lidar_translation=1000.0 * c["sensor2lidar_translation"])),
        "CAM_F0: stands 1,600.0 m ahead, .* in millimetres",
    ),
}


@pytest.mark.parametrize("kind", KINDS)
def test_frames_of_another_meaning_are_told(tmp_path: Path, kind: str) -> None:
    spoil, said = KINDS[kind]
    frames = road_frames()
    spoil(frames)
    write_city(tmp_path)
    write_log(tmp_path, frames)
    write_blobs(tmp_path, frames)
    reader = reader_of(tmp_path)
    index = reader.index()
    with pytest.raises(BadClip, match=rf"{NAME}\.pkl: .*{said}"):
        for ref, problem in index.broken.items():
            raise BadClip(ref.log_id + ".pkl", "index", problem)
        reader.read(index.refs[0])
