"""A submission to NAVSIM's leaderboard is read as data, whoever's agent wrote it and by whichever Python."""

import pickle
import sys
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from factory.readers.base import BadClip
from planners.evaluation.submission import read_submission


@dataclass
class TrajectorySampling:
    num_poses: int
    time_horizon: float
    interval_length: float


@dataclass
class Trajectory:
    poses: Any
    trajectory_sampling: Any


PUBLIC = {
    "navsim.common.dataclasses": Trajectory,
    "nuplan.planning.simulation.trajectory.trajectory_sampling": TrajectorySampling,
}


@pytest.fixture(autouse=True)
def public_names(monkeypatch: pytest.MonkeyPatch) -> None:
    """So that pickles name the classes as NAVSIM's do."""
    for module, made in PUBLIC.items():
        monkeypatch.setattr(made, "__module__", module)
        parts = module.split(".")
        for n in range(1, len(parts) + 1):
            monkeypatch.setitem(sys.modules, ".".join(parts[:n]), ModuleType(".".join(parts[:n])))
        setattr(sys.modules[module], made.__name__, made)


def plan(n: int, apart_s: float, mps: float = 5.0) -> Trajectory:
    """Straight on."""
    poses = np.zeros((n, 3), np.float32)
    poses[:, 0] = mps * apart_s * np.arange(1, n + 1)
    return Trajectory(poses, TrajectorySampling(n, n * apart_s, apart_s))


def written(path: Path, content: object, protocol: int = 4) -> Path:
    path.write_bytes(pickle.dumps(content, protocol=protocol))
    return path


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
def test_plans_of_both_eras_and_rates_are_at_10_hz_for_4_s(tmp_path: Path, protocol: int) -> None:
    one = {"team_name": "a", "predictions": [{"t": plan(8, 0.5), "longer": plan(10, 0.5), "finer": plan(40, 0.1)}]}
    two = {"first_stage_predictions": [{"t": plan(8, 0.5)}], "second_stage_predictions": [{"u": plan(8, 0.5)}]}
    along = 0.5 * np.arange(1, 41)
    for content, tokens in ((one, {"t", "longer", "finer"}), (two, {"t", "u"})):
        found = read_submission(written(tmp_path / "submission.pkl", content, protocol))
        assert found.keys() == tokens
        for poses in found.values():
            np.testing.assert_allclose(poses, np.column_stack([along, np.zeros((40, 2))]), atol=1e-5)


class Runs:
    def __reduce__(self) -> Any:
        return exec, ("print('this ran')",)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ({"team_name": "a"}, "no submission: none of predictions, first_stage_predictions"),
        ({"predictions": [{}, {}]}, "no list of one dictionary"),
        ({"predictions": [{"t": plan(6, 0.5)}]}, r"token t.*\(6, 3\) poses 0.5 s apart; 4 s of them"),
        ({"predictions": [{"t": plan(8, 0.4)}]}, "token t.*0.4 s apart"),
        ({"predictions": [{"t": plan(8, 0.5, np.nan)}]}, "token t.*not finite"),
        ({"predictions": [{"t": np.zeros((8, 3))}]}, "token t.*no Trajectory"),
        ({"predictions": [{"t": Runs()}]}, "refused global builtins.exec"),
    ],
)
def test_what_holds_no_plans_is_refused_by_file_and_token(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], content: object, said: str
) -> None:
    with pytest.raises(BadClip, match=f"submission.pkl.*{said}"):
        read_submission(written(tmp_path / "submission.pkl", content))
    assert not capsys.readouterr().out
