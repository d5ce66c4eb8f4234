"""The own body found in photos: a bonnet and mirrors painted into the town's, of which the true mask is known."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from factory.datasets.town.reader import SyntheticReader
from factory.datasets.town.settings import TownSettings
from factory.stages.sensors import NOBODY, own_body_masks
from tasks.render.rig.own_body import LEAST_PHOTOS, _in_picture, choose_photos, find_own_body, shrink
from tasks.world.arrays import Bools, Bytes
from tasks.world.clip import Block, Camera, SensorFile

WIDTH, HEIGHT = 240, 135
FINER = 4  # the outline is drawn so many times larger
BODIES = {  # outlines as shares of width and height
    "bonnet": [(0.08, 1.0), (0.14, 0.93), (0.3, 0.87), (0.5, 0.85), (0.7, 0.87), (0.86, 0.93), (0.92, 1.0)],
    "rear fender": [(0.0, 1.0), (0.0, 0.8), (0.25, 0.9), (0.4, 1.0)],
    "mirror": [(0.0, 0.56), (0.09, 0.53), (0.14, 0.58), (0.14, 0.66), (0.08, 0.71), (0.05, 0.76), (0.0, 0.76)],
}
PAINTS = {"white": ((210, 212, 214), 0.05), "grey": ((60, 60, 62), 0.0)}  # colour, and how much of the scene it mirrors


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> tuple[tuple[Camera, ...], Block]:
    """What two cameras of a town's drive saw: it has no own body."""
    cameras = ("ring_front_center", "ring_front_left")
    settings = TownSettings(cameras=cameras, width=WIDTH, height=HEIGHT, lidar_beams=0)
    reader = SyntheticReader(tmp_path_factory.mktemp("town"), 1, settings=settings)
    clip = reader.read(reader.index().refs[0])
    assert clip.block is not None
    return clip.cameras, clip.block


def shape_of(body: str) -> Bools:
    drawn = np.zeros((HEIGHT * FINER, WIDTH * FINER), np.uint8)
    cv2.fillPoly(drawn, [np.array([(x * WIDTH * FINER, y * HEIGHT * FINER) for x, y in BODIES[body]], np.int32)], 255)
    return np.asarray(cv2.resize(drawn, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA) > 127)


def painted(photo: Bytes, body: str, paint: str, rng: np.random.Generator) -> Bytes:
    """A body of this paint, a little darker here than there, with noise."""
    colour, shine = PAINTS[paint]
    down, along = np.mgrid[0:HEIGHT, 0:WIDTH] / np.array([HEIGHT, WIDTH])[:, None, None]
    plain = np.array(colour) * ((0.8 + 0.5 * down) * (1.0 + 0.15 * np.sin(9.0 * along)))[..., None]
    mirrored = cv2.GaussianBlur(photo[::-1].astype(np.float32), (0, 0), 3.0)
    shown = np.where(shape_of(body)[..., None], (1.0 - shine) * plain + shine * mirrored, photo)
    return np.clip(shown + rng.normal(0.0, 0.7, shown.shape), 0, 255).astype(np.uint8)


def photos_of(camera: Camera, block: Block) -> tuple[list[Bytes], np.ndarray]:
    mine = [file for file in block.images if file.sensor == camera.name]
    poses = np.stack([file.world_from_ego for file in mine])
    rows = choose_photos(poses)
    assert len(rows) > LEAST_PHOTOS
    read = [cv2.imread(mine[row].uri, cv2.IMREAD_COLOR) for row in rows]
    return [shrink(np.asarray(photo)[..., ::-1].copy()) for photo in read if photo is not None], poses[rows]


@pytest.mark.slow
@pytest.mark.parametrize("paint", PAINTS)
@pytest.mark.parametrize("body", BODIES)
def test_a_painted_body_is_found_and_nothing_else(
    drive: tuple[tuple[Camera, ...], Block], body: str, paint: str
) -> None:
    truth, rng = shape_of(body), np.random.default_rng(0)
    for camera in drive[0]:
        photos, poses = photos_of(camera, drive[1])
        found = find_own_body([painted(photo, body, paint, rng) for photo in photos], camera, poses)
        assert found is not None
        shares = found[truth].mean(), found[~truth].mean()
        assert shares[0] >= 0.95 and shares[1] <= 0.01, (camera.name, shares)


@pytest.mark.slow
def test_a_rig_that_sees_no_body_has_none_and_nobody_asks_where_that_is_said(
    drive: tuple[tuple[Camera, ...], Block], tmp_path: Path
) -> None:
    cameras, block = drive
    assert own_body_masks("", block.images, cameras) == {}
    assert own_body_masks(NOBODY, [SensorFile(cameras[0].name, "gone.jpg", 0.0, np.eye(4))], cameras) == {}
    bonnet = [painted_file(file, tmp_path) for file in block.images if file.sensor == cameras[0].name]
    found: Mapping[str, Bools] = own_body_masks("", bonnet, cameras)
    assert list(found) == [cameras[0].name] and found[cameras[0].name].shape == (HEIGHT, WIDTH)


def painted_file(file: SensorFile, folder: Path) -> SensorFile:
    photo = cv2.imread(file.uri, cv2.IMREAD_COLOR)
    assert photo is not None
    uri = str(folder / Path(file.uri).name)
    cv2.imwrite(uri, painted(photo, "bonnet", "grey", np.random.default_rng(0)))
    return replace(file, uri=uri)


@pytest.mark.slow
def test_of_an_ego_that_stands_nothing_is_said(drive: tuple[tuple[Camera, ...], Block]) -> None:
    """All keeps its place there."""
    _, poses = photos_of(drive[0][0], drive[1])
    assert not len(choose_photos(np.repeat(poses[:1], 100, axis=0)))
    barely = poses.copy()
    barely[:, :3, 3] = poses[0, :3, 3] + (poses[:, :3, 3] - poses[0, :3, 3]) * 0.01
    assert not len(choose_photos(barely))


def test_a_lens_projects_as_opencv_s_and_without_distortion_to_the_bit() -> None:
    points = np.random.default_rng(0).normal(size=(1000, 3)) * [4.0, 2.0, 1.0] + [0.0, 0.0, 8.0]
    lens = np.array([[211.3, 0.0, 119.2], [0.0, 207.9, 66.6], [0.0, 0.0, 1.0]])
    for distortion in (np.zeros(5), np.array([-0.1, 0.02, 0.001, -0.002, 0.003])):
        theirs, _ = cv2.projectPoints(points[:, None], np.zeros(3), np.zeros(3), lens, distortion)
        assert np.array_equal(_in_picture(points, lens, distortion), theirs[:, 0])
