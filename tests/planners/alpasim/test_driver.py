"""A planner behind AlpaSim's contract: one rollout's plans depend on what was sent of it, and on nothing else."""

import random
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("carla_driver_interface", reason='the contract needs pip install ".[alpasim]"')

import grpc
from carla_driver_interface import protocol
from carla_driver_interface.testing import FakeCamera, FakeLoop

from factory.alpasim import wire
from factory.alpasim.wire import Fault, start_server
from factory.config.arguments import Refused
from factory.config.compose import ConfigError
from planners.alpasim import driver as driver_module
from planners.alpasim.driver import Driver
from planners.alpasim.session import HEADING, Moment, Session, driven_on, local_poses, state_at
from planners.evaluation.planning import plan_samples
from tasks.world.frames import to_local, to_world
from tests.factory.alpasim.scrambled import scrambled_message
from tests.planners.alpasim import rollout as sent
from tests.planners.alpasim.rollout import NAN, Rollout
from tests.planners.navsim.agent_inputs import HISTORY, MOTION, row
from tests.planners.navsim.trained import FAMILIES, made, saved

BLIND = "constant_velocity"


class InProcess:
    """The stub's methods on a driver in this process."""

    def __init__(self, driver: Driver) -> None:
        self._driver = driver

    def __getattr__(self, method: str) -> Any:
        answers = {
            "get_version": protocol.VersionId,
            "drive": protocol.DriveResponse,
            "start_session": protocol.SessionRequestStatus,
        }
        kind = answers.get(method, protocol.Empty)
        return lambda request: kind.FromString(self._driver.service.answer(method, request.SerializeToString()))


@pytest.fixture(scope="module")
def looking(tmp_path_factory: pytest.TempPathFactory) -> str:
    """An LTF's folder."""
    return saved(made("ltf_small"), tmp_path_factory.mktemp("ltf"))


@pytest.fixture(scope="module")
def served(looking: str) -> Iterator[tuple[Driver, Any]]:
    """A driver that looks, and a stub over the wire."""
    driver = Driver(looking)
    server, port = start_server([driver.service], "127.0.0.1", 0)
    with grpc.insecure_channel(f"127.0.0.1:{port}") as channel:
        yield driver, protocol.EgodriverServiceStub(channel)
    server.stop(0)
    driver.close()


@pytest.fixture(scope="module")
def blind() -> Iterator[Driver]:
    driver = Driver(BLIND)
    yield driver
    driver.close()


def driven(stub: Any, uuid: str, steps: int = 3, **how: Any) -> list[bytes]:
    """The answers of a rollout's drive calls."""
    one = Rollout(stub, uuid, **how)
    one.begin()
    answers = [one.step().SerializeToString(deterministic=True) for _ in range(steps)]
    one.end()
    return answers


def poses(answer: Any) -> tuple[np.ndarray, np.ndarray]:
    """Stamps (N,) [us], and x, y, heading (N, 3) of a trajectory."""
    found = [(p.pose.vec.x, p.pose.vec.y, 2.0 * np.arctan2(p.pose.quat.z, p.pose.quat.w)) for p in answer.poses]
    return np.array([p.timestamp_us for p in answer.poses]), np.array(found)


def refused(driver: Driver, method: str, request: Any) -> str:
    with pytest.raises(Fault) as caught:
        driver.service.answer(method, request if isinstance(request, bytes) else request.SerializeToString())
    return f"{caught.value.status} {caught.value}"


def test_a_rollout_is_answered_every_tenth_of_a_second_for_four_seconds_from_now(served: tuple[Driver, Any]) -> None:
    one = Rollout(served[1], "life")
    one.begin()
    for step in range(3):
        now, at = one.now_us, one.at
        stamps, found = poses(one.step())
        assert stamps.tolist() == [now + 100_000 * i for i in range(41)], step
        np.testing.assert_allclose(found[0], at, atol=1e-4)
        assert np.isfinite(found).all() and len({a.pose.vec.z for a in one.answers[-1].poses}) == 1
    one.end()
    with pytest.raises(grpc.RpcError) as gone:
        one.step()
    assert gone.value.code() == grpc.StatusCode.NOT_FOUND
    version = served[1].get_version(protocol.Empty())
    assert version.version_id.startswith("driving-data-factory ") and version.grpc_api_version.minor > 50


def test_in_process_and_over_the_wire_in_any_order_the_plan_is_the_same_to_the_bit(served: tuple[Driver, Any]) -> None:
    expected = driven(InProcess(served[0]), "here")
    assert driven(served[1], "wire") == expected
    for seed in range(3):
        assert driven(served[1], f"shuffled{seed}", order=random.Random(seed)) == expected
    assert driven(served[1], "left", curvature=1 / 50) != expected, "the command matters"


@pytest.mark.slow
@pytest.mark.parametrize("batch", [1, 3])
@pytest.mark.parametrize("name", FAMILIES)
def test_rollouts_side_by_side_drive_as_each_does_alone(tmp_path: Path, name: str, batch: int) -> None:
    """To the last bit one by one, but for rounding in batches."""
    driver = Driver(saved(made(name), tmp_path), batch=batch, wait_s=0.05)
    bends, stub = (0.0, 1 / 50, -1 / 50, 0.0, 1 / 80), InProcess(driver)
    sizes, plan = [], driver._planner._made.plan
    driver._planner._made.plan = lambda shown: sizes.append(len(shown)) or plan(shown)  # type: ignore[func-returns-value]

    def drive(uuid: str, i: int) -> list[bytes]:
        return driven(stub, f"{uuid}{i}", curvature=bends[i], speed=4.0 + i)

    alone = [drive("alone", i) for i in range(len(bends))]
    with ThreadPoolExecutor(len(bends)) as pool:
        together = list(pool.map(lambda i: drive("beside", i), range(len(bends))))
    if batch == 1:
        assert together == alone
    for one, other in zip(together, alone):
        for found, expected in zip(one, other):
            np.testing.assert_allclose(
                *(poses(protocol.Trajectory.FromString(a))[1] for a in (found, expected)), atol=1e-3
            )
    assert driver.counts == {"plans": 30} and max(sizes) == batch
    driver.close()


@pytest.mark.parametrize("name", FAMILIES)
def test_the_plan_is_that_of_the_row_of_the_same_content(tmp_path: Path, name: str) -> None:
    planner = made(name)
    driver = Driver(saved(planner, tmp_path))
    stub, now = InProcess(driver), 1_500_000
    stub.start_session(sent.start("row"))
    x, y, yaw = 3.0, 5.0, -1.0
    for i, pose in enumerate(to_world(np.array([x, y, yaw]), HISTORY.astype(float)).tolist()):
        motion = sent.egomotion("row", [sent.pose_at(500_000 * i, *pose)], float(MOTION[0]))
        state = motion.dynamic_states[0]
        state.linear_velocity.y, state.linear_acceleration.x, state.linear_acceleration.y = MOTION[1:].tolist()
        stub.submit_egomotion_observation(motion)
    stub.submit_route(sent.route_request("row", now, 1 / 30))
    expected_row = row(("cam_l0", "cam_f0", "cam_r0"), "left")
    for image in expected_row["images"]:
        message = sent.picture("row", image["camera"].upper(), now)
        message.camera_image.image_bytes = image["jpeg"]
        stub.submit_image_observation(message)
    _, found = poses(
        stub.drive(protocol.DriveRequest(session_uuid="row", time_now_us=now, time_query_us=now)).trajectory
    )
    plan = plan_samples(planner, [expected_row])[0]
    np.testing.assert_allclose(to_local(np.array([x, y, yaw]), found[5:])[:, :2], plan[4:, :2], atol=1e-4)
    driver.close()


def test_the_first_two_poses_are_not_differenced_and_history_goes_back_at_known_speed() -> None:
    """The second pose is where the first was, 17 ms later: a difference would say that the car stands."""
    state = np.array([100.0, -40.0, 0.5, 0.7, 6.0, 0.0, 0.0, 0.0, 0.2])
    states = {0: state, 17_000: state}
    for back_s in (0.5, 1.0, 1.5):
        found = to_local(state[:3], state_at(states, -int(back_s * 1e6)))
        radius = 6.0 / 0.2
        closed = [-radius * np.sin(0.2 * back_s), radius * (1.0 - np.cos(0.2 * back_s)), -0.2 * back_s]
        np.testing.assert_allclose(found[: HEADING + 1], closed, atol=1e-9)


@pytest.mark.parametrize("rate_hz", [3.0, 10.0, 37.0, 100.0])
def test_history_is_that_of_the_drive_whatever_the_rate_of_its_poses(rate_hz: float) -> None:
    step_us = round(1e6 / rate_hz)
    begin = np.array([5.0, 6.0, 3.0, 0.0, 8.0, 0.0, 0.0, 0.0, 0.1])

    def at(stamp_us: int) -> np.ndarray:
        moved = begin.copy()
        moved[:3] = to_world(begin[:3], driven_on(begin, stamp_us / 1e6))
        return moved

    states = {stamp: at(stamp) for stamp in range(0, 2_000_000 + step_us, step_us)}
    for stamp in range(400_000, 1_900_000, 130_000):
        np.testing.assert_allclose(state_at(states, stamp)[:2], at(stamp)[:2], atol=0.012)


def test_an_answer_begins_at_the_ego_s_own_speed_and_keeps_the_plan_s_clock() -> None:
    state = np.array([10.0, 20.0, 0.0, 0.0, 8.0, 0.0, 0.0, 0.0, 0.0])
    plan = np.column_stack([np.arange(1, 9) * 1.0, np.zeros((8, 2))])  # 2 m/s
    found = local_poses(plan, state, 1_000_000, 1_000_000, 1_500_000)
    along = np.array([pose[0] - 10.0 for pose in found.values()])
    assert along[1] == pytest.approx(0.8, abs=0.07), "8 m/s at first"
    np.testing.assert_allclose(along[5:], np.arange(5, 41) * 0.2, atol=1e-9)
    later = local_poses(plan, state, 1_000_000, 1_250_000, 6_000_000)
    assert list(later) == [1_250_000 + 100_000 * i for i in range(49)]
    np.testing.assert_allclose([p[0] - 10.0 for p in later.values()][3:], np.arange(3, 49) * 0.2 + 0.5, atol=1e-9)


def test_a_camera_without_a_picture_of_now_is_said_and_counted_and_the_car_goes_straight_on(
    served: tuple[Driver, Any], caplog: pytest.LogCaptureFixture
) -> None:
    driver, stub = served
    one, before = Rollout(stub, "blinded", speed=7.0), driver.counts["fallbacks"]
    one.begin()
    one.step()
    one.observe()
    one.now_us += 2 * sent.STEP_US
    stub.submit_egomotion_observation(sent.egomotion("blinded", [sent.pose_at(one.now_us, *one.at)], 7.0))
    _, found = poses(one.drive())
    assert driver.counts["fallbacks"] == before + 1
    assert "blinded at 1517000 us: straight on at the ego's speed: no picture of cam_l0 of now" in caplog.text
    np.testing.assert_allclose(to_local(found[0], found)[:, 0], 0.7 * np.arange(41), atol=1e-4)
    one.end()
    assert "session blinded: 1 plans, 1 fallbacks" in caplog.text


class Failing:
    """Plans nothing but NaN, or raises, for an ego above 5 or 9 m/s."""

    digest = "1"

    def __init__(self) -> None:
        from planners.data.batch import Needs

        self.needs = Needs()

    def plan(self, batch: Any) -> np.ndarray:
        speed = batch.status[:, 4].numpy()
        if (speed > 9.0).any():
            raise RuntimeError("above 9 m/s")
        return np.where(speed[:, None, None] > 5.0, np.nan, np.ones((len(batch), 8, 3)))


def test_a_planner_that_fails_for_one_rollout_plans_for_the_others(caplog: pytest.LogCaptureFixture) -> None:
    driver = Driver("tests.planners.alpasim.test_driver:Failing", batch=3, wait_s=0.2)
    stub, ended = InProcess(driver), {}

    def rollout(speed: float) -> None:
        try:
            driven(stub, str(speed), 1, cameras=(), speed=speed)
        except RuntimeError as error:
            ended[speed] = str(error)

    threads = [threading.Thread(target=rollout, args=(speed,)) for speed in (3.0, 6.0, 12.0)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert driver.counts == {"plans": 1, "fallbacks": 1} and ended == {12.0: "above 9 m/s"}
    assert "session 6.0 at 17000 us: straight on" in caplog.text
    driver.close()


def test_planners_that_want_more_than_is_sent_are_refused_in_one_line(tmp_path: Path, looking: str) -> None:
    for planner, why in (
        (saved(made("ego_mlp_bev_small"), tmp_path), "raster of map and agents, which AlpaSim shows no agent"),
        ("pdm_closed", "plans from the log itself"),
        ("tests.planners.navsim.test_pilot:OfSamples", "must take batches"),
    ):
        with pytest.raises(ConfigError, match=why):
            Driver(planner)
    with pytest.raises(ConfigError, match="cameras: 1, in the places of 0: none"):
        Driver(BLIND, cameras=["CAM_F0"])
    with pytest.raises(ConfigError, match="device=nowhere: "):
        Driver(BLIND, device="nowhere")
    driver = Driver(looking, cameras=["CAM_R0", "CAM_F0", "CAM_L0"])
    driver.service.answer("start_session", sent.start("other order").SerializeToString())
    assert "INVALID_ARGUMENT start_session: rollout_spec.vehicle.available_cameras: no cam_r0" in refused(
        driver, "start_session", sent.start("two", ("CAM_F0", "CAM_L0"))
    )
    driver.close()


def test_what_is_wrong_with_a_message_is_named(served: tuple[Driver, Any]) -> None:
    driver, stub = served
    one = Rollout(stub, "wrong")
    one.begin()
    assert refused(driver, "start_session", sent.start("wrong")) == "ALREADY_EXISTS session_uuid='wrong' is open"
    assert "1 to 128 characters, not 0" in refused(driver, "start_session", sent.start(""))
    drive = protocol.DriveRequest(session_uuid="wrong", time_now_us=5, time_query_us=5)
    assert refused(driver, "drive", drive).startswith("FAILED_PRECONDITION drive: time_now_us=5: send the ego's poses")
    drive.time_query_us = 4
    assert "time_query_us=4: from time_now_us=5" in refused(driver, "drive", drive)
    assert "NOT_FOUND" in refused(driver, "drive", protocol.DriveRequest(session_uuid="none"))
    bad = sent.egomotion("wrong", [sent.pose_at(0, 0.0, NAN, 0.0)], 1.0)
    assert "trajectory.poses[0].pose.vec=[0.0, nan" in refused(driver, "submit_egomotion_observation", bad)
    bad = sent.egomotion("wrong", [protocol.PoseAtTime()], 1.0)
    assert "pose.quat=[0.0, 0.0, 0.0, 0.0]: not a unit" in refused(driver, "submit_egomotion_observation", bad)
    del bad.dynamic_states[:]
    assert "dynamic_states: 0, one for each of the 1" in refused(driver, "submit_egomotion_observation", bad)
    image = sent.picture("wrong", "CAM_F0", 0)
    image.camera_image.image_bytes = b"GIF89a"
    assert "a GIF file: convert it" in refused(driver, "submit_image_observation", image)
    image.camera_image.logical_id = "CAM_B0"
    assert "no camera cam_b0 was declared" in refused(driver, "submit_image_observation", image)
    route = sent.route_request("wrong", 0, 0.0)
    route.route.waypoints[3].y = float("inf")
    assert "route.waypoints[3]: beyond 1e+07 m" in refused(driver, "submit_route", route)
    assert "the bytes are no DriveRequest" in refused(driver, "drive", b"\xff\xff")
    with pytest.raises(grpc.RpcError) as caught:
        stub.drive(drive)
    assert caught.value.code() == grpc.StatusCode.INVALID_ARGUMENT and "time_query_us=4" in caught.value.details()
    one.end()


def test_png_and_a_route_of_few_points_or_none_are_driven(served: tuple[Driver, Any]) -> None:
    one = Rollout(served[1], "few")
    one.begin()
    before = served[0].counts["fallbacks"]
    for waypoints in ([], [protocol.Vec3(x=NAN, y=NAN, z=NAN)] * 20, [protocol.Vec3(x=42.1, y=9.0)]):
        one.observe()
        for name in sent.YAWS:
            served[1].submit_image_observation(sent.picture("few", name, one.now_us, "PNG"))
        route = protocol.Route(waypoints=waypoints, timestamp_us=one.now_us)
        served[1].submit_route(protocol.RouteRequest(session_uuid="few", route=route))
        one.drive()
    assert served[0].counts["fallbacks"] == before
    one.end()


def test_sessions_and_what_they_hold_are_bounded(blind: Driver, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(wire, "SESSIONS", 2)
    for uuid in ("a", "b"):
        blind.service.answer("start_session", sent.start(uuid, ()).SerializeToString())
    assert "RESOURCE_EXHAUSTED 2 sessions are open" in refused(blind, "start_session", sent.start("c", ()))
    for uuid in ("a", "b"):
        blind.service.answer("close_session", protocol.DriveSessionCloseRequest(session_uuid=uuid).SerializeToString())
    session = Session(("front",), frozenset({"front"}))
    for stamp in random.Random(0).sample(range(20), 20):
        session.keep_frame("front", stamp, sent.photo(0))
        session.keep_route(stamp, np.zeros((0, 2)))
    assert sorted(session.frames["front"]) == [16, 17, 18, 19] and min(session.routes) == 12
    session.keep_states({stamp: np.zeros(9) for stamp in range(10_000)})
    assert min(session.states) == 10_000 - 4096


REQUESTS = {
    "get_version": protocol.Empty,
    "start_session": protocol.DriveSessionRequest,
    "close_session": protocol.DriveSessionCloseRequest,
    "submit_image_observation": protocol.RolloutCameraImage,
    "submit_egomotion_observation": protocol.RolloutEgoTrajectory,
    "submit_route": protocol.RouteRequest,
    "submit_recording_ground_truth": protocol.GroundTruthRequest,
    "drive": protocol.DriveRequest,
    "shut_down": protocol.Empty,
}
STRINGS = ("", "open", "cam_f0", "CAM_F0", "é" * 200)


def scrambled(message: Any, rng: random.Random) -> Any:
    """Fields of random values; those of a session that is open among them."""
    photos = lambda: rng.choice([b"", rng.randbytes(40), sent.photo(1)[: rng.randrange(900)], sent.photo(1)])  # noqa: E731
    return scrambled_message(message, rng, STRINGS, photos)


def close_all_but(driver: Driver, kept: str) -> None:
    for uuid in set(driver.rollouts._open) - {kept}:
        driver.service.answer("close_session", protocol.DriveSessionCloseRequest(session_uuid=uuid).SerializeToString())


def extremes(rng: random.Random) -> list[tuple[str, Any]]:
    """What a session may hold and no rollout would: cut pictures, poses as far and as fast as they are taken."""
    stamps = (0, 17_000, 500_000, rng.choice([600_000, 2**31 - 1, 2**62]))
    far = [sent.pose_at(stamp, rng.choice([-1e7, 0.0, 1e7]), 1e7, rng.uniform(-9, 9)) for stamp in stamps]
    motion = sent.egomotion("open", far, rng.choice([-1e7, 0.0, 1e7]), rng.choice([-1e7, 0.1, 1e7]))
    cut = [sent.picture("open", name, 17_000) for name in sent.YAWS]
    for message in cut:
        message.camera_image.image_bytes = message.camera_image.image_bytes[: rng.choice([700, 900, 5000])]
    pictures = [("submit_image_observation", message) for message in cut]
    return [("submit_egomotion_observation", motion), ("submit_route", sent.route_request("open", 0, 1.0)), *pictures]


@pytest.mark.parametrize("method", REQUESTS)
def test_no_message_ends_the_driver_or_hurts_another_session(served: tuple[Driver, Any], method: str) -> None:
    driver, stub = served
    expected = driven(InProcess(driver), "before")
    other = Rollout(InProcess(driver), "other")
    other.begin()
    rng, statuses = random.Random(method), set()
    valid = sent.picture("open", "CAM_F0", 17_000).SerializeToString()
    for i in range(150):
        if i % 10 == 0:
            close_all_but(driver, "other")
            driver.service.answer("start_session", sent.start("open").SerializeToString())
            for request in extremes(rng):
                getattr(InProcess(driver), request[0])(request[1])
        damaged = bytearray(valid)
        damaged[rng.randrange(40)] = rng.randrange(256)
        for request in (scrambled(REQUESTS[method](), rng).SerializeToString(), rng.randbytes(i), bytes(damaged)):
            try:
                driver.service.answer(method, request)
            except Fault as fault:
                statuses.add(fault.status)
    assert statuses <= {"INVALID_ARGUMENT", "NOT_FOUND", "ALREADY_EXISTS", "FAILED_PRECONDITION", "RESOURCE_EXHAUSTED"}
    close_all_but(driver, "other")
    assert [other.step().SerializeToString(deterministic=True) for _ in range(3)] == expected
    other.end()
    assert stub.get_version(protocol.Empty()).version_id


def test_bytes_that_are_no_message_or_too_many_get_a_status_over_the_wire() -> None:
    driver = Driver(BLIND)
    server, port = start_server([driver.service], "127.0.0.1", 0)
    options = [("grpc.max_send_message_length", -1)]
    with grpc.insecure_channel(f"127.0.0.1:{port}", options=options) as channel:
        for method in REQUESTS:
            raw = channel.unary_unary(f"/{driver_module.SERVICE}/{method}")
            for request, code in ((b"\xff\xff", "INVALID_ARGUMENT"), (bytes(33 << 20), "RESOURCE_EXHAUSTED")):
                with pytest.raises(grpc.RpcError) as caught:
                    raw(request)
                assert caught.value.code().name == code
        assert len(driven(protocol.EgodriverServiceStub(channel), "after", cameras=())) == 3
    with pytest.raises(Refused, match=f"port={port}.*give another port="):
        start_server([driver.service], "127.0.0.1", port)
    server.stop(0)
    driver.close()


@pytest.mark.slow
def test_the_package_s_own_loop_drives_the_command_to_its_end(looking: str) -> None:
    words = [sys.executable, "-m", "planners", "serve", "protocol=alpasim", f"planner={looking}", "port=0"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        address = process.stdout.readline().split()[-1]
        cameras = [FakeCamera(f"cam_{n}", 320, 180, yaw_left_deg=yaw) for n, yaw in (("l", 55), ("f", 0), ("r", -55))]
        with FakeLoop(address, cameras, step_s=0.5, initial_speed_mps=5.0) as loop:
            result = loop.run(4)
        process.send_signal(signal.SIGTERM)
        _, said = process.communicate(timeout=60)
    assert result.steps == 4 and process.returncode == 0
    assert "all sessions: 4 plans, 0 fallbacks" in said


@pytest.mark.parametrize(("curvature", "ours", "theirs"), [(1 / 50, 0, 0), (1 / 200, 1, 0), (0, 1, 1), (-1 / 50, 2, 2)])
def test_the_route_is_told_as_the_rule_has_it_in_the_ego_s_frame_now(curvature: float, ours: int, theirs: int) -> None:
    """Also where the route was sent 0.2 s earlier."""
    session = Session((), frozenset())
    state = np.array([100.0, -40.0, 2.0, 0.0, 6.0, 0.0, 0.0, 0.0, 0.0])
    session.keep_states({0: state})
    session.keep_route(0, sent.arc(curvature, np.linspace(0.0, 80.0, 20)[10:]))
    for stamp in (0, 200_000):
        told = [Moment(session, stamp).observed(rule).status[:4].argmax() for rule in ("curvature", "simscale")]
        assert told == [ours, theirs]
