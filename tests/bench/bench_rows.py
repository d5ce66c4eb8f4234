"""What a rolling shutter leaves: `python -m tests.bench.bench_rows [log=0] [readout_ms=30] [width=320] [height=180]`.

Photos of the synthetic town, painted band by band from where the ego was as the band's middle row was read, against
the same photos taken at once from where it was at the middle row, which is how a fit takes them: PSNR, and by how much
what is at some distances to the side moves on the picture's first and last row. Nothing moves but the ego.
"""

import sys
from itertools import pairwise

import numpy as np

from factory.readers.settings import TownSettings
from factory.readers.town.draw import Theatre, paint
from factory.readers.town.sensors import build_rig, world_from_ego
from factory.readers.town.town import plan_log
from tasks.render.rig.rig import motions, twists_of
from tasks.render.scene.asset import psnr
from tasks.world.arrays import Array, Bytes
from tasks.world.camera import Camera
from tasks.world.clip import STEP_S

BANDS, EVERY, FIRST = 8, 50, 10
AWAY_M = (5.0, 10.0, 20.0)


def in_bands(theatre: Theatre, step: int, camera: Camera, pose: Array, twist: Array, readout_s: float) -> Bytes:
    """(H, W, 3) as a rolling shutter takes it; twist (6,) of the ego a second."""
    scene, edges = theatre.at(step), np.linspace(0, camera.height, BANDS + 1).astype(int)
    out = np.zeros((camera.height, camera.width, 3), np.uint8)
    for first, last in pairwise(edges):
        after_s = readout_s * (0.5 * (first + last) / camera.height - 0.5)
        there = pose @ motions(after_s * twist[None])[0]
        out[first:last] = paint(scene, camera, there)[first:last]
    return out


def main() -> None:
    """Prints a line for each camera."""
    options = dict(option.split("=", 1) for option in sys.argv[1:])
    readout_s = float(options.get("readout_ms", "30")) / 1000.0
    size = TownSettings(width=int(options.get("width", "320")), height=int(options.get("height", "180")))
    town, drive = plan_log(0, int(options.get("log", "0")))
    theatre = Theatre(town.scenery, drive, town.sun_azimuth, town.sun_elevation, town.sky_seed)
    poses = np.stack([world_from_ego(state) for state in drive.ego])
    rig, steps = build_rig(size.cameras, size.width, size.height), range(FIRST, len(poses) - 1, EVERY)
    twists = [twists_of((np.linalg.inv(poses[s - 1]) @ poses[s + 1])[None])[0] / (2.0 * STEP_S) for s in steps]
    speeds = np.array([np.linalg.norm(t[:3]) for t in twists])
    print(f"{len(speeds)} instants, {speeds.min():.1f} to {speeds.max():.1f} m/s, read in {1000.0 * readout_s:.0f} ms")
    for camera in rig:
        found = []
        for step, twist in zip(steps, twists):
            at_once = paint(theatre.at(step), camera, poses[step])
            found.append(psnr(in_bands(theatre, step, camera, poses[step], twist, readout_s), at_once))
        ahead = camera.ego_from_camera[0, 2]  # cosine between where it looks and where the ego drives
        across = np.sqrt(max(1.0 - ahead * ahead, 0.0)) * speeds.mean() * 0.5 * readout_s * camera.intrinsics[0, 0]
        moved = ", ".join(f"{across / away:.1f} px at {away:g} m" for away in AWAY_M)
        print(
            f"{camera.name}: {np.mean(found):.1f} dB ({min(found):.1f} worst); in its middle column, first row: {moved}"
        )


if __name__ == "__main__":
    main()
