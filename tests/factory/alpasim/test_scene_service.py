"""Scenes behind AlpaSim's renderer contract: what is answered is what a run draws of the same instant."""

import random
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

pytest.importorskip("carla_driver_interface", reason='the contract needs pip install ".[alpasim]"')

import grpc
from carla_driver_interface.protocol import common_pb2, sensorsim_pb2

from factory.alpasim.artifact import write_artifacts
from factory.alpasim.scenes import Scenes, scenes_of_run
from factory.alpasim.sensors import SERVICE, Sensors
from factory.alpasim.wire import Fault, Service, start_server
from factory.config.run import load_config
from factory.setup.settings import assemble
from factory.store.reader import SampleTable, decode_stored_image
from factory.store.samples import Store
from factory.views.rendered_again import agents_in_world
from tasks.render.scene.asset import psnr
from tasks.render.scene.engine import encode_jpeg
from tasks.render.scene.movers import agents_at_time, world_from_boxes
from tasks.render.views import render_views, undistorted
from tasks.world.clip import NOW
from tests.factory.alpasim.asked import (
    OPTICAL,
    STREET,
    asked,
    cameras,
    pair,
    scenes,
    shot,
    street,
    with_ego_pose,
)
from tests.factory.alpasim.scrambled import scrambled_message
from tests.factory.toy import executed

Return = sensorsim_pb2.RGBRenderReturn


@pytest.fixture(scope="module")
def service() -> Service:
    return Sensors(scenes("another")).service


def decoded(data: bytes) -> np.ndarray:
    return np.asarray(cv2.cvtColor(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB))


def picture(service: Service, request: Any) -> np.ndarray:
    data = request if isinstance(request, bytes) else request.SerializeToString()
    return decoded(Return.FromString(service.answer("render_rgb", data)).image_bytes)


def drive(step: int) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Where the ego and the others are in `local` at a step of the street's log; all are numbers of few bits."""
    scene = street()
    ego = np.eye(4)
    ego[:3, 3] = scene.on_road[step, :3, 3] - scene.origin
    there = agents_at_time(scene.agents, 0.1 * step)
    poses = world_from_boxes(there.boxes)
    poses[:, :3, 3] -= scene.origin
    return ego, dict(zip(there.track_ids, poses))


@pytest.mark.parametrize("step", [15, 40, 65])
def test_a_picture_at_the_logged_pose_is_the_run_s_to_the_last_byte(service: Service, step: int) -> None:
    """With its sky, the camera's exposure then, boxes for who has no Gaussians, and its own car in front."""
    scene, (ego, objects) = street(), drive(step)
    expected = next(render_views(scene.asset, scene.cameras[:1], scene.on_road[[step]], scene.agents, [step], 96, 64))[
        0
    ]
    request = shot(STREET, cameras(service, STREET)["front"], ego, 100_000 * step, objects)
    np.testing.assert_array_equal(picture(service, request), expected)
    np.testing.assert_array_equal(picture(service, with_ego_pose(request, ego)), expected)
    jpeg = shot(STREET, cameras(service, STREET)["front"], ego, 100_000 * step, objects, image_format=2)
    for jpeg.image_quality in (95.0, 30.0):
        found = Return.FromString(asked(service, "render_rgb", jpeg)).image_bytes
        assert found == encode_jpeg(expected, round(jpeg.image_quality))
    expected = next(render_views(scene.asset, scene.cameras[:1], scene.on_road[[step]], scene.agents, [step], 48, 32))[
        0
    ]
    request.resolution_w, request.resolution_h = 48, 32
    np.testing.assert_array_equal(picture(service, request), expected)


def test_a_moved_object_moves_and_one_that_is_not_sent_is_not_there(service: Service) -> None:
    scene, (ego, objects) = street(), drive(40)
    objects["ahead"][:2, 3] += [-6.0, 2.0]
    camera = cameras(service, STREET)["front"]
    boxes = scene.agents.boxes.copy()
    boxes[40, 0, :2] += [-6.0, 2.0]
    moved = replace(scene.agents, boxes=boxes)
    expected = next(render_views(scene.asset, scene.cameras[:1], scene.on_road[[40]], moved, [40], 96, 64))[0]
    np.testing.assert_array_equal(picture(service, shot(STREET, camera, ego, 4_000_000, objects)), expected)
    del objects["ahead"]
    valid = scene.agents.valid.copy()
    valid[40, 0] = False
    gone = replace(scene.agents, valid=valid)
    expected = next(render_views(scene.asset, scene.cameras[:1], scene.on_road[[40]], gone, [40], 96, 64))[0]
    np.testing.assert_array_equal(picture(service, shot(STREET, camera, ego, 4_000_000, objects)), expected)
    objects["ahead"] = drive(40)[1]["ahead"]
    objects["ahead"][2, 3] -= 100.0  # as AlpaSim hides it
    np.testing.assert_array_equal(picture(service, shot(STREET, camera, ego, 4_000_000, objects)), expected)


def test_a_lens_s_picture_undistorted_is_the_pinhole_s(service: Service) -> None:
    """And its corners, which the pinhole does not see, are of the same scene: a wider pinhole sees them."""
    scene, (ego, objects) = street(), drive(40)
    camera = cameras(service, STREET)["bent"]
    assert list(camera.intrinsics.opencv_pinhole_param.radial_coeffs) == [-0.3, 0.1, -0.01, 0.0, 0.0, 0.0]
    camera.intrinsics.resolution_w, camera.intrinsics.resolution_h = 384, 256  # finer, so that two remaps blur little
    lens = camera.intrinsics.opencv_pinhole_param
    for name in ("focal_length_x", "focal_length_y", "principal_point_x", "principal_point_y"):
        setattr(lens, name, 4.0 * getattr(lens, name))
    bent = picture(service, shot(STREET, camera, ego, 4_000_000, objects))
    own = replace(
        scene.cameras[1], width=384, height=256, intrinsics=np.diag([4.0, 4.0, 1.0]) @ scene.cameras[1].intrinsics
    )
    straight = next(render_views(scene.asset, [own], scene.on_road[[40]], scene.agents, [40], 384, 256))[0]
    back = undistorted(bent, own)
    assert psnr(back, straight) > 30.0 and psnr(bent, straight) < 20.0
    assert (np.abs(bent[-2:].astype(int) - (40, 200, 40)) < 40).all(), "the own car goes on at the lower edge"
    told = cameras(Sensors(scenes(), pinhole=True).service, STREET)["bent"]
    assert not told.intrinsics.opencv_pinhole_param.radial_coeffs
    np.testing.assert_array_equal(
        picture(service, shot(STREET, told, ego, 4_000_000, objects)),
        np.stack([*render_views(scene.asset, scene.cameras[1:], scene.on_road[[40]], scene.agents, [40], 96, 64)])[
            0, 0
        ],
    )


def test_a_camera_of_the_client_s_own_is_where_it_says(service: Service) -> None:
    scene, (ego, objects) = street(), drive(40)
    camera = cameras(service, STREET)["front"]
    mount = OPTICAL.copy()
    mount[:3, 3] = 0.5, 1.25, 0.75
    request = shot(STREET, camera, ego, 4_000_000, objects)
    request.sensor_pose.CopyFrom(pair(ego @ mount))
    own = replace(scene.cameras[0], ego_from_camera=mount)
    expected = next(render_views(scene.asset, [own], scene.on_road[[40]], scene.agents, [40], 96, 64))[0]
    np.testing.assert_array_equal(picture(service, with_ego_pose(request, ego)), expected)
    request.camera_intrinsics.logical_id = "mine"
    assert "logical_id='mine': one of front, bent, or send ego_pose" in refused(service, "render_rgb", request)
    own = replace(own, name="mine")  # without an own body and exposures
    expected = next(render_views(scene.asset, [own], scene.on_road[[40]], scene.agents, [40], 96, 64))[0]
    np.testing.assert_array_equal(picture(service, with_ego_pose(request, ego)), expected)


def test_an_ego_that_floats_or_leans_is_drawn_on_the_road(service: Service) -> None:
    """As AlpaSim without a physics service sends it: heights and tilts of another place."""
    ego, objects = drive(40)
    camera = cameras(service, STREET)["front"]
    expected = picture(service, shot(STREET, camera, ego, 4_000_000, objects))
    for pose in (*objects.values(), ego):
        pose[2, 3] += 3.0
    np.testing.assert_array_equal(picture(service, shot(STREET, camera, ego, 4_000_000, objects)), expected)


def test_several_pictures_of_a_request_are_those_of_single_ones_in_their_order(service: Service) -> None:
    ego, objects = drive(40)
    told = cameras(service, STREET)
    requests = [shot(STREET, told[name], ego, 4_000_000, objects) for name in ("front", "bent", "front")]
    alone = [asked(service, "render_rgb", request) for request in requests]
    whole = sensorsim_pb2.AggregatedRenderReturn.FromString(
        asked(service, "render_aggregated", sensorsim_pb2.AggregatedRenderRequest(rgb_requests=requests))
    )
    assert [one.SerializeToString() for one in whole.rgb_returns] == alone
    batch = sensorsim_pb2.BatchRGBRenderRequest()
    for i, request in enumerate(requests):
        batch.items.add(camera_name=f"c{i}", request=request)
    items = sensorsim_pb2.BatchRGBRenderReturn.FromString(asked(service, "batch_render_rgb", batch)).items
    assert [(one.camera_name, one.success) for one in items] == [("c0", True), ("c1", True), ("c2", True)]
    assert [one.result.SerializeToString() for one in items] == alone


def refused(service: Service, method: str, request: Any) -> str:
    with pytest.raises(Fault) as caught:
        service.answer(method, request if isinstance(request, bytes) else request.SerializeToString())
    return f"{caught.value.status} {caught.value}"


def test_what_is_wrong_with_a_request_is_named(service: Service) -> None:
    ego, objects = drive(40)
    camera = cameras(service, STREET)["front"]

    def no(**how: Any) -> str:
        return refused(service, "render_rgb", shot(STREET, camera, ego, 4_000_000, objects, **how))

    assert no(scene_id="else").startswith("NOT_FOUND scene_id='else': no such scene")
    for said, how in (
        ("image_format=0: PNG (1) or JPEG (2)", {"image_format": 0}),
        ("image_quality=0: from 1 to 100", {"image_format": 2, "image_quality": 0.0}),
        ("image_quality=nan", {"image_format": 2, "image_quality": float("nan")}),
        ("resolution_w, _h=0, 64", {"resolution_w": 0}),
        ("resolution_w, _h=100000, 64", {"resolution_w": 100_000}),
        ("resolution_w, _h=4096, 1: less than a pixel", {"resolution_w": 4096, "resolution_h": 1}),
        ("frame_start_us=5000000: after frame_end_us=4000000", {"frame_start_us": 5_000_000}),
        ("frame_end_us=9223372036854775808: microseconds", {"frame_end_us": 1 << 63}),
        ("insert_ego_mask: there are no masks", {"insert_ego_mask": True}),
    ):
        assert said in no(**how) and no(**how).startswith("INVALID_ARGUMENT render_rgb: "), said
    request = shot(STREET, camera, ego, 4_000_000, objects)
    request.dynamic_objects[1].track_id = "nobody"
    assert "dynamic_objects[1].track_id='nobody': no track of this scene" in refused(service, "render_rgb", request)
    request.dynamic_objects[1].track_id = "ahead"
    assert "dynamic_objects[1].track_id='ahead': stands there twice" in refused(service, "render_rgb", request)
    whole = sensorsim_pb2.AggregatedRenderRequest(rgb_requests=[shot(STREET, camera, ego, 0, {}), request])
    assert "rgb_requests[1].dynamic_objects[1]" in refused(service, "render_aggregated", whole)
    many = sensorsim_pb2.BatchRGBRenderRequest(items=[sensorsim_pb2.BatchRGBRenderRequestItem()] * 65)
    assert refused(service, "batch_render_rgb", many).endswith("items: 65 of them, at most 64 in a message")
    whole.lidar_requests.add()
    assert "lidar_requests: no lidar" in refused(service, "render_aggregated", whole)
    lens = request.camera_intrinsics.opencv_pinhole_param
    lens.radial_coeffs[:] = [-3.0, 0.0, 0.0]
    request.dynamic_objects[1].track_id = "left"
    assert "opencv_pinhole_param: the distortion shows a pixel several rays" in refused(service, "render_rgb", request)
    lens.radial_coeffs[:] = [0.0, 0.0, 0.0, 0.5]
    assert "other coefficients must be 0" in refused(service, "render_rgb", request)
    lens.focal_length_x = -1.0
    lens.radial_coeffs[:] = []
    assert "intrinsics: focal lengths must be positive" in refused(service, "render_rgb", request)
    request.camera_intrinsics.ftheta_param.SetInParent()
    assert "opencv_pinhole_param is drawn, no other lens" in refused(service, "render_rgb", request)
    request.sensor_pose.end_pose.quat.w = float("nan")
    assert "sensor_pose.end_pose.quat" in refused(service, "render_rgb", request)


def test_scenes_and_versions_are_told(service: Service) -> None:
    empty = common_pb2.Empty()
    found = common_pb2.AvailableScenesReturn.FromString(asked(service, "get_available_scenes", empty))
    assert list(found.scene_ids) == [STREET, "another"]
    version = common_pb2.VersionId.FromString(asked(service, "get_version", empty))
    assert version.version_id.startswith("driving-data-factory ") and version.grpc_api_version.minor > 50
    masks = sensorsim_pb2.AvailableEgoMasksReturn.FromString(asked(service, "get_available_ego_masks", empty))
    assert not masks.ego_mask_metadata


REQUESTS = {
    "get_version": common_pb2.Empty,
    "get_available_scenes": common_pb2.Empty,
    "get_available_ego_masks": common_pb2.Empty,
    "get_available_cameras": sensorsim_pb2.AvailableCamerasRequest,
    "render_rgb": sensorsim_pb2.RGBRenderRequest,
    "render_aggregated": sensorsim_pb2.AggregatedRenderRequest,
    "batch_render_rgb": sensorsim_pb2.BatchRGBRenderRequest,
}


@pytest.fixture(scope="module")
def channel(service: Service) -> Iterator[Any]:
    server, port = start_server([service], "127.0.0.1", 0)
    with grpc.insecure_channel(f"127.0.0.1:{port}") as opened:
        yield opened
    server.stop(0)


@pytest.mark.parametrize("method", REQUESTS)
def test_no_message_ends_the_service_or_changes_another_client_s_picture(
    service: Service, channel: Any, method: str
) -> None:
    ego, objects = drive(40)
    valid = shot(STREET, cameras(service, STREET)["bent"], ego, 4_000_000, objects)
    expected, statuses = asked(service, "render_rgb", valid), set()
    call = channel.unary_unary(f"/{SERVICE}/{method}")
    rng = random.Random(method)
    data = valid.SerializeToString()
    for i in range(120):
        damaged = bytearray(data)
        for _ in range(3):
            damaged[rng.randrange(len(data))] = rng.randrange(256)
        message = scrambled_message(REQUESTS[method](), rng, (STREET, "another", "front", "ahead", "é" * 200, ""))
        for request in (message.SerializeToString(), rng.randbytes(i), bytes(damaged)):
            try:
                service.answer(method, request)
            except Fault as fault:
                statuses.add(fault.status)
    assert statuses <= {"INVALID_ARGUMENT", "NOT_FOUND"}
    try:
        call(b"\xff\xff")
    except grpc.RpcError as error:
        assert error.code() == grpc.StatusCode.INVALID_ARGUMENT
    assert channel.unary_unary(f"/{SERVICE}/render_rgb")(data) == expected


def test_clients_side_by_side_get_the_pictures_that_each_gets_alone(service: Service, channel: Any) -> None:
    told, call = cameras(service, STREET), channel.unary_unary(f"/{SERVICE}/render_rgb")

    def pictures(scene_id: str, name: str) -> list[bytes]:
        found = []
        for step in range(15, 60, 5):
            ego, objects = drive(step)
            found.append(call(shot(scene_id, told[name], ego, 100_000 * step, objects).SerializeToString()))
            with pytest.raises(grpc.RpcError):  # between them, what one does wrong
                call(shot("nowhere", told[name], ego, 0, {}).SerializeToString())
        return found

    who = [(STREET, "front"), (STREET, "bent"), ("another", "front")]
    alone, together = [pictures(*one) for one in who], dict[int, list[bytes]]()
    threads = [threading.Thread(target=lambda i=i: together.update({i: pictures(*who[i])})) for i in range(3)]  # type: ignore[misc]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [together[i] for i in range(3)] == alone and alone[0] == alone[2] != alone[1]


@pytest.fixture(scope="module")
def run(small_town: Path, tmp_path_factory: pytest.TempPathFactory) -> Store:
    """One clip of the town, rendered."""
    words = "render.width=64 render.height=36 render.scene=discs vocabulary.k=300 experts=[pdm_closed]"
    gates = "render.psnr_min=0 render.camera_psnr_min=0 render.gate.enabled=false"
    folder = tmp_path_factory.mktemp("served")
    config = load_config(["clips=av2", f"clips.root={small_town}", f"out={folder}", *words.split(), *gates.split()])
    made, store = assemble(config), Store(folder)
    executed(made.work, made.index.refs[:1], made.config.experts, 1, store)
    return store


def test_a_clip_without_samples_is_served_in_the_scene_of_its_log(run: Store, tmp_path: Path) -> None:
    shutil.copytree(run.location.uri, tmp_path / "none", ignore=shutil.ignore_patterns("samples"))
    (name,), without = scenes_of_run(run).ids, scenes_of_run(Store(tmp_path / "none"))
    assert without.ids == [name] and without.digest == scenes_of_run(run).digest
    assert without.find("scene_id", name).asset.digest == scenes_of_run(run).find("scene_id", name).asset.digest


def test_a_run_s_sample_asked_for_again_comes_out_as_it_is_stored(run: Store) -> None:
    """JPEG and poses in 32 bits lie between the two."""
    (row,), found = SampleTable(run.location.uri), scenes_of_run(run)
    assert found.ids == [row["clip_id"]]
    scene, service = found.find("scene_id", row["clip_id"]), Sensors(found).service
    (camera,), agents = cameras(service, row["clip_id"]).values(), agents_in_world(row)
    start = row["now_s"] - 0.1 * NOW  # of the row's tracks, since the clip's first step
    assert len(row["images"]) >= 4
    for image in row["images"]:
        ego = np.reshape(image["ego_pose"], (4, 4)).copy()
        ego[:3, 3] -= scene.origin
        there = agents_at_time(agents, image["time_s"] + 0.1 * NOW)
        poses = world_from_boxes(there.boxes)
        poses[:, :3, 3] -= scene.origin
        objects = dict(zip(there.track_ids, poses))
        stamp = round(1e6 * (row["now_s"] + image["time_s"]))
        request = shot(row["clip_id"], camera, ego, stamp, objects, resolution_w=64, resolution_h=36)
        assert start >= 0.0 and psnr(picture(service, request), decode_stored_image(image)) > 33.0


@pytest.mark.slow
def test_the_command_serves_a_run_until_it_is_told_to_end(run: Store) -> None:
    words = [sys.executable, "-m", "factory", "scene", "serve", run.location.uri, "port=0", "traffic=replay"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        first, address = process.stdout.readline(), process.stdout.readline().split()[-1]
        try:
            with grpc.insecure_channel(address) as channel:
                told = channel.unary_unary(f"/{SERVICE}/get_available_scenes")(b"")
                metadata = channel.unary_unary("/traffic.TrafficService/get_metadata")(b"")
        finally:
            process.send_signal(signal.SIGTERM)
        assert process.wait(60) == 0 and first == f"1 scenes, such as {scenes_of_run(run).ids[0]}\n"
    assert told[2:] in metadata and b" replay" in metadata


def test_a_scene_whose_file_is_damaged_is_named_and_others_are_served(run: Store, tmp_path: Path) -> None:
    (scene_id,) = scenes_of_run(run).ids
    found = scenes_of_run(run)
    (path,) = Path(run.location.uri, "cache").glob("block-*.safetensors")
    whole = path.read_bytes()
    path.write_bytes(whole[:-9])
    try:
        mixed = Scenes({STREET: street, scene_id: lambda: found.find("scene_id", scene_id)})
        service = Sensors(mixed).service
        request = sensorsim_pb2.AvailableCamerasRequest(scene_id=scene_id)
        assert refused(service, "get_available_cameras", request).startswith(f"DATA_LOSS scene_id={scene_id}: ")
        assert cameras(service, STREET)
        with pytest.raises(ValueError, match=f"{scene_id}: .*block-"):
            write_artifacts(mixed, tmp_path)
    finally:
        path.write_bytes(whole)
    assert cameras(Sensors(scenes_of_run(run)).service, scene_id)
