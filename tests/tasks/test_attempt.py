"""One attempt: what the gate lets through, how the second stage starts, and what stays untouched."""

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from tasks.attempt import (
    BRAKING_MPS2,
    ExpertGate,
    Judged,
    ReadyScene,
    attempt,
    drive_under_log_replay,
    hit_after_s,
    perturbed_scene,
    verdict,
)
from tasks.experts.pdm_closed import PdmClosed
from tasks.experts.protocol import Expert, Goal, Human, Plan
from tasks.experts.recovery import RecoveryExpert, RecoveryTable
from tasks.reward.epdms import Scores
from tasks.rollout.simulate import TrafficSettings, prepare_traffic, simulate
from tasks.stages import END_FAULTS, STAGES, Rejected
from tasks.subscores import JUDGED
from tasks.world.clip import HORIZON_STEPS, NOW, Clip, Rollout, Scene, scene_of_clip
from tasks.world.frames import HEADING, VX, to_world
from tasks.world.vocabulary import kinematic_trajectories
from tests.tasks.bad_ends import Aside, Close, shift
from tests.tasks.streets import moved, same_poses, street_clip

GATE = ExpertGate()
RNG = np.random.default_rng(0)  # no expert here draws from it


def scores(**values: float) -> Scores:
    """Two rows: row 0 all zero, row 1 perfect but for `values`."""
    row: dict[str, NDArray[np.float64]] = {field.name: np.array([0.0, 1.0]) for field in fields(Scores)}
    return Scores(**row | {name: np.array([0.0, value]) for name, value in values.items()})  # type: ignore[arg-type]


def first_stage(clip: Clip) -> Rollout:
    """Ends 1.2 m to the left of the log."""
    return simulate(scene_of_clip(clip), to_world(clip.ego_states[NOW, :3], shift(8.0, 1.2)), TrafficSettings())


@pytest.fixture(scope="module")
def scene() -> Scene:
    clip = street_clip()
    return perturbed_scene(clip, first_stage(clip))


@pytest.fixture(scope="module")
def table() -> RecoveryTable:
    """Drives of all kinds, and some that only move over."""
    shifts = [shift(speed, side) for speed in (7.0, 8.0, 9.0) for side in (-1.5, -1.0, -0.7, -0.4, 0.4, 0.7, 1.0, 1.5)]
    return RecoveryTable(np.concatenate([kinematic_trajectories(2000, seed=1), shifts]))


def tried(scene: Scene, expert: Expert) -> tuple[Judged, Rejected | None]:
    result = attempt(ReadyScene(scene, TrafficSettings()), expert, GATE, RNG)
    assert not isinstance(result, Rejected)
    return result


def test_the_route_of_the_perturbed_scene_begins_with_the_lane_that_the_perturbation_ends_on() -> None:
    """At x = 70 m that is the junction's, from 60 m on, and not the one before, where the log is."""
    clip = street_clip()
    stage_one = first_stage(clip)
    states = stage_one.ego_states.copy()
    states[:, 0] += np.linspace(0.0, 70.0 - states[-1, 0], len(states))
    ahead = perturbed_scene(clip, replace(stage_one, ego_states=states)).centerline
    assert ahead[0, 0] == 60.0 and ahead[-1, 0] == clip.centerline[-1, 0]
    assert perturbed_scene(clip, stage_one).centerline[0, 0] < 60.0


def test_a_drive_with_every_sub_score_one_and_progress_above_a_half_is_accepted() -> None:
    assert verdict(scores(), GATE) is None
    assert verdict(scores(ep=0.5001), GATE) is None


@pytest.mark.parametrize("name", JUDGED)
@pytest.mark.parametrize("value", [0.0, 0.5, float("nan")])
def test_half_of_a_sub_score_fails_and_is_named(name: str, value: float) -> None:
    rejected = verdict(scores(**{name: value}), GATE)
    assert rejected is not None
    assert (rejected.stage, rejected.reason) == ("reward", name)
    assert f"{name}={value:g}" in rejected.detail


@pytest.mark.parametrize("value", [0.5, 0.0, float("nan")])
def test_half_the_progress_is_not_enough(value: float) -> None:
    rejected = verdict(scores(ep=value), GATE)
    assert rejected is not None
    assert rejected.reason == "ep"


def test_the_first_failing_sub_score_is_the_reason_and_all_stand_in_the_detail() -> None:
    rejected = verdict(scores(ep=0.2, ttc=0.0, dac=0.0), GATE)
    assert rejected == Rejected("reward", "dac", "dac=0 ttc=0 ep=0.200")


def test_extended_comfort_is_never_asked_for_and_an_unknown_sub_score_is_refused() -> None:
    assert "ec" not in GATE.full
    for wrong in ("ec", "comfort"):
        with pytest.raises(ValueError, match=wrong):
            ExpertGate(full=("nc", wrong))


def test_every_reason_of_the_gate_is_in_the_list_of_stages() -> None:
    reasons = next(stage.reasons for stage in STAGES if stage.name == "reward")
    assert {*GATE.full, "ep"} <= set(reasons)


def test_the_second_stage_starts_from_the_first_one_s_world() -> None:
    clip = street_clip()
    rollout = first_stage(clip)
    scene = perturbed_scene(clip, rollout)
    assert scene.step == NOW + HORIZON_STEPS
    np.testing.assert_array_equal(scene.ego_state, rollout.ego_states[-1])
    np.testing.assert_array_equal(scene.ego_history, rollout.ego_states[-16:])  # the simulated last 1.5 s
    np.testing.assert_array_equal(scene.agents.boxes[NOW : scene.step + 1], rollout.agents.boxes)
    np.testing.assert_array_equal(scene.agents.boxes[:NOW], clip.agents.boxes[:NOW])
    np.testing.assert_array_equal(scene.agents.boxes[scene.step + 1 :], clip.agents.boxes[scene.step + 1 :])
    np.testing.assert_array_equal(scene.ever_simulated, rollout.simulated)


def test_the_second_rollout_continues_ego_and_traffic_without_a_jump(scene: Scene) -> None:
    judged, _ = tried(scene, PdmClosed())
    np.testing.assert_array_equal(judged.rollout.ego_states[0], scene.ego_state)
    np.testing.assert_array_equal(judged.rollout.agents.boxes[0], scene.agents.boxes[scene.step])
    cars = judged.rollout.simulated
    assert cars.any()
    way = np.hypot(*np.moveaxis(np.diff(judged.rollout.agents.boxes[:, cars, :2], axis=0), -1, 0))
    assert np.nanmax(way) < 1.5  # at most 15 m/s in a step of 0.1 s


def test_both_experts_recover_from_beside_the_lane_s_middle(scene: Scene, table: RecoveryTable) -> None:
    for expert in (PdmClosed(), RecoveryExpert(table)):
        judged, rejected = tried(scene, expert)
        assert rejected is None, f"{expert.name}: {rejected}"
        assert all(getattr(judged.scores, name)[1] == 1.0 for name in GATE.full)
        assert judged.scores.ep[1] > 0.5
        assert abs(judged.rollout.ego_states[-1, 1]) < abs(scene.ego_state[1])


def test_experts_that_share_a_scene_drive_and_score_as_each_would_alone(scene: Scene, table: RecoveryTable) -> None:
    experts = (PdmClosed(), RecoveryExpert(table))
    alone = [tried(scene, expert)[0] for expert in experts]
    for order in ((0, 1, 0), (1, 0, 1)):
        ready = ReadyScene(scene, TrafficSettings())
        for i in order:
            shared = attempt(ready, experts[i], GATE, RNG)
            assert not isinstance(shared, Rejected)
            assert np.array_equal(shared[0].rollout.agents.boxes, alone[i].rollout.agents.boxes, equal_nan=True)
            assert np.array_equal(shared[0].rollout.ego_states, alone[i].rollout.ego_states)
            assert np.array_equal(shared[0].reference, alone[i].reference)
            assert np.array_equal(shared[0].scores.pdm_score, alone[i].scores.pdm_score)


def test_a_route_that_has_ended_is_a_rejection_not_an_error(scene: Scene) -> None:
    at_the_end = replace(scene, centerline=np.repeat(scene.centerline[-1:], 2, axis=0))
    result = attempt(ReadyScene(at_the_end, TrafficSettings()), PdmClosed(), GATE, RNG)
    assert isinstance(result, Rejected)
    assert (result.stage, result.reason) == ("rollout", "route_ended")


ASKS_FOR_ENDS = ExpertGate(full=(), progress_above=-1.0)
REPLAY = TrafficSettings(mode="replay")


def ended(scene: Scene, expert: Expert, gate: ExpertGate) -> Rejected | None:
    result = attempt(ReadyScene(scene, REPLAY), expert, gate, RNG)
    assert not isinstance(result, Rejected)
    return result[1]


def test_a_drive_that_ends_beside_the_route_is_refused_where_that_is_asked(scene: Scene) -> None:
    rejected = ended(scene, Aside(), ASKS_FOR_ENDS)
    assert rejected == Rejected("reward", "off_route", "ends on no lane of the route")
    assert ended(scene, Aside(), replace(ASKS_FOR_ENDS, off_route=False)) is None


def test_a_drive_that_ends_on_a_lane_that_leaves_the_route_is_refused(scene: Scene) -> None:
    """The street's lane ends some way beyond where PDM-Closed gets to, and the route goes on elsewhere."""
    judged, rejected = tried(scene, PdmClosed())
    assert rejected is None
    end_x, clip = float(judged.rollout.ego_states[-1, 0]), scene.clip
    for name, suffix in (("out", ""), ("out_left", "_left")):
        assert clip.road_map.lanes[name].lane_id == f"out{suffix}"
    for left_m, leads_on in ((25.0, True), (8.0, False)):
        lanes = {}
        for name, lane in clip.road_map.lanes.items():
            line = lane.centerline
            if name.startswith("out"):
                line = line[line[:, 0] <= end_x + left_m]
            lanes[name] = replace(lane, centerline=line)
        route = replace(clip.route, roadblock_ids=(*clip.route.roadblock_ids, "rb_elsewhere"))
        ends = replace(scene, clip=replace(clip, road_map=replace(clip.road_map, lanes=lanes), route=route))
        found = ended(ends, PdmClosed(), replace(ASKS_FOR_ENDS, after=False))
        assert (found is None) == leads_on
        if found is not None:
            assert found.reason == "off_route" and "leaves the route within" in found.detail


def test_a_drive_that_ends_a_moment_before_a_collision_is_refused_where_that_is_asked(scene: Scene) -> None:
    rejected = ended(scene, Close(), ASKS_FOR_ENDS)
    assert rejected is not None and (rejected.stage, rejected.reason) == ("reward", "after")
    assert "hits somebody after 0." in rejected.detail and "when it brakes" in rejected.detail
    assert ended(scene, Close(), replace(ASKS_FOR_ENDS, after=False)) is None


def test_a_collision_that_braking_prevents_refuses_nothing(scene: Scene) -> None:
    """The car ahead is 7.5 m farther on: at 10 m/s more than it the ego hits it still, braking it does not."""
    agents = scene.agents
    farther = replace(scene, agents=replace(agents, boxes=agents.boxes + np.array([7.5, 0.0, 0.0, 0.0, 0.0])))
    result = attempt(ReadyScene(farther, REPLAY), Close(), ASKS_FOR_ENDS, RNG)
    assert not isinstance(result, Rejected)
    judged, rejected = result
    traffic = prepare_traffic(farther, REPLAY)
    assert hit_after_s(traffic, judged.prepared, judged.rollout.ego_states) < np.inf
    assert hit_after_s(traffic, judged.prepared, judged.rollout.ego_states, BRAKING_MPS2) == np.inf
    assert rejected is None


def test_sub_scores_come_before_ends_and_the_route_before_the_second_after(scene: Scene) -> None:
    both = ended(scene, Aside(), GATE)
    assert both is not None and both.reason in JUDGED
    assert set(END_FAULTS) <= set(next(stage.reasons for stage in STAGES if stage.name == "reward"))


def test_what_an_end_leads_to_changes_neither_drive_nor_scores(scene: Scene, table: RecoveryTable) -> None:
    """Traffic that went on for a second is asked beside the rollout, which stays as it was to the last bit."""
    without = replace(GATE, off_route=False, after=False)
    for expert in (PdmClosed(), RecoveryExpert(table)):
        (a, _), (b, _) = (
            attempt(ReadyScene(scene, TrafficSettings()), expert, gate, RNG)  # type: ignore[misc]
            for gate in (GATE, without)
        )
        np.testing.assert_array_equal(a.rollout.ego_states, b.rollout.ego_states, strict=True)
        np.testing.assert_array_equal(a.rollout.agents.boxes, b.rollout.agents.boxes, strict=True)
        np.testing.assert_array_equal(a.scores.pdm_score, b.scores.pdm_score, strict=True)


class OffTheRoad:
    """A human who does not look."""

    name = "human"

    def digest(self) -> str:
        return "blind"

    def plan(self, scene: Scene, rng: np.random.Generator) -> Plan:
        way = scene.ego_state[3] * 0.1 * np.arange(1, HORIZON_STEPS + 1)
        return Plan(np.column_stack([way, -0.3 * way, np.full(len(way), -0.29)]))


def test_a_human_drive_is_scored_and_never_filtered() -> None:
    clip = street_clip()
    judged = drive_under_log_replay(scene_of_clip(clip), OffTheRoad(), RNG)
    assert verdict(judged.scores, GATE) is not None
    assert judged.scores.dac[1] == 0.0
    assert judged.scene.step == NOW


def test_around_the_human_everybody_does_what_the_log_says() -> None:
    clip = street_clip()
    judged = drive_under_log_replay(scene_of_clip(clip), Human(), RNG)
    np.testing.assert_array_equal(judged.plan.poses, clip.ego_states[NOW + 1 : NOW + 41, :3])
    np.testing.assert_array_equal(judged.rollout.agents.boxes, clip.agents.boxes[NOW : NOW + 41])
    assert not judged.rollout.simulated.any()
    assert judged.scores.pdm_score[1] > 0.8


@pytest.mark.parametrize("origin", [(350.0, -120.0, 0.0), (-40.0, 900.0, 2.2)])
def test_moving_the_world_moves_a_whole_attempt_along(table: RecoveryTable, origin: tuple[float, ...]) -> None:
    here, frame = street_clip(), np.array(origin)
    there = moved(here, frame)
    for expert in (PdmClosed(), RecoveryExpert(table)):
        (a, rejected_a), (b, rejected_b) = (
            tried(perturbed_scene(clip, first_stage(clip)), expert) for clip in (here, there)
        )
        assert rejected_a == rejected_b
        assert same_poses(to_world(frame, a.rollout.ego_states), b.rollout.ego_states[..., :3], 1e-5)
        assert same_poses(to_world(frame, a.rollout.agents.boxes), b.rollout.agents.boxes[..., :3], 1e-5)
        assert a.scores.pdm_score[1] == pytest.approx(b.scores.pdm_score[1], abs=1e-6)


@dataclass(frozen=True)
class Several:
    """An expert with these plans."""

    given: tuple[Plan | Rejected, ...]
    name: str = "several"

    def digest(self) -> str:
        return "several"

    def plan(self, scene: Scene, rng: np.random.Generator) -> Plan | Rejected:
        return self.given[0]

    def plans(self, scene: Scene, rng: np.random.Generator) -> Iterator[Plan | Rejected]:
        yield from self.given


def test_of_several_plans_the_first_that_is_accepted_is_driven_and_of_none_the_first_is_told(scene: Scene) -> None:
    good = PdmClosed().plan(scene, RNG)
    assert isinstance(good, Plan)
    off, farther = (Plan(good.poses + np.array([0.0, aside_m, 0.0])) for aside_m in (30.0, 60.0))
    judged, rejected = tried(scene, Several((off, good, farther)))
    assert rejected is None and judged.plan is good
    judged, rejected = tried(scene, Several((off, farther)))
    assert rejected is not None and judged.plan is off
    lost = Rejected("expert", "out_of_reach", "nowhere")
    assert attempt(ReadyScene(scene, TrafficSettings()), Several((lost,)), GATE, RNG) == lost


@pytest.mark.parametrize(
    ("aside_m", "turned_deg", "faster_mps", "near"),
    [
        *[(0.9, 0.0, 0.0, True), (1.1, 0.0, 0.0, False), (0.0, 4.9, 0.0, True), (0.0, 5.1, 0.0, False)],
        *[(0.0, 0.0, 0.9, True), (0.0, 0.0, 1.1, False)],
    ],
)
def test_a_drive_that_is_the_log_s_own_is_refused_unless_that_is_off(
    scene: Scene, aside_m: float, turned_deg: float, faster_mps: float, near: bool
) -> None:
    """The log is laid beside the drive, as far off as said at one instant or another."""
    good = PdmClosed().plan(scene, RNG)
    assert isinstance(good, Plan)
    driven = tried(scene, Several((good,)))[0].rollout.ego_states
    log = scene.clip.ego_states.copy()
    log[scene.step : scene.step + len(driven)] = driven
    log[scene.step + 7, 1] -= aside_m
    log[scene.step + 19, HEADING] += np.radians(turned_deg)
    log[scene.step + 40, VX] -= faster_mps
    beside = replace(scene, clip=replace(scene.clip, ego_states=log))
    assert tried(beside, Several((good,)))[1] == (
        Rejected(
            "reward",
            "near_log",
            f"at most {aside_m:.2f} m, {turned_deg:.1f} degrees and {faster_mps:.1f} m/s off the log",
        )
        if near
        else None
    )
    open_gate = replace(GATE, near_log=False)
    result = attempt(ReadyScene(beside, TrafficSettings()), Several((good,)), open_gate, RNG)
    assert not isinstance(result, Rejected) and result[1] is None


@pytest.mark.parametrize(
    ("off", "recovered"), [((1.9, 9.0, 2.4), True), ((2.2, 0, 0), False), ((0, 11, 0), False), ((0, 0, 3), False)]
)
def test_a_drive_that_ends_too_far_from_its_goal_is_not_recovered(
    scene: Scene, off: tuple[float, float, float], recovered: bool
) -> None:
    good = PdmClosed().plan(scene, RNG)
    assert isinstance(good, Plan)
    end = tried(scene, Several((good,)))[0].rollout.ego_states[-1]
    pose = end[: HEADING + 1] + np.array([off[0], 0.0, np.radians(off[1])])
    judged, rejected = tried(scene, Several((Plan(good.poses, Goal(pose, end[VX] + off[2], 2.0, 10.0, 2.5)),)))
    assert (rejected is None) == recovered
    if rejected is not None:
        assert (rejected.stage, rejected.reason) == ("reward", "not_recovered")
        assert rejected.detail == f"ends {off[0]:.1f} m, {off[1]:.0f} degrees and {off[2]:.1f} m/s off the log"
    np.testing.assert_array_equal(judged.rollout.ego_states[-1], end)
