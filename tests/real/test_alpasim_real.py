"""AlpaSim's loop and score on real logs: who drives as the log did fails nowhere."""

import json
from pathlib import Path

import pytest

pytest.importorskip("carla_driver_interface", reason='the contract needs pip install ".[alpasim]"')

from factory.exits import COMPLETE
from planners.drive.drive import main


@pytest.mark.slow
@pytest.mark.parametrize("limit", [6, pytest.param(12, marks=pytest.mark.long)])
@pytest.mark.parametrize(("dataset", "folder"), [("av2", "av2/sensor"), ("scenarionet", "scenarionet/nuscenes")])
def test_the_log_s_own_drive_scores_one(
    dataset: str, folder: str, limit: int, shared_root: Path, tmp_path: Path
) -> None:
    """Followed by the MPC it stays within a metre of the log, on the road and apart from all others."""
    words = [f"clips={dataset}", f"clips.root={shared_root / 'data' / folder}", "planner=human", "bounds=false"]
    assert main([*words, "seconds=20", f"limit={limit}", f"out={tmp_path}"]) == COMPLETE
    told = json.loads((tmp_path / "results-summary.json").read_text())["rollouts"]
    assert len(told) >= 5 * limit // 6
    for entry in told:
        assert (entry["score"], entry["metrics"]["collision_any"]) == (1.0, 0.0), entry
        assert entry["metrics"]["dist_to_gt_trajectory"] < 1.0, entry
