"""From NAVSIM's folders to a planner that is scored in them, by the commands: every link held against the one before.

A town's log as OpenScene with a GeoPackage, sweeps and the JPEGs of bent lenses -> a run that reconstructs the street
and renders where the simulated ego was -> its export, read by the independent reader -> a training step -> the agent
before the exported logs -> our scorer. Brought back as samples: tests/factory/imports.
"""

import json
import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from factory.__main__ import main as factory
from factory.datasets.av2.reader import read_log
from factory.datasets.navsim.reader import NavsimReader
from factory.datasets.town.settings import MOUNTS, TownSettings
from factory.datasets.town.town import write_logs
from factory.run import main as run
from factory.stages.sensors import decode_image, encode_jpeg
from factory.store.reader import SampleTable, decode_stored_image
from planners.evaluation.planning import plan_samples
from planners.navsim.agent import RemotePlanner, agent_input_arrays
from planners.navsim.serve import FRONT, AgentPlanner, observation_of
from planners.training.checkpoint import load_planner, newest_checkpoint
from planners.training.train import main as train
from tasks.trajectories import score_trajectories
from tasks.world.clip import Clip
from tasks.world.frames import to_world
from tests.factory.datasets.navsim.navsim_town import frames_of, write_town
from tests.factory.datasets.navsim.openscene_reader import Scene, read_scenes, read_split
from tests.factory.datasets.navsim.openscene_writer import Sensed, sensed_by_town
from tests.planners.navsim import agent_inputs
from tests.planners.navsim.agent_inputs import DISTORTION, AgentInput, Cameras, EgoStatus

SIZE = (96, 54)  # of the log's JPEGs
K = 48
TOWN = "us-ma-boston"
SEEN_STEPS = 60  # of the log, photographed: the simulated ego starts at 5.5 s
RENDERED = (  # the smallest fit: a street that can be told, and nobody asks whether it is beautiful
    *("render=auto", "render.frames=history", "render.width=80", "render.height=45"),
    *("render.fit.iterations=20", "render.fit.start_gaussians=2000", "render.fit.most_gaussians=2500"),
    *("render.fit.start_every=2", "render.fit.stereo_photos=2"),
    *("render.psnr_min=0", "render.gate.enabled=false"),
)


@dataclass(frozen=True)
class Chain:
    """NAVSIM's folders, the run made of them, and its export."""

    root: Path

    @property
    def logs(self) -> Path:
        return self.root / "navsim_logs/mini"

    @property
    def run(self) -> Path:
        return self.root / "run"

    @property
    def to(self) -> Path:
        return self.root / "to"

    def reader(self) -> NavsimReader:
        return NavsimReader(self.logs, self.root / "maps", cache_dir=self.root / "kept", stride_s=4.0)

    def rows(self) -> list[dict[str, Any]]:
        return sorted(SampleTable(self.run), key=lambda row: (row["expert"], row["round"]))

    def scenes(self) -> dict[tuple[str, int], Scene]:
        """By expert and round, found as a training finds them: by the splits' files."""
        found = {}
        for row in self.rows():
            who = "navtrain_human" if row["expert"] == "human" else f"navtrain_reaction_pdm_v1.0-{row['round']}"
            devkit = self.to / "devkit/navsim/planning/script/config/common/train_test_split"
            folder, chosen = read_split(devkit / f"{who}.yaml")
            scenes = read_scenes(self.to / "navsim_logs" / folder, self.to / "sensor_blobs" / folder, chosen)
            (found[row["expert"], row["round"]],) = scenes.values()
        return found


@pytest.fixture(scope="module")
def chain(tmp_path_factory: pytest.TempPathFactory) -> Chain:
    made = Chain(tmp_path_factory.mktemp("chain"))
    write_navsim(made.root)
    clips = ["clips=navsim", f"clips.root={made.logs}", f"clips.maps={made.root / 'maps'}", "+clips.stride_s=4.0"]
    clips += [f"clips.sensors={made.root / 'sensor_blobs/mini'}", f"clips.cache_dir={made.root / 'kept'}"]
    drawn = (*RENDERED, "rounds=2", "experts=[pdm_closed,human]", f"vocabulary.k={K}", "executor=local")
    assert run([*clips, *drawn, f"out={made.run}"]) == 0
    assert factory(["export", "navsim", f"out={made.run}", f"to={made.to}", "resize=true", "workers=1"]) == 0
    return made


def write_navsim(root: Path) -> None:
    """A log of the town in nuPlan's Boston, seen by eight cameras at 2 Hz through lenses as the rig's, and by lidar."""
    seen = TownSettings(tuple(MOUNTS), *SIZE, photo_steps=SEEN_STEPS, lidar_beams=16, lidar_azimuths=180)
    (folder,) = write_logs(root / "av2", (1,), 0, seen)
    write_town(root, "mini", folder, TOWN, through_lenses(sensed_by_town(read_log(folder))))


def through_lenses(sensed: Sensed) -> Sensed:
    """The same with pictures bent as the rig's lenses bend them."""
    rig = {camera.name: camera for camera in sensed.cameras}
    grid = np.stack(np.meshgrid(*map(np.arange, SIZE)), -1).reshape(-1, 1, 2).astype(np.float32)
    images = {}
    for (name, k), data in sensed.images.items():
        matrix = rig[name].intrinsics
        from_pinhole = cv2.undistortPoints(grid, matrix, DISTORTION, P=matrix).reshape(*SIZE[::-1], 2)
        straight = decode_image(data, name)
        bent = cv2.remap(straight, from_pinhole, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)  # type: ignore[call-overload]
        images[name, k] = encode_jpeg(np.asarray(bent, np.uint8), 95)
    return Sensed(tuple(replace(camera, distortion=DISTORTION) for camera in sensed.cameras), images, sensed.sweeps)


@pytest.mark.slow
def test_the_run_is_of_the_log_s_frames_and_has_two_rounds(chain: Chain) -> None:
    frames = _logged(chain)
    tokens = [frame["token"] for frame in frames]
    rows = chain.rows()
    assert [(row["expert"], row["round"]) for row in rows] == [("human", 0), ("pdm_closed", 0), ("pdm_closed", 1)]
    for row in rows:
        at = tokens.index(row["frame_tokens"][0])
        assert row["frame_tokens"][1] == tokens[at + 8]
        poses = np.stack([frame["ego2global_translation"][:2] for frame in (frames[at], frames[at + 8])])
        np.testing.assert_allclose(row["parent_states"][:, :2], poses, atol=1e-6)
        assert len(row["images"]) == 32 and row["map_location"] == TOWN
        assert row["image_source"] == ("photo" if row["expert"] == "human" else "render")
        assert not any(np.any(camera["distortion"]) for camera in row["cameras"]), "rendered as pinholes see"
    human = rows[0]
    logged = np.stack([frame["ego2global_translation"][:2] for frame in frames[at + 1 : at + 9]])
    np.testing.assert_allclose(to_world(human["now_pose"], human["label_2hz"])[:, :2], logged, atol=1e-4)


@pytest.mark.slow
def test_pictures_are_those_of_pinholes_and_the_street_is_found_again(chain: Chain) -> None:
    """The human's as the town was painted, before lenses bent it; others rendered where nobody took a photo."""
    (folder,) = (chain.root / "av2").iterdir()
    painted = sensed_by_town(read_log(folder))
    bent = through_lenses(painted)
    human, *simulated = chain.rows()
    at = [frame["token"] for frame in _logged(chain)].index(human["frame_tokens"][0])
    for image in human["images"]:
        key = image["camera"], at + round(2.0 * image["time_s"])
        far = [
            np.abs(_small(sensed.images[key]) - _inner(decode_stored_image(image))).mean() for sensed in (painted, bent)
        ]
        assert far[0] < 6.0 and far[0] < 0.9 * far[1], key
    assert all(row["psnr"] > 18.0 for row in simulated)


def _small(jpeg: bytes) -> np.ndarray:
    """As large as the run's pictures."""
    return _inner(cv2.resize(decode_image(jpeg, "town"), (80, 45), interpolation=cv2.INTER_AREA))


def _inner(pixels: np.ndarray) -> np.ndarray:
    """What a lens shows of the rest is bent away."""
    return pixels[5:40, 10:70].astype(float)


@pytest.mark.slow
def test_the_independent_reader_finds_in_the_export_what_the_rows_say(chain: Chain) -> None:
    road_map, scenes = _clip(chain).road_map, chain.scenes()
    connectors = {int(name) for name, lane in road_map.lanes.items() if lane.is_intersection}
    lit: set[int] = set()
    for row in chain.rows():
        scene = scenes[row["expert"], row["round"]]
        first, second = row["frame_tokens"]
        assert scene.token == (first if row["expert"] == "human" else f"{second}-{row['round']:03d}")
        assert scene.simulated == (row["expert"] != "human") and not scene.second_stage
        assert len(scene.frames) == 12 and scene.n_history == 4 and scene.map_name == TOWN
        np.testing.assert_allclose(scene.history(), row["ego_history_2hz"], atol=1e-5)
        np.testing.assert_allclose(scene.future(), row["label_2hz"], atol=1e-5)
        np.testing.assert_allclose(scene.status()[4:], row["ego_status"], atol=1e-6)
        assert ("left", "straight", "right", "unknown")[int(np.argmax(scene.status()[:4]))] == row["command"]
        assert scene.now.roadblock_ids == tuple(row["route_roadblock_ids"])
        assert set(map(int, scene.now.roadblock_ids)) & set(map(int, road_map.roadblock_of.values()))
        lit |= {number for number, _ in scene.now.traffic_lights}
        there = np.asarray(row["agent_valid"])[:, 15]
        assert sorted(scene.now.track_tokens) == sorted(np.asarray(row["agent_ids"])[there])
        _same_pictures(row, scene)
    assert lit and lit <= connectors


def _logged(chain: Chain) -> list[dict[str, Any]]:
    """The frames of NAVSIM's log, written as NumPy 1 names its parts."""
    (file,) = chain.logs.glob("*.pkl")
    return frames_of(file)


def _same_pictures(row: Mapping[str, Any], scene: Scene) -> None:
    """Each is the row's, 24 times as large, with its colours in the middle of each of its pixels, and of the same rays.

    Between them it is interpolated: its mean over a pixel is off by as much as that is unlike its neighbours.
    """
    rig = {camera["name"].lower(): camera for camera in row["cameras"]}
    for image in row["images"]:
        name = image["camera"].lower()
        shot = scene.frames[round(2.0 * image["time_s"]) + 3].cameras[name]
        middles = shot.image().reshape(45, 24, 80, 24, 3)[:, 11:13, :, 11:13].mean(axis=(1, 3))
        # Grey levels: the export's JPEG and a 48th of the way to the next pixel, 0.3; 1.3 where it is 2 pixels aside.
        assert np.abs(middles - decode_stored_image(image)).mean() < 1.0
        scale = np.diag([1920 / 80, 1080 / 45, 1.0])
        np.testing.assert_allclose(shot.intrinsics, scale @ rig[name]["intrinsics"].reshape(3, 3))
        pose = rig[name]["ego_from_camera"].reshape(4, 4)
        np.testing.assert_allclose(shot.rotation, pose[:3, :3], atol=1e-9)
        np.testing.assert_allclose(shot.translation, pose[:3, 3], atol=1e-9)


@pytest.mark.slow
def test_a_planner_of_one_step_drives_as_an_agent_in_the_exported_logs_and_is_scored(chain: Chain) -> None:
    data = [f"data.real=[{chain.run}]", f"data.sim=[{chain.run}]", "planner.training.batch_size=3"]
    cameras = f"planner.settings.image.cameras=[{','.join(name.upper() for name in FRONT)}]"
    out = chain.root / "trained"
    assert train(["planner=ltf_small", cameras, *data, "steps=1", f"out={out}"]) == 0
    assert json.loads((newest_checkpoint(out) / "record.json").read_text())["step"] == 1
    scenes, rows, clip = chain.scenes(), chain.rows(), _clip(chain)
    expected = plan_samples(load_planner(out), rows)
    remote = RemotePlanner(str(out), sys.executable)
    plans = {key: remote.plan(agent_input(scene), 40) for key, scene in scenes.items()}
    remote.close()
    for row, of_row in zip(rows, expected):  # pictures are other JPEGs, decoded smaller
        np.testing.assert_allclose(plans[row["expert"], row["round"]], of_row, atol=0.3)
    still = AgentPlanner("constant_velocity")
    steady = still.plan(observation_of(agent_input_arrays(agent_input(scenes["human", 0]), ()), ()), 8)
    speed = rows[0]["ego_status"][0]
    straight = np.array([[0.5 * speed * k, 0.0, 0.0] for k in range(1, 9)])
    np.testing.assert_allclose(steady, straight, atol=0.1)
    driven = [scenes["human", 0].future(), rows[0]["label_2hz"], steady, straight, plans["human", 0][4::5]]
    scores = score_trajectories(clip, np.stack(driven)).pdm_score
    assert scores[0] == pytest.approx(scores[1], abs=1e-5) and scores[2] == pytest.approx(scores[3], abs=0.01)
    assert ((scores >= 0.0) & (scores <= 1.0)).all() and scores[0] > 0.8


def _clip(chain: Chain) -> Clip:
    """The human sample's."""
    reader = chain.reader()
    (ref,) = reader.index().refs
    return reader.read(ref)


def agent_input(scene: Scene) -> AgentInput:
    """What NAVSIM would show an agent of a scene, decoded by PIL, with the front cameras at now alone."""
    status = scene.status()
    egos = [EgoStatus(pose, status[4:6], status[6:], status[:4].astype(int)) for pose in scene.history()]
    shot = {}
    for name in FRONT:
        camera = scene.now.cameras[name]
        calibration = camera.rotation, camera.translation, camera.intrinsics, camera.distortion
        shot[name] = agent_inputs.Camera(camera.image(), *calibration)
    return AgentInput(egos, [Cameras(), Cameras(), Cameras(), Cameras(**shot)])
