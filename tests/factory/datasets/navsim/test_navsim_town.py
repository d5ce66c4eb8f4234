"""A run of the synthetic town with pictures of all its cameras, by the commands, from the first to the last."""

import json
import pickle
from pathlib import Path

import cv2
import numpy as np
import pytest

from factory.commands.table import COMMANDS
from factory.datasets.navsim.frames import sample_names, split_names
from factory.datasets.navsim.pictures import CAMERAS
from factory.readers.settings import MOUNTS
from factory.run import main as run
from factory.store.reader import SampleTable
from tasks.world.frames import to_local
from tests.factory.datasets.navsim.test_navsim_frames import poses_of

TOWN = [
    "clips.n_clips=1",
    f"clips.settings.cameras=[{','.join(MOUNTS)}]",
    "clips.settings.width=64",
    "clips.settings.height=36",
    "clips.settings.lidar_beams=0",
    "render=map",
    "render.frames=history",
    "render.width=64",
    "render.height=36",
    "vocabulary.k=64",
    "experts=[human,recovery]",
    "executor=local",
]


@pytest.mark.slow
def test_a_town_s_run_is_exported_whole(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, to = tmp_path / "out", tmp_path / "to"
    assert run([*TOWN, f"clips.cache_dir={tmp_path / 'towns'}", f"out={out}"]) == 0
    export = COMMANDS["export"].load()
    assert export(["navsim", f"out={out}", f"to={to}", "map_location=us-ma-boston"]) == 0
    assert "not known here" not in capsys.readouterr().out, "the kinematic vocabulary is"
    rows = list(SampleTable(out).iterate())
    assert {row["expert"] for row in rows} == {"human", "recovery"}
    for row in rows:
        names, split = sample_names(row), split_names(row)
        frames = pickle.loads((to / "navsim_logs" / split.folder / f"{names.log}.pkl").read_bytes())
        poses = poses_of(frames)
        np.testing.assert_allclose(to_local(poses[3], poses)[4:], row["label_2hz"], atol=2e-6)
        stored = {image["jpeg"] for image in row["images"]}
        paths = [frame["cams"][name]["data_path"] for frame in frames for name in CAMERAS]
        files = [to / "sensor_blobs" / split.folder / path for path in paths]
        assert {path.read_bytes() for path in files[:32]} == stored and not any(path.exists() for path in files[32:])
        assert cv2.imread(str(files[0])).shape == (36, 64, 3)
        rewards = pickle.loads((to / "traj_pdm_v2" / split.rewards).read_bytes())
        assert rewards[names.token]["ego_progress"].shape == (64,)
        assert frames[3]["anns"]["gt_names"].tolist() and frames[3]["roadblock_ids"]
    assert np.load(to / "devkit/traj_final/64.npy").shape == (64, 40, 3)
    header = json.loads((to / "manifest.jsonl").read_text().splitlines()[0])
    assert header["image_sources"] == {"map": len(rows)} and header["logs_with_absent_pictures"] == 0
