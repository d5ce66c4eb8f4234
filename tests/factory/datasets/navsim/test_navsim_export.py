"""The whole export: what SimScale's recipe asks for, how it goes on, and what it refuses."""

import json
import pickle
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from factory.commands.table import COMMANDS
from factory.datasets.navsim.export import ExportSummary
from factory.datasets.navsim.frames import CAMERAS, CannotExport, ExportSettings, match_cameras
from factory.datasets.navsim.pickles import METRICS
from factory.store.reader import labels_of
from tasks.render.views import pinhole
from tests.factory.datasets.navsim.navsim_samples import SIZE, TOKENS, K, exported, pictures, quiet, tree
from tests.planners.samples import write_table

CONFIG = "devkit/navsim/planning/script/config"
SPLITS = ("pdm_v1.0-0", "pdm_v1.0-1", "recovery_v1.0-0")
SOURCE = "2021.05.12_veh-35_00005_00204"
main = COMMANDS["export"].load()


def read(path: Path) -> Any:
    return yaml.safe_load(path.read_text())


def test_the_recipe_of_the_public_training_holds(openscene: tuple[Path, ExportSummary]) -> None:
    """Stem and log_name agree, have a round and two dashes before it; the token has a dash and not 17 characters."""
    to, summary = openscene
    logs = sorted((to / "navsim_logs").rglob("*.pkl"))
    assert len(logs) == summary.logs == summary.written == 4
    for log in logs:
        frames = pickle.loads(log.read_bytes())
        now = frames[3]
        assert len(frames) == 12 and {frame["log_name"] for frame in frames} == {log.stem}
        assert now["lidar_path"] == "" and now["roadblock_ids"] and now["map_location"] == "us-nv-las-vegas-strip"
        assert "-".join(log.stem.split("-")[:2]) == SOURCE, "WorldEngine's rule"
        if log.parent.name == "navtrain_human":
            assert re.fullmatch(r"[0-9a-f]{16}", now["token"])
        else:
            k = log.parent.name[-1]
            assert re.fullmatch(rf"[0-9a-f]{{16}}-00{k}", now["token"]) and log.stem.endswith(f"-00{k}")
        blobs = to / "sensor_blobs" / log.parent.name
        for frame in frames[:4]:
            assert all((blobs / frame["cams"][name]["data_path"]).is_file() for name in CAMERAS)


@pytest.mark.parametrize("split", SPLITS)
def test_filters_and_splits_name_the_logs_that_are_there(openscene: tuple[Path, ExportSummary], split: str) -> None:
    to, _ = openscene
    name = f"navtrain_reaction_{split}"
    chosen = read(to / CONFIG / "common/train_test_split" / f"{name}.yaml")
    assert chosen == {"data_split": f"synthetic_reaction_{split}", "defaults": [{"scene_filter": name}]}
    logs = sorted(path.stem for path in (to / "navsim_logs" / chosen["data_split"]).iterdir())
    scenes = read(to / CONFIG / "common/train_test_split/scene_filter" / f"{name}.yaml")
    assert scenes["_target_"] == "navsim.common.dataclasses.SceneFilter" and scenes["log_names"] == logs
    assert (scenes["num_history_frames"], scenes["num_future_frames"], scenes["frame_interval"]) == (4, 8, 1)
    assert scenes["tokens"] == [f"{TOKENS[1]}-00{split[-1]}"]
    of_training = read(to / CONFIG / "training" / f"default_log_split_synthetic_reation_{split}.yaml")
    assert sorted(of_training) == ["test_logs", "train_logs", "val_logs"]
    where = "val_logs" if split == "pdm_v1.0-1" else "train_logs"
    assert {key: logs if key == where else [] for key in of_training} == of_training


def test_rewards_are_the_labels_under_the_public_names_and_add_up_over_rounds(
    openscene: tuple[Path, ExportSummary], street_run: Path
) -> None:
    to, _ = openscene
    files = {path.name: pickle.loads(path.read_bytes()) for path in (to / "traj_pdm_v2").rglob("*.pkl")}
    first, second = files["simcale_16384_pdm_v1.0-0.pkl"], files["simcale_16384_pdm_v1.0-1.pkl"]
    assert list(first) == [f"{TOKENS[1]}-000"] and list(second) == [f"{TOKENS[1]}-000", f"{TOKENS[1]}-001"]
    np.testing.assert_equal(first[f"{TOKENS[1]}-000"], second[f"{TOKENS[1]}-000"])
    assert list(files["simcale_16384_recovery_v1.0-0.pkl"]) == [f"{TOKENS[1]}-000"], "of another expert, none before"
    found = files["navtrain_human_16384.pkl"][TOKENS[0]]
    labels = labels_of(exported(0, "human"))
    assert list(found) == list(METRICS)
    assert all(values.dtype == np.float16 and values.shape == (K,) for values in found.values())
    np.testing.assert_array_equal(found["no_at_fault_collisions"], labels.nc)
    np.testing.assert_array_equal(found["driving_direction_compliance"], labels.ddc)
    np.testing.assert_array_equal(found["traffic_light_compliance"], labels.tlc)
    np.testing.assert_allclose(found["ego_progress"], labels.ep("masked"), atol=1e-3)
    np.testing.assert_allclose(found["pdm_score"], labels.pdm_score("masked"), atol=1e-3)


def test_the_manifest_names_every_other_file_with_its_checksum(openscene: tuple[Path, ExportSummary]) -> None:
    to, summary = openscene
    header, *lines = map(json.loads, (to / "manifest.jsonl").read_text().splitlines())
    files = [file for line in lines for file in (line["log"]["files"] if "log" in line else [line["file"]])]
    there = tree(to)
    there.pop("manifest.jsonl")
    assert {file["path"]: file["sha256"] for file in files} == there
    assert sum(file["bytes"] for file in files) == summary.n_bytes == sum((to / path).stat().st_size for path in there)
    assert header["logs"] == {"navtrain_human": 1} | {f"synthetic_reaction_{split}": 1 for split in SPLITS}
    assert header["picture_sizes"] == ["32x18"] and header["distorted_logs"] == 0


def test_what_is_there_is_not_written_again(openscene: tuple[Path, ExportSummary], street_run: Path) -> None:
    to, before = openscene
    stamps = {path: path.stat().st_mtime_ns for path in to.rglob("*")}
    again = quiet(street_run, to)
    assert (again.written, again.logs, again.n_bytes, again.notes) == (0, 4, before.n_bytes, before.notes)
    assert {path: path.stat().st_mtime_ns for path in to.rglob("*")} == stamps


def test_a_run_that_has_grown_adds_its_logs_alone(
    openscene: tuple[Path, ExportSummary], street_run: Path, tmp_path: Path
) -> None:
    """And rows that are no more take their logs with them."""
    small, to = tmp_path / "run", tmp_path / "to"
    write_table(small, [exported(0, "human"), exported(1, "pdm_closed", 0), exported(9, "recovery", 5)], group_rows=1)
    assert quiet(small, to).written == 3
    kept = to / f"navsim_logs/navtrain_human/{SOURCE}-{TOKENS[0]}.pkl"
    stamp = kept.stat().st_mtime_ns
    assert quiet(street_run, to).written == 2
    assert kept.stat().st_mtime_ns == stamp
    logs = {path: digest for path, digest in tree(to).items() if path.startswith("navsim_logs")}
    assert logs == {path: digest for path, digest in tree(openscene[0]).items() if path.startswith("navsim_logs")}


def test_another_export_does_not_go_into_the_same_folder(street_run: Path, tmp_path: Path) -> None:
    quiet(street_run, tmp_path, ExportSettings(experts=("human",)))
    with pytest.raises(ValueError, match="other settings"):
        quiet(street_run, tmp_path, ExportSettings(experts=("recovery",)))


def test_a_log_that_was_lost_is_written_again(
    openscene: tuple[Path, ExportSummary], street_run: Path, tmp_path: Path
) -> None:
    to = tmp_path / "to"
    shutil.copytree(openscene[0], to)
    (lost,) = to.glob("navsim_logs/navtrain_human/*.pkl")
    lost.write_bytes(lost.read_bytes()[:100])
    assert quiet(street_run, to).written == 1
    assert tree(to) == tree(openscene[0])


def test_experts_rounds_and_splits_choose(street_run: Path, tmp_path: Path) -> None:
    chosen = ExportSettings(experts=("pdm_closed",), rounds=(1,), splits=("val",), tag="ours")
    assert quiet(street_run, tmp_path, chosen).logs == 1
    assert [path.name for path in (tmp_path / "navsim_logs").iterdir()] == ["synthetic_reaction_pdm_ours_v1.0-1"]


def test_pictures_of_another_size_are_told_of_and_resized_on_demand(tmp_path: Path) -> None:
    write_table(tmp_path / "run", [exported(0, "human", **pictures(("ring_front_center",), (0.0,)))])
    found = {}
    for resize in (False, True):
        to = tmp_path / str(resize)
        told = quiet(tmp_path / "run", to, ExportSettings(resize=resize, missing="none"))
        assert any("32x18" in note and "resize=true" in note for note in told.notes) == (not resize)
        (log,) = to.glob("navsim_logs/navtrain_human/*.pkl")
        found[resize] = pickle.loads(log.read_bytes())[3]["cams"]["CAM_F0"]
        (picture,) = to.rglob("*.jpg")
        assert cv2.imread(str(picture)).shape == ((1080, 1920, 3) if resize else (18, 32, 3))
    scale = np.diag([1920 / SIZE[0], 1080 / SIZE[1], 1.0])
    np.testing.assert_allclose(found[True]["cam_intrinsic"], scale @ found[False]["cam_intrinsic"])


def test_a_lens_keeps_its_terms_and_its_logs_are_counted(tmp_path: Path) -> None:
    """Rows that were imported from SimScale's release have the pictures and the rig of NAVSIM's logs."""
    lens, columns = [-0.356, 0.172, -0.002, 0.0, -0.052], pictures()
    columns["cameras"] = [camera | {"distortion": np.array(lens)} for camera in columns["cameras"]]
    write_table(tmp_path / "run", [exported(0, "human"), exported(1, "pdm_closed", 0, **columns)])
    quiet(tmp_path / "run", tmp_path / "to")
    (log,) = (tmp_path / "to").glob("navsim_logs/synthetic_reaction_pdm_*/*.pkl")
    assert list(pickle.loads(log.read_bytes())[3]["cams"]["CAM_F0"]["distortion"]) == lens
    header = json.loads((tmp_path / "to" / "manifest.jsonl").read_text().splitlines()[0])
    assert header["distorted_logs"] == 1


@pytest.mark.parametrize(
    ("columns", "said"),
    [
        (pictures(("ring_front_center", "ring_front_left")), "no camera stands for CAM_L1, CAM_L2"),
        (pictures(times_s=(0.0,)), "CAM_F0, .* lack earlier instants"),
        ({"cameras": None, "images": None, "image_source": "none"}, "no camera stands for CAM_F0"),
    ],
    ids=["two cameras", "now alone", "none"],
)
def test_absent_pictures_are_refused_black_or_named(tmp_path: Path, columns: dict[str, Any], said: str) -> None:
    write_table(tmp_path / "run", [exported(0, "human", **columns)])
    with pytest.raises(CannotExport, match=f"sample attempt00000: {said}"):
        quiet(tmp_path / "run", tmp_path / "refused")
    for missing, there in (("black", True), ("none", False)):
        to = tmp_path / missing
        told = quiet(tmp_path / "run", to, ExportSettings(missing=missing))  # type: ignore[arg-type]
        assert any("lack pictures" in note for note in told.notes)
        (log,) = to.glob("navsim_logs/navtrain_human/*.pkl")
        cams = [frame["cams"] for frame in pickle.loads(log.read_bytes())]
        paths = {to / "sensor_blobs/navtrain_human" / c[name]["data_path"] for c in cams[:4] for name in CAMERAS}
        assert all(path.is_file() for path in paths) == there
        black = to / "sensor_blobs/navtrain_human/black.jpg"
        assert black.exists() == there and (not there or cv2.imread(str(black)).max() == 0)
        for name in CAMERAS:
            assert np.linalg.det(cams[0][name]["sensor2lidar_rotation"]) == pytest.approx(1.0)


def test_a_rig_without_navsim_s_names_is_paired_by_direction() -> None:
    yaws = {"front": 0, "front_left": 60, "rear_left": 120, "rear": 180, "rear_right": -120, "front_right": -60}
    ring = [pinhole(name, yaw, 70.0) for name, yaw in yaws.items()]
    paired = match_cameras(ring)
    ours = {slot: camera.name for slot, camera in paired.items()}
    assert ours == {
        "CAM_F0": "front",
        "CAM_L0": "front_left",
        "CAM_L1": "rear_left",
        "CAM_R0": "front_right",
        "CAM_R1": "rear_right",
        "CAM_B0": "rear",
    }
    assert list(match_cameras(list(reversed(ring)))) == list(ours), "whatever their order"
    assert match_cameras([]) == {}


def test_samples_without_labels_have_no_rewards_and_it_is_said(tmp_path: Path) -> None:
    none = dict.fromkeys(name for name in exported(0, "human") if name.startswith("label_") and "hz" not in name)
    write_table(tmp_path / "none", [exported(0, "human", **none)])
    told = quiet(tmp_path / "none", tmp_path / "to_none")
    assert any("no sample has vocabulary labels" in note for note in told.notes)
    assert not (tmp_path / "to_none/traj_pdm_v2").exists()
    rows = [exported(1, "pdm_closed", 0), exported(2, "pdm_closed", 1, **none)]
    write_table(tmp_path / "some", rows)
    told = quiet(tmp_path / "some", tmp_path / "to_some")
    assert any("1 samples have no labels" in note for note in told.notes)
    last = (tmp_path / "to_some/traj_pdm_v2/sim/simcale_16384_pdm_v1.0-1.pkl").read_bytes()
    assert list(pickle.loads(last)) == [f"{TOKENS[1]}-000"], "the last round's file is there, as it is what is opened"


def test_a_log_without_a_route_is_written_and_named_nowhere(tmp_path: Path) -> None:
    write_table(tmp_path / "run", [exported(0, "human", route_roadblock_ids=[])])
    told = quiet(tmp_path / "run", tmp_path / "to")
    assert any("1 logs have no route" in note for note in told.notes)
    config = tmp_path / "to" / CONFIG
    assert read(config / "common/train_test_split/scene_filter/navtrain_human.yaml")["tokens"] == []
    assert read(config / "training/default_log_split_navtrain_human.yaml")["train_logs"] == []


def test_two_samples_of_one_name_are_refused(tmp_path: Path) -> None:
    write_table(tmp_path / "run", [exported(0, "human"), exported(1, "human")])
    with pytest.raises(CannotExport, match=f"attempt00000 and attempt00001 would both be {TOKENS[0]}"):
        quiet(tmp_path / "run", tmp_path / "to")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["expert=nobody"], "no sample of expert=nobody; there are expert: human, pdm_closed, recovery"),
        (["expert=human,nobody"], "no sample of expert nobody"),
        (["round=7"], "no sample of round=7"),
        (["round=one"], "round=one: must be a whole number"),
        (["split=night"], "split: train, val"),
        (["sample=0"], "navsim takes expert="),
        (["to=."], "to=<folder> is missing"),
        (["to=s3://bucket/folder"], "to a local folder"),
        (["workers=0"], "must be 1 or more"),
        (["executor=slurm"], "one of local, ray"),
        (["tag=a-b"], "letters, digits and _"),
        (["missing=white"], "one of refuse, black, none"),
        (["map_location=PIT"], "the public code knows"),
    ],
)
def test_what_cannot_be_asked_for_is_said(
    street_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], said: str
) -> None:
    to = [] if any(argument.startswith("to=") for argument in arguments) else [f"to={tmp_path}"]
    assert main(["navsim", f"out={street_run}", *to, *arguments]) == 2
    assert said in capsys.readouterr().err


def test_settings_of_navsim_are_no_others(street_run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["mcap", f"out={street_run}", "sample=0", "resize=true"]) == 2
    assert "resize=...: of export navsim alone" in capsys.readouterr().err


def test_a_folder_that_cannot_be_one_is_said(
    street_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("here")
    assert main(["navsim", f"out={street_run}", f"to={tmp_path / 'file'}"]) == 2
    assert str(tmp_path / "file") in capsys.readouterr().err


def test_the_command_says_what_it_wrote_and_what_a_training_would_stumble_over(
    street_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["navsim", f"out={street_run}", f"to={tmp_path}", "expert=recovery"]) == 0
    said = capsys.readouterr().out
    assert "1 samples chosen, 0 of them are there already" in said and "1 logs written, 1 in all" in said
    assert "trajectories of vocabulary vocabulary-1 are not known here" in said


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    folder = tmp_path / "disk"
    folder.mkdir()
    if subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=300k", "tmpfs", str(folder)], capture_output=True
    ).returncode:
        pytest.skip("a small disk is a tmpfs, and only root may mount one")
    yield folder
    subprocess.run(["umount", "--lazy", str(folder)], check=True)


def test_a_full_disk_is_said_in_one_line_and_the_same_command_goes_on(
    small_disk: Path, openscene: tuple[Path, ExportSummary], street_run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["navsim", f"out={street_run}", f"to={small_disk / 'to'}"]
    assert main(command) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert re.match(rf"error: {small_disk}/\S+: the disk is full: [\d,]+ bytes are needed", line)
    assert not list(small_disk.rglob("*.tmp"))
    subprocess.run(["mount", "-o", "remount,size=16m", str(small_disk)], check=True)
    assert main(command) == 0
    assert tree(small_disk / "to") == tree(openscene[0])
