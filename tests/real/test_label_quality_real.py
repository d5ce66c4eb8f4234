"""What is accepted on the shared logs, looked at from outside: no code of the factory's or the reward's judges here."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments.experts.check import OFF_ROAD_M2, measured, off_the_log, rows_of
from factory.run import main

pytestmark = pytest.mark.slow  # 14 clips, 28 with the long ones
LOGS = {"av2": ("av2", "sensor", "val"), "scenarionet": ("scenarionet", "nuscenes")}
JERK_MPS3 = 8.37  # comfort's, which the reward asks of a smoothed jerk; PDM-Closed's first tenth of a second is near it
YAW_RATE_RADPS = 0.95


RUNS = [*((name, 7) for name in LOGS), *(pytest.param((name, 14), marks=pytest.mark.long) for name in LOGS)]


@pytest.fixture(scope="module", params=RUNS, ids=lambda run: f"{run[0]}-{run[1]}")
def rows(request: pytest.FixtureRequest, shared_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The samples of one round of both experts, and the log's."""
    name, limit = request.param
    out = tmp_path_factory.mktemp(name)
    human = shared_root / "data" / "vocabulary" / "human_8192x40x3.npy"
    words = [f"clips={name}", f"clips.root={shared_root.joinpath('data', *LOGS[name])}"]
    words += [f"vocabulary.file={human}", "experts=[pdm_closed,recovery,human]", "rounds=1", "reward.labels=none"]
    assert main([*words, f"limit={limit}", "render=none", "executor=local", f"out={out}"]) == 0
    found = rows_of(str(out))
    assert {row["expert"] for row in found} == {"human", "pdm_closed", "recovery"} and len(found) > 12 * limit // 7
    return found


def test_accepted_labels_meet_nobody_stay_on_the_road_and_end_on_the_route(rows: list[dict[str, Any]]) -> None:
    for row in rows:
        label = measured(row)
        assert label.met == () and label.on_route and label.off_road_m2 <= OFF_ROAD_M2, (row["clip_id"], label)
        assert label.between_rates_m == 0.0
        if row["expert"] != "human":
            assert label.jerk_mps3 < JERK_MPS3 and label.yaw_rate_radps < YAW_RATE_RADPS, (row["clip_id"], label)


def test_a_recovery_ends_at_the_log_and_no_label_is_the_log_again(rows: list[dict[str, Any]]) -> None:
    assert all(measured(row).at_log for row in rows if row["expert"] == "recovery")
    simulated = [np.array(row["off_log_most"]) for row in rows if row["expert"] != "human"]
    assert all((most > [1.0, np.radians(5.0), 1.0]).any() for most in simulated)


def test_the_distances_from_the_log_are_those_from_the_window_four_seconds_later(rows: list[dict[str, Any]]) -> None:
    said, found = off_the_log(rows)
    assert len(said) > 0.6 * sum(row["expert"] == "human" for row in rows)
    np.testing.assert_allclose(said[:, :2], found[:, :2], atol=1e-4)
    np.testing.assert_allclose(said[:, 2], found[:, 2], atol=0.15)  # that is the mean over the last 0.1 s
