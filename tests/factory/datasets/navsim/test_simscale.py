"""SimScale's released layout as samples: what stands in a row, what is counted as failed, what goes on."""

import pickle
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from factory.__main__ import main as factory
from factory.datasets.navsim import import_rows as table
from factory.exits import COMPLETE, COMPLETE_WITH_FAILURES
from factory.store.reader import SampleTable, labels_of
from factory.store.samples import Store
from factory.store.verify import verify
from factory.views.board.gallery import failures
from factory.views.board.watch import Watch
from planners.data.batch import BevLayout
from planners.data.bev import BevClass, bev_raster
from tasks.world.frames import to_local, to_world
from tasks.world.road_map import LightState
from tasks.world.vocabulary import kinematic_trajectories
from tests.factory.datasets.navsim import simscale_writer as simscale
from tests.factory.datasets.navsim.geopackage_writer import CITIES, ORIGIN, stub_rows, write_geopackage

PDM, RECOVERY = "synthetic_reaction_pdm_v1.0-0", "synthetic_reaction_recovery_v1.0-2"
HUMAN = "navtrain_human"  # of our own export
CITY = "us-nv-las-vegas-strip"  # of the writer's logs
Brought = tuple[Path, dict[tuple[str, int], dict[str, Any]]]


def imported(root: Path, out: Path, *words: str) -> int:
    return factory(["import", "simscale", f"root={root}", f"out={out}", *words])


def write_released(root: Path) -> Path:
    """Two logs of one folder, one of another."""
    for folder, seed, round in ((PDM, 1, 0), (PDM, 2, 0), (RECOVERY, 1, 2)):
        simscale.write_log(root, folder, seed, round)
    return root


@pytest.fixture
def released(tmp_path: Path) -> Path:
    return write_released(tmp_path / "SimScale_data")


@pytest.fixture(scope="module")
def brought(tmp_path_factory: pytest.TempPathFactory) -> Brought:
    """The same logs' folder, and their rows by expert and seed."""
    root, out = (tmp_path_factory.mktemp("simscale") / name for name in ("SimScale_data", "out"))
    write_released(root)
    assert imported(root, out) == COMPLETE
    return root, rows_of(out)


def rows_of(out: Path) -> dict[tuple[str, int], dict[str, Any]]:
    """By expert and seed."""
    return {(row["expert"], int(row["frame_tokens"][0], 16)): row for row in SampleTable(out)}


def test_a_row_holds_what_the_log_says(brought: Brought) -> None:
    _, rows = brought
    assert sorted(rows) == [("pdm_closed", 1), ("pdm_closed", 2), ("recovery", 1)]
    row, frames, poses = rows["pdm_closed", 1], simscale.frames(1, 0), simscale.poses(1)
    now = frames[simscale.NOW]
    np.testing.assert_allclose(row["now_pose"], poses[3], rtol=0, atol=1e-9)
    local = to_local(poses[3], poses)
    np.testing.assert_allclose(row["ego_history_2hz"], local[:4], atol=1e-5)
    np.testing.assert_allclose(row["label_2hz"], local[4:], atol=1e-5)
    np.testing.assert_array_equal(row["ego_status"], np.float32(now["ego_dynamic_state"]))
    named = ("log_id", "split", "round", "candidate_index", "command", "map_location", "image_source")
    log = simscale.SOURCE
    assert [row[n] for n in named] == [log, "train", 0, 0, "left", "us-nv-las-vegas-strip", "render"]
    assert row["frame_tokens"] == [f"{1:016x}", f"{0xB0001:016x}"]
    assert row["route_roadblock_ids"] == now["roadblock_ids"]
    assert rows["recovery", 1]["round"] == 2 and rows["recovery", 1]["clip_id"] == row["clip_id"]
    empty = ("lane_ids", "lane_polygons", "drivable_rings", "route_centerline", "light_lane_ids")
    assert all(len(row[name]) == 0 for name in empty)  # without maps
    assert row["stage2_score"] is None and row["perturbed_states"] is None and row["label_subscores"] is None


def test_between_two_frames_poses_are_linear_and_headings_take_the_short_way(brought: Brought) -> None:
    row = brought[1]["pdm_closed", 1]
    fine = np.concatenate([row["ego_history_10hz"], row["label_10hz"]])
    known = fine[::5]
    for k in range(5):  # a share of k fifths of every piece
        wanted = known[:-1] + k / 5 * (known[1:] - known[:-1])
        np.testing.assert_allclose(fine[k:-1:5], wanted, atol=2e-5)


def test_logs_without_pictures_are_counted_and_the_others_listed(
    released: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (shown,) = (released / "sensor_blobs" / PDM).glob(f"{2:016x}*")
    shutil.rmtree(shown)
    assert imported(released, tmp_path / "out") == COMPLETE_WITH_FAILURES
    told = capsys.readouterr().out
    assert f"{PDM}: 2 logs, 1 usable, 1 without pictures" in told
    assert f"{RECOVERY}: 1 logs, 1 usable, 0 without pictures" in told
    listed = yaml.safe_load((tmp_path / "out" / "usable" / f"{PDM}.yaml").read_text())
    log = simscale.frames(1, 0)
    assert (listed["log_names"], listed["tokens"]) == ([log[3]["log_name"]], [log[3]["token"]])


def test_objects_are_placed_by_the_ego_of_their_frame(brought: Brought) -> None:
    row, frames, poses = brought[1]["pdm_closed", 1], simscale.frames(1, 0), simscale.poses(1)
    ids, frame_steps = list(row["agent_ids"]), np.arange(0, 56, 5)
    for i, (frame, step) in enumerate(zip(frames, frame_steps)):
        anns = frame["anns"]
        for box, track in zip(anns["gt_boxes"], anns["track_tokens"]):
            world = to_world(poses[i], box[[0, 1, 6]])
            here = row["agent_boxes"][ids.index(track), step]
            np.testing.assert_allclose(here[:2], to_local(poses[3], world)[:2], atol=1e-4)
            np.testing.assert_allclose(here[3:], box[3:5], atol=1e-6)
            assert row["agent_valid"][ids.index(track), step]
    late = ids.index(f"{0xD001:016x}")
    assert not row["agent_valid"][late, :25].any() and row["agent_valid"][late, 25:].all()
    assert list(row["agent_kinds"]) == ["VEHICLE", "TRAFFIC_CONE", "PEDESTRIAN", "BICYCLE"]


def test_pictures_are_the_files_bytes_with_their_cameras(brought: Brought) -> None:
    released, rows = brought
    row, frames = rows["pdm_closed", 2], simscale.frames(2, 0)
    found = {(image["camera"], round(image["time_s"], 3)): image for image in row["images"]}
    assert len(found) == 4 * 8
    for i, frame in enumerate(frames[:4]):
        for name, camera in frame["cams"].items():
            image = found[name, round(0.5 * (i - 3), 3)]
            assert image["jpeg"] == (released / "sensor_blobs" / PDM / camera["data_path"]).read_bytes()
            np.testing.assert_allclose(image["ego_pose"].reshape(4, 4)[:3, 3], frame["ego2global_translation"])
    for camera in row["cameras"]:
        given = frames[3]["cams"][camera["name"]]
        np.testing.assert_array_equal(camera["intrinsics"].reshape(3, 3), given["cam_intrinsic"])
        np.testing.assert_array_equal(camera["distortion"], simscale.DISTORTION)
        np.testing.assert_array_equal(camera["ego_from_camera"].reshape(4, 4)[:3, :3], given["sensor2lidar_rotation"])
        assert (camera["width"], camera["height"]) == simscale.SIZE


def on_the_road(seed: int, **changed: Any) -> list[dict[str, Any]]:
    """A log along the one road of a small city, lanes 1 and 2 and between them connector 3, red for six frames."""
    log = simscale.frames(seed, 0)
    for i, frame in enumerate(log):
        frame["ego2global_translation"] = np.append(ORIGIN + np.array([10.0 + 4.0 * i, 0.5]), 608.1)
        frame["ego2global_rotation"] = np.array([1.0, 0.0, 0.0, 0.0])
        frame |= {"roadblock_ids": ["31", "33", "32"], "traffic_lights": [(3, i < 6)]} | changed
    return log


@pytest.fixture
def city(tmp_path: Path) -> Path:
    """nuPlan's maps with the city of the logs alone."""
    version, zone = CITIES[CITY]
    write_geopackage(tmp_path / "maps" / CITY / version / "map.gpkg", stub_rows(), zone)
    return tmp_path / "maps"


@pytest.mark.slow
def test_with_maps_a_row_has_the_lanes_the_route_and_the_lights_around_it(city: Path, tmp_path: Path) -> None:
    root, out = tmp_path / "SimScale_data", tmp_path / "out"
    simscale.write_log(root, PDM, 1, 0, on_the_road(1))
    strayed = simscale.write_log(root, PDM, 2, 0, on_the_road(2, roadblock_ids=["77"]))
    elsewhere = simscale.write_log(root, PDM, 3, 0, on_the_road(3, map_location="us-ma-boston"))
    assert imported(root, out, f"maps={city}") == COMPLETE_WITH_FAILURES
    (row,) = SampleTable(out)
    assert sorted(row["lane_ids"]) == ["1", "2", "3"] and row["map_location"] == CITY
    polygons = dict(zip(row["lane_ids"], row["lane_polygons"]))
    ahead = {"1": (0.0, 50.0), "3": (50.0, 60.0), "2": (60.0, 110.0)}  # along the road, of which now is at 22 m, 0.5 m
    for lane_id, (begin, end) in ahead.items():
        ring = np.asarray(polygons[lane_id])
        corners = [[begin - 22.0, -2.5], [end - 22.0, 1.5]]
        np.testing.assert_allclose([ring.min(axis=0), ring.max(axis=0)], corners, atol=1e-3)
    assert row["route_roadblock_ids"] == ["31", "33", "32"] and sorted(row["route_lane_ids"]) == ["1", "2", "3"]
    line = np.asarray(row["route_centerline"])
    np.testing.assert_allclose(line[:, 1], -0.5, atol=1e-3)
    assert line[-1, 0] == pytest.approx(110.0 - 22.0, abs=1e-3)
    assert row["light_lane_ids"] == ["3"]
    red = np.asarray(row["light_states"])[0, ::5] == LightState.RED
    np.testing.assert_array_equal(red, np.arange(12) < 6)
    failed = {one["error"].partition(": ")[0]: one["error"] for one in Store(out).outcomes.read().to_pylist()}
    assert len(failed) == 2 and "frames[3].roadblock_ids" in failed[str(strayed)], "off its route, said where"
    (lacking,) = (said for path, said in failed.items() if path != str(strayed))
    assert "us-ma-boston" in lacking and elsewhere.exists()


def test_what_reads_samples_reads_them(released: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A map that is empty and a row without scores are nothing that pages, episodes or batches stumble over."""
    out = tmp_path / "out"
    imported(released, out)
    assert factory(["status", f"out={out}"]) == 0 and "simscale 3" in capsys.readouterr().out
    assert factory(["show", f"out={out}", "sample=0", f"to={tmp_path / 'sample.png'}"]) == 0
    assert factory(["report", f"out={out}"]) == 0
    assert factory(["export", "mcap", f"out={out}", "sample=0", f"to={tmp_path}"]) == 0
    layout = BevLayout(times_s=(0.0,))
    rasters = [bev_raster(row, layout) for row in SampleTable(out)]
    assert all(set(np.unique(raster)) > {0, int(BevClass.VEHICLE)} for raster in rasters)


def test_a_human_log_is_a_row_of_the_human_that_begins_at_the_frame_of_its_name(released: Path, tmp_path: Path) -> None:
    """Its clip is that of the simulated rows that began in the same frame."""
    simscale.write_log(released, HUMAN, 1, None)
    assert imported(released, tmp_path / "out") == COMPLETE
    rows = rows_of(tmp_path / "out")
    row, frames = rows["human", 1], simscale.frames(1, None)
    assert row["clip_id"] == rows["pdm_closed", 1]["clip_id"] and row["log_id"] == simscale.SOURCE
    assert row["frame_tokens"] == [frames[3]["token"], frames[11]["token"]] == [f"{1:016x}", f"{0xA000C:016x}"]
    assert (row["candidate_index"], row["round"], row["image_source"]) == (-1, 0, "photo")
    poses = simscale.poses(1)
    np.testing.assert_allclose(row["parent_states"][:, :3], poses[[3, 11]], rtol=0, atol=1e-9)
    np.testing.assert_allclose(row["label_2hz"], to_local(poses[3], poses)[4:], atol=1e-5)


def test_exported_again_and_imported_again_rows_are_the_same(released: Path, tmp_path: Path) -> None:
    simscale.write_log(released, HUMAN, 1, None)
    imported(released, tmp_path / "out")
    assert factory(["export", "navsim", f"out={tmp_path / 'out'}", f"to={tmp_path / 'again'}"]) == 0
    assert imported(tmp_path / "again", tmp_path / "twice") == COMPLETE
    once, twice = rows_of(tmp_path / "out"), rows_of(tmp_path / "twice")
    assert sorted(once) == sorted(twice) and len(once) == 4
    for key, row in once.items():
        for name in ("clip_id", "now_pose", "ego_history_2hz", "label_2hz", "ego_status", "frame_tokens", "command"):
            np.testing.assert_array_equal(row[name], twice[key][name], err_msg=name)
        assert [image["jpeg"] for image in row["images"]] == [image["jpeg"] for image in twice[key]["images"]]
        np.testing.assert_allclose(row["label_10hz"], twice[key]["label_10hz"], atol=1e-5)


def test_the_unpacked_layout_gives_the_same_rows(released: Path, tmp_path: Path) -> None:
    unpacked = tmp_path / "unpacked" / "SimScale"
    for name in (PDM, RECOVERY):
        (unpacked / name).mkdir(parents=True)
        (released / "navsim_logs" / name).rename(unpacked / name / "meta_datas")
        (released / "sensor_blobs" / name).rename(unpacked / name / "sensor_blobs_hist")
    assert imported(tmp_path / "unpacked", tmp_path / "out") == COMPLETE
    assert len(SampleTable(tmp_path / "out")) == 3


def _without_a_key(log: list[dict[str, Any]]) -> None:
    del log[7]["ego2global_rotation"]


def _gap(log: list[dict[str, Any]]) -> None:
    for frame in log[5:]:
        frame["timestamp"] += 500_000


def _short(log: list[dict[str, Any]]) -> None:
    log.pop()


def _not_annotated(log: list[dict[str, Any]]) -> None:
    log[9]["anns"] = None


def _token(log: list[dict[str, Any]]) -> None:
    log[3]["token"] += "0"


@pytest.mark.parametrize(
    ("harm", "said"),
    [
        (_without_a_key, "frames[7].ego2global_rotation: missing"),
        (_gap, "frames[5].timestamp: not 0.5 s"),
        (_short, "frames: 11, expected 12"),
        (_not_annotated, "frames[9].anns: missing"),
        (_token, "frames[3].token: is "),
    ],
)
def test_a_bad_log_is_counted_and_hurts_no_other(harm: Any, said: str, released: Path, tmp_path: Path) -> None:
    log = simscale.frames(2, 0)
    harm(log)
    path = simscale.write_log(released, PDM, 2, 0, log)
    assert imported(released, tmp_path / "out") == COMPLETE_WITH_FAILURES
    (failed,) = Store(tmp_path / "out").outcomes.read().to_pylist()
    assert failed["error"].startswith(f"{path}: {said}") and failed["error_kind"] == "input"
    assert sorted(rows_of(tmp_path / "out")) == [("pdm_closed", 1), ("recovery", 1)]


@pytest.mark.parametrize(("folder", "other"), [(PDM, None), (HUMAN, 0)])
def test_a_log_of_the_other_kind_s_name_is_counted(
    folder: str, other: int | None, released: Path, tmp_path: Path
) -> None:
    path = simscale.write_log(released, folder, 5, other)
    assert imported(released, tmp_path / "out") == COMPLETE_WITH_FAILURES
    (failed,) = Store(tmp_path / "out").outcomes.read().to_pylist()
    assert failed["error"].startswith(f"{path}: name: expected <log>-<token>{'' if folder == HUMAN else '-000'}.pkl")
    assert len(rows_of(tmp_path / "out")) == 3


def test_two_folders_of_one_expert_and_round_are_one_too_many(
    released: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """They hold the same samples under two names, as where the split's name is a link to the folder's."""
    (released / "navsim_logs" / "navtrain_reaction_pdm_v1.0-0").symlink_to(released / "navsim_logs" / PDM)
    assert imported(released, tmp_path / "out") == 2
    assert "are both of pdm_closed in round 0: name one with only=" in capsys.readouterr().err
    assert imported(released, tmp_path / "out", f"only={PDM}") == COMPLETE
    assert len(rows_of(tmp_path / "out")) == 2


def test_missing_and_damaged_pictures_are_counted(released: Path, tmp_path: Path) -> None:
    first = released / "sensor_blobs" / PDM / simscale.frames(1, 0)[1]["cams"]["CAM_R2"]["data_path"]
    second = released / "sensor_blobs" / PDM / simscale.frames(2, 0)[0]["cams"]["CAM_F0"]["data_path"]
    first.unlink()
    second.write_bytes(second.read_bytes()[:-200])
    assert imported(released, tmp_path / "out") == COMPLETE_WITH_FAILURES
    said = {row["error"].split(": ")[0] for row in Store(tmp_path / "out").outcomes.read().to_pylist()}
    assert said == {str(first), str(second)}


def test_the_same_command_goes_on_and_tries_what_failed_again(released: Path, tmp_path: Path) -> None:
    path = released / "navsim_logs" / PDM / f"{simscale.names(2, 0)[0]}.pkl"
    whole = path.read_bytes()
    path.write_bytes(whole[:-50])
    assert imported(released, tmp_path / "out") == COMPLETE_WITH_FAILURES
    before = Store(tmp_path / "out").samples.version
    path.write_bytes(whole)
    assert imported(released, tmp_path / "out") == COMPLETE
    store = Store(tmp_path / "out")
    assert len(store.samples) == 3 and len(store.outcomes) == 0
    assert before is not None and store.samples.version is not None and store.samples.version > before
    assert not verify(store).damage


def test_what_failed_is_tried_again_by_the_import_and_every_place_says_so(
    released: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """`retry` has settings of runs alone."""
    path, out = released / "navsim_logs" / PDM / f"{simscale.names(2, 0)[0]}.pkl", tmp_path / "out"
    path.write_bytes(path.read_bytes()[:-50])
    imported(released, out)
    capsys.readouterr()
    again = "give the same command again, python -m factory import simscale ..."
    assert factory(["failed", f"out={out}"]) == 0
    told = capsys.readouterr().out
    assert f"to retry input: fix or take out the named file, then {again}" in told and "factory retry" not in told
    assert factory(["retry", f"out={out}"]) == 2
    told = capsys.readouterr()
    assert again in told.err and "retry_failed" not in told.err + told.out and "factory retry" not in told.out
    (shown,) = failures(Watch(Store(out)).snapshot())["items"]
    assert again in shown["retry"] and shown["error"].startswith(str(path))


def test_files_are_cut_by_the_bytes_of_the_rows_since_the_last(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root, out = tmp_path / "SimScale_data", tmp_path / "out"
    for seed in range(5):
        simscale.write_log(root, PDM, seed, 0)
    assert imported(root, tmp_path / "whole") == COMPLETE
    whole = Store(tmp_path / "whole").samples
    assert [len(rows) for _, rows in whole.files(["attempt_id"])] == [5]
    monkeypatch.setattr(table, "SHARD_BYTES", int(1.5 * whole.read().nbytes / 5))
    assert imported(root, out) == COMPLETE
    assert sorted(len(rows) for _, rows in Store(out).samples.files(["attempt_id"])) == [1, 2, 2]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["rewards=x"], "go together"),
        (["only=synthetic_reaction_pdm_v1.0-4"], "only=synthetic_reaction_pdm_v1.0-4: not under"),
        (["rewards=.", "vocabulary=none.npy"], "none.npy"),
        (["maps=nowhere"], "maps=nowhere: no such folder"),
    ],
)
def test_what_cannot_be_is_refused(
    words: Sequence[str], said: str, released: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert imported(released, tmp_path / "out", *words) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_another_import_or_run_is_not_mixed_in(
    released: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    imported(released, tmp_path / "out", "pictures=false")
    assert {row["image_source"] for row in SampleTable(tmp_path / "out")} == {"none"}
    assert imported(released, tmp_path / "out") == 2
    assert "choose another out" in capsys.readouterr().err
    assert imported(tmp_path / "elsewhere", tmp_path / "out2") == 2


def rewards(k: int, seed: int) -> dict[str, np.ndarray]:
    """As gen_gt writes them: progress is 0 where a multiplier is."""
    rng = np.random.default_rng(seed)
    nc, ddc = rng.choice([0.0, 0.5, 1.0], (2, k))
    dac, tlc, ttc, lk, hc = (rng.random((5, k)) < 0.8).astype(float)
    ep = np.where(nc * ddc * dac * tlc > 0.0, rng.random(k), 0.0)
    ep[rng.random(k) < 0.1] *= 1e-3
    names = ("no_at_fault_collisions", "drivable_area_compliance", "driving_direction_compliance")
    names += ("traffic_light_compliance", "ego_progress", "time_to_collision_within_bound", "lane_keeping")
    values = (nc, dac, ddc, tlc, ep, ttc, lk, hc)
    return {name: np.float16(value) for name, value in zip((*names, "history_comfort"), values)}


def test_rewards_become_labels_that_say_the_same(released: Path, tmp_path: Path) -> None:
    k, token = 300, simscale.names(1, 0)[2]
    given = rewards(k, 0)
    folder = tmp_path / "another_disk" / "sim"
    folder.mkdir(parents=True)
    (tmp_path / "traj_pdm").mkdir()
    (tmp_path / "traj_pdm" / "sim").symlink_to(folder)
    (folder / "simcale_16384_pdm_v1.0-0.pkl").write_bytes(pickle.dumps({token: given}))
    np.save(tmp_path / "vocabulary.npy", kinematic_trajectories(k, 1).astype(np.float32))
    words = (f"rewards={tmp_path / 'traj_pdm'}", f"vocabulary={tmp_path / 'vocabulary.npy'}")
    assert imported(released, tmp_path / "out", *words) == COMPLETE
    rows = rows_of(tmp_path / "out")
    labels = labels_of(rows["pdm_closed", 1])
    assert rows["pdm_closed", 2]["label_subscores"] is None and rows["recovery", 1]["label_subscores"] is None
    ours = {"no_at_fault_collisions": "nc", "driving_direction_compliance": "ddc", "lane_keeping": "lk"}
    for name, ours_name in ours.items():
        np.testing.assert_array_equal(getattr(labels, ours_name), given[name])
    ep, wanted = labels.ep("masked"), given["ego_progress"].astype(float)
    large = wanted >= 1 / 8
    np.testing.assert_array_equal(ep[large], wanted[large])
    assert (np.abs(ep - wanted) < 1 / 8000).all()
