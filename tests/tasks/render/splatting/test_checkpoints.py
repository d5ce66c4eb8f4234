"""Checkpoints of splatfacto, MTGS and WorldEngine: every part where it belongs, in the frame that it belongs to."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tasks.render.splatting import sh
from tasks.render.splatting.formats import LoggedVehicle, from_checkpoint, gauss_params, to_splatfacto, to_worldengine
from tasks.render.splatting.gaussians import Gaussians, moved, rotations_of
from tasks.render.splatting.project import ANTIALIASED
from tasks.world.frames import planar_matrices
from tests.tasks.render.splatting.test_ply import some
from tests.tasks.render.splatting.test_spz import apart

NAMES = ("means", "scales", "quats", "features_dc", "features_rest", "opacities")


def trained(parts: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """What MTGS' trainer saves of its parts."""
    named = {
        f"_model.gaussian_models.{part}.{name}": value for part, state in parts.items() for name, value in state.items()
    }
    return {"step": 30_000, "pipeline": {"_model.device_indicator_param": np.zeros(0)} | named, "optimizers": {}}


def light(scene: Gaussians, towards: np.ndarray) -> np.ndarray:
    """(N, 3) the colours seen along a direction, by the sum over the basis up to degree 1."""
    x, y, z = towards / np.linalg.norm(towards)
    basis = sh.C1 * np.array([-y, z, -x])
    return np.asarray(scene.colours + np.einsum("k,nkc->nc", basis, scene.sh_rest[:, :3]))


@pytest.mark.parametrize("count", sh.COUNTS)
def test_what_goes_out_comes_back(count: int) -> None:
    scene = some(40, count)
    for content, screen in (
        (to_splatfacto(scene), None),
        (to_worldengine(scene, np.array([1.0, 2.0, 3.0])), ANTIALIASED),
        (trained({"background": gauss_params(scene)}), ANTIALIASED),
    ):
        found = from_checkpoint(content)
        assert found.screen == screen
        assert max(apart(scene, found.background).values()) < 2e-6 and not found.nodes
    assert from_checkpoint(to_worldengine(scene, np.array([1.0, 2.0, 3.0]))).origin.tolist() == [1.0, 2.0, 3.0]  # type: ignore[union-attr]


def test_a_file_of_splatfacto_before_its_parameters_had_a_prefix_is_read() -> None:
    scene = some(10, 3)
    old = {name.replace("gauss_params.", ""): value for name, value in to_splatfacto(scene)["pipeline"].items()}
    assert set(old) == {f"_model.{name}" for name in NAMES}
    assert max(apart(scene, from_checkpoint({"pipeline": old}).background).values()) < 2e-6


def test_without_coefficients_colours_are_logits() -> None:
    state = {
        "means": np.zeros((1, 3)),
        "scales": np.zeros((1, 1)),
        "features_dc": np.array([[0.0, np.log(3.0), -np.log(3.0)]]),
        "features_rest": np.zeros((1, 0, 3)),
        "opacities": np.array([[np.log(4.0)]]),
    }
    found = from_checkpoint({"pipeline": {f"_model.gauss_params.{name}": value for name, value in state.items()}})
    np.testing.assert_allclose(found.background.colours, [[0.5, 0.75, 0.25]])
    np.testing.assert_allclose(found.background.opacities, [0.8], rtol=1e-6)
    assert found.background.log_scales.shape == (1, 3) and found.background.quats.tolist() == [[1.0, 0.0, 0.0, 0.0]]


def test_a_street_is_background_and_sky_and_bending_bodies_are_left_out_by_name() -> None:
    street, sky, walker = some(5, 3, 1), some(7, 3, 2), some(3, 3, 3)
    found = from_checkpoint(trained({
        "skybox": gauss_params(sky), "background": gauss_params(street), "deformable_node_77": gauss_params(walker),
    }))  # fmt: skip
    assert len(found.background) == 12 and found.left_out == ("deformable_node_77",) and not found.nodes
    assert max(apart(street, found.background.take(slice(0, 5))).values()) < 2e-6


def test_the_light_of_a_vehicle_is_that_of_its_place_in_the_middle_of_the_log() -> None:
    """There a coefficient is of a direction in the world: put where it was, the vehicle has the same light."""
    stored = some(6, 3)
    turns = np.linspace(0.2, 1.4, 5) / 2
    quats = np.column_stack([np.cos(turns), np.zeros((5, 2)), np.sin(turns)])
    places = np.column_stack([np.arange(5.0), np.zeros(5), np.ones(5)])
    places[0, 2] = 100_000.0  # not there yet: the middle of four is the third of five
    state = gauss_params(stored) | {"instance_quats": quats, "instance_trans": places}
    node = from_checkpoint(trained({"background": gauss_params(stored), "rigid_object_ab": state})).nodes["ab"]
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotations_of(quats[3][None])[0], places[3]
    placed = moved(node, pose)
    for towards in np.eye(3):
        np.testing.assert_allclose(light(placed, towards), light(stored, towards), atol=1e-6)
    np.testing.assert_allclose(placed.means, stored.means @ pose[:3, :3].T + pose[:3, 3], atol=1e-4)


def logged(token: str, node: Gaussians) -> LoggedVehicle:
    """Five instants at 10 Hz from 2 s of the log on; absent at the first and the last, turning left on the way."""
    turns = np.array([0.0, 0.2, 0.5, 0.9, 0.0])
    poses = planar_matrices(np.column_stack([10.0 * np.arange(5.0), -np.arange(5.0), turns]))
    poses[:, 2, 3] = 0.8
    poses[[0, 4]] = np.nan
    return LoggedVehicle(token, node, 2.0 + 0.1 * np.arange(5), poses)


@pytest.mark.parametrize("count", sh.COUNTS)
def test_vehicles_go_out_with_their_poses_and_come_back(count: int) -> None:
    street, cars = some(10, count, 1), {"7f": some(6, count, 2), "a-8": some(4, 0, 3)}
    content = to_worldengine(street, np.zeros(3), [logged(token, car) for token, car in cars.items()])
    found = from_checkpoint(content)
    assert list(found.nodes) == list(cars) and found.screen == ANTIALIASED
    for token, car in cars.items():
        assert max(apart(car, found.nodes[token]).values()) < 2e-6


def test_a_vehicle_s_part_has_what_worldengine_s_loader_asks_for() -> None:
    """render/mtgs/gaussian_model/rigid_object.py and vanilla_gaussian_splatting.py of a14fd10: of `config` these names,
    of `state_dict` each parameter under gauss_params., instance_trans and instance_quats, a row for each stamp [us];
    mtgs.py cuts the part's name at its last underscore and takes poses above 1 km for absent."""
    vehicle = logged("7f", some(6, 3))
    parts = to_worldengine(some(3, 3), np.zeros(3), [vehicle])
    assert list(parts) == ["background", "rigid_object_7f"]
    config, state = parts["rigid_object_7f"]["config"], parts["rigid_object_7f"]["state_dict"]
    assert (config["type"], config["sh_degree"], config["scale_dim"]) == ("RigidSubModel", 1, 3)
    assert "fourier_features_dim" not in config  # colours are no waves
    assert config["log_timestamps"].tolist() == [2_000_000, 2_100_000, 2_200_000, 2_300_000, 2_400_000]
    assert set(state) == {f"gauss_params.{name}" for name in NAMES} | {"instance_quats", "instance_trans"}
    quats, places = state["instance_quats"], state["instance_trans"]
    assert quats.shape == (5, 4) and places.shape == (5, 3) and quats.dtype == places.dtype == np.float32
    assert (places[:, 2] < 1000.0).tolist() == [False, True, True, True, False]
    np.testing.assert_allclose(np.linalg.norm(quats, axis=1), 1.0, atol=1e-6)
    for k in (1, 2, 3):  # get_means: local @ rotation.T + place
        pose = vehicle.scene_from_box[k]
        placed = state["gauss_params.means"] @ rotations_of(quats[k][None])[0].T + places[k]
        np.testing.assert_allclose(placed, moved(vehicle.gaussians, pose).means, atol=1e-4)
    middle = moved(vehicle.gaussians, vehicle.scene_from_box[2])  # there its coefficients are of the world's directions
    np.testing.assert_allclose(state["gauss_params.features_rest"], middle.sh_rest, atol=1e-6)


def test_a_vehicle_that_is_nowhere_is_named() -> None:
    vehicle = logged("7f", some(3, 0))
    for bad in (
        replace(vehicle, scene_from_box=np.full((5, 4, 4), np.nan)),
        replace(vehicle, times_s=np.array([2.0]), scene_from_box=vehicle.scene_from_box[1:2]),
    ):
        with pytest.raises(ValueError, match="7f: it takes two instants"):
            to_worldengine(some(3, 0), np.zeros(3), [bad])


def test_half_a_vehicle_is_mirrored_about_its_length() -> None:
    half = some(4, 3)
    part = {"config": {"type": "MirroredRigidSubModel"}, "state_dict": gauss_params(half)}
    whole = from_checkpoint(to_worldengine(half, np.zeros(3)) | {"rigid_object_ab": part}).nodes["ab"]
    mirror = np.diag([1.0, -1.0, 1.0])
    assert len(whole) == 8
    other = whole.take(slice(4, 8))
    np.testing.assert_allclose(other.means, half.means @ mirror)
    spread = [r * np.exp(g.log_scales)[:, None] for g in (half, other) for r in [rotations_of(g.quats)]]
    here, there = (s @ s.transpose(0, 2, 1) for s in spread)
    np.testing.assert_allclose(there, mirror @ here @ mirror, atol=1e-5)
    for towards in np.eye(3):
        np.testing.assert_allclose(light(other, mirror @ towards), light(half, towards), atol=1e-6)


@pytest.mark.parametrize(("traversal", "added"), [(None, 0.3), (0, 0.1), (1, 0.5)])
def test_colours_are_those_of_a_traversal_or_their_mean(traversal: int | None, added: float) -> None:
    scene = some(4, 3)
    state = gauss_params(scene)
    rest = state["gauss_params.features_rest"]
    state["gauss_params.features_adapters"] = np.broadcast_to(np.array([0.1, 0.5])[None, :, None], (4, 2, 3))
    state["gauss_params.features_rest"] = np.stack([rest - 0.2, rest + 0.2], 1)
    found = from_checkpoint(trained({"background": state}), traversal).background
    np.testing.assert_allclose(found.colours - scene.colours, sh.C0 * added, atol=1e-6)
    shift = {None: 0.0, 0: -0.2, 1: 0.2}[traversal]
    np.testing.assert_allclose(found.sh_rest, rest + shift, atol=1e-6)


def test_colours_that_are_waves_are_their_mean() -> None:
    """One wave is a constant; the others have whole periods over all sides, and so no mean there."""
    scene = some(4, 3)
    state = gauss_params(scene)
    constant = state["gauss_params.features_dc"]
    waves = np.stack([constant, 0.3 * np.ones_like(constant), -0.2 * np.ones_like(constant)], 1)
    part = {
        "config": {"type": "RigidSubModel", "fourier_in_space": "spatial"},
        "state_dict": state | {"gauss_params.features_dc": waves},
    }
    spatial = from_checkpoint(to_worldengine(scene, np.zeros(3)) | {"rigid_object_ab": part}).nodes["ab"]
    np.testing.assert_allclose(spatial.colours, scene.colours, atol=1e-6)
    part["config"] = {"type": "RigidSubModel", "fourier_in_space": "temporal"}
    over_time = from_checkpoint(to_worldengine(scene, np.zeros(3)) | {"rigid_object_ab": part}).nodes["ab"]
    phase = 2 * (
        2 * np.pi / 3
    )  # at the log's end; over it sin has the mean (1 - cos phase) / phase, cos sin phase / phase
    mean = 0.3 * (1 - np.cos(phase)) / phase - 0.2 * np.sin(phase) / phase
    np.testing.assert_allclose(over_time.colours, scene.colours + sh.C0 * mean, atol=1e-4)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (None, "expected names and values, found NoneType"),
        ({}, "neither 'pipeline'"),
        ({"pipeline": {"_model.field.weight": np.zeros(3)}}, "no gauss_params under 'pipeline'"),
        ({"pipeline": {"_model.gauss_params.means": np.zeros((1, 3))}}, "background: scales is absent"),
        (trained({"rigid_object_ab": gauss_params(some(3, 0))}), "no part 'background' among rigid_object_ab"),
        ({"background": {"config": {}, "state_dict": 3}}, "background: 'config' and 'state_dict'"),
        (
            trained({"background": gauss_params(some(3, 0)) | {"gauss_params.means": np.full((3, 3), np.nan)}}),
            "background: means: NaN or infinity",
        ),
        (
            trained({"background": gauss_params(some(3, 0)), "rigid_object_ab": gauss_params(some(3, 0)) | {
                "instance_quats": np.ones((2, 4)), "instance_trans": np.ones((3, 3))}}),
            "rigid_object_ab: 2 instance_quats and 3 instance_trans",
        ),
    ],
)  # fmt: skip
def test_faults_are_named(content: object, said: str) -> None:
    with pytest.raises(ValueError, match="checkpoint: ") as caught:
        from_checkpoint(content)
    assert said in str(caught.value)


def test_a_traversal_that_is_not_there_is_named() -> None:
    state = gauss_params(some(3, 0)) | {"gauss_params.features_adapters": np.zeros((3, 2, 3))}
    with pytest.raises(ValueError, match="traversal 2 of 2"):
        from_checkpoint(trained({"background": state}), 2)
