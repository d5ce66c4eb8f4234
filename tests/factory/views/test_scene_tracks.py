"""`scene export format=ckpt out=RUN`: a block with its vehicles, where the log had them, as WorldEngine reads it."""

import pickle
from dataclasses import replace
from pathlib import Path
from typing import NoReturn

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from factory.commands.table import COMMANDS
from factory.graph.steps import PreparedClip, cache_key
from factory.pipeline import PerturbedClip, without_sensors
from factory.readers.base import ClipRef
from factory.stages.scene_file import read_scene, write_scene
from factory.store.samples import ClipCandidates, Store
from factory.views.scene_files import classic_scene, logged_rig, logged_vehicles
from tasks.render.scene.asset import BlockRange, PhotoPose, RenderAsset, psnr
from tasks.render.scene.engine import render
from tasks.render.scene.movers import PlacedAgents, agents_at_time, boxes_at, world_from_boxes
from tasks.render.scene.sky import COLUMNS, ROWS, SkyMap
from tasks.render.splatting.project import ANTIALIASED, CLASSIC, FITTED
from tasks.world.clip import CLIP_STEPS, Camera, Clip, Pinhole
from tests.tasks.render.splatting.test_ply import some
from tests.tasks.streets import street_clip

torch = pytest.importorskip("torch", reason="checkpoints take PyTorch")
main = COMMANDS["scene"].load()
ORIGIN = np.array([20.0, -5.0, 0.5])
K = np.array([[60.0, 0.0, 48.0], [0.0, 60.0, 32.0], [0.0, 0.0, 1.0]])


MOUNT = np.array([[0.0, 0.0, 1.0, 1.5], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.25], [0.0, 0.0, 0.0, 1.0]])
BENT = np.array([-0.3, 0.1, 0.002, -0.001, -0.01])
RIG = (Camera("CAM_F0", 96, 64, K, BENT, MOUNT),)


def clips() -> list[Clip]:
    """Two of one log, the second 3 s later, and one of another log."""
    clip = replace(street_clip(), start_s=10.0, cameras=RIG)
    later = replace(clip, clip_id="later", start_s=13.0, agents=replace(clip.agents, boxes=clip.agents.boxes + 0.25))
    return [clip, later, replace(clip, clip_id="elsewhere", log_id="another")]


@pytest.fixture
def run(tmp_path: Path) -> Store:
    """What a run has kept of the clips: its table of candidates and the prepared clips, without any sensor file."""
    store, rows = Store(tmp_path / "run"), []
    for clip in clips():
        rows.append(ClipCandidates(clip.clip_id, clip.dataset, clip.log_id, "c", "p", "v", {}, ()))
        payload = PerturbedClip(ClipRef(clip.dataset, clip.log_id, 0), without_sensors(clip), ())
        store.cache.store(cache_key(clip.clip_id, "p"), PreparedClip(clip.clip_id, "c", (), {}, payload))
    store.claim()
    store.commit(rows, [], [])
    return store


@pytest.fixture
def block(tmp_path: Path) -> Path:
    """A scene of the first clip's block with two of its tracks and one that no clip shows."""
    clip = clips()[0]
    rng = np.random.default_rng(0)
    nodes = {name: some(60, 3, k) for k, name in enumerate(clip.agents.track_ids[:2])} | {"never seen": some(4, 0, 9)}
    for name, node in nodes.items():
        nodes[name] = replace(node, means=(node.means * 0.3).astype(np.float32), log_scales=node.log_scales * 0 - 1.5)
    asset = RenderAsset(
        ORIGIN, some(40, 3, 7), nodes, SkyMap(rng.uniform(0, 1, (ROWS, COLUMNS, 3)).astype(np.float32)), 27.0,
        block=BlockRange(clip.dataset, clip.log_id, 10.0, 24.0, np.zeros(2), np.ones(2)), screen=ANTIALIASED,
    )  # fmt: skip
    write_scene(tmp_path / "block.safetensors", asset)
    return tmp_path / "block.safetensors"


def beside(there: PlacedAgents, j: int) -> Pinhole:
    """A camera 8 m beside a box, which looks at it."""
    pose = np.eye(4)
    pose[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]  # along the world's y
    pose[:3, 3] = there.boxes[j, :3] + [0.0, -8.0, 0.3]
    return Pinhole(K, pose, 96, 64)


def test_a_block_goes_out_with_its_vehicles_and_its_pictures_come_back(
    run: Store, block: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, back = tmp_path / "out", tmp_path / "back.safetensors"
    asked = ["export", str(block), f"to={out}", "format=ckpt", f"out={run.location.uri}"]
    assert main(asked) == 0
    assert "left out    never seen: no clip of the run shows them here" in capsys.readouterr().out
    assert main(["import", str(out / "background" / "out.ckpt"), f"to={back}", f"like={block}"]) == 0
    whole, found = read_scene(block), read_scene(back)
    found = replace(found, background=found.background.take(slice(0, len(whole.background))))  # behind it: the sky
    assert len(found.nodes) == 2 and found.origin.tolist() == ORIGIN.tolist() and found.screen == ANTIALIASED
    renamed = dict(zip(found.nodes, whole.nodes))
    as_found = replace(found, nodes={renamed[token]: node for token, node in found.nodes.items()})
    there = agents_at_time(clips()[0].agents, 4.0)
    for name in renamed.values():
        eye = beside(there, there.track_ids.index(name))
        first, second = (render(asset, [eye], there)[0].rgb for asset in (whole, as_found))
        nobody = render(whole, [eye])[0].rgb
        np.testing.assert_allclose(second, first, atol=1e-5)
        assert np.abs(first - nobody).max() > 0.1  # the vehicle is in the picture


class PlainContainers(pickle.Unpickler):
    """Reads containers, numbers and text, and nothing that is to be called."""

    def find_class(self, module: str, name: str) -> NoReturn:
        raise pickle.UnpicklingError(f"{module}.{name} is no plain container")


def matrix(quat: list[float]) -> np.ndarray:
    """Of w, x, y, z."""
    return np.asarray(Rotation.from_quat([*quat[1:], quat[0]]).as_matrix())


def test_alpasim_s_renderer_finds_its_cameras_where_a_run_has_them(run: Store, block: Path, tmp_path: Path) -> None:
    """By the rules of its MTGS server, written anew (NVlabs/alpasim 9177bd0, plugins/mtgs/server)."""
    out = tmp_path / "town-scene"
    assert main(["export", str(block), f"to={out}", "format=ckpt", f"out={run.location.uri}"]) == 0
    with (out / "video_scene_dict.pkl").open("rb") as file:
        ((name, scene),) = PlainContainers(file).load().items()
    parts = torch.load(out / "background" / f"{name}.ckpt", weights_only=True)
    vehicles = read_scene(block).nodes.keys() - {"never seen"}
    assert {part.split("_")[-1] for part in parts} == {"background", "skybox", *vehicles}
    recon2world = np.array(parts["background"]["config"]["recon2world_translation"])
    logged = np.array([frame["ego2global"] for frame in scene["frame_infos"]])
    assert len(logged) == CLIP_STEPS + 30
    (clip, _, _), (camera,) = clips(), RIG
    first = clip.world_from_ego[0, :3, 3]
    for step in (0, 40, 95):
        local = clip.world_from_ego[step, :2, 3] - first[:2]  # as a request has it; heading 0
        at = local + first[:2] - recon2world[:2]
        ego = logged[np.argmin(np.linalg.norm(logged[:, :2, 3] - at, axis=1))].copy()
        ego[:2, 3] = at
        told = scene["frame_infos"][0]["cams"]["CAM_F0"]
        mount = np.eye(4)
        mount[:3, :3], mount[:3, 3] = matrix(told["sensor2ego_rotation"]), told["sensor2ego_translation"]
        expected = clip.world_from_ego[step] @ camera.ego_from_camera
        expected[:3, 3] -= ORIGIN
        np.testing.assert_allclose(ego @ mount, expected, atol=1e-9)
        assert (told["cam_intrinsic"], told["distortion"]) == (K.tolist(), BENT.tolist())
    assert (told["width"], told["height"]) == (96, 64)
    for bad in ("town-001", "a-b-1-9"):
        asked = ["export", str(block), f"to={tmp_path / bad}", "format=ckpt", f"out={run.location.uri}"]
        assert main(asked) == (2 if bad[-4] == "-" else 0)


def test_for_the_classic_mode_opacities_keep_the_light_that_they_had(run: Store, block: Path, tmp_path: Path) -> None:
    """Drawn so, street and vehicles look more like ours than before; nothing but opacities changes."""
    asset, store = replace(read_scene(block), screen=FITTED), run
    small = {name: replace(node, log_scales=node.log_scales - 2.0) for name, node in asset.nodes.items()}
    asset = replace(asset, nodes=small)
    vehicles, _ = logged_vehicles(store, asset)
    made, driven = classic_scene(asset, vehicles, logged_rig(store, asset))
    (clip, _, _) = clips()
    for step in (20, 60):
        there = agents_at_time(clip.agents, 0.1 * step)
        eye = Pinhole(K, clip.world_from_ego[step] @ MOUNT, 96, 64)
        ours, before, after = (render(a, [eye], there)[0].rgb for a in (asset, replace(asset, screen=CLASSIC), made))
        assert psnr(ours, after) > psnr(ours, before) + 1.0
    assert [vehicle.token for vehicle in driven] == [vehicle.token for vehicle in vehicles]
    for name, node in made.nodes.items():
        assert node.means is asset.nodes[name].means and node.log_scales is asset.nodes[name].log_scales


def test_poses_are_the_log_s_in_the_scene_s_frame_on_its_road_and_of_all_its_clips(run: Store, block: Path) -> None:
    asset = replace(read_scene(block), taken=(PhotoPose("front", 0.0, np.eye(4), 0.4),))  # the road lies 0.4 m higher
    vehicles, unseen = logged_vehicles(run, asset)
    assert unseen == ["never seen"] and len(vehicles) == 2
    first, later, _ = clips()
    for j, vehicle in enumerate(vehicles):
        assert len(vehicle.times_s) == CLIP_STEPS + 30 and np.diff(vehicle.times_s) == pytest.approx(0.1)
        assert vehicle.times_s[0] == pytest.approx(10.0)
        for row, clip, time_s in ((10, first, 1.0), (CLIP_STEPS + 20, later, 8.6)):
            boxes, valid = boxes_at(clip.agents, time_s)
            assert valid[j]
            expected = world_from_boxes(boxes)[j]
            expected[:3, 3] += [0.0, 0.0, 0.4] - ORIGIN
            np.testing.assert_allclose(vehicle.scene_from_box[row], expected, atol=1e-9)


def test_a_stretch_that_no_clip_of_the_run_lies_in_is_named(
    run: Store, block: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asset = read_scene(block)
    assert asset.block is not None
    asked = [f"to={tmp_path / 'out'}", "format=ckpt", f"out={run.location.uri}"]
    for block_range, said in (
        (replace(asset.block, start_s=50.0, end_s=70.0), "no prepared clip of log"),
        (None, "does not say which log it is of"),
    ):
        write_scene(tmp_path / "other.safetensors", replace(asset, block=block_range))
        assert main(["export", str(tmp_path / "other.safetensors"), *asked]) == 2
        assert said in capsys.readouterr().err
    assert main(["export", str(block), f"to={tmp_path / 'out'}", f"out={run.location.uri}"]) == 2
    assert "out= brings vehicles' poses into a checkpoint: format=ckpt" in capsys.readouterr().err
    damaged = next(Path(run.cache.location.uri).glob(f"{clips()[0].clip_id}-*"))
    damaged.write_bytes(damaged.read_bytes()[:-9])
    assert main(["export", str(block), *asked]) == 2
    assert f"{damaged.name}: " in capsys.readouterr().err
