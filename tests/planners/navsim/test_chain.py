"""From NAVSIM's folders to a planner that is scored in them, by the commands: every link held against the one before.

A town's log as OpenScene with a GeoPackage, sweeps and the JPEGs of bent lenses -> a run that reconstructs the street
and renders where the simulated ego was -> its export (frame by frame: tests/factory/datasets/navsim) -> a training step
-> the agent before the exported logs -> our scorer. Brought back as samples: tests/factory/imports.
"""

import json
import pickle
import sys
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
from factory.stages.sensors import decode_image
from factory.store.reader import SampleTable, decode_stored_image
from planners.evaluation.planning import plan_samples
from planners.navsim.agent import RemotePlanner, agent_input_arrays
from planners.navsim.serve import FRONT, AgentPlanner, observation_of
from planners.training.checkpoint import load_planner, newest_checkpoint
from planners.training.train import main as train
from tasks.render.scene.engine import encode_jpeg
from tasks.trajectories import score_trajectories
from tasks.world.clip import Clip
from tasks.world.frames import to_local, to_world
from tests.factory.datasets.navsim.navsim_town import frames_of, write_town
from tests.factory.datasets.navsim.openscene_writer import Sensed, sensed_by_town
from tests.factory.datasets.navsim.test_navsim_frames import Frames, poses_of
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

    def exported(self) -> dict[tuple[str, int], Frames]:
        """The frames of each row's log, by expert and round."""
        found = {}
        for row in self.rows():
            who = "navtrain_human" if row["expert"] == "human" else f"synthetic_reaction_pdm_v1.0-{row['round']}"
            (log,) = (self.to / "navsim_logs" / who).iterdir()
            found[row["expert"], row["round"]] = pickle.loads(log.read_bytes())
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


def _logged(chain: Chain) -> list[dict[str, Any]]:
    """The frames of NAVSIM's log, written as NumPy 1 names its parts."""
    (file,) = chain.logs.glob("*.pkl")
    return frames_of(file)


@pytest.mark.slow
def test_a_planner_of_one_step_drives_as_an_agent_in_the_exported_logs_and_is_scored(chain: Chain) -> None:
    data = [f"data.real=[{chain.run}]", f"data.sim=[{chain.run}]", "planner.training.batch_size=3"]
    cameras = f"planner.settings.image.cameras=[{','.join(name.upper() for name in FRONT)}]"
    out = chain.root / "trained"
    assert train(["planner=ltf_small", cameras, *data, "steps=1", f"out={out}"]) == 0
    assert json.loads((newest_checkpoint(out) / "record.json").read_text())["step"] == 1
    logs, rows, clip = chain.exported(), chain.rows(), _clip(chain)
    shown = {key: agent_input(frames, chain.to / "sensor_blobs") for key, frames in logs.items()}
    expected = plan_samples(load_planner(out), rows)
    remote = RemotePlanner(str(out), sys.executable)
    plans = {key: remote.plan(one, 40) for key, one in shown.items()}
    remote.close()
    for row, of_row in zip(rows, expected):  # pictures are other JPEGs, decoded smaller
        np.testing.assert_allclose(plans[row["expert"], row["round"]], of_row, atol=0.3)
    still = AgentPlanner("constant_velocity")
    steady = still.plan(observation_of(agent_input_arrays(shown["human", 0], ()), ()), 8)
    speed = rows[0]["ego_status"][0]
    straight = np.array([[0.5 * speed * k, 0.0, 0.0] for k in range(1, 9)])
    np.testing.assert_allclose(steady, straight, atol=0.1)
    ahead = local_poses(logs["human", 0])[4:]
    driven = [ahead, rows[0]["label_2hz"], steady, straight, plans["human", 0][4::5]]
    scores = score_trajectories(clip, np.stack(driven)).pdm_score
    assert scores[0] == pytest.approx(scores[1], abs=1e-5) and scores[2] == pytest.approx(scores[3], abs=0.01)
    assert ((scores >= 0.0) & (scores <= 1.0)).all() and scores[0] > 0.8


def _clip(chain: Chain) -> Clip:
    """The human sample's."""
    reader = chain.reader()
    (ref,) = reader.index().refs
    return reader.read(ref)


def local_poses(frames: Frames) -> np.ndarray:
    """(12, 3) in the ego frame at now, by the public code's heading."""
    poses = poses_of(frames)
    return to_local(poses[3], poses)


def agent_input(frames: Frames, blobs: Path) -> AgentInput:
    """What NAVSIM would show an agent of a log, with the front cameras at now alone."""
    egos, shot = [], {}
    for pose, frame in zip(local_poses(frames)[:4].astype(np.float32), frames):
        motion = np.array(frame["ego_dynamic_state"], np.float32)
        egos.append(EgoStatus(pose, motion[:2], motion[2:], frame["driving_command"].astype(int)))
    keys = ("sensor2lidar_rotation", "sensor2lidar_translation", "cam_intrinsic", "distortion")
    for name in FRONT:
        camera = frames[3]["cams"][name.upper()]
        (file,) = blobs.glob(f"*/{camera['data_path']}")
        shot[name] = agent_inputs.Camera(cv2.imread(str(file))[..., ::-1], *(camera[key] for key in keys))
    return AgentInput(egos, [Cameras(), Cameras(), Cameras(), Cameras(**shot)])
