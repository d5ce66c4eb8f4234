"""What AlpaSim is served: the cost of an instant's pictures and of driving, and a scene in its own renderer's mode.

    python -m tests.bench.bench_alpasim SCENE cameras.json root=<of its paths> width=1920 instants=5

Cost: CPU and wall seconds of one `render_aggregated` for all cameras as JPEG, with the lenses and without, the first of
each (its lens is worked out then) left out. Driving: CPU seconds of a simulated one of a synthetic town's clip,
replayed, with constant velocity behind the messages; the first drive left out; then with two instants of those
pictures. Mode: PSNR [dB] of pictures in gsplat's classic mode against the product's, without vehicles and with
opacities as they are or as `scene export rasterize=classic` makes them, from the log's poses and from 2 m to the left,
at the width and at halves of it.
"""

import sys
import time
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from carla_driver_interface.protocol import sensorsim_pb2

from factory.alpasim.scenes import Scenes, ServedScene, scene_of_drive
from factory.alpasim.sensors import Sensors
from factory.datasets.scenarionet.photos import read_photo_drive
from factory.datasets.town.reader import SyntheticReader
from factory.datasets.town.settings import TownSettings
from factory.stages.scene_file import read_scene
from planners.drive.alpasim_score import logged_rollout, score_drive
from planners.drive.contract import DriverSession, peer_in_process
from planners.drive.loop import LoopSettings, drive
from planners.drive.starts import extend_clip, logged_start
from planners.evaluation.planner_names import find_planner
from tasks.render.scene.asset import RenderAsset, psnr
from tasks.render.splatting.classic import made_classic
from tasks.render.splatting.project import CLASSIC
from tasks.render.views import render_views
from tasks.settings import TrafficSettings
from tasks.world.arrays import Bytes
from tasks.world.clip import NOW, STEP_S, Pinhole
from tests.factory.alpasim.asked import asked, cameras, shot


def driving() -> float:
    """CPU seconds of a simulated one, without pictures."""
    settings = LoopSettings(seconds=8.5, traffic=TrafficSettings(mode="replay"))
    with TemporaryDirectory() as folder:
        reader = SyntheticReader(Path(folder), 1, settings=TownSettings(cameras=(), lidar_beams=0))
        start = logged_start(extend_clip(reader.read(reader.index().refs[0]), settings.clip_steps(NOW)))
    peer, taken = peer_in_process(find_planner("constant_velocity"), {}), []
    for _ in range(4):
        cpu = time.process_time()
        with DriverSession(peer, start.scene, None) as session:
            made = drive(start, session, settings)
        score_drive(logged_rollout(made, settings.seconds))
        taken.append((time.process_time() - cpu) / (STEP_S * made.n_steps))
    return float(np.mean(taken[1:]))


def cost(scene: ServedScene, pinhole: bool, width: int, instants: int) -> tuple[float, str]:
    """CPU seconds of an instant, mean over the instants, and a row of the table."""
    service, taken = Sensors(Scenes({"scene": lambda: scene}), pinhole=pinhole).service, []
    height = round(width * scene.cameras[0].height / scene.cameras[0].width)
    told, sizes = cameras(service, "scene").values(), {"resolution_w": width, "resolution_h": height, "image_format": 2}
    for row in np.linspace(0, len(scene.on_road) - 1, instants + 1).astype(int).tolist():
        ego = scene.on_road[row].copy()
        ego[:3, 3] -= scene.origin
        shots = [shot("scene", camera, ego, 0, {}, **sizes) for camera in told]
        request = sensorsim_pb2.AggregatedRenderRequest(rgb_requests=shots)
        wall, cpu = time.perf_counter(), time.process_time()
        asked(service, "render_aggregated", request)
        taken.append((time.process_time() - cpu, time.perf_counter() - wall))
    spent = np.mean(taken[1:], axis=0)
    how = "pinholes" if pinhole else "lenses"
    row = f"| {len(told)} views of {width}x{height}, {how} | {spent[0]:.2f} CPU s | {spent[1]:.2f} s | of an instant"
    return float(spent[0]), row


def in_classic_mode(scene: ServedScene, width: int, aside_m: float) -> str:
    """A row of the table."""
    asset, height = scene.asset, round(width * scene.cameras[0].height / scene.cameras[0].width)
    rig = [camera.resized(width, height) for camera in scene.cameras]
    rows = np.linspace(0, len(scene.on_road) - 1, 18).astype(int)
    poses = [(scene.on_road[row] @ c.ego_from_camera, c.intrinsics) for row in rows for c in rig]
    eyes = [Pinhole(k, pose - np.pad(asset.origin[:, None], ((0, 1), (3, 0))), width, height) for pose, k in poses]
    made = replace(asset, background=made_classic(asset.background, asset.screen, eyes))
    looks = scene.on_road[(rows[:-1:4] + rows[1::4]) // 2].copy()
    looks[:, :3, 3] += aside_m * looks[:, :3, 1]
    nobody = replace(scene.agents, valid=np.zeros_like(scene.agents.valid))

    def drawn(of: RenderAsset) -> Bytes:
        return np.stack([*render_views(of, rig, looks, nobody, [0.0] * len(looks), width, height)])

    ours, before, after = drawn(asset), *(drawn(replace(one, screen=CLASSIC)) for one in (asset, made))
    where = f"{width}x{height}, {aside_m:g} m to the left"
    return f"| {where} | {psnr(ours, before):.2f} | {psnr(ours, after):.2f} |"


def main() -> None:
    """Prints two tables."""
    path, sidecar, *words = sys.argv[1:]
    options = {"width": "1920", "instants": "5", "root": str(Path(sidecar).parent)}
    options |= dict(word.split("=", 1) for word in words)
    asset, width = read_scene(Path(path)), int(options["width"])
    scene = scene_of_drive(read_photo_drive(Path(sidecar), Path(options["root"])), asset)
    print(f"{len(asset.background):,} Gaussians")
    alone = driving()
    print(f"| driving without pictures | {alone:.2f} CPU s | | of a simulated second")
    for pinhole in (True, False):
        seen, row = cost(scene, pinhole, width, int(options["instants"]))
        print(f"{row}\n| driving with them | {alone + 2.0 * seen:.2f} CPU s | | of a simulated second", flush=True)
    for size in (width, width // 2, width // 4):
        for aside_m in (0.0, 2.0):
            print(in_classic_mode(scene, size, aside_m), flush=True)


if __name__ == "__main__":
    main()
