"""A fisheye's photos become a pinhole's as they are opened, and nothing else knows of it."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from factory.datasets.scenarionet.reader import ScenarioNetReader
from factory.stages.scene_file import read_scene, write_scene
from factory.stages.sensors import load_photos, read_masks, resized_mask
from factory.store.location import ClipCache, Location
from tasks.render.scene.asset import RenderAsset
from tasks.render.scene.sky import COLUMNS, ROWS, SkyMap
from tasks.render.splatting.gaussians import EMPTY
from tasks.render.views import straightened
from tasks.world.clip import Camera, Clip, Fisheye
from tests.factory.datasets.scenarionet import scenarionet_scenarios as town

SIZE = (160, 120)
K = np.array([[70.0, 0.0, 78.0], [0.0, 72.0, 61.0], [0.0, 0.0, 1.0]])
TERMS = np.array([-0.04, 0.01, -0.003, 0.0005])
MOUNT = np.array([[0.0, 0.0, 1.0, 1.7], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 1.5], [0.0, 0.0, 0.0, 1.0]])
LENS = Fisheye(K, TERMS)


def pattern(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A smooth colour for each direction x / z, y / z."""
    grey = [127.0 + 110.0 * np.sin(a * x + b * y) for a, b in ((4.0, 1.0), (1.0, 5.0), (3.0, -3.0))]
    return np.rint(np.stack(grey, axis=-1)).astype(np.uint8)


def pixels() -> tuple[np.ndarray, np.ndarray]:
    """x / z, y / z at the focal length of each pixel's centre."""
    u, v = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
    return (u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]


def as_taken() -> np.ndarray:
    """What the fisheye shows: of each pixel the angle theta by bisection of its distance from the centre."""
    x, y = pixels()
    distance = np.hypot(x, y)
    low, high = np.zeros_like(distance), np.full_like(distance, 1.5)
    for _ in range(60):
        theta = 0.5 * (low + high)
        t2 = theta * theta
        beyond = theta * (1.0 + t2 * (TERMS[0] + t2 * (TERMS[1] + t2 * (TERMS[2] + t2 * TERMS[3])))) > distance
        low, high = np.where(beyond, low, theta), np.where(beyond, theta, high)
    stretch = np.tan(low) / distance
    return pattern(x * stretch, y * stretch)


def test_a_pinhole_would_have_taken_the_same() -> None:
    off = np.abs(straightened(as_taken(), LENS).astype(int) - pattern(*pixels()))
    assert off.max() <= 8 and off.mean() < 1.0
    assert np.abs(as_taken().astype(int) - pattern(*pixels())).mean() > 10.0, "it was bent"


def test_a_sidecar_says_so_and_photos_and_masks_come_out_straight(tmp_path: Path) -> None:
    log = town.save(town.nuscenes(), tmp_path / "logs", "sd_nuscenes_v1.0-mini_scene-0001.pkl")
    (tmp_path / "photos").mkdir()
    whole_colours = [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    options = [cv2.IMWRITE_JPEG_QUALITY, 98, *whole_colours]
    assert cv2.imwrite(str(tmp_path / "photos" / "0.jpg"), as_taken()[:, :, ::-1], options)
    camera = {"K": K.tolist(), "width": SIZE[0], "height": SIZE[1], "cam_to_ego": MOUNT.tolist(),
              "fisheye": TERMS.tolist()}  # fmt: skip
    frames = [{"t_s": 0.5 * k, "file": "0.jpg"} for k in range(24)]
    told = {"cameras": {"front": camera}, "frames": frames}
    (tmp_path / "photos" / "cameras.json").write_text(json.dumps(told))
    reader = ScenarioNetReader(log, cameras=tmp_path / "photos")
    clip = reader.read(reader.index().refs[0])
    assert clip.block is not None
    (photo,) = load_photos(clip.block.images[:1], clip.cameras, *SIZE)
    assert np.abs(photo.rgb.astype(int) - pattern(*pixels())).mean() < 2.5
    low = np.zeros((SIZE[1], SIZE[0]), bool)
    low[100:] = True
    (tmp_path / "masks").mkdir()
    assert cv2.imwrite(str(tmp_path / "masks" / "front.png"), low.astype(np.uint8) * 255)
    opened = read_masks(str(tmp_path / "masks"), clip.cameras)["front"]  # of photos as they are opened: straight
    straight = resized_mask(opened, clip.cameras[0], *SIZE)
    assert straight[:, 78].sum() < low[:, 78].sum() and straight[:, 2].sum() < straight[:, 78].sum()

    cache = ClipCache(Location.parse(tmp_path / "cache"))
    cache.store("clip", clip)
    kept = cache.load("clip")
    assert isinstance(kept, Clip) and kept.cameras[0].fisheye is not None
    assert (kept.cameras[0].fisheye.terms == TERMS).all()


def test_a_scene_with_a_corrected_rig_keeps_the_lens(tmp_path: Path) -> None:
    """Its photos are opened with the lens as given, whatever the pinhole behind it was corrected to."""
    camera = Camera("front", *SIZE, K + np.diag([1.0, 1.0, 0.0]), np.zeros(5), MOUNT, LENS)
    sky = SkyMap(np.zeros((ROWS, COLUMNS, 3), np.float32))
    scene = RenderAsset(np.zeros(3), EMPTY, {}, sky, 30.0, rig=(camera, replace(camera, name="plain", fisheye=None)))
    write_scene(tmp_path / "scene.safetensors", scene)
    front, plain = read_scene(tmp_path / "scene.safetensors").rig
    assert front.fisheye is not None and (front.fisheye.intrinsics == K).all() and plain.fisheye is None
    assert (front.intrinsics == camera.intrinsics).all()
