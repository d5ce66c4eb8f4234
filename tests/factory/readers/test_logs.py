"""The base of log readers, through the smallest reader that there is: a street, its logs a few numbers each."""

import pickle
from pathlib import Path

import numpy as np
import pytest

from factory.readers.base import BadClip, ClipRef
from factory.readers.logs import LoggedDrive, LogReader, WholeLog, WindowSensors, route_of_drive
from tasks.world.clip import CLIP_STEPS, STEP_S, AgentTracks
from tasks.world.frames import EGO_STATE_SIZE, VX, X
from tasks.world.road_map import TrafficLights
from tests.tasks.streets import street_clip

SPEED_MPS = 8.0
NOBODY = AgentTracks(
    track_ids=(),
    kinds=(),
    boxes=np.zeros((200, 0, 5)),
    velocities=np.zeros((200, 0, 2)),
    valid=np.zeros((200, 0), bool),
    center_z=np.zeros((200, 0)),
    heights=np.zeros(0),
)


class StreetReader(LogReader[WholeLog]):
    """Each log is a text file: its number of steps, the first that is driven, the one at which the drive breaks."""

    data_set = "street"

    def logs(self) -> dict[str, Path]:
        return {path.stem: path for path in sorted(self.root.glob("*.txt"))}

    def drive(self, path: Path) -> LoggedDrive | str:
        text = path.read_text()
        if text == "unlabelled":
            return "nobody labelled it"
        try:
            n_steps, first, gap = (int(word) for word in text.split())
        except ValueError as error:
            raise BadClip(str(path), "steps", "expected three numbers") from error
        states = np.zeros((n_steps, EGO_STATE_SIZE))
        states[:, X], states[:, VX] = SPEED_MPS * STEP_S * np.arange(n_steps), SPEED_MPS
        states[:first] = np.nan
        segment = np.where(np.arange(n_steps) < gap, 0, 1)
        segment[:first] = -1
        return LoggedDrive(states, NOBODY.window(0, n_steps), segment)

    def load(self, path: Path) -> WholeLog:
        drive, street = self.drive(path), street_clip()
        assert isinstance(drive, LoggedDrive)
        driven = drive.ego_states[drive.segment >= 0, :3]
        return WholeLog(
            file=str(path),
            ego_states=drive.ego_states,
            agents=drive.agents,
            road_map=street.road_map,
            route=route_of_drive(street.road_map, driven, str(path), "map"),
            lights=TrafficLights(),
            licence="none",
            content_digest="0",
        )

    def recorded(self, log: WholeLog, start: int, stop: int) -> WindowSensors:
        poses = np.tile(np.eye(4), (stop - start, 1, 1))
        poses[:, 0, 3] = log.ego_states[start:stop, X]
        return WindowSensors(poses)


@pytest.fixture
def reader(tmp_path: Path) -> StreetReader:
    for name, text in {
        "a_whole": "116 0 116",
        "b_late": "130 14 130",
        "c_gap": "116 0 100",
        "d_short": "95 0 95",
        "e_unlabelled": "unlabelled",
        "f_broken": "much",
        "g_undriven": "100 100 0",
    }.items():
        (tmp_path / f"{name}.txt").write_text(text)
    return StreetReader(tmp_path)


def test_every_log_is_windows_or_has_its_reason(reader: StreetReader) -> None:
    index = reader.index()
    assert [(ref.log_id, ref.start_ms) for ref in index.refs] == [
        *(("a_whole", ms) for ms in (0, 1000, 2000)),
        *(("b_late", ms) for ms in (1400, 2400, 3400)),  # counted from where the drive begins
        ("c_gap", 0),
    ]
    assert index.dropped == {"broken_tracks": 2}
    assert index.skipped_logs == {
        "d_short": "9.5 s long, a clip needs 9.6 s",
        "e_unlabelled": "nobody labelled it",
        "g_undriven": "0.0 s long, a clip needs 9.6 s",
    }
    ((ref, message),) = index.broken.items()
    assert (ref.log_id, ref.start_ms) == ("f_broken", 0) and "f_broken.txt: steps: expected three numbers" in message


def test_a_clip_is_the_log_s_steps_from_its_start_on(reader: StreetReader) -> None:
    clip = reader.read(ClipRef("street", "a_whole", 1000))
    expected = SPEED_MPS * (1.0 + STEP_S * np.arange(CLIP_STEPS))
    assert np.abs(clip.ego_states[:, X] - expected).max() < 1e-9
    assert np.abs(clip.world_from_ego[:, 0, 3] - expected).max() < 1e-9
    assert (clip.start_s, clip.dataset, clip.clip_id) == (1.0, "street", ClipRef("street", "a_whole", 1000).clip_id)
    assert StreetReader(reader.root, name="").name == "" and StreetReader(reader.root, name="mine").name == "mine"


class CountingReader(StreetReader):
    listed = 0

    def logs(self) -> dict[str, Path]:
        self.listed += 1
        return super().logs()


def test_logs_are_listed_once_a_process_however_many_clips_are_read(reader: StreetReader) -> None:
    counting = CountingReader(reader.root)
    refs = counting.index().refs
    elsewhere = pickle.loads(pickle.dumps(counting))
    for ref in refs:
        assert counting.read(ref).clip_id == elsewhere.read(ref).clip_id == ref.clip_id
    assert (counting.listed, elsewhere.listed) == (1, 2)  # the copy knows that it was


def test_what_a_caller_does_to_a_clip_does_not_reach_the_next(reader: StreetReader) -> None:
    ref = ClipRef("street", "a_whole", 0)
    reader.read(ref).ego_states[:] = 0.0
    assert reader.read(ref).ego_states[-1, VX] == SPEED_MPS


@pytest.mark.parametrize(
    "log_id, start_ms, problem",
    [("a_whole", 2100, "start_ms"), ("a_whole", 50, "start_ms"), ("a_whole", -100, "start_ms"), ("h", 0, "no log h")],
)
def test_a_window_that_is_not_there_is_refused(reader: StreetReader, log_id: str, start_ms: int, problem: str) -> None:
    with pytest.raises(BadClip, match=problem):
        reader.read(ClipRef("street", log_id, start_ms))


def test_logs_can_be_chosen_and_put_into_a_split(tmp_path: Path) -> None:
    for name in ("a", "b", "c"):
        (tmp_path / f"{name}.txt").write_text("150 0 999")
    some = StreetReader(tmp_path, only=["c", "a"], split="val")
    refs = some.index().refs
    assert {ref.log_id for ref in refs} == {"a", "c"}
    assert {some.read(ref).split for ref in refs} == {"val"}
    assert refs == tuple(ref for ref in StreetReader(tmp_path).index().refs if ref.log_id != "b")
    with pytest.raises(ValueError, match=r"no log d under .*; there are a, b, c"):
        StreetReader(tmp_path, only=["d"]).index()
    with pytest.raises(ValueError, match=r"clips\.split=dev"):
        StreetReader(tmp_path, split="dev")
