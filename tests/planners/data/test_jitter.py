"""Samples from beside the log: closed forms of what is seen and where the label leads, and what the loader makes."""

from pathlib import Path

import numpy as np
import pytest

from planners.data.batch import BevLayout, ImageLayout, Needs
from planners.data.bev import BevClass
from planners.data.index import DataSettings, open_data
from planners.data.jitter import JitterSettings, Offset, draw_offset
from planners.data.loader import Loader
from planners.data.mix import MixSettings
from tests.planners.samples import sample, write_table

STRAIGHT = np.column_stack([np.arange(1, 41), np.zeros(40), np.zeros(40)]).astype(float)  # 10 m/s
LAYOUT = BevLayout(ahead_m=30.0, behind_m=10.0, side_m=10.0, cell_m=0.5)


def test_a_label_begins_at_the_ego_and_is_the_log_again_behind_the_way_back() -> None:
    offset = Offset(1.5, 0.1, 20.0)
    bent = offset.bent_back(STRAIGHT)
    assert abs(bent[0, 1]) < 0.03 and abs(bent[0, 2]) < 0.05, "it leaves the ego straight ahead"
    np.testing.assert_allclose(bent[20:], offset.seen_poses(STRAIGHT[20:]), atol=1e-12)
    moved = np.vstack([[0.0, 0.0], bent[:, :2]])
    along = np.arctan2(*np.diff(moved, axis=0)[:, ::-1].T)
    np.testing.assert_allclose((along[1:] + along[:-1]) / 2, bent[:-1, 2], atol=0.02)
    speeds = np.linalg.norm(np.diff(moved, axis=0), axis=1)
    assert speeds.max() < 1.03 and speeds.min() > 0.97


def test_without_an_offset_nothing_moves_and_who_stands_stays() -> None:
    rng = np.random.default_rng(0)
    curve = np.column_stack([np.arange(1.0, 41), rng.normal(size=(40, 2)) * 0.1])
    np.testing.assert_allclose(Offset(0.0, 0.0, 20.0).bent_back(curve), curve, atol=1e-12)
    stands = Offset(1.0, 0.1, 20.0).bent_back(np.zeros((40, 3)))
    np.testing.assert_allclose(stands, 0.0, atol=1e-12)


def test_what_is_seen_lies_where_it_did() -> None:
    """Back from the ego's new frame into the old one, a point is the same."""
    offset = Offset(-0.7, 0.2, 20.0)
    poses = np.random.default_rng(1).normal(size=(5, 7, 5)) * 3.0
    seen = offset.seen_poses(poses)
    cos, sin = np.cos(0.2), np.sin(0.2)
    np.testing.assert_allclose(seen[..., :2] @ np.array([[cos, sin], [-sin, cos]]) + [0.0, -0.7], poses[..., :2])
    np.testing.assert_allclose(np.angle(np.exp(1j * (seen[..., 2] + 0.2 - poses[..., 2]))), 0.0, atol=1e-12)
    assert (seen[..., 3:] == poses[..., 3:]).all()


def test_a_draw_hangs_on_seed_pass_and_sample_alone() -> None:
    settings = JitterSettings(share=0.5, lateral_m=1.0, heading_rad=0.1)
    drawn = [draw_offset(settings, 0, 0, str(i)) for i in range(2000)]
    there = [one for one in drawn if one is not None]
    assert len(there) / 2000 == pytest.approx(0.5, abs=0.04) and drawn[7] == draw_offset(settings, 0, 0, "7")
    assert draw_offset(JitterSettings(share=1.0), 0, 0, "7") != draw_offset(JitterSettings(share=1.0), 0, 1, "7")
    assert max(abs(one.lateral_m) for one in there) <= 1.0 and max(abs(one.heading_rad) for one in there) <= 0.1
    with pytest.raises(ValueError, match=r"share=2\.0"):
        JitterSettings(share=2.0)
    with pytest.raises(ValueError, match=r"back_m=0\.0"):
        JitterSettings(back_m=0.0)


def test_the_loader_moves_real_samples_alone_and_the_same_ones_again(tmp_path: Path) -> None:
    road = [np.array([[-30.0, -2.0], [60.0, -2.0], [60.0, 2.0], [-30.0, 2.0], [-30.0, -2.0]])]
    seen = {
        "lane_polygons": road,
        "label_10hz": STRAIGHT,
        "label_2hz": STRAIGHT[4::5],
        "agent_kinds": [],
        "agent_boxes": np.zeros((0, 56, 5), np.float32),
        "agent_valid": np.zeros((0, 56), bool),
    }
    rows = [sample(i, "human" if i < 4 else "recovery", **seen) for i in range(8)]
    write_table(tmp_path / "out", rows)
    data = open_data(DataSettings(real=str(tmp_path / "out"), sim=str(tmp_path / "out")))

    def batch(share: float, epoch: int = 0):
        mix = MixSettings(jitter=JitterSettings(share, lateral_m=3.0))
        loader = Loader(data, Needs(bev=LAYOUT), mix, 8)
        return next(loader.epoch(epoch))

    moved, plain = batch(1.0), batch(0.0)
    assert moved.attempt_ids == plain.attempt_ids
    assert moved.plan_2hz.equal(moved.plan_10hz[:, 4::5]) and moved.bev.equal(batch(1.0).bev)
    assert not moved.plan_2hz.equal(batch(1.0, 1).plan_2hz)
    for i, simulated in enumerate(plain.simulated.tolist()):
        assert moved.plan_10hz[i].equal(plain.plan_10hz[i]) == moved.bev[i].equal(plain.bev[i]) == simulated
        assert moved.status[i].equal(plain.status[i]) and moved.history[i].equal(plain.history[i])
        near = (
            moved.bev[i, 0, -21, :] != BevClass.BACKGROUND
        )  # of the row of the ego: the lane lies where it is no more
        left = (near.nonzero().float().mean() - 19.5).item() * LAYOUT.cell_m
        offset = None if simulated else draw_offset(JitterSettings(1.0, 3.0), 0, 0, plain.attempt_ids[i])
        assert left == pytest.approx(offset.lateral_m if offset else 0.0, abs=0.8)


def test_who_sees_pictures_is_refused(tmp_path: Path) -> None:
    write_table(tmp_path / "out", [sample(i) for i in range(2)])
    data = open_data(DataSettings(real=str(tmp_path / "out")))
    for needs, what in ((Needs(image=ImageLayout()), "sees pictures"), (Needs(labels="v"), "learns scores")):
        with pytest.raises(ValueError, match=what):
            Loader(data, needs, MixSettings(jitter=JitterSettings(0.5)), 2)
