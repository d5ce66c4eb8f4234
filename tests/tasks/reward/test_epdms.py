"""What the sub-scores add up to, and what must not change them."""

import pickle
from dataclasses import fields, replace

import numpy as np
import pytest

from tasks.reward.epdms import Scores, human_filtered, relative_progress, rows, score, score_with_ec
from tasks.reward.prepare import prepare
from tasks.reward.rules.map_index import index_map
from tasks.rollout.lqr import track
from tasks.world.agents import AgentKind
from tasks.world.frames import to_world
from tasks.world.lanes import MapLayer
from tests.tasks.reward.straight_street import Thing, drive, past_of, rectangle, street, tracks

TRAFFIC = (
    Thing(25.3, 0.2, 0.02, (3.0, 0.1)),
    Thing(18.1, 4.1, np.pi, (-6.0, 0.0)),
    Thing(-12.2, 0.1, 0.0, (9.0, 0.0)),
    Thing(14.7, -5.1, np.pi / 2, (0.0, 1.3), AgentKind.PEDESTRIAN, 0.7, 0.6),
    Thing(21.9, 2.4, 0.3, kind=AgentKind.TRAFFIC_CONE, length=0.4, width=0.4),
)
EXTRA = (
    rectangle("turn", MapLayer.LANE_CONNECTOR, (33.3, -2), (50, 2)),
    rectangle("int_turn", MapLayer.INTERSECTION, (33.3, -2), (50, 2)),
)


def plans(count: int) -> np.ndarray:
    """Plans (K, 40, 3) of different speed and curvature, in the ego frame."""
    rng = np.random.default_rng(4)
    t = 0.1 * np.arange(1, 41)
    speed, bend = rng.uniform(0.0, 12.0, (count, 1)), rng.uniform(-0.02, 0.02, (count, 1))
    heading = bend * speed * t
    step = 0.1 * speed * np.exp(1j * heading)
    position = np.cumsum(step, axis=1)
    return np.stack([position.real, position.imag, heading], axis=-1)


def scored(origin: np.ndarray, **settings) -> Scores:
    start = drive(6.0, origin=origin)
    states = track(start[0, 0], to_world(origin, plans(40)))
    prepared = street(TRAFFIC, EXTRA, ("turn",), past_of(start), origin, start[0, 0])
    return score(prepared, states, **settings)


def test_progress_is_held_against_the_best_of_the_batch_or_against_row_0_alone():
    """Row 0 is 20 m far. The second is 40 m, the third 10 m, the fourth 80 m and breaks a rule."""
    ep_raw_m, multiplier = np.array([20.0, 40.0, 10.0, 80.0]), np.array([1.0, 1.0, 1.0, 0.0])
    assert relative_progress(ep_raw_m, multiplier, False).tolist() == [0.5, 1.0, 0.25, 1.0]
    assert relative_progress(ep_raw_m, multiplier, True).tolist() == [1.0, 1.0, 0.5, 1.0]
    assert relative_progress(np.array([3.0, 5.0]), np.ones(2), True).tolist() == [1.0, 1.0], "nobody beyond 5 m"
    assert relative_progress(np.array([3.0, 5.1]), np.ones(2), False).tolist() == [3.0 / 5.1, 1.0]


def test_the_score_is_a_product_times_a_weighted_mean():
    got = scored(np.zeros(3))
    multiplier = got.nc * got.dac * got.tlc * got.ddc
    weighted = 5 * got.ep + 5 * got.ttc + 2 * got.lk + 2 * got.hc
    np.testing.assert_allclose(got.multiplier, multiplier)
    np.testing.assert_allclose(got.pdm_score, multiplier * weighted / 14)
    ec = np.linspace(0, 1, len(got)).round()
    np.testing.assert_allclose(score_with_ec(got, ec), multiplier * (weighted + 2 * ec) / 16)
    for name in ("nc", "dac", "tlc", "ddc", "ttc", "lk", "hc"):
        values = getattr(got, name)
        assert np.array_equal(values < 1.0, np.isfinite(got.first_failures[name])), name
        assert 0.0 < values.mean() < 1.0 or name in ("hc", "lk"), f"{name} is not tried by these plans"


@pytest.mark.parametrize("origin", [(300.0, -120.0, 0.0), (0.0, 0.0, 2.1), (5200.0, 2400.0, -0.7)])
def test_shifting_and_rotating_the_world_changes_no_score(origin):
    here, there = scored(np.zeros(3)), scored(np.array(origin))
    for field in fields(Scores):
        ours, theirs = getattr(here, field.name), getattr(there, field.name)
        np.testing.assert_allclose(theirs, ours, atol=1e-8, err_msg=field.name)


def test_pairs_are_two_row_batches_with_row_zero():
    start = drive(6.0)
    states = track(start[0, 0], plans(12))
    prepared = street(TRAFFIC, EXTRA, (), past_of(start), ego0=start[0, 0])
    paired = score(prepared, states, normalise="pairs")
    for k in range(1, 12):
        alone = rows(score(prepared, states[[0, k]]), slice(1, 2))
        assert alone.ep[0] == paired.ep[k] and alone.pdm_score[0] == paired.pdm_score[k]
    assert score(prepared, states[:1]).ep[0] == paired.ep[0]


def test_everything_but_progress_is_the_same_alone_and_in_a_batch_of_any_size():
    start = drive(6.0)
    states = track(start[0, 0], plans(40))
    prepared = street(TRAFFIC, EXTRA, ("turn",), past_of(start), ego0=start[0, 0])
    many = score(prepared, np.tile(states, (20, 1, 1)))  # 800 rows: more than one pass
    for k in (0, 7, 39):
        alone = score(prepared, states[k : k + 1])
        for field in fields(Scores):
            if field.name not in ("ep", "pdm_score"):
                assert np.array_equal(getattr(alone, field.name)[0], getattr(many, field.name)[k + 760]), field.name


def test_the_human_filter_forgives_zeros_only():
    got = scored(np.zeros(3))
    human = rows(got, slice(0, 1))
    human = replace(human, **{name: np.ones(1) for name in ("nc", "dac", "tlc", "ddc", "ep", "ttc", "lk", "hc")})
    assert np.array_equal(human_filtered(got, human).pdm_score, got.pdm_score)
    half = replace(human, nc=np.array([0.5]))
    assert np.array_equal(human_filtered(got, half).nc, got.nc)
    forgiven = human_filtered(got, replace(human, nc=np.zeros(1)))
    assert (forgiven.nc == 1.0).all()
    np.testing.assert_allclose(forgiven.multiplier, got.dac * got.tlc * got.ddc)


def test_a_prepared_scene_may_be_sent_to_another_process():
    start = drive(6.0)
    states = track(start[0, 0], plans(10))
    prepared = street(TRAFFIC, EXTRA, ("turn",), past_of(start), ego0=start[0, 0])
    here, there = score(prepared, states), score(pickle.loads(pickle.dumps(prepared)), states)
    for field in fields(Scores):
        assert np.array_equal(getattr(here, field.name), getattr(there, field.name)), field.name


def test_bad_states_and_inputs_are_refused():
    with pytest.raises(ValueError, match="states must be"):
        score(street(), np.zeros((3, 40, 11)))
    with pytest.raises(ValueError, match="finite"):
        score(street(), np.full((1, 41, 11), np.nan))
    with pytest.raises(ValueError, match="past_states"):
        prepare(
            past_states=np.zeros((3, 11)),
            centerline=np.zeros((2, 2)),
            polygons=(),
            route_lane_ids=frozenset(),
            objects=tracks([]),
        )


def test_a_scene_without_map_and_traffic_is_off_road():
    bare = replace(street(), map_index=index_map((), frozenset()))
    got = score(bare, drive(5.0))
    assert got.dac[0] == 0.0 and got.nc[0] == 1.0 and got.ddc[0] == 0.5
