"""What the gate finds to be a guess, against the eye: `python -m tests.bench.bench_guess front=<nuscenes_front>`.

guess_labels.csv has 340 pictures of three data sets, each a camera and a pose of the ego (x, y, z, rotation vector),
rated by eye before the gate had a say: good, usable, or bad (torn, smeared, rubble). Bounds were chosen on those that
are `chosen`, the others were kept aside: of nuScenes' front camera pictures of the same street, of the town all. Forty
more are `accepted`: drawn with numpy's seed 0 from the pictures of the run of docs/photos.md, gate and all. Scenes are
built as runs build them, into `out`; rig=<scene file> is openscene_0101's, as `factory scene build` writes it. Options:
out=out/bench_guess, town=0 leaves the town out, iterations= fewer, of one log of it, for a quick look. Vehicles of
simulated drives are not in the pictures.
"""

import csv
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from factory.config.run import load_config
from factory.readers.base import read_clip
from factory.setup.settings import assemble
from factory.stages.assets import load_or_build_scene
from factory.stages.scene_file import read_scene
from factory.stages.sensors import block_of, choose_cameras
from tasks.render.gate import worst_quarter
from tasks.render.scene.asset import RenderAsset
from tasks.render.seen import PhotoSights, guessed_pixels, photo_sights, street_views
from tasks.render.settings import GateSettings
from tasks.world.arrays import Array
from tasks.world.clip import Camera, SensorFile

LABELS = Path(__file__).parent / "guess_labels.csv"
RATINGS = ("good", "usable", "bad")
PARTS = {"chosen": "bounds chosen on", "aside": "kept aside", "accepted": "accepted by the whole gate"}
TOWN = ["preset=demo", "clips.seed=5", "clips.n_clips=6"]
FRONT = [
    "clips=scenarionet",
    "clips.split=train",
    "render.fit.iterations=1200",
    "render.fit.start_gaussians=100000",
    "render.fit.most_gaussians=130000",
]
Block = tuple[RenderAsset, PhotoSights, dict[str, Camera]]


def blocks_of_run(overrides: list[str], out: Path) -> Iterator[tuple[str, Block]]:
    """Log by log, as a run with these settings has them."""
    work = assemble(load_config([*overrides, f"out={out}"])).work
    seen = set[str]()
    for ref in work.reader.index().refs:
        if ref.log_id in seen:
            continue
        seen.add(ref.log_id)
        clip = read_clip(work.reader, ref)
        asset = load_or_build_scene(clip, work.render, out / "cache")
        assert asset is not None
        cameras = asset.as_corrected(choose_cameras(clip.cameras, work.render.cameras))
        sights = photo_sights(asset, asset.photos_of(block_of(clip).images), cameras)
        yield ref.log_id, (asset, sights, {camera.name: camera for camera in cameras})


def block_of_file(path: Path) -> Block:
    """Of a scene that brings its photos' poses and its rig."""
    asset = read_scene(path)
    files = [SensorFile(taken.camera, "", taken.time_s, taken.world_from_ego) for taken in asset.taken]
    return asset, photo_sights(asset, files, asset.rig), {camera.name: camera for camera in asset.rig}


def measured(block: Block, row: dict[str, str]) -> float:
    """The share of the worst quarter of a labelled picture that is a guess."""
    asset, sights, cameras = block
    pose: Array = np.eye(4)
    pose[:3, 3] = [float(row[name]) for name in ("x_m", "y_m", "z_m")]
    pose[:3, :3] = Rotation.from_rotvec([float(row[name]) for name in ("rx_rad", "ry_rad", "rz_rad")]).as_matrix()
    eye, view = next(street_views(asset, [(cameras[row["camera"]], pose)]))
    return worst_quarter(guessed_pixels(sights, eye, view, np.zeros((0, 7))))


def main() -> None:
    """Prints how many of each rating are above the bound."""
    options = dict(option.split("=", 1) for option in sys.argv[1:])
    out = Path(options.get("out", "out/bench_guess"))
    blocks: dict[str, Block] = {}
    fewer = [f"render.fit.iterations={options['iterations']}"] if "iterations" in options else []
    if options.get("town", "1") != "0":
        blocks |= blocks_of_run([*TOWN, *fewer, *(["clips.n_clips=1"] if fewer else [])], out / "town")
    if "front" in options:
        root = options["front"]
        sidecar = [f"clips.root={next(Path(root).glob('*.pkl'))}", f"clips.cameras={root}"]
        blocks |= blocks_of_run([*FRONT, *sidecar, *fewer], out / "front")
    if "rig" in options:
        blocks["openscene_0101"] = block_of_file(Path(options["rig"]))
    found: dict[tuple[str, str, str], list[float]] = {}
    for row in csv.DictReader(LABELS.read_text().splitlines()):
        if row["log"] in blocks:
            key = row["data"], row["part"], row["rating"]
            found.setdefault(key, []).append(measured(blocks[row["log"]], row))
    bound = GateSettings().guessed_max
    print(f"| pictures above {bound:g} | " + " | ".join(RATINGS) + " |\n|---|---|---|---|")
    for data, part in dict.fromkeys((data, part) for data, part, _ in found):
        values = [np.array(found.get((data, part, rating), [])) for rating in RATINGS]
        cells = [f"{(shares > bound).sum()} of {len(shares)}" for shares in values]
        print(f"| {data}, {PARTS[part]} | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
