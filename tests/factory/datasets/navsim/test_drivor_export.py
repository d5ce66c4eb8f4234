"""The export for DrivoR, as valeoai/TOAD @ 0110647 loads it: config groups, five rounds, 14 frames."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from factory.datasets.navsim.frames import BLACK, CannotExport, ExportSettings, sample_names
from factory.readers.pickles import load_plain
from tests.factory.datasets.navsim.navsim_samples import TOKENS, YAWS, exported, pictures, quiet
from tests.planners.samples import write_table

CONFIG = "devkit/navsim/planning/script/config/common"
DRIVOR = ExportSettings(consumer="drivor")
ALL = "synthetic_reaction_pdm_v1.0"


@pytest.fixture(scope="module")
def drivor(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Rounds 0 and 2 of a rig without a camera behind, with now's pictures alone; a human sample is left out."""
    root = tmp_path_factory.mktemp("drivor")
    seen = pictures([name for name in YAWS if name != "ring_rear_center"], times_s=(0.0,))
    rows = [exported(i, "pdm_closed", round_, **seen) for i, round_ in enumerate((0, 2))]
    write_table(root / "run", [*rows, exported(9, "human")])
    done = quiet(root / "run", root / "to", DRIVOR)
    assert done.logs == 2 and [note for note in done.notes if "fifth second" in note]
    assert quiet(root / "run", root / "to", DRIVOR).written == 0
    return root / "to"


def scenes(to: Path, group: str, name: str) -> Any:
    chosen = yaml.safe_load((to / CONFIG / group / f"{name}.yaml").read_text())
    assert chosen["defaults"] == [{"scene_filter": name}]
    return chosen["data_split"], yaml.safe_load((to / CONFIG / group / "scene_filter" / f"{name}.yaml").read_text())


def test_all_five_rounds_are_listed_and_what_is_empty_has_an_empty_cache(drivor: Path) -> None:
    """Training builds a loader of each folder, and the agent opens all five caches."""
    split, whole = scenes(drivor, "train_test_split_synthetic", ALL)
    assert split == ALL, "to which the training adds -k"
    assert whole["num_history_frames"] + whole["num_future_frames"] == 14 and len(whole["log_names"]) == 2
    for k in range(5):
        logs = sorted((drivor / "navsim_logs" / f"{ALL}-{k}").iterdir())
        mine = [name for name in whole["log_names"] if f"-00{k}" in name]
        assert [log.stem for log in logs] == mine and len(mine) == (k in (0, 2))
        for group, name in (("train_test_split_synthetic", ALL), ("train_test_split", "navtrain_reaction_pdm_v1.0")):
            split, of_round = scenes(drivor, group, f"{name}-{k}")
            assert split == f"{ALL}-{k}" and of_round["log_names"] == mine and of_round["num_future_frames"] == 10
        caches = list((drivor / "exp" / f"train_metric_{ALL}-{k}" / "metadata").glob("*.csv"))
        assert [path.read_text().splitlines()[1:] for path in caches] == ([] if mine else [[]])


def test_the_first_four_seconds_are_those_of_the_other_export_and_the_fifth_goes_straight_on(
    drivor: Path, tmp_path: Path
) -> None:
    row = exported(0, "pdm_closed")
    write_table(tmp_path / "run", [row])
    quiet(tmp_path / "run", tmp_path / "to")
    (short_log,), (log,) = ((root / f"navsim_logs/{ALL}-0").glob("*.pkl") for root in (tmp_path / "to", drivor))
    short, long = (load_plain(path.read_bytes(), str(path)) for path in (short_log, log))
    assert len(long) == 14 and [frame["frame_idx"] for frame in long] == list(range(14))
    for ours, theirs in zip(long, short):
        for key in ("token", "timestamp", "ego2global", "ego_dynamic_state", "can_bus", "anns", "traffic_lights"):
            np.testing.assert_equal(ours[key], theirs[key])
    assert len({frame["token"] for frame in long}) == 14 and long[11]["sample_next"] == long[12]["token"]
    last, *after = long[11:]
    assert len(last["anns"]["track_tokens"])
    for n, frame in enumerate(after, 1):
        moved = (np.linalg.inv(last["ego2global"]) @ frame["ego2global"])[:2, 3]
        np.testing.assert_allclose(moved, 0.5 * n * np.array(last["ego_dynamic_state"][:2]), atol=1e-6)
        assert frame["anns"]["track_tokens"] == last["anns"]["track_tokens"]
        xy, before = (
            f["anns"]["gt_boxes"][:, :2] @ f["ego2global"][:2, :2].T + f["ego2global"][:2, 3] for f in (frame, last)
        )
        velocities = last["anns"]["gt_velocity_3d"][:, :2] @ last["ego2global"][:2, :2].T
        np.testing.assert_allclose(xy, before + 0.5 * n * velocities, atol=1e-5)


def test_the_camera_behind_is_black_and_another_that_it_opens_must_be_there(drivor: Path, tmp_path: Path) -> None:
    blobs = drivor / "sensor_blobs" / f"{ALL}-0"
    (log,) = (drivor / f"navsim_logs/{ALL}-0").glob("*.pkl")
    cams = load_plain(log.read_bytes(), str(log))[3]["cams"]
    assert cams["CAM_B0"]["data_path"] == BLACK
    assert all((blobs / cams[name]["data_path"]).is_file() for name in ("CAM_F0", "CAM_L0", "CAM_R0", "CAM_B0"))
    write_table(
        tmp_path / "run",
        [exported(0, "pdm_closed", **pictures(("ring_front_center", "ring_front_left"), times_s=(0.0,)))],
    )
    with pytest.raises(CannotExport, match=r"no camera stands for CAM_R0, CAM_B0 .*CAM_B0 at now"):
        quiet(tmp_path / "run", tmp_path / "to", DRIVOR)


def test_no_log_is_taken_for_one_of_another_round() -> None:
    """Its training asks for -000 first, then -001, anywhere in the name."""
    row = {**exported(0, "pdm_closed", 3), "frame_tokens": ("0010abcdef012345", TOKENS[1])}
    assert "-001" in sample_names(row, replace(DRIVOR, consumer="simscale")).log
    names = sample_names(row, DRIVOR)
    assert next(k for k in range(5) if f"-00{k}" in names.log) == 3 and names.log.endswith("-f010abcdef012345-003")
    assert names.token == f"{TOKENS[1]}-003"


def test_what_drivor_does_not_read_is_refused(tmp_path: Path) -> None:
    for other in ({"tag": "ours"}, {"experts": ("recovery",)}):
        with pytest.raises(ValueError, match="for=drivor"):
            ExportSettings(consumer="drivor", **other)
    write_table(tmp_path / "run", [exported(0, "pdm_closed", 5)])
    with pytest.raises(CannotExport, match="of round 5, and DrivoR reads 0 to 4"):
        quiet(tmp_path / "run", tmp_path / "to", DRIVOR)
