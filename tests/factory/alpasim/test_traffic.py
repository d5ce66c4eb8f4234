"""Traffic behind AlpaSim's contract: asked step by step it moves as one rollout of a run does."""

import random
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pytest

pytest.importorskip("carla_driver_interface", reason='the contract needs pip install ".[alpasim]"')

from carla_driver_interface.protocol import common_pb2

from factory.alpasim.scenes import Scenes, scene_of_drive
from factory.alpasim.traffic import END_US, Traffic, ego_states, traffic_messages
from factory.alpasim.wire import Fault, Service
from tasks.rollout.simulate import prepare_traffic, roll_out, roll_out_longer
from tasks.settings import TrafficSettings
from tasks.world.clip import NOW, Block, PhotoDrive, SensorFile, scene_of_clip
from tasks.world.frames import EGO_STATE_SIZE, PACIFICA, VX, X, Y
from tests.factory.alpasim.asked import STREET, asked, pose_message, scenes, street
from tests.factory.alpasim.scrambled import scrambled_message
from tests.tasks.streets import LANE_M

proto = traffic_messages(common_pb2)
HANDOVER_US = 1_000_000  # AlpaSim's second of log
SLOW_MPS = 4.0  # the ego's from T on; its log drives at 8


@pytest.fixture
def service() -> Service:
    return Traffic(scenes(), TrafficSettings()).service


def centre(x: float) -> np.ndarray:
    """Of the ego's box in `local`, the rear axle at x of the world, in the left lane."""
    scene, pose = street(), np.eye(4)
    pose[:3, 3] = [x + PACIFICA.rear_axle_to_center, LANE_M, 1.5] - scene.origin
    return pose


def driven_x(time_s: float) -> float:
    """The ego drives its log up to T, 1.5 s after the first instant, then slower."""
    return min(time_s - 1.5, 0.0) * 8.0 + max(time_s - 1.5, 0.0) * SLOW_MPS


def trajectory(poses: Mapping[int, np.ndarray]) -> Any:
    told = proto.TrafficSessionRequest().logged_object_trajectories.add().trajectory
    for stamp, pose in poses.items():
        told.poses.add(timestamp_us=stamp).pose.ParseFromString(pose_message(pose).SerializeToString())
    return told


def start(uuid: str, order: tuple[str, ...] = ("walker", "cone", "EGO", "left", "ahead")) -> Any:
    """As AlpaSim opens a session: every track's log, the ego's among them."""
    scene = street()
    request = proto.TrafficSessionRequest(session_uuid=uuid, map_id=STREET, random_seed=7, handover_time_us=HANDOVER_US)
    for name in order:
        if name == "EGO":
            poses = {100_000 * k: centre(8.0 * (0.1 * k - 1.5)) for k in range(96)}
        else:
            j, poses = scene.agents.track_ids.index(name), {}
            for k in np.flatnonzero(scene.agents.valid[:, j]).tolist():
                poses[100_000 * k] = np.eye(4)
                poses[100_000 * k][:3, 3] = [*scene.agents.boxes[k, j, :2], 0.8] - scene.origin
        request.logged_object_trajectories.add(object_id=name, trajectory=trajectory(poses))
    return request


def simulate(uuid: str, query_us: int) -> Any:
    request = proto.TrafficRequest(session_uuid=uuid, time_query_us=query_us)
    poses = {query_us: centre(driven_x(1e-6 * query_us))}
    request.object_trajectory_updates.add(object_id="EGO", trajectory=trajectory(poses))
    return request


def answered(service: Service, request: Any) -> dict[str, np.ndarray]:
    """Track -> x, y, z in the world."""
    answer = proto.TrafficReturn.FromString(asked(service, "simulate", request))
    found = {}
    for update in answer.object_trajectory_updates:
        (at,) = update.trajectory.poses
        assert at.timestamp_us == request.time_query_us
        found[update.object_id] = np.array([at.pose.vec.x, at.pose.vec.y, at.pose.vec.z]) + street().origin
    return found


def rollout(service: Service, uuid: str, every_us: int) -> dict[int, dict[str, np.ndarray]]:
    asked(service, "start_session", start(uuid))
    queries = range(every_us, 5_500_001, every_us)
    found = {query: answered(service, simulate(uuid, query)) for query in queries}
    asked(service, "close_session", proto.TrafficSessionCloseRequest(session_uuid=uuid))
    return found


@pytest.mark.parametrize("every_us", [100_000, 500_000])
def test_traffic_is_the_rollout_of_a_run_around_the_same_ego(service: Service, every_us: int) -> None:
    """And before T, as the handover of 1 s comes before the history that a scene begins with, the log."""
    clip = street().clip
    assert clip is not None
    states = np.zeros((41, EGO_STATE_SIZE))
    states[:, X], states[:, Y], states[:, VX] = SLOW_MPS * 0.1 * np.arange(41), LANE_M, SLOW_MPS
    states[0, VX] = 8.0
    tracks = roll_out(prepare_traffic(scene_of_clip(clip), TrafficSettings()), states).agents
    assert not np.allclose(tracks.boxes[40, 1], clip.agents.boxes[NOW + 40, 1], atol=2.0), "who follows brakes"
    for query, found in rollout(service, "one", every_us).items():
        step = query // 100_000
        log, row = (clip.agents, step) if step < NOW else (tracks, step - NOW)
        assert list(found) == [name for name in ("walker", "cone", "left", "ahead") if log.valid[row][index(name)]]
        for name, place in found.items():
            j = index(name)
            np.testing.assert_allclose(place, [*log.boxes[row, j, :2], log.center_z[row, j]], atol=1e-4)


def index(name: str) -> int:
    return street().agents.track_ids.index(name)


def test_asked_more_often_or_between_steps_it_is_the_same_traffic(service: Service) -> None:
    often, seldom, odd = (rollout(service, str(every), every) for every in (50_000, 500_000, 330_000))
    for query in seldom:
        for name, place in seldom[query].items():
            np.testing.assert_allclose(place, often[query][name], atol=1e-4)
    for query in odd:  # linear between steps; where the ego braked is known to 0.33 s
        before, after = (often[at] for at in (query // 50_000 * 50_000, -(-query // 50_000) * 50_000))
        share = query % 50_000 / 50_000
        for name, place in odd[query].items():
            if name in before and name in after:
                np.testing.assert_allclose(place, (1 - share) * before[name] + share * after[name], atol=0.2)


def test_a_rollout_looks_only_back() -> None:
    """The rows of a longer one begin with those of a shorter one, whatever the ego does later."""
    clip = street().clip
    assert clip is not None
    traffic = prepare_traffic(scene_of_clip(clip), TrafficSettings())
    poses = {100_000 * k: np.array([driven_x(0.1 * k), LANE_M, 0.0]) for k in range(60)}
    whole = roll_out_longer(traffic, ego_states(poses, 1_500_000, 45))
    for n in (20, 35, 50):
        part = roll_out_longer(traffic, ego_states({k: p for k, p in poses.items() if k <= 100_000 * n}, 1_500_000, 41))
        np.testing.assert_array_equal(part.boxes[: n - NOW + 1], whole.boxes[: n - NOW + 1])


def test_tracks_that_are_not_sent_are_not_there(service: Service) -> None:
    asked(service, "start_session", start("few", ("EGO", "left")))
    assert list(answered(service, simulate("few", 2_000_000))) == ["left"]


def test_sessions_side_by_side_do_not_meet(service: Service) -> None:
    alone = rollout(service, "alone", 500_000)
    for uuid in ("a", "b"):
        asked(service, "start_session", start(uuid))
    far = simulate("b", 2_500_000)
    far.object_trajectory_updates[0].trajectory.poses[0].pose.vec.x += 40.0
    for query in range(500_000, 5_500_001, 500_000):
        found = answered(service, simulate("a", query))
        if query == 2_500_000:
            answered(service, far)
        assert {name: place.tolist() for name, place in found.items()} == {
            name: place.tolist() for name, place in alone[query].items()
        }


def refused(service: Service, method: str, request: Any) -> str:
    with pytest.raises(Fault) as caught:
        asked(service, method, request)
    return f"{caught.value.status} {caught.value}"


def changed(request: Any, change: Callable[[Any], object]) -> Any:
    change(request)
    return request


def test_what_is_wrong_with_a_request_is_named(service: Service) -> None:
    def no(change: Callable[[Any], object]) -> str:
        return refused(service, "start_session", changed(start("bad"), change))

    at = "INVALID_ARGUMENT start_session: logged_object_trajectories"
    assert no(lambda r: setattr(r, "map_id", "x")).startswith("NOT_FOUND map_id='x': no such scene")
    assert no(lambda r: setattr(r, "session_uuid", "")).endswith("session_uuid: 1 to 128 characters, not 0")
    assert no(lambda r: setattr(r, "handover_time_us", END_US + 1)).endswith(f"the log of the scene ends at {END_US}")
    objects = "logged_object_trajectories"
    assert no(lambda r: getattr(r, objects).pop(2)) == f"{at}: no poses of EGO"
    assert no(lambda r: setattr(getattr(r, objects)[0], "object_id", "who")).endswith("no track of this scene")
    assert no(lambda r: getattr(r, objects)[4].CopyFrom(getattr(r, objects)[3])).endswith("'left': stands there twice")
    moved = no(lambda r: setattr(getattr(r, objects)[3].trajectory.poses[5].pose.vec, "y", 30.0))
    assert f"{at}[3].object_id='left': poses[5] lies 26.0 m from the track's log" in moved
    asked(service, "start_session", start("open"))
    assert refused(service, "start_session", start("open")).startswith("ALREADY_EXISTS")
    late = changed(simulate("open", 2_000_000), lambda r: setattr(r, "time_query_us", END_US + 1))
    assert refused(service, "simulate", late).endswith(f"the log of the scene ends at {END_US}")
    ahead = changed(simulate("open", 2_000_000), lambda r: setattr(r, "time_query_us", 2_100_000))
    assert "poses of EGO up to time_query_us=2100000 are expected, known: to 2000000" in refused(
        service, "simulate", ahead
    )
    other = changed(simulate("open", 2_000_000), lambda r: setattr(r.object_trajectory_updates[0], "object_id", "left"))
    assert "object_trajectory_updates[0].object_id='left': EGO alone" in refused(service, "simulate", other)
    assert refused(service, "simulate", simulate("closed", 0)).startswith("NOT_FOUND session_uuid='closed'")


def test_a_scene_of_photos_has_no_traffic() -> None:
    served = street()
    assert served.clip is not None
    photo = SensorFile("front", "0.png", 0.0, np.eye(4))
    drive = PhotoDrive("photos", "log", "", served.cameras, Block(0.0, served.agents, (photo,), ()))
    service = Traffic(Scenes({STREET: lambda: scene_of_drive(drive, served.asset)}), TrafficSettings()).service
    assert refused(service, "start_session", start("one")).endswith("a scene of photos has no map")


def test_metadata_tell_scenes_and_how_long_a_log_comes_first(service: Service) -> None:
    told = proto.TrafficModuleMetadata.FromString(asked(service, "get_metadata", proto.Empty()))
    assert list(told.supported_map_ids) == [STREET] and told.minimum_history_length_us == 1_500_000
    assert told.version_id.version_id.endswith(" idm") and told.version_id.grpc_api_version.minor > 50


def test_messages_made_from_the_table_are_the_wire_s() -> None:
    """Bytes written by hand: field << 3 | wire type, little endian."""
    request = proto.TrafficRequest(session_uuid="ab", time_query_us=258)
    request.object_trajectory_updates.add(object_id="EGO")
    assert request.SerializeToString() == b"\x0a\x02ab\x11\x02\x01\0\0\0\0\0\0\x1a\x05\x0a\x03EGO"
    assert not proto.TrafficSessionRequest().HasField("handover_time_us")
    assert proto.TrafficSessionRequest(handover_time_us=0).SerializeToString() == b"\x29" + bytes(8)


REQUESTS = {
    "get_metadata": "Empty",
    "start_session": "TrafficSessionRequest",
    "simulate": "TrafficRequest",
    "close_session": "TrafficSessionCloseRequest",
}


@pytest.mark.parametrize("method", REQUESTS)
def test_no_message_ends_the_service_or_hurts_another_session(service: Service, method: str) -> None:
    expected = rollout(service, "before", 500_000)[5_000_000]
    rng, statuses = random.Random(method), set()
    asked(service, "start_session", start("other"))
    asked(service, "start_session", start("open"))
    valid = {"start_session": start("new"), "simulate": simulate("open", 2_000_000)}.get(method, proto.Empty())
    data = valid.SerializeToString()
    strings = ("open", "EGO", "left", STREET, "", "é" * 200)
    for i in range(100):
        damaged = bytearray(data)
        for _ in range(min(3, len(data))):
            damaged[rng.randrange(len(data))] = rng.randrange(256)
        message = scrambled_message(getattr(proto, REQUESTS[method])(), rng, strings)
        for request in (message.SerializeToString(), rng.randbytes(i), bytes(damaged)):
            try:
                service.answer(method, request)
            except Fault as fault:
                statuses.add(fault.status)
    assert statuses <= {"INVALID_ARGUMENT", "NOT_FOUND", "ALREADY_EXISTS", "RESOURCE_EXHAUSTED"}
    for query in range(500_000, 5_000_001, 500_000):
        found = answered(service, simulate("other", query))
    assert {name: place.tolist() for name, place in found.items()} == {
        name: place.tolist() for name, place in expected.items()
    }
