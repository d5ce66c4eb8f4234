"""What the sub-scores add up to, and what must not change them."""

from dataclasses import replace

import numpy as np

from tasks.reward.epdms import Scores, human_filtered, relative_progress, score, score_with_ec, select_rows
from tasks.reward.map_index import index_map
from tasks.rollout.lqr import track
from tasks.world.clip import AgentKind
from tasks.world.frames import to_world
from tasks.world.road_map import MapLayer
from tests.tasks.reward.straight_street import Thing, drive, past_of, rectangle, street

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
    prepared = street(TRAFFIC, EXTRA, (("turn",), np.ones((41, 1), dtype=bool)), past_of(start), origin, start[0, 0])
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


def test_the_human_filter_forgives_zeros_only():
    got = scored(np.zeros(3))
    human = select_rows(got, slice(0, 1))
    human = replace(human, **{name: np.ones(1) for name in ("nc", "dac", "tlc", "ddc", "ep", "ttc", "lk", "hc")})
    assert np.array_equal(human_filtered(got, human).pdm_score, got.pdm_score)
    half = replace(human, nc=np.array([0.5]))
    assert np.array_equal(human_filtered(got, half).nc, got.nc)
    forgiven = human_filtered(got, replace(human, nc=np.zeros(1)))
    assert (forgiven.nc == 1.0).all()
    np.testing.assert_allclose(forgiven.multiplier, got.dac * got.tlc * got.ddc)


def test_a_scene_without_map_and_traffic_is_off_road():
    bare = replace(street(), map_index=index_map((), frozenset()))
    got = score(bare, drive(5.0))
    assert got.dac[0] == 0.0 and got.nc[0] == 1.0 and got.ddc[0] == 0.5
