"""A front camera at 2 Hz beside a ScenarioNet log: `python -m tests.bench.bench_front <nuscenes_front> [name=value]`.

Photos with index mod 8 = 4 are held out: matched for their poses, nothing else is taken from them. With `adjust=0`
poses and calibration are as given. Boxes are the log's. Names are those of `FitSettings`.
"""

import sys
import time
from dataclasses import fields, replace
from pathlib import Path

from factory.readers.scenarionet.reader import ScenarioNetReader
from factory.stages.rig import corrected_rig, known_of, lines_of
from factory.stages.sensors import block_of, load_sensors
from tasks.render.fit.reconstruct import advance, finish
from tasks.render.fit.settings import FitSettings
from tasks.render.fit.start import prepare
from tasks.render.rig.settings import RigSettings

SIZE = (400, 225)
SETTINGS = replace(FitSettings(), iterations=1500, start_gaussians=120_000, most_gaussians=160_000, stereo_photos=6)


def main() -> None:
    """Corrects, trains and prints what comes out photo by photo."""
    root, options = Path(sys.argv[1]), dict(option.split("=", 1) for option in sys.argv[2:])
    adjust, threads = options.pop("adjust", "1") == "1", int(options.pop("threads", "2"))
    out = Path(options.pop("out", "out/bench_front"))
    out.mkdir(parents=True, exist_ok=True)
    kinds = {field.name: type(getattr(FitSettings(), field.name)) for field in fields(FitSettings)}
    settings = replace(SETTINGS, **{k: kinds[k](float(v)) for k, v in options.items()})
    reader = ScenarioNetReader(next(root.glob("*.pkl")), cameras=root)
    clip, started = reader.read(reader.index().refs[0]), time.process_time()
    block, cameras, found = block_of(clip), clip.cameras, None
    if adjust:
        block, cameras, found = corrected_rig(out / "front.safetensors", block, cameras, RigSettings())
    data = load_sensors(block, cameras, *SIZE)
    if found is not None:
        data = replace(data, known=known_of(data, block, found))
        print("\n".join(lines_of(found)))
    problem, state = prepare(data.photos, data.sweeps, block.agents, settings, threads=threads, known=data.known)
    advance(problem, state, settings, settings.iterations, threads=threads)
    asset = finish(problem, state, threads)
    each = ", ".join(f"{view.psnr_db:.1f} at {view.time_s:g} s" for view in asset.views)
    print(f"{time.process_time() - started:.0f} CPU s, {len(state)} Gaussians, held out {asset.psnr_db:.2f} dB: {each}")


if __name__ == "__main__":
    main()
