"""Cameras that are late: `python -m tests.bench.bench_late [openscene=<folder>] [front=<folder>] [town=1]`.

Of each rig, as it is and with stamps made 100 ms early for one camera or for all: what delays the photos would rather
have, by how much corners that were not fitted are less off with them, and which are believed. Of openscene_0101
instants 20 and 27 are not read; `front` is nuscenes_front; the synthetic town's stamps are right. `corners=4000` are
looked for in a photo. A photo's stamp is made early by giving it the pose 100 ms before, along the drive as it
is given.
"""

import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from factory.readers.scenarionet.reader import ScenarioNetReader
from factory.readers.settings import TownSettings
from factory.readers.town.reader import SyntheticReader
from factory.stages.sensors import block_of, opened_photos, taken_by
from tasks.render.rig.adjust import adjusted
from tasks.render.rig.corners import Corners, corners_of
from tasks.render.rig.correct import sigmas_of
from tasks.render.rig.late import delays
from tasks.render.rig.masks import hidden_by
from tasks.render.rig.matching import matched_corners, pairs
from tasks.render.rig.rig import given_rig, motions
from tasks.render.rig.settings import RigSettings
from tasks.world.agents import AgentTracks
from tasks.world.camera import Camera, SensorFile
from tests.bench.bench_rig import HELD_OUT, read_block

LATE_S = 0.1
Rig = tuple[str, Sequence[Camera], Sequence[SensorFile], AgentTracks | None]
TOWN = TownSettings(width=480, height=270, steps_per_photo=5, photo_steps=60, lidar_beams=0)


def rigs(options: dict[str, str], folder: Path) -> Iterator[Rig]:
    """Name, cameras, photos and boxes of each rig asked for."""
    if "openscene" in options:
        cameras, files, _ = read_block(Path(options["openscene"]), HELD_OUT)
        yield "openscene_0101", cameras, files, None
    if "front" in options:
        root = Path(options["front"])
        reader = ScenarioNetReader(next(root.glob("*.pkl")), cameras=root)
        clip = reader.read(reader.index().refs[0])
        yield "nuscenes_front", clip.cameras, block_of(clip).images, block_of(clip).agents
    if options.get("town") == "1":
        town = SyntheticReader(folder, 9, 0, TOWN)
        refs = {ref.log_id: ref for ref in town.index().refs}
        for log_id, ref in sorted(refs.items()):
            clip = town.read(ref)
            block = block_of(clip)
            yield f"town {log_id}", clip.cameras, taken_by(clip.cameras, block.images), block.agents


def early(files: Sequence[SensorFile], cameras: Sequence[Camera], names: Sequence[str]) -> list[SensorFile]:
    """The photos, those of the named cameras at the pose LATE_S before their own."""
    _, shots = given_rig(cameras, files)
    before = shots.world_from_ego @ motions(-LATE_S * shots.twists)
    return [replace(f, world_from_ego=pose) if f.sensor in names else f for f, pose in zip(files, before)]


def row(name: str, cameras: Sequence[Camera], files: Sequence[SensorFile], corners: Sequence[Corners]) -> str:
    """What is found of a rig, as a line."""
    settings, began = RigSettings(), time.process_time()
    rig, shots = given_rig(cameras, files)
    away = shots.world_from_ego[0, :3, 3].round()
    local = shots.world_from_ego.copy()
    local[:, :3, 3] -= away
    shots = replace(shots, world_from_ego=local)
    matched = matched_corners(rig, shots, corners, pairs(rig, shots, cameras, settings.partners))
    sigmas = sigmas_of(cameras, len(rig.corrections), settings)
    matching, began = time.process_time() - began, time.process_time()
    held = adjusted(rig, shots, matched, sigmas)
    adjusting, began = time.process_time() - began, time.process_time()
    found = delays(rig, shots, matched, held, sigmas, settings.stamp_s)
    deciding = time.process_time() - began
    late = " ".join(f"{1000.0 * s:+.0f}" for s in found.late_s)
    believed = ", ".join(c.name for c, yes in zip(cameras, found.believed) if yes) or "none"
    return (
        f"| {name} | {late} | {100.0 * found.gain:.1f} % | {found.sure:.1f} | {believed} | "
        f"{matching:.0f} + {adjusting:.0f} + {deciding:.0f} |"
    )


def main() -> None:
    """Prints a line for each rig and each way of being late."""
    options = dict(option.split("=", 1) for option in sys.argv[1:])
    settings = replace(RigSettings(), corners=int(options.get("corners", "4000")))
    print(
        "| rig, late | would be late [ms] | gain | standard errors | believed | CPU s: matching, adjusting, deciding |"
    )
    with tempfile.TemporaryDirectory() as folder:
        for name, cameras, files, agents in rigs(options, Path(folder)):
            opened = {}
            took = {camera.name: camera for camera in cameras}
            for at, image in opened_photos(files, cameras):
                hidden = hidden_by(agents, took[files[at].sensor], files[at])
                opened[at] = corners_of(image, settings.width, settings.corners, hidden)
            corners = [opened[at] for at in range(len(files))]
            turns, speeds = (given_rig(cameras, files)[1].twists[:, k] for k in (5, 0))
            print(f"{name}: {speeds.min():.1f} to {speeds.max():.1f} m/s, "
                  f"{np.degrees(turns.min()):.0f} to {np.degrees(turns.max()):.0f} deg/s", flush=True)  # fmt: skip
            one = cameras[-1].name
            for how, names in (("as it is", ()), (f"{one} 100 ms", (one,)), ("all 100 ms", tuple(took))):
                print(row(f"{name}, {how}", cameras, early(files, cameras, names), corners), flush=True)


if __name__ == "__main__":
    main()
