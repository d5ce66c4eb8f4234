"""The benchmarks' peers: a ratio needs a peer that is there, and one that is not is refused in one line."""

import sys

import numpy as np
import pytest

from tests.bench.peer import Beside, peer_python


@pytest.mark.parametrize("python", ["/nowhere/python", sys.executable])
def test_a_python_without_the_public_metric_is_refused_in_one_line(
    monkeypatch: pytest.MonkeyPatch, python: str
) -> None:
    monkeypatch.setenv("PEER", python)
    with pytest.raises(SystemExit, match="navsim and nuplan-devkit are installed") as refused:
        peer_python()
    assert str(refused.value).startswith(f"PEER={python} ")
    assert "\n" not in str(refused.value)


def test_ratios_are_of_turns_and_unequal_scores_are_said() -> None:
    turns = {"ours_s": np.array([1e-4, 2e-4, 1e-4]), "peer_s": np.array([2e-2, 2e-2, 3e-2])}
    assert Beside(**turns, worst=1e-12).row(2) == "50.0 | 10,000 | 100 / 200 / 300 | equal"
    assert Beside(**turns, worst=0.5).row(2).endswith("| differ by 0.5")
