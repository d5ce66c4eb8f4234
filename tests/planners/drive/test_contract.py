"""The loop that asks as AlpaSim's nuPlan track: both ways alike, what it sends, and what it makes of answers."""

import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("carla_driver_interface", reason='the contract needs pip install ".[alpasim]"')

from carla_driver_interface import protocol
from carla_driver_interface.driver import BaseDriver, DriveContext, DriveResult
from carla_driver_interface.geometry import Pose
from carla_driver_interface.geometry import Trajectory as Curve
from carla_driver_interface.server import serving

from factory.alpasim.wire import start_server
from factory.datasets.town.reader import SyntheticReader
from factory.datasets.town.settings import TownSettings
from factory.exits import BAD_CONFIG, COMPLETE, COMPLETE_WITH_FAILURES
from planners.drive.alpasim_score import logged_rollout, score_drive
from planners.drive.contract import DriverSession, Peer, SceneService, ask_over_the_wire, peer_in_process, plan_of
from planners.drive.drive import main
from planners.drive.loop import ClosedLoopDrive, LoopSettings, drive
from planners.drive.starts import DriveStart, extend_clip, logged_start
from planners.evaluation.planner_names import find_planner
from planners.evaluation.planning import plan_samples
from tasks.settings import TrafficSettings
from tasks.world.clip import NOW
from tasks.world.frames import HEADING, to_world
from tests.planners.drive.streets import Steady, car, start_on, street_with
from tests.planners.drive.test_drive import rows, words
from tests.planners.drive.test_drive import towns as towns  # the fixture
from tests.planners.drive.test_painted import LOOKING
from tests.planners.navsim.trained import made, saved

TRACK = LoopSettings(seconds=3.1, traffic=TrafficSettings(mode="replay"))
BLIND = peer_in_process(find_planner("constant_velocity"), {})


def driven(start: DriveStart, peer: Peer, settings: LoopSettings = TRACK) -> ClosedLoopDrive:
    with DriverSession(peer, start.scene, None) as session:
        return drive(start, session, settings)


@contextmanager
def over_the_wire(peer: Peer) -> Iterator[Peer]:
    """The same service behind a socket."""
    service = getattr(peer.ask, "__self__")  # noqa: B009 - whose bound method it is
    server, port = start_server([service], "127.0.0.1", 0)
    yield Peer(ask_over_the_wire(f"127.0.0.1:{port}"), peer.needs_pictures, peer.service)
    server.stop(0)


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> DriveStart:
    reader = SyntheticReader(tmp_path_factory.mktemp("town"), 1, settings=TownSettings(cameras=(), lidar_beams=0))
    clip = reader.read(reader.index().refs[0])
    return logged_start(extend_clip(clip, 200))


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["replay", "idm"])
@pytest.mark.parametrize("name", ["constant_velocity", "pdm_closed"])
def test_in_process_and_over_the_wire_the_town_is_driven_to_the_same_bits(
    town: DriveStart, name: str, mode: Any
) -> None:
    settings = LoopSettings(seconds=6.0, traffic=TrafficSettings(mode=mode))
    peer = peer_in_process(find_planner(name), {})
    here = driven(town, peer, settings)
    with over_the_wire(peer) as wire:
        there = driven(town, wire, settings)
    assert here.n_steps == 55 and len(here.plans) == 11
    for field in ("ego_states", "plans"):
        assert getattr(here, field).tobytes() == getattr(there, field).tobytes(), field
    assert here.agents.boxes.tobytes() == there.agents.boxes.tobytes()


class Sent:
    """A peer's questions, noted."""

    def __init__(self, peer: Peer) -> None:
        self.said: list[tuple[str, bytes]] = []
        self.peer = Peer(self.ask, peer.needs_pictures, peer.service)
        self._ask = peer.ask

    def ask(self, method: str, request: bytes) -> bytes:
        self.said.append((method, request))
        return self._ask(method, request)

    def messages(self, method: str, kind: Any) -> list[Any]:
        return [kind.FromString(request) for name, request in self.said if name == method]


def test_what_is_sent_is_what_the_track_sends() -> None:
    """Two poses 17 ms apart at first, then one; a route of points 42 m and more ahead, then NaN; then the question."""
    sent = Sent(BLIND)
    made = driven(start_on(street_with(car(100.0)), TRACK), sent.peer)
    assert made.n_steps == 30
    names = [name for name, _ in sent.said]
    assert names[0] == "start_session" and names[-1] == "close_session"
    for i in range(6):
        before, asked = set(names[1 + 3 * i : 3 + 3 * i]), names[3 + 3 * i]
        assert before == {"submit_egomotion_observation", "submit_route"} and asked == "drive"
    motions = sent.messages("submit_egomotion_observation", protocol.RolloutEgoTrajectory)
    stamps = [[pose.timestamp_us for pose in one.trajectory.poses] for one in motions]
    assert stamps == [[0, 17_000], *([17_000 + 500_000 * i] for i in range(1, 6))]
    first, second = (pose.pose.vec.x for pose in motions[0].trajectory.poses)
    assert (first, second) == pytest.approx((0.0, 8.0 * 0.017), abs=1e-6)
    assert all(one.dynamic_states[0].linear_velocity.x == pytest.approx(8.0) for one in motions)
    route = sent.messages("submit_route", protocol.RouteRequest)[0].route
    along = np.array([point.x for point in route.waypoints])
    np.testing.assert_allclose(along[:10], np.linspace(0.0, 80.0, 20)[10:], atol=1e-3)
    assert len(along) == 20 and np.isnan(along[10:]).all() and route.timestamp_us == 17_000
    asked = sent.messages("drive", protocol.DriveRequest)
    assert [(one.time_now_us, one.time_query_us - one.time_now_us) for one in asked] == [
        (17_000 + 500_000 * i, 500_000) for i in range(6)
    ]


def test_the_first_half_second_is_the_log_s_whatever_is_planned() -> None:
    """A driver that would stand still; then it brakes, and only then."""
    start = start_on(street_with(car(100.0)), TRACK)
    peer = SceneService(Steady(0.0))
    made = driven(start, Peer(peer.service.answer, False, peer))
    assert made.ego_states[:6].tobytes() == start.scene.clip.ego_states[NOW : NOW + 6].tobytes()
    assert made.ego_states[-1, 3] < 1.0 < made.ego_states[6, 3]


def test_a_collision_ends_nothing_and_the_drive_ends_with_its_log() -> None:
    """A standing vehicle 20 m ahead is driven through; the log has 8 s."""
    settings = LoopSettings(seconds=60.0, traffic=TrafficSettings(mode="replay"))
    made = driven(start_on(street_with(car(20.0)), settings), BLIND, settings)
    columns = score_drive(logged_rollout(made, settings.seconds))
    assert (made.n_steps, columns.collision_front, columns.score) == (80, 1.0, 0.0)


def test_a_planner_without_a_plan_ends_the_session() -> None:
    class Lost(Steady):
        def plan(self, scene: Any, look: Any) -> Any:
            return None

    service = SceneService(Lost(1.0))
    made = driven(start_on(street_with(car(50.0)), TRACK), Peer(service.service.answer, False, service))
    assert (made.n_steps, len(made.plans)) == (0, 0)


def answer(stamps: list[int], poses: list[tuple[float, float, float]]) -> Any:
    found = protocol.Trajectory()
    for stamp, (x, y, yaw) in zip(stamps, poses):
        at = found.poses.add(timestamp_us=stamp)
        at.pose.vec.x, at.pose.vec.y = x, y
        at.pose.quat.w, at.pose.quat.z = np.cos(yaw / 2.0), np.sin(yaw / 2.0)
    return found


def test_an_answer_is_interpolated_and_stays_at_its_end() -> None:
    """Two poses a second apart, whose headings lie to both sides of pi."""
    plan = plan_of(answer([17_000, 1_017_000], [(0.0, 0.0, 3.1), (10.0, 5.0, -3.1)]), 17_000)
    np.testing.assert_allclose(plan[:10, 0], np.arange(1.0, 11.0), atol=1e-6)
    assert plan[4, 2] == pytest.approx(np.pi, abs=1e-6)
    assert (plan[10:] == plan[9]).all() and len(plan) == 40


@pytest.mark.parametrize(
    ("stamps", "poses", "said"),
    [
        ([], [], "0 poses"),
        ([500_000], [(0.0, 0.0, 0.0)], "the first at time_now_us=17000"),
        ([17_000, 17_000], [(0.0, 0.0, 0.0)] * 2, "then on"),
        ([17_000], [(np.nan, 0.0, 0.0)], "not finite"),
    ],
)
def test_an_answer_that_is_no_plan_is_refused(stamps: list[int], poses: list[Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        plan_of(answer(stamps, poses), 17_000)


class Cruise(BaseDriver):
    """Straight on at the sent speed, with carla-driver-interface alone."""

    def drive(self, context: DriveContext) -> DriveResult:
        speed, plan = context.session.dynamic_states[-1].linear_velocity.x, Curve.empty()
        for i in range(9):
            plan.append(context.time_now_us + 500_000 * i, Pose.from_xyz_yaw(0.5 * i * speed, 0.0, 0.0, 0.0))
        return DriveResult(plan)


@pytest.mark.slow
def test_a_driver_written_with_the_interface_alone_drives(
    towns: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """And its score stands in AlpaSim's file."""
    with serving(Cruise(), 0, "127.0.0.1", mode="alpasim") as port:
        asked = [word for word in words(towns, tmp_path, "limit=1") if not word.startswith("planner=")]
        assert main([*asked, f"driver=127.0.0.1:{port}"]) == COMPLETE
    (row,) = rows(tmp_path)
    assert row["duration_s"] == pytest.approx(2.5) and row["score"] > 0.0  # type: ignore[operator]
    told = json.loads((tmp_path / "results-summary.json").read_text())
    assert [entry["score"] for entry in told["rollouts"]] == [row["score"]]
    assert "score %" in capsys.readouterr().out


def test_nobody_at_the_address_and_other_faults_are_told_in_one_line(
    towns: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("planners.drive.contract.STARTUP_S", 0.2)
    asked = [word for word in words(towns, tmp_path, "limit=1") if not word.startswith("planner=")]
    for more, said in (
        (["driver=127.0.0.1:9"], "driver=127.0.0.1:9: get_version: "),
        (["planner=human", "seconds=0.51"], "0.517 to 600 s"),
        (["planner=human", "driver=127.0.0.1:9"], "in the place of planner="),
    ):
        assert main([*asked, *more]) == BAD_CONFIG
        assert said in capsys.readouterr().err


def test_without_the_messages_package_nothing_is_driven(
    towns: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "carla_driver_interface", None)
    assert main(words(towns, tmp_path / "out")) == BAD_CONFIG
    assert "[planners]" in capsys.readouterr().err and not (tmp_path / "out").exists()


class Silent:
    """No plan at all."""

    digest = "silent-1"

    def plan(self, sample: Any) -> np.ndarray:
        return np.full((8, 3), np.nan)


def test_a_drive_that_fails_scores_zero_in_the_summary(towns: Path, tmp_path: Path) -> None:
    asked = [word for word in words(towns, tmp_path, "limit=1") if not word.startswith("planner=")]
    who = "planners={silent: 'tests.planners.drive.test_contract:Silent', steady: constant_velocity}"
    assert main([*asked, who]) == COMPLETE_WITH_FAILURES
    told = {
        entry["run_name"]: entry for entry in json.loads((tmp_path / "results-summary.json").read_text())["rollouts"]
    }
    assert (told["silent"]["status"], told["silent"]["score"], told["steady"]["status"]) == ("fail", 0.0, "pass")


@pytest.mark.slow
def test_who_takes_samples_is_shown_the_painter_s_pictures(towns: Path, tmp_path: Path) -> None:
    asked = [word for word in words(towns, tmp_path, "limit=1") if not word.startswith("planner=")]
    assert main([*asked, *LOOKING]) == COMPLETE
    (row,) = rows(tmp_path)
    assert row["pictures"] == "truth" and len(row["plans"]) == 5  # type: ignore[arg-type]


@pytest.mark.slow
def test_a_trained_planner_plans_by_the_messages_what_it_plans_of_the_row(
    towns: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From 0.5 s on, before which its plan goes over from the ego's own motion; float32 leaves under a millimetre."""
    spec, plan, apart = saved(made("ltf_small", command="curvature"), tmp_path / "ltf"), DriverSession.plan, []
    load = find_planner(spec).load
    assert load is not None
    planner = load()

    def both(session: DriverSession, scene: Any, look: Any) -> Any:
        found = plan(session, scene, look)
        own = to_world(scene.ego_state[: HEADING + 1], plan_samples(planner, [look()])[0])
        apart.append(np.abs(found[4:, :2] - own[4:, :2]).max())
        return found

    monkeypatch.setattr(DriverSession, "plan", both)
    asked = [word for word in words(towns, tmp_path / "out", "limit=1") if not word.startswith("planner=")]
    assert main([*asked, f"planner={spec}", "render.width=320", "render.height=180"]) == COMPLETE
    assert len(apart) == 5 and max(apart) < 1e-3
