"""A short run of tests.chaos.poison: one clip of each kind among few."""

from pathlib import Path

import pytest

from tests.chaos.poison import HOW, trial, write_files


@pytest.mark.ray
@pytest.mark.slow
def test_clips_that_do_harm_are_told_of_and_touch_no_other(tmp_path: Path) -> None:
    """In processes of this machine alone: tests/factory/graph/test_isolated.py."""
    write_files(tmp_path)
    told = trial(tmp_path, "ray", 20, 2)
    assert len(told) == len(HOW) + 1
