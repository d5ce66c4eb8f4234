"""A film of a street: every instant of both stages, with or without a camera."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from factory.config.compose import ConfigError
from factory.views.pictures import write_mp4
from planners.evaluation.planner_names import find_planner
from planners.evaluation.replay import HOLD, ReplaySettings, find_clip, replay, settings_of
from planners.evaluation.scoring import Rules
from tests.planners.small_benchmark import StreetBenchmark

INSTANTS = 15 + 41  # -1.5 .. 4 s


@pytest.fixture(scope="module")
def benchmark() -> StreetBenchmark:
    return StreetBenchmark(("a", "bc", "bd"))


@pytest.mark.slow
def test_both_stages_are_shown_from_history_to_the_end(benchmark: StreetBenchmark) -> None:
    pictures = list(replay(benchmark, find_planner("pdm_closed"), "a", Rules()))
    assert len(pictures) == 2 * (INSTANTS + HOLD)
    assert {picture.shape for picture in pictures} == {(560, 1280, 3)}
    assert (pictures[0] != pictures[30]).any()


def test_a_film_makes_its_folder(tmp_path: Path) -> None:
    write_mp4(path := tmp_path / "a" / "b.mp4", [np.zeros((16, 16, 3), np.uint8)])
    assert path.stat().st_size > 0


def test_nobody_drives_like_the_human_after_stage_one(benchmark: StreetBenchmark) -> None:
    assert len(list(replay(benchmark, find_planner("human"), "a", Rules()))) == INSTANTS + HOLD


def test_the_camera_shows_the_latest_picture_up_to_now(benchmark: StreetBenchmark) -> None:
    def image(time_s: float, level: int) -> dict[str, object]:
        jpeg = cv2.imencode(".jpg", np.full((9, 16, 3), level, np.uint8))[1].tobytes()
        return {"camera": "front", "time_s": time_s, "jpeg": jpeg}

    key = benchmark.keys[0]
    camera = {"name": "front", "ego_from_camera": [0, 0, 1, 0, -1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 0, 1]}
    benchmark._rows[key] |= {"cameras": [camera], "images": [image(-0.5, 60), image(0.0, 200), image(0.5, 250)]}
    pictures = list(replay(benchmark, find_planner("human"), "a", Rules()))
    middle = [int(picture[200, 920].mean()) for picture in pictures]
    assert np.abs(np.array(middle[:15]) - 60).max() <= 2
    assert np.abs(np.array(middle[15:]) - 200).max() <= 2


def test_a_clip_or_follow_up_that_is_not_there_is_named(benchmark: StreetBenchmark) -> None:
    assert [find_clip(benchmark, text) for text in ("0", "bd", "2")] == ["a", "bd", "bd"]
    with pytest.raises(ConfigError, match="clip=b: 2 of 3"):
        find_clip(benchmark, "b")
    with pytest.raises(ConfigError, match="follow_up=7: clip a has"):
        list(replay(benchmark, find_planner("pdm_closed"), "a", Rules(), follow_up=7))


def test_the_command_line_is_typed() -> None:
    assert settings_of(["benchmark=x"]) == ReplaySettings(benchmark="x", out="replay.mp4")
    assert [settings_of(["benchmark=x", f"clip={text}"]).clip for text in ("3", "ab12")] == [3, "ab12"]
    assert settings_of(["benchmark=x", "planner=my.module:Mine"]).planner == "my.module:Mine"
    with pytest.raises(ConfigError, match="clp"):
        settings_of(["benchmark=x", "clp=0"])
