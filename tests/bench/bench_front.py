"""A front camera at 2 Hz beside a ScenarioNet log: `python -m tests.bench.bench_front <nuscenes_front> [name=value]`.

Photos with index mod 8 = 4 are held out: matched for their poses, nothing else is taken from them; with `matched=0` not
even that, and their poses are moved as those before and after were. With `adjust=0` poses and calibration are as given.
Boxes are the log's, as high above the road as logged. Means by class at the end. Names are those of `FitSettings`.
"""

import sys
import time
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from factory.datasets.scenarionet.reader import ScenarioNetReader
from factory.stages.assets import correct_block_rig, known_points, photo_poses, rig_report_lines
from factory.stages.sensors import block_of, load_sensors
from tasks.render.fit.reconstruct import finish_scene, run_iterations
from tasks.render.fit.start import prepare_fit
from tasks.render.rig.correct import RigCorrection
from tasks.render.scene.asset import photo_rises
from tasks.render.scene.movers import lift_tracks
from tasks.render.settings import FitSettings
from tasks.world.clip import Block, Camera, SensorFile

SIZE = (400, 225)
EVERY = 8  # of the photos one is held out, as `hold_out_every` has it
Pair = tuple[SensorFile, SensorFile]  # as given and as corrected
SETTINGS = replace(FitSettings(), iterations=1500, start_gaussians=120_000, most_gaussians=160_000, stereo_photos=6)


def beside(given: SensorFile, before: Pair, after: Pair) -> SensorFile:
    """A file at the pose between its neighbours' corrections, each a file as given and as corrected."""
    share = (given.time_s - before[0].time_s) / (after[0].time_s - before[0].time_s)
    moves = [new.world_from_ego[:3, 3] - old.world_from_ego[:3, 3] for old, new in (before, after)]
    turns = Rotation.from_matrix(
        [new.world_from_ego[:3, :3] @ old.world_from_ego[:3, :3].T for old, new in (before, after)]
    )
    pose = given.world_from_ego.copy()
    pose[:3, :3] = Slerp([0.0, 1.0], turns)(share).as_matrix() @ pose[:3, :3]
    pose[:3, 3] += (1.0 - share) * moves[0] + share * moves[1]
    return replace(given, world_from_ego=pose)


def unmatched(
    path: Path, block: Block, cameras: Sequence[Camera]
) -> tuple[Block, tuple[Camera, ...], RigCorrection | None]:
    """The block corrected without its held-out photos, which are moved as their neighbours were."""
    kept = [k for k in range(len(block.images)) if k % EVERY != EVERY // 2]
    given = {k: block.images[k] for k in kept}
    fewer = replace(block, images=tuple(given.values()))
    corrected, rig, found = correct_block_rig(path, fewer, cameras)
    known = dict(zip(kept, corrected.images, strict=True))
    files = [
        known[k] if k in known else beside(file, (given[k - 1], known[k - 1]), (given[k + 1], known[k + 1]))
        for k, file in enumerate(block.images)
    ]
    return replace(block, images=tuple(files)), rig, found


def main() -> None:
    """Corrects, trains and prints what comes out photo by photo."""
    root, options = Path(sys.argv[1]), dict(option.split("=", 1) for option in sys.argv[2:])
    adjust, threads = options.pop("adjust", "1") == "1", int(options.pop("threads", "2"))
    matched = options.pop("matched", "1") == "1"
    out = Path(options.pop("out", "out/bench_front"))
    out.mkdir(parents=True, exist_ok=True)
    kinds = {field.name: type(getattr(FitSettings(), field.name)) for field in fields(FitSettings)}
    settings = replace(SETTINGS, **{k: kinds[k](float(v)) for k, v in options.items()})
    reader = ScenarioNetReader(next(root.glob("*.pkl")), cameras=root)
    clip, started = reader.read(reader.index().refs[0]), time.process_time()
    block, cameras, found = block_of(clip), clip.cameras, None
    if adjust:
        path = out / "front.safetensors"
        if matched:
            block, cameras, found = correct_block_rig(path, block, cameras)
        else:
            block, cameras, found = unmatched(path, block, cameras)
    data = load_sensors(block, cameras, *SIZE)
    if found is not None:
        data = replace(data, known=known_points(data, block, found))
        print("\n".join(rig_report_lines(found)))
    agents = block.agents
    if found is not None:
        agents = lift_tracks(agents, *photo_rises(photo_poses(block_of(clip).images, block.images)))
    problem, state = prepare_fit(data.photos, data.sweeps, agents, settings, threads=threads, known=data.known)
    run_iterations(problem, state, settings, settings.iterations, threads=threads)
    asset = finish_scene(problem, state, threads)
    each = ", ".join(f"{view.psnr_db:.1f} at {view.time_s:g} s" for view in asset.views)
    print(f"{time.process_time() - started:.0f} CPU s, {len(state)} Gaussians, held out {asset.psnr_db:.2f} dB: {each}")
    parts = [part for view in asset.views for part in view.classes]
    named = {name: [part.psnr_db for part in parts if part.name == name] for name in sorted({p.name for p in parts})}
    print(", ".join(f"{name} {np.mean(values):.2f} dB" for name, values in named.items()))


if __name__ == "__main__":
    main()
