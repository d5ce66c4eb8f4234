"""The submission's file: what the public script puts there, read by names alone, and every plan the agent's own."""

import pickletools
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from factory.datasets.navsim.reader import read_selection
from factory.exits import BAD_CONFIG, COMPLETE
from factory.readers.pickles import Record, load_records
from planners.__main__ import main as planners
from planners.navsim.agent import agent_input_arrays
from planners.navsim.serve import FRONT, AgentPlanner, observation_of
from planners.navsim.submit import scenes_of_split, submission_bytes
from tests.factory.datasets.navsim import scene_pickles
from tests.factory.datasets.navsim.openscene_writer import write_frames
from tests.planners.navsim import agent_inputs
from tests.planners.navsim.agent_inputs import AgentInput, Camera, Cameras, EgoStatus
from tests.planners.navsim.trained import made, saved
from tests.planners.navsim.two_stage_files import (
    SIZE,
    STAGE_ONE,
    STAGE_TWO,
    TOKENS,
    log_frames,
    write_filter,
    write_split,
)

TRAJECTORY = "navsim.common.dataclasses Trajectory"
SAMPLING = "nuplan.planning.simulation.trajectory.trajectory_sampling TrajectorySampling"
TEAM = {"team_name": "<a href=x>Ours</a>", "authors": "A, B", "email": "a@b.org", "institution": "Ours, München"}
TEAM |= {"country / region": "DE"}
TEAM_WORDS = [f"{key.split()[0]}={value}" for key, value in TEAM.items()]
Stages = tuple[dict[str, Any], dict[str, Any]]


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    write_split(tmp_path, log_frames())
    return tmp_path


def submit(root: Path, planner: str, *other: str) -> int:
    words = [f"planner={planner}", f"split={root / 'split.yaml'}", f"logs={root / 'navsim_logs/test'}"]
    words += [f"root={root / 'navhard_two_stage'}", f"out={root / 'submission.pkl'}"]
    return planners(["submit", *words, *TEAM_WORDS, *other])


def stages_of(path: Path) -> Stages:
    """Token -> poses of both stages, by the keys and classes of the public script and nothing else."""
    content = load_records(path.read_bytes(), str(path), (TRAJECTORY, SAMPLING))
    assert list(content) == [*TEAM, "first_stage_predictions", "second_stage_predictions"]
    assert {key: content[key] for key in TEAM} == TEAM
    assert all(isinstance(content[f"{which}_stage_predictions"], list) for which in ("first", "second"))
    ((first,), (second,)) = content["first_stage_predictions"], content["second_stage_predictions"]
    return {token: poses_of(one) for token, one in first.items()}, {t: poses_of(one) for t, one in second.items()}


def poses_of(record: Any) -> np.ndarray:
    """A Trajectory's, whose fields are those of the public dataclass."""
    assert isinstance(record, Record) and (record.module, record.name) == tuple(TRAJECTORY.split(" "))
    assert list(record.state) == ["poses", "trajectory_sampling"] and record.arguments == ()
    sampling, poses = record.state["trajectory_sampling"], record.state["poses"]
    assert (sampling.module, sampling.name) == tuple(SAMPLING.split(" ")) and sampling.arguments == ()
    assert {name: type(value) for name, value in sampling.state.items()} == {
        "num_poses": int,
        "time_horizon": float,
        "interval_length": float,
    }
    assert sampling.state["num_poses"] == len(poses) and sampling.state["time_horizon"] == 4.0
    assert sampling.state["num_poses"] * sampling.state["interval_length"] == pytest.approx(4.0)
    assert poses.dtype == np.float32 and poses.shape == (8, 3)
    return np.asarray(poses)


def test_the_file_names_the_public_classes_and_numpy_s_old_places_alone() -> None:
    """So that NAVSIM's Python 3.9 and numpy 1.23 open it, where nothing of ours is."""
    data = submission_bytes(TEAM, {"a": np.zeros((8, 3), np.float32)}, {"b": np.ones((8, 3), np.float32)})
    named = {str(argument) for opcode, argument, _ in pickletools.genops(data) if opcode.name == "GLOBAL"}
    assert named == {TRAJECTORY, SAMPLING, "numpy.core.multiarray _reconstruct", "numpy ndarray", "numpy dtype"}
    assert all(opcode.proto <= 4 for opcode, _, _ in pickletools.genops(data))
    assert not [opcode for opcode, _, _ in pickletools.genops(data) if opcode.name == "STACK_GLOBAL"]


def test_plans_of_two_lengths_or_none_are_no_submission() -> None:
    plan = np.zeros((8, 3), np.float32)
    with pytest.raises(ValueError, match=r"plans of \[8, 40\] poses"):
        submission_bytes(TEAM, {"a": plan}, {"b": np.zeros((40, 3), np.float32)})
    with pytest.raises(ValueError, match=r"plans of \[\] poses"):
        submission_bytes(TEAM, {}, {})


def test_constant_velocity_is_the_public_agent_s_closed_form_in_both_stages(files: Path) -> None:
    assert submit(files, "constant_velocity") == COMPLETE
    first, second = stages_of(files / "submission.pkl")
    frames = log_frames()
    assert {*first} == {frames[k]["token"] for k in STAGE_ONE} and {*second} == set(TOKENS)
    for token, k in (*((frames[k]["token"], k) for k in STAGE_ONE), *zip(TOKENS, STAGE_TWO)):
        speed = np.hypot(*np.float32(frames[k]["ego_dynamic_state"][:2]))
        steady = np.column_stack([0.5 * speed * np.arange(1, 9), np.zeros((8, 2))])
        np.testing.assert_allclose((first | second)[token], steady, rtol=2e-7)


def test_what_is_seen_of_a_scene_is_what_the_agent_is_shown(files: Path) -> None:
    folders = files / "navsim_logs/test", files / "sensor_blobs/test", files / "navhard_two_stage"
    scenes = scenes_of_split(read_selection(str(files / "split.yaml")), *folders)
    found = {scene.token: scene for scene in (*scenes.first_stage(), *filter(None, scenes.second_stage()))}
    frames = log_frames()
    for token, k in (*((frames[k]["token"], k) for k in STAGE_ONE), *zip(TOKENS, STAGE_TWO)):
        seen, wanted = (
            found[token].observation(FRONT),
            observation_of(agent_input_arrays(agent_input(frames, k), FRONT), FRONT),
        )
        np.testing.assert_allclose(seen.history, wanted.history, atol=2e-7)
        np.testing.assert_array_equal(seen.status, wanted.status)
        for view, other in zip(seen.views, wanted.views, strict=True):
            assert view.camera.name == other.camera.name
            np.testing.assert_array_equal(view.image, other.image)
            np.testing.assert_array_equal(view.camera.ego_from_camera, other.camera.ego_from_camera)
            np.testing.assert_array_equal(view.camera.intrinsics, other.camera.intrinsics)
            np.testing.assert_array_equal(view.camera.distortion, other.camera.distortion)


@pytest.mark.slow
def test_a_trained_planner_s_plans_are_those_it_makes_as_an_agent(files: Path) -> None:
    folder = saved(made("ltf_small"), files / "training")
    assert submit(files, folder, f"sensors={files / 'sensor_blobs/test'}") == COMPLETE
    first, second = stages_of(files / "submission.pkl")
    frames, pilot = log_frames(), AgentPlanner(folder)
    for token, k in (*((frames[k]["token"], k) for k in STAGE_ONE), *zip(TOKENS, STAGE_TWO)):
        given = observation_of(agent_input_arrays(agent_input(frames, k), FRONT), FRONT)
        np.testing.assert_allclose((first | second)[token], pilot.plan(given, 8), atol=2e-6, err_msg=token)
    plans = [*first.values(), *second.values()]
    assert all(np.abs(one - other).max() > 1e-3 for i, one in enumerate(plans) for other in plans[:i])


def agent_input(frames: list[dict[str, Any]], k: int) -> AgentInput:
    """What the public loader shows of frame k, by pyquaternion's heading and complex numbers."""
    w, x, y, z = np.array([one["ego2global_rotation"] for one in frames[k - 3 : k + 1]]).T
    heading = np.arctan2(2.0 * (w * z - x * y), 1.0 - 2.0 * (y**2 + z**2))
    at = np.array([complex(*one["ego2global_translation"][:2]) for one in frames[k - 3 : k + 1]])
    local = (at - at[-1]) * np.exp(-1j * heading[-1])
    poses = np.column_stack([local.real, local.imag, heading - heading[-1]]).astype(np.float32)
    motion, command = np.float32(frames[k]["ego_dynamic_state"]), frames[k]["driving_command"]
    egos = [EgoStatus(pose, motion[:2], motion[2:], command) for pose in poses]
    shot = {}
    for name in FRONT:
        entry = frames[k]["cams"][name.upper()]
        keys = ("sensor2lidar_rotation", "sensor2lidar_translation", "cam_intrinsic", "distortion")
        pixels = np.array(Image.open(BytesIO(agent_inputs.photo(name, *SIZE))))
        shot[name] = Camera(pixels, *(entry[key] for key in keys))
    return AgentInput(egos, [Cameras(), Cameras(), Cameras(), Cameras(**shot)])


def test_a_split_of_one_stage_has_an_empty_second(files: Path) -> None:
    frames = log_frames()
    write_filter(files, [frames[4]["token"]], include_synthetic_scenes=False, reactive_synthetic_initial_tokens=None)
    assert submit(files, "constant_velocity") == COMPLETE
    first, second = stages_of(files / "submission.pkl")
    assert list(first) == [frames[4]["token"]] and second == {}


def test_what_the_public_loader_leaves_out_is_left_out_and_told(
    files: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A frame without a route, one too near the log's end, a synthetic scene of no scene here and of no log named."""
    frames = log_frames()
    frames[7]["roadblock_ids"] = []
    write_frames(files, "test", frames[0]["log_name"], frames)
    scenes = files / "navhard_two_stage/synthetic_scene_pickles"
    strange = scene_pickles.scene_of_log(frames, 10, TOKENS[1], cameras=True)  # of frame 2, which is not in the filter
    scene_pickles.write_scene(scenes, strange)
    write_filter(files, [frames[k]["token"] for k in (4, 3, 7, 15)])
    assert submit(files, "constant_velocity") == COMPLETE
    first, second = stages_of(files / "submission.pkl")
    assert {*first} == {frames[4]["token"], frames[3]["token"]} and {*second} == {TOKENS[0]}
    assert "2 + 1 plans" in (told := capsys.readouterr().out) and "3 tokens of the split are no scenes" in told
    write_filter(files, [frames[4]["token"]], log_names=[frames[0]["log_name"]])
    elsewhere = scene_pickles.scene_of_log(frames, 12, TOKENS[0], cameras=True)
    elsewhere["scene_metadata"]["log_name"] = "another"
    scene_pickles.write_scene(scenes, elsewhere)
    assert submit(files, "constant_velocity") == COMPLETE
    assert stages_of(files / "submission.pkl")[1] == {}


def test_a_scene_of_which_nothing_but_what_is_shown_is_there_is_planned(files: Path) -> None:
    """As in splits whose future and annotations are kept back."""
    frames = log_frames()
    hidden = scene_pickles.scene_of_log(frames, 12, TOKENS[0])
    hidden["extended_detections_tracks"] = hidden["extended_traffic_light_data"] = None
    for one in hidden["frames"]:
        one["annotations"] = None
    scene_pickles.write_scene(files / "navhard_two_stage/synthetic_scene_pickles", hidden)
    for one in frames:
        del one["anns"]
    write_frames(files, "test", frames[0]["log_name"], frames)
    assert submit(files, "constant_velocity") == COMPLETE
    assert len(stages_of(files / "submission.pkl")[1]) == 2


def lost_token(root: Path) -> None:
    write_filter(root, [log_frames()[4]["token"], "f" * 16])


def lost_log(root: Path) -> None:
    write_filter(root, [log_frames()[4]["token"]], log_names=[log_frames()[0]["log_name"], "gone"])


def lost_scene(root: Path) -> None:
    (root / f"navhard_two_stage/synthetic_scene_pickles/{TOKENS[1]}.pkl").unlink()


def cut_scene(root: Path) -> None:
    path = root / f"navhard_two_stage/synthetic_scene_pickles/{TOKENS[1]}.pkl"
    path.write_bytes(path.read_bytes()[:900])


def renamed_scene(root: Path) -> None:
    folder = root / "navhard_two_stage/synthetic_scene_pickles"
    (folder / f"{TOKENS[0]}.pkl").replace(folder / f"{TOKENS[1]}.pkl")
    (folder / f"{TOKENS[0]}.pkl").write_bytes((folder / f"{TOKENS[1]}.pkl").read_bytes())


def lost_sensors(root: Path) -> None:
    (root / "sensor_blobs").rename(root / "elsewhere")


@pytest.mark.parametrize(
    ("spoil", "words", "told"),
    [
        (lost_token, (), f"1 of the split's 2 tokens are in no log here: {'f' * 16}"),
        (lost_log, (), "1 of the split's 2 logs are not here, such as gone"),
        (lost_scene, (), f"{TOKENS[1]}.pkl: no such file; 1 of the 2 scenes"),
        (cut_scene, (), f"{TOKENS[1]}.pkl: pickle: truncated"),
        (renamed_scene, (), f"{TOKENS[1]}.pkl: scene_metadata.initial_token: is {TOKENS[0]}"),
        (lost_sensors, ("sensors={root}/sensor_blobs/test",), "sensor_blobs/test: no such folder"),
    ],
)
def test_what_is_missing_or_broken_is_named_and_nothing_is_written(
    files: Path, spoil: Any, words: tuple[str, ...], told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    spoil(files)
    assert submit(files, "constant_velocity", *(word.format(root=files) for word in words)) == BAD_CONFIG
    assert told in capsys.readouterr().err and not (files / "submission.pkl").exists()


@pytest.mark.slow
def test_pictures_that_a_planner_lacks_are_named(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = saved(made("ltf_small"), files / "training")
    assert submit(files, folder) == BAD_CONFIG
    assert "sensors=... is missing" in capsys.readouterr().err
    here = [f"sensors={files / 'sensor_blobs/test'}"]
    picture = files / "sensor_blobs/test" / log_frames()[7]["cams"]["CAM_R0"]["data_path"]
    whole = picture.read_bytes()
    picture.unlink()
    assert submit(files, folder, *here) == BAD_CONFIG
    assert f"{picture}: image: missing" in capsys.readouterr().err
    picture.write_bytes(b"")
    assert submit(files, folder, *here) == BAD_CONFIG
    assert f"{picture}: image: the file is empty" in capsys.readouterr().err
    picture.write_bytes(whole)
    scene = scene_pickles.scene_of_log(log_frames(), 12, TOKENS[0])
    scene_pickles.write_scene(files / "navhard_two_stage/synthetic_scene_pickles", scene)
    assert submit(files, folder, *here) == BAD_CONFIG
    assert f"token {TOKENS[0]}: the frame names no picture of cam_l0, cam_f0, cam_r0" in capsys.readouterr().err
    assert not (files / "submission.pkl").exists()


def test_who_knows_the_world_submits_nothing(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert submit(files, "human") == BAD_CONFIG
    assert "plans from the log itself" in capsys.readouterr().err
