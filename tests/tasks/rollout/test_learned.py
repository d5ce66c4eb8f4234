"""Traffic that a policy drives: what the policy is asked, what becomes of its answer, what it cannot know."""

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tasks.rollout.learned.imitation import (
    ImitationPolicy,
    NetworkWeights,
    forward,
    unfitted,
    weights_file,
    weights_from,
)
from tasks.rollout.learned.lesson import lessons
from tasks.rollout.learned.look import NEAR, OWN, look
from tasks.rollout.learned.policy import SEEN_ROWS, BadPolicy, RoadLines, SeenWorlds, policy_of, told
from tasks.rollout.simulate import (
    TrafficSettings,
    next_scene,
    prepare_traffic,
    roll_on,
    roll_out,
    roll_out_many,
)
from tasks.world.agents import PER_STEP, AgentKind
from tasks.world.clip import CLIP_STEPS, NOW, STEP_S
from tasks.world.vehicle import X
from tests.tasks.rollout import slow_learned, worlds
from tests.tasks.rollout.worlds import Track

Array = NDArray[np.float64]
HERE = __name__


def weights_by_chance(seed: int = 0, spread: float = 0.2) -> NetworkWeights:
    """A policy that answers to everything it sees, in no sensible way."""
    rng = np.random.default_rng(seed)
    shapes = ((NEAR, 8), 8, (OWN + 8, 16), 16, (16, 16), 16, (16, 2), 2)
    return NetworkWeights(*(rng.normal(0.0, spread, shape) for shape in shapes))


def by_chance(weights: str | None) -> ImitationPolicy:
    return ImitationPolicy(weights_by_chance(), "by chance")


LEARNED = TrafficSettings(mode="learned", policy=f"{HERE}:by_chance")
STRAIGHT_ON = TrafficSettings(mode="learned", policy="tasks.rollout.learned.imitation:unfitted")


@dataclass(frozen=True)
class Recorded:
    """Keeps its speed; keeps what it was asked."""

    calls: list[tuple[SeenWorlds, RoadLines]]

    def digest(self) -> str:
        return "recorded"

    def next_states(self, seen: SeenWorlds, streets: RoadLines) -> Array:
        self.calls.append((seen, streets))
        return unfitted().next_states(seen, streets)


CALLS: list[tuple[SeenWorlds, RoadLines]] = []


def recorded(weights: str | None) -> Recorded:
    return Recorded(CALLS)


def asked_in(scene: Any, ego: Array) -> list[tuple[SeenWorlds, RoadLines]]:
    CALLS.clear()
    roll_out(prepare_traffic(scene, replace(LEARNED, policy=f"{HERE}:recorded")), ego)
    return list(CALLS)


@pytest.mark.parametrize("seed", range(8))
def test_many_egos_are_answered_as_each_alone_and_one_more_time_to_the_last_bit(seed: int) -> None:
    scene = worlds.random_scene(seed)
    traffic, egos = prepare_traffic(scene, LEARNED), worlds.random_egos(scene, seed, 5)
    many = roll_out_many(traffic, egos)
    for b, ego in enumerate(egos):
        alone = roll_out(traffic, ego)
        for name in ("boxes", "velocities", "valid"):
            assert getattr(many, name)[b].tobytes() == getattr(alone.agents, name).tobytes()
        assert (many.simulated[b] == alone.simulated).all()
    again = roll_out_many(prepare_traffic(scene, LEARNED), egos[::-1])
    assert again.boxes[::-1].tobytes() == many.boxes.tobytes()


def test_what_the_ego_does_later_changes_nothing_before() -> None:
    scene = worlds.scene(worlds.straight_road(), Track(0.0, speed=5.0), ego=(25.0, 0.0, 0.0), ego_speed=3.0)
    (first,) = worlds.random_egos(scene, 1, 1)
    other = first.copy()
    other[21:, X] += 3.0
    traffic = prepare_traffic(scene, LEARNED)
    a, b = (roll_out(traffic, ego).agents.boxes for ego in (first, other))
    np.testing.assert_array_equal(a[:22], b[:22])
    assert not np.array_equal(a, b, equal_nan=True)


def test_a_policy_is_shown_the_second_before_and_nothing_of_what_comes() -> None:
    scene = worlds.scene(worlds.straight_road(), Track(0.0, speed=5.0), ego=(40.0, 0.0, 0.0), ego_speed=3.0)
    ego = np.repeat(scene.ego_state[None], 41, axis=0)
    ego[:, X] = 40.0 + 0.3 * np.arange(41)
    calls = asked_in(scene, ego)
    assert len(calls) == 40
    for t, (seen, streets) in enumerate(calls):
        assert seen.boxes.shape == (SEEN_ROWS, 1, 2, 5) and seen.asked.tolist() == [[True]]
        ego_center = ego[0, X] + 0.3 * (np.arange(t - 10, t + 1)) + 1.461
        assert seen.boxes[:, 0, 1, 0] == pytest.approx(ego_center, abs=0.01)
        assert seen.boxes[:, 0, 0, 0] == pytest.approx(0.5 * np.arange(t - 10, t + 1))
        assert seen.velocities[:, 0, 1, 0] == pytest.approx(3.0)
        assert streets.ways.line_state.shape == (1, 0) and streets.way.tolist() == [0]
        assert len(streets.lane_points) == streets.lane_first[-1] == 801


@pytest.mark.parametrize("seed", [0, 2, 5])
def test_the_kernels_see_and_want_what_plain_numpy_does(seed: int) -> None:
    scene = worlds.random_scene(seed)
    weights, n = weights_by_chance(seed), 0
    for seen, streets in asked_in(scene, worlds.random_egos(scene, seed, 1)[0])[::13]:
        who = np.argwhere(seen.asked)
        own, near, count = look(seen, streets.ways, streets.way, who)
        found = forward(weights, own, near, count)
        for a, (b, i) in enumerate(who.tolist()):
            beside = slow_learned.neighbours(seen, b, i)
            assert own[a] == pytest.approx(slow_learned.oneself(seen, streets.ways, streets.way, b, i), abs=1e-4)
            assert count[a] == len(beside)
            assert near[a, : count[a]] == pytest.approx(beside, abs=1e-9) and not near[a, count[a] :].any()
            assert found[a] == pytest.approx(slow_learned.wants(weights, own[a], beside), abs=1e-9)
            n += 1
    assert n > 3


def test_a_leader_is_whoever_s_box_is_in_the_strip_ahead_and_nobody_beside_it() -> None:
    """Bumpers 20 - 4.6 m apart; the lane beside is 3.5 m away."""
    lanes = worlds.straight_road() | {"beside": worlds.lane("beside", [(-100.0, 3.5), (500.0, 3.5)])}
    ahead = worlds.scene(lanes, Track(0.0, speed=8.0), Track(20.0, speed=5.0), Track(12.0, 3.5, speed=2.0))
    (seen, streets), *_ = asked_in(ahead, np.repeat(ahead.ego_state[None], 41, axis=0))
    own = look(seen, streets.ways, streets.way, np.array([[0, 0]]))[0][0]
    assert own[21:26] == pytest.approx([1.0, 10.0 / 25.4, 3.0 / 18.4, 15.4 / 8.0 / 4.0, 0.3])
    assert own[26] == pytest.approx(9.0 / (2.0 * 15.4) / 4.0)


def test_who_is_no_vehicle_on_a_lane_does_what_its_log_does() -> None:
    parked = Track(-30.0, 6.0)
    walker = Track(20.0, -6.0, np.pi / 2, 1.2, AgentKind.PEDESTRIAN, (0.6, 0.6))
    off_road = Track(0.0, -20.0, speed=4.0)
    scene = worlds.scene(worlds.straight_road(), parked, walker, off_road)
    rollout = roll_out(prepare_traffic(scene, LEARNED), np.repeat(scene.ego_state[None], 41, axis=0))
    assert not rollout.simulated.any()
    np.testing.assert_array_equal(rollout.agents.boxes, scene.agents.boxes[NOW : NOW + 41])


def test_a_car_that_its_log_holds_is_not_asked_before_its_log_starts() -> None:
    """It stands for 1.5 s, as at a light that is in no map; then the policy's first answer moves it."""
    way = np.maximum(0.0, STEP_S * (np.arange(CLIP_STEPS) - NOW - 15) * 6.0)
    scene = worlds.scene(worlds.straight_road(), Track(0.0, poses=np.column_stack([way, 0.0 * way, 0.0 * way])))
    calls = asked_in(scene, parked_ego())  # there is none while nobody is to be asked
    assert len(calls) == 40 - 16 and all(seen.asked[0, 0] for seen, _ in calls)
    assert (calls[0][0].boxes[:, 0, 0, 0] == 0.0).all()


def parked_ego() -> Array:
    scene = worlds.scene(worlds.straight_road())
    return np.repeat(scene.ego_state[None], 41, axis=0)


def test_somebody_on_foot_waits_before_a_driven_car_and_then_goes_on_late() -> None:
    """The walker's log steps into the car's side, of one that keeps its 8 m/s whatever it sees."""
    walker = Track(20.0, -2.5, np.pi / 2, 0.8, AgentKind.PEDESTRIAN, (0.6, 0.6))
    scene = worlds.scene(worlds.straight_road(), Track(5.0, speed=8.0), walker)
    rollout = roll_out(prepare_traffic(scene, STRAIGHT_ON), parked_ego())
    y = rollout.agents.boxes[:, 1, 1]
    waited = np.flatnonzero(np.diff(y) == 0.0)
    assert len(waited) > 3 and (np.diff(y)[-5:] > 0.07).all()
    assert y[-1] == pytest.approx(-2.5 + 0.08 * (40 - len(waited)))


def test_a_newcomer_enters_with_room_and_is_driven_from_then_on() -> None:
    late = Track(0.0, speed=6.0, first=NOW + 10)
    scene = worlds.scene(worlds.straight_road(), late)
    free = roll_out(prepare_traffic(scene, STRAIGHT_ON), parked_ego())
    assert free.agents.valid[:, 0].tolist() == [False] * 10 + [True] * 31 and free.simulated[0]
    blocked = worlds.scene(worlds.straight_road(), late, Track(6.0 + 5.0, speed=0.0))
    assert not roll_out(prepare_traffic(blocked, STRAIGHT_ON), parked_ego()).agents.valid[:, 0].any()


@pytest.mark.parametrize("seed", range(4))
def test_the_rows_of_a_rollout_stay_where_it_goes_on_and_a_second_one_starts_from_it(seed: int) -> None:
    scene = worlds.random_scene(seed)
    traffic = prepare_traffic(scene, LEARNED)
    (ego,) = worlds.random_egos(scene, seed, 1)
    rollout = roll_out(traffic, ego)
    on = roll_on(traffic, np.concatenate([ego, np.repeat(ego[-1:], 10, axis=0)]))
    for name in PER_STEP:
        np.testing.assert_array_equal(getattr(on, name)[:41], getattr(rollout.agents, name))
    second = next_scene(scene, rollout, scene.centerline)
    after = roll_out(prepare_traffic(second, LEARNED), np.repeat(ego[-1:], 41, axis=0))
    np.testing.assert_array_equal(after.agents.boxes[0], rollout.agents.boxes[-1])
    assert np.isfinite(after.agents.boxes[after.agents.valid]).all()


def test_a_lesson_on_the_log_is_what_the_log_does_and_beside_it_leads_back() -> None:
    """A log at 1 m/s2 and 5 m/s at NOW: the same on it; 1 m to its left a curve to the right; slower, to catch up."""
    time = STEP_S * (np.arange(CLIP_STEPS) - NOW)
    x, speed = 5.0 * time + 0.5 * time**2, 5.0 + time
    xy = np.stack([x, np.zeros(CLIP_STEPS)], axis=1)[:, None]
    boxes = np.array([[[0.0, 0.0, 0.0, 4.6, 1.9]], [[0.0, 1.0, 0.0, 4.6, 1.9]], [[0.0, 0.0, 0.0, 4.6, 1.9]]])
    velocities = np.array([[[5.0, 0.0]], [[5.0, 0.0]], [[3.0, 0.0]]])
    who = np.array([[0, 0], [1, 0], [2, 0]])
    wants, known, away = lessons(xy, speed[:, None], NOW, boxes, velocities, who)
    assert wants[:, 0] == pytest.approx([1.0, 1.0, 3.0]) and away == pytest.approx([0.0, 1.0, 0.0])
    arc = x[x >= 5.0][0]  # the first logged place 5 m on
    assert wants[1, 1] == pytest.approx(-2.0 / (1.0 + arc**2)) and wants[0, 1] == 0.0
    assert known.all()


def test_a_lesson_where_the_log_stands_is_to_stand() -> None:
    xy, speed = np.zeros((CLIP_STEPS, 1, 2)), np.zeros((CLIP_STEPS, 1))
    boxes, velocities = np.array([[[0.1, 0.0, 0.0, 4.6, 1.9]]]), np.array([[[0.5, 0.0]]])
    wants, known, _ = lessons(xy, speed, NOW, boxes, velocities, np.array([[0, 0]]))
    assert wants[0, 0] == pytest.approx(-0.5) and known.tolist() == [[1.0, 0.0]]


def test_a_file_of_weights_comes_back_in_single_precision_and_drives(tmp_path: Path) -> None:
    weights = weights_by_chance(4)
    data = weights_file(weights, "{}")
    for name, array in weights_from(data)._asdict().items():
        np.testing.assert_array_equal(array, getattr(weights, name).astype(np.float32))
    path = tmp_path / "traffic.npz"
    path.write_bytes(data)
    policy = policy_of(TrafficSettings(mode="learned", weights=str(path)))
    assert policy.digest() == hashlib.sha256(data).hexdigest()[:16]
    path.write_bytes(weights_file(weights_by_chance(5), "{}"))
    assert policy_of(TrafficSettings(mode="learned", weights=str(path))).digest() != policy.digest()


def test_a_file_that_is_none_or_damaged_is_named_with_what_is_wrong(tmp_path: Path) -> None:
    path = tmp_path / "traffic.npz"
    settings = TrafficSettings(mode="learned", weights=str(path))
    with pytest.raises(BadPolicy, match=f"traffic.weights: {path}: No such file"):
        policy_of(settings)
    data = weights_file(weights_by_chance(), "{}")
    flipped = bytearray(data)
    flipped[len(data) // 2] ^= 1
    unlike = weights_file(weights_by_chance()._replace(last_bias=np.array([np.nan, 0.0])), "{}")
    wrong = {
        "its checksum is another": bytes(flipped),
        "it does not end with a checksum": data[:-40],
        "last_bias must hold finite numbers": unlike,
    }
    for said, content in wrong.items():
        path.write_bytes(content)
        with pytest.raises(BadPolicy, match=f"{path}: .*{said}"):
            policy_of(settings)


def test_weights_that_see_other_things_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tasks.rollout.learned.imitation.COLUMNS", [0, OWN, NEAR, 8])
    data = weights_file(weights_by_chance(), "{}")
    monkeypatch.undo()
    with pytest.raises(ValueError, match="fit it again"):
        weights_from(data)


@dataclass(frozen=True)
class Answers:
    """Answers what it was made with, whatever it is asked."""

    value: float
    columns: int

    def digest(self) -> str:
        return ""

    def next_states(self, seen: SeenWorlds, streets: RoadLines) -> Array:
        return np.full((*seen.asked.shape, self.columns), self.value)


def answers_nan(weights: str | None) -> Answers:
    return Answers(np.nan, 4)


def answers_three(weights: str | None) -> Answers:
    return Answers(0.0, 3)


@pytest.mark.parametrize(
    ("policy", "said"),
    [
        ("nothing_of_that_name:It", "traffic.policy=nothing_of_that_name:It: name one as"),
        ("tasks.rollout.idm:NoSuchPolicy", "name one as"),
        ("builtins:repr", "is no traffic policy: it has no digest, next_states"),
        (f"{HERE}:answers_nan", "Answers.next_states gave a state that is not finite"),
        (f"{HERE}:answers_three", r"Answers.next_states gave \(1, 1, 3\), not \(1, 1, 4\)"),
    ],
)
def test_what_is_no_policy_is_told(policy: str, said: str) -> None:
    scene = worlds.scene(worlds.straight_road(), Track(0.0, speed=5.0))
    with pytest.raises(BadPolicy, match=said):
        roll_out(prepare_traffic(scene, replace(LEARNED, policy=policy)), parked_ego())


def test_settings_without_weights_are_refused_and_told_by_what_is_in_the_file(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="traffic weights is missing"):
        TrafficSettings(mode="learned")
    assert {"weights", "policy"} & told(TrafficSettings()).keys() == set()
    paths = [tmp_path / name for name in ("a.npz", "b.npz")]
    for path in paths:
        path.write_bytes(weights_file(weights_by_chance(), "{}"))
    one, other = (told(TrafficSettings(mode="learned", weights=str(path))) for path in paths)
    assert one == other and one["weights"] == hashlib.sha256(paths[0].read_bytes()).hexdigest()[:16]


def test_speeds_are_kept_where_nobody_wants_anything() -> None:
    """The policy of no weights keeps to its way, which is its log's: a step is speed times time."""
    scene = worlds.scene(worlds.straight_road(), Track(0.0, 0.4, 0.02, speed=7.0))
    agents = roll_out(prepare_traffic(scene, STRAIGHT_ON), parked_ego()).agents
    steps = np.hypot(*np.diff(agents.boxes[:, 0, :2], axis=0).T)
    assert steps == pytest.approx(0.7, abs=1e-4) and agents.velocities[:, 0, 0] == pytest.approx(7.0, abs=0.05)
    assert agents.boxes[:, 0, 1] == pytest.approx(scene.agents.boxes[NOW : NOW + 41, 0, 1], abs=0.05)
