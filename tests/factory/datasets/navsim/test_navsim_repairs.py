"""Faults of one box or one frame of a NAVSIM log: put right or left out, told, and all clips are kept."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tasks.world.clip import STEP_S
from tasks.world.repair.records import LEFT_OUT
from tests.factory.datasets.navsim.small import reader_of, road_frames, write_city, write_log

FRAMES, AT = 24, 8  # of the log; the frame that is spoiled
AT_S = 0.5 * AT


def value(key: str, place: Any, changed: object) -> Callable[[list[dict[str, Any]]], None]:
    """One value of frame AT's boxes; the first of its two is the car."""

    def change(frames: list[dict[str, Any]]) -> None:
        column = frames[AT]["anns"][key]
        frames[AT]["anns"][key] = column = np.array(column) if isinstance(column, np.ndarray) else list(column)
        column[place] = changed

    return change


def again(name: str, ahead_m: float) -> Callable[[list[dict[str, Any]]], None]:
    """The car a second time in all frames, or what is at another place of the ego's lane."""

    def change(frames: list[dict[str, Any]]) -> None:
        for frame in frames:
            anns = frame["anns"]
            box = anns["gt_boxes"][0] + np.array([ahead_m, 0, 0, 0, 0, 0, 0])
            frame["anns"] = {
                "gt_boxes": np.vstack([anns["gt_boxes"], box]),
                "gt_names": np.append(anns["gt_names"], "vehicle"),
                "gt_velocity_3d": np.vstack([anns["gt_velocity_3d"], anns["gt_velocity_3d"][0]]),
                "instance_tokens": [*anns["instance_tokens"], name],
                "track_tokens": [*anns["track_tokens"], name],
            }

    return change


# what is wrong -> what is changed, and (pass, time [s], whether it is left out) of what is told
REPAIRED = {
    "velocity NaN": (value("gt_velocity_3d", (0, 1), np.nan), [("impossible", AT_S, True)]),
    "box NaN": (value("gt_boxes", (0, 6), np.nan), [("impossible", AT_S, True)]),
    "no length": (value("gt_boxes", (0, 3), 0.0), [("impossible", AT_S, True)]),
    "box elsewhere": (value("gt_boxes", (0, 1), 90.0), [("jump", AT_S, True)]),
    "no token": (value("track_tokens", 0, ""), [("token", AT_S, True)]),
    "token is None": (value("track_tokens", 0, None), [("token", AT_S, True)]),
    "one token twice": (value("track_tokens", 1, "twice"), None),
    "unknown class": (value("gt_names", 0, "dragon"), [("class", AT_S, True)]),
    "turned round": (value("gt_boxes", (0, 6), np.pi), [("heading", AT_S, False)]),
    "listed twice": (again("~double", 0.1), [("twice", 0.0, True)]),
    "the ego among them": (again("~me", -18.6), [("ego", 0.0, True)]),
}


@pytest.mark.parametrize("fault", REPAIRED)
def test_a_fault_of_one_box_is_put_right_or_left_out_and_told_and_nothing_else_changes(
    tmp_path: Path, fault: str
) -> None:
    """Everything drives straight at one speed here: between two frames it is where it was."""
    change, told = REPAIRED[fault]
    spoiled, sound = road_frames(n=FRAMES), road_frames(n=FRAMES)
    change(spoiled)
    if told is None:
        spoiled[AT]["anns"]["track_tokens"][1] = spoiled[AT]["anns"]["track_tokens"][0]
        told = [("twice", AT_S, False)]
    readers = []
    for name, frames in (("spoiled", spoiled), ("sound", sound)):
        write_city(tmp_path / name)
        write_log(tmp_path / name, frames)
        readers.append(reader_of(tmp_path / name, sensors=None))
    found, whole = readers
    index = found.index()
    assert index.refs and index.refs == whole.index().refs and not index.broken and not index.dropped
    for ref in index.refs:
        clip, expected = found.read(ref), whole.read(ref)
        start_s = ref.start_ms / 1000
        here = [(r.what, round(r.time_s, 9), r.now == LEFT_OUT) for r in clip.repairs]
        assert here == [(what, max(t, start_s), left) for what, t, left in told]
        assert clip.agents.track_ids == expected.agents.track_ids and clip.agents.kinds == expected.agents.kinds
        assert np.array_equal(clip.agents.valid, expected.agents.valid)
        np.testing.assert_allclose(clip.agents.boxes, expected.agents.boxes, atol=1e-6)
        np.testing.assert_allclose(clip.agents.velocities, expected.agents.velocities, atol=1e-9)
        np.testing.assert_allclose(clip.agents.center_z, expected.agents.center_z, atol=1e-6)
        assert np.array_equal(clip.ego_states, expected.ego_states)
        assert len(clip.agents.boxes) * STEP_S == pytest.approx(9.6)


@pytest.mark.parametrize("at", [1, 2, 4, 8, 18, 20, 23])
def test_an_identity_that_jumps_is_two_things_also_at_the_edge_of_a_window(tmp_path: Path, at: int) -> None:
    """8 m at 2 Hz: a car may drive so fast, and only its other frames say that this one does not."""
    frames = road_frames(n=28)
    for frame in frames[4 + at :]:
        frame["anns"]["gt_boxes"] = frame["anns"]["gt_boxes"] + np.array([0.0, 8.0, 0, 0, 0, 0, 0])
    write_city(tmp_path)
    write_log(tmp_path, frames)
    reader = reader_of(tmp_path, sensors=None)
    ref = next(ref for ref in reader.index().refs if ref.start_ms == 2000)
    clip = reader.read(ref)
    told = {r.thing: r.now for r in clip.repairs if r.what == "jump"}
    assert len(told) == (2 if at < 20 else 0)
    for name, seen in zip(clip.agents.track_ids, clip.agents.valid.T):
        assert seen[: 5 * at].any() != (name in told.values())
    sideways = np.abs(np.diff(clip.agents.boxes[..., 1], axis=0))
    assert np.nanmax(sideways) < 1e-6, "nothing jumps, nor slides from the one place to the other"


@pytest.mark.parametrize(
    "spoil",
    [
        lambda frame: frame.update(ego2global_translation=np.array([np.nan, 0.0, 0.0])),
        lambda frame: frame.update(ego2global_rotation=np.zeros(4)),
        lambda frame: frame.update(ego2global_translation=frame["ego2global_translation"] + np.array([0.0, 60.0, 0.0])),
        lambda frame: frame.update(timestamp=0),
        lambda frame: frame.update(timestamp=2 * frame["timestamp"]),
        lambda frame: frame.pop("anns") and frame["cams"].clear(),
        lambda frame: frame.pop("token"),
    ],
)
def test_a_frame_that_cannot_be_read_costs_the_windows_it_is_in(
    tmp_path: Path, spoil: Callable[[dict[str, Any]], object], caplog: pytest.LogCaptureFixture
) -> None:
    frames = road_frames(n=60)
    write_city(tmp_path)
    log = write_log(tmp_path, frames)
    sound = reader_of(tmp_path, sensors=None).index()
    spoil(frames[25])
    assert write_log(tmp_path, frames) == log
    reader = reader_of(tmp_path, sensors=None, cache_dir=tmp_path / "again")
    index = reader.index()
    assert not index.broken
    lost = [ref for ref in sound.refs if ref not in index.refs]
    assert set(index.refs) < set(sound.refs) and index.dropped == {"unreadable_frame": len(lost)} and lost
    assert f"(1 such frames, which cost {len(lost)} windows)" in caplog.text and f"{log}: " in caplog.text
    reader.read(index.refs[0])
    assert [ref for ref in sound.refs if not ref.start_ms <= 12_500 <= ref.start_ms + 9_500] == list(index.refs)


def test_a_frame_that_stands_twice_is_read_once_and_costs_no_window(tmp_path: Path) -> None:
    frames = road_frames(n=60)
    write_city(tmp_path)
    log = write_log(tmp_path, frames)
    sound = reader_of(tmp_path, sensors=None)
    before = sound.index().refs
    clips = {ref: sound.read(ref) for ref in (before[0], before[-1])}
    assert write_log(tmp_path, [*frames[:25], frames[25], *frames[25:]]) == log
    reader = reader_of(tmp_path, sensors=None, cache_dir=tmp_path / "again")
    index = reader.index()
    assert index.refs == before and not index.broken and not index.dropped
    for ref, whole in clips.items():
        clip = reader.read(ref)
        np.testing.assert_array_equal(clip.ego_states, whole.ego_states)
        np.testing.assert_array_equal(clip.agents.boxes, whole.agents.boxes)


def test_a_log_of_which_most_frames_cannot_be_read_is_refused_by_the_first(tmp_path: Path) -> None:
    frames = road_frames(n=FRAMES)
    for frame in frames[6:]:
        frame["ego2global_rotation"] = np.zeros(4)
    write_city(tmp_path)
    write_log(tmp_path, frames)
    (problem,) = reader_of(tmp_path, sensors=None).index().broken.values()
    assert "frames[6].ego2global_rotation: a quaternion w, x, y, z of length 0" in problem
