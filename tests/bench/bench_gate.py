"""What the gate on pictures catches and what it loses: `python -m tests.bench.bench_gate`.

Drives that the reward accepts in runs of preset=demo on synthetic towns, every camera at 1 Hz from T to T+2H, before
any gate. Each picture is labelled by what the painter of the town shows from the same pose with the same traffic:
likeness (SSIM at half of 160 pixels' width, tasks/render/gate.py) inside the outline of each vehicle that covers
`share` of the picture or more (0.02, the gate's own); the worst counts. Limits were chosen on the first seeds and are
reported on the others. Options: chosen=0,1 held=2 clips=9 share=0.02 out=out/bench_gate, drives=4 of each clip and
expert, every=2 of the gate's instants, iterations= fewer for a quick look. A later call with the same `out` reads
<out>/labels-<seed>.csv and only prints.
"""

import csv
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

import numpy as np

from factory.config.run import load_config
from factory.graph.steps import PreparedClip
from factory.pipeline import FactoryWork
from factory.setup.settings import assemble
from factory.stages.assets import load_or_build_scene
from factory.stages.imaging import lazy_vehicle_photos, scene_in_clip_time
from factory.stages.sensors import choose_cameras
from tasks.render.gate import GateSettings, VehiclePhotos, check_drive_pictures, gate_picture_size
from tasks.render.scene.asset import RenderAsset
from tasks.render.settings import STEPS_OF, Frames
from tasks.world.clip import HORIZON_STEPS, NOW, Clip
from tests.bench.gate_truth import Painted, Simulated, drives, verdicts

BAD, GOOD = 0.7, 0.8  # likeness to the truth: below, something is torn or smeared; from there on, nothing is
LIMITS = (0.5, 0.55, 0.6, 0.65, 0.7, 0.75, 0.8)
EXPERTS = ("pdm_closed", "recovery")
NUMBERS = ("likeness", "share", "expected", "beside")
STORED = [NOW + HORIZON_STEPS + offset for offset in STEPS_OF[Frames.HISTORY]]  # steps of a clip


@dataclass(frozen=True)
class Labelled:
    """One picture's label, and what the gate goes by."""

    log: str
    drive: str
    camera: str
    step: int
    likeness: float  # to the truth, of the worst large vehicle; 1 where there is none
    share: float  # of the picture, of that vehicle; 0 where there is none
    fault: str  # of the gate's other measures
    expected: float  # the gate's expectation, by the nearest photo
    beside: float  # the likeness to that photo itself, seen from here; 1 where none is near enough


def labelled(
    seed: int, clips: int, most: int, every: int, share_min: float, out: Path, fit: Sequence[str]
) -> list[Labelled]:
    """Runs the seed's towns; fit: settings of their scenes."""
    overrides = [*fit, f"clips.seed={seed}", f"clips.n_clips={clips}", f"out={out}/town{seed}", "render.psnr_min=0"]
    config = load_config(["preset=demo", *overrides])
    gate = replace(config.render.gate, vehicle_share=share_min)
    work = assemble(replace(config, render=replace(config.render, gate=gate))).work
    settings, began = work.render.gate, time.perf_counter()
    rows: list[Labelled] = []
    costs: list[list[float]] = []
    for ref in work.reader.index().refs:
        prepared = work.prepare(ref)
        if not isinstance(prepared, PreparedClip):
            print(f"{ref.log_id} at {ref.start_ms} ms: {prepared}", flush=True)
            continue
        clip = work.reader.read(ref)
        asset = load_or_build_scene(clip, work.render, work.cache_dir, threads=2)
        assert asset is not None, "a town has photos"
        album, town = lazy_vehicle_photos(clip, asset, work.render), Painted(seed, ref.log_id)
        timed_album = lazy_vehicle_photos(clip, asset, work.render)  # whose photos are opened while the clock runs
        asset = scene_in_clip_time(clip, asset)
        size = gate_picture_size((work.render.width, work.render.height), settings)
        rig = [camera.resized(*size) for camera in choose_cameras(clip.cameras, work.render.cameras)]
        for drive in drives(work, prepared, EXPERTS, most):
            name = f"{clip.clip_id}/{drive.expert}/{drive.candidate}"
            costs.append([cpu_ms(drive, asset, clip, work, kept_album) for kept_album in (None, timed_album)])
            for shown in town.pictures(drive, asset, rig, every):
                likeness, share = shown.label(settings.vehicle_share)
                fault, *alike = verdicts(shown, drive, asset, album, settings)
                rows.append(Labelled(ref.log_id, name, shown.camera, shown.step, likeness, share, fault, *alike))
        print(
            f"{ref.log_id} at {ref.start_ms} ms: {len(rows)} pictures, {time.perf_counter() - began:.0f} s", flush=True
        )
    whole = np.array([pair for pair in costs if np.isfinite(pair).all()])
    if len(whole):
        without, held = whole.mean(axis=0)
        print(f"gate of {len(whole)} drives that pass: {without:.0f} CPU ms a drive without photos, {held:.0f} with")
    return rows


def cpu_ms(drive: Simulated, asset: RenderAsset, clip: Clip, work: FactoryWork, album: VehiclePhotos | None) -> float:
    """CPU time of the gate on a drive [ms]; NaN where it refuses it, which ends it early."""
    render, began = work.render, time.process_time()
    cameras, size = choose_cameras(clip.cameras, render.cameras), (render.width, render.height)
    found = check_drive_pictures(
        asset, cameras, drive.poses, drive.agents, drive.steps, size, render.gate, album=album, stored=STORED
    )
    return 1e3 * (time.process_time() - began) if found is None else float("nan")


def kept(path: Path, rows: Sequence[Labelled]) -> None:
    """Writes labels as CSV."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [field.name for field in fields(Labelled)])
        writer.writeheader()
        writer.writerows(asdict(row) for row in rows)


def read(path: Path) -> list[Labelled]:
    """Labels that `kept` wrote."""
    with path.open(newline="", encoding="utf-8") as file:
        found = [
            row | {"step": int(row["step"])} | {name: float(row[name]) for name in NUMBERS}
            for row in csv.DictReader(file)
        ]
    return [Labelled(**row) for row in found]  # type: ignore[arg-type]


def table(rows: Sequence[Labelled]) -> str:
    """Per limit what is refused of the pictures with a large vehicle, by label, and of the drives, of which only the
    stored pictures count: by what is expected of a vehicle, by how it is beside a photo, by both at the defaults."""
    large = [row for row in rows if row.share > 0.0]
    of = {
        "bad": [row for row in large if row.likeness < BAD],
        "fair": [row for row in large if BAD <= row.likeness < GOOD],
        "good": [row for row in large if row.likeness >= GOOD],
    }
    everyone, poor = {row.drive for row in rows}, {row.drive for row in of["bad"] if row.step in STORED}
    lines = [
        f"{len(rows)} pictures of {len(everyone)} drives; with a large vehicle {len(large)}: "
        + ", ".join(f"{len(found)} {name}" for name, found in of.items())
        + f"; refused by the other measures: {sum(bool(row.fault) for row in of['bad'])} of the bad, "
        f"{sum(bool(row.fault) for row in of['good'])} of the good",
        "",
        "| `vehicle_min` | `beside_min` | bad caught | bad missed | fair lost | good lost | drives refused "
        "| with a bad picture | drives with a bad picture let through |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    settings = GateSettings()
    defaults = (settings.vehicle_min, settings.beside_min)
    for expected, beside in (*((limit, 0.0) for limit in LIMITS), *((0.0, limit) for limit in LIMITS), defaults):
        refused = [row.expected < expected or row.beside < beside for row in large]
        fell = {row.drive for row, falls in zip(large, refused, strict=True) if falls and row.step in STORED}
        gone = {id(row) for row, falls in zip(large, refused, strict=True) if falls}
        caught, fair, good = (sum(id(row) in gone for row in found) for found in of.values())
        limits = " | ".join(f"{limit:g}" if limit else "-" for limit in (expected, beside))
        lines.append(
            f"| {limits} | {caught} ({caught / max(len(of['bad']), 1):.0%}) | {len(of['bad']) - caught} "
            f"| {fair} ({fair / max(len(of['fair']), 1):.0%}) | {good} ({good / max(len(of['good']), 1):.1%}) "
            f"| {len(fell)} | {len(fell & poor)} | {len(poor - fell)} |"
        )
    return "\n".join(lines)


def main() -> None:
    """Labels what is not labelled yet and prints the tables."""
    options = dict(option.split("=", 1) for option in sys.argv[1:])
    out = Path(options.pop("out", "out/bench_gate"))
    clips, most, every = (int(options.pop(name, given)) for name, given in (("clips", 9), ("drives", 4), ("every", 2)))
    share_min = float(options.pop("share", GateSettings().vehicle_share))
    towns = {
        name: [int(s) for s in options.pop(name, given).split(",")]
        for name, given in (("chosen", "0,1"), ("held", "2"))
    }
    fit = [f"render.fit.iterations={options.pop('iterations')}"] if "iterations" in options else []
    if options:
        raise SystemExit(f"no such option: {', '.join(options)}")
    out.mkdir(parents=True, exist_ok=True)
    for name, seeds in towns.items():
        rows: list[Labelled] = []
        for seed in seeds:
            path = out / f"labels-{seed}.csv"
            if not path.exists():
                kept(path, labelled(seed, clips, most, every, share_min, out, fit))
            rows += read(path)
        what = "limits were chosen on" if name == "chosen" else "held out"
        print(f"\nseeds {', '.join(map(str, seeds))} ({what}): {table(rows)}")


if __name__ == "__main__":
    main()
