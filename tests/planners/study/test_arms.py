"""Arms of an experiment: what they drove from the same starts, by closed forms of drives made up."""

from typing import Any

import numpy as np
import pytest

from planners.study import arms as module
from planners.study.arms import (
    ArmDrives,
    HeldAgainst,
    arm_differences,
    comparison_tables,
    read_arm_drives,
)
from planners.training.many import Training
from tests.planners.drive.test_summary import row

ARMS = ("ltf-real-steps", "ltf-more-steps")
PAIR = HeldAgainst("real alone", ARMS[1], ARMS[0])


def training(label: str) -> Training:
    return Training(label, facts={"seed": int(label[-1])})


def drives_of(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Any, rows: list[dict[str, Any]], seeds: int = 1
) -> list[ArmDrives]:
    """What is found of drives that are there."""
    everyone = [training(f"{arm}-{seed}") for seed in range(seeds) for arm in ARMS]
    for one in everyone:
        (tmp_path / "trainings" / one.label).mkdir(parents=True, exist_ok=True)
    monkeypatch.setattr(module, "drive_settings", lambda *_: None)
    monkeypatch.setattr(module, "read_drives", lambda _: (rows, True))
    return read_arm_drives(everyone, str(tmp_path), "")


def test_arms_are_held_against_each_other_where_all_have_driven(monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> None:
    """The second arm scores a tenth more in three drives; each has driven one that the other has not."""
    rows = [row(i, planner=f"{ARMS[0]}-0", score=0.5) for i in (0, 1, 2, 4)]
    rows += [row(i, planner=f"{ARMS[1]}-0", score=0.6) for i in range(4)]
    rows += [row(i, planner="constant_velocity", score=0.2) for i in range(3)]
    (found,) = drives_of(monkeypatch, tmp_path, rows)
    assert (found.kind, found.level, len(found.clusters)) == ("logged", "town", 3)
    apart = {(one["arm"], one["reference"], one["measure"]): one for one in arm_differences([found], [PAIR])}
    more = apart[ARMS[1], ARMS[0], "score"]
    assert [more[name] for name in ("difference", "low", "high")] == pytest.approx([10.0, 10.0, 10.0])
    assert apart[ARMS[0], "constant_velocity", "score"]["difference"] == pytest.approx(30.0)
    assert "**+10.0** [+10.0, +10.0]" in comparison_tables([found], list(apart.values()), [])


def test_towns_are_drawn_whole_and_incidents_count_by_the_kilometre(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Any
) -> None:
    """Two towns of two drives; the second arm has an incident in 4 km, and from two towns any rate may be."""
    log = {i: f"town-{i // 2}-000{i % 2}-straight" for i in range(4)}
    rows = [row(i, planner=f"{ARMS[0]}-0", log_id=log[i]) for i in range(4)]
    rows += [
        row(i, planner=f"{ARMS[1]}-0", log_id=log[i], score=float(i > 0), offroad_or_collision_at_fault=float(i == 0))
        for i in range(4)
    ]
    (found,) = drives_of(monkeypatch, tmp_path, rows)
    one = found.difference(ARMS[1], ARMS[0], "incidents_per_km")
    assert (one.difference, one.low, one.high) == pytest.approx((0.25, 0.0, 1.0))
    clean = found.difference(ARMS[1], None, "score")
    assert (clean.b, clean.low, clean.high) == pytest.approx((75.0, 0.0, 100.0))


def test_a_seed_that_an_arm_has_not_driven_counts_for_none(monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> None:
    labels = [f"{ARMS[0]}-0", f"{ARMS[1]}-0", f"{ARMS[0]}-1"]
    rows = [row(i, planner=label, start=start) for label in labels for i in range(2) for start in (-1, 0)]
    found = drives_of(monkeypatch, tmp_path, rows, seeds=2)
    assert [one.kind for one in found] == ["logged", "perturbed"]
    assert all(len(one.rows[arm]) == 1 for one in found for arm in ARMS)
    assert drives_of(monkeypatch, tmp_path, rows[:2], seeds=2) == []


def test_seeds_are_pairs(monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> None:
    """The same gain in each of two seeds that differ by much has no width."""
    rows = []
    for seed, base in ((0, 0.1), (1, 0.8)):
        rows += [row(i, planner=f"{ARMS[0]}-{seed}", score=base) for i in range(2)]
        rows += [row(i, planner=f"{ARMS[1]}-{seed}", score=base + 0.1) for i in range(2)]
    (found,) = drives_of(monkeypatch, tmp_path, rows, seeds=2)
    one = found.difference(ARMS[1], ARMS[0], "score")
    np.testing.assert_allclose((one.difference, one.low, one.high), 10.0)
