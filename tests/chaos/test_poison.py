"""A short run of tests.chaos.poison: one clip of each kind among few."""

from pathlib import Path

import pytest

from tests.chaos.poison import HOW, trial, write_files


@pytest.mark.slow
@pytest.mark.parametrize("executor", ["local", pytest.param("ray", marks=pytest.mark.ray)])
def test_clips_that_do_harm_are_told_of_and_touch_no_other(tmp_path: Path, executor: str) -> None:
    write_files(tmp_path)
    told = trial(tmp_path, executor, 20, 2)
    assert len(told) == len(HOW) + 1
