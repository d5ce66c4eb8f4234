"""EPDMS as a training validates by it: that of the scorers of plans, on the scenes that the tables' runs kept."""

import csv
import re
import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
import torch
from torch import Tensor

from factory.files import DamagedFile
from factory.run import main as run_factory
from factory.setup import bank
from factory.store.samples import Store
from factory.views.scene_files import prepared_clip
from planners.data.batch import Batch
from planners.data.index import DataSettings
from planners.evaluation.benchmark_folder import BenchmarkFolder
from planners.evaluation.scoring import Rules, prepare_lone, score_lone
from planners.training.callbacks import VALIDATION, Callback
from planners.training.checkpoint import ENDED, newest_checkpoint, read_record
from planners.training.train import main
from planners.training.validation import make_validation
from tasks.bank import SceneBank
from tasks.caches import Damaged
from tasks.reward.aggregate import COLUMNS
from tasks.subscores import OF_ONE_PLAN
from tasks.trajectories import at_ten_hz, score_trajectories
from tests.planners.small_benchmark import write_benchmark_folder
from tests.planners.toy import Toy, ToySettings

CPU = torch.device("cpu")


class Steered(Toy):
    """Goes on as fast as it drives and swerves, each sample by its own speed, whatever is learned."""

    name = "tests.planners.training.test_validation:Steered"
    STEPS = 8

    def plan(self, batch: Batch) -> Tensor:
        t = 4.0 / self.STEPS * torch.arange(1, self.STEPS + 1)
        speed = batch.status[:, 4:5]
        return torch.stack([speed * t, 0.02 * (speed - 6.0) * t**2, 0.0 * speed * t], dim=-1)


class Fine(Steered):
    """At 10 Hz."""

    STEPS = 40


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run's folder: the logged drive, and simulated ones, of clips of the built-in town."""
    out = tmp_path_factory.mktemp("validation") / "run"
    blind = ["clips=synthetic_towns", "clips.settings.cameras=[]", "clips.settings.lidar_beams=0", "limit=5"]
    made = ["render=none", "reward.labels=none", "vocabulary.k=64", "experts=[human,pdm_closed]", "executor=local"]
    assert run_factory([*blind, *made, f"out={out}"]) == 0
    return out


@pytest.fixture
def own(made: Path, tmp_path: Path) -> Path:
    """A copy of it."""
    return Path(shutil.copytree(made, tmp_path / "run"))


def validated(planner: Toy, table: Path, folder: Path, workers: int = 1) -> dict[str, float]:
    return make_validation(DataSettings(val=str(table)), planner, CPU, workers, folder)(planner)


@pytest.mark.parametrize("kind", [Steered, Fine])
def test_scores_are_those_of_the_plans_on_the_samples_own_clips(made: Path, tmp_path: Path, kind: type[Toy]) -> None:
    planner, store = kind(ToySettings(), {}), Store(made)
    digest = store.runs()[-1]["prepare_digest"]
    expected, plans = [], []
    for row in store.samples.read(["clip_id", "expert", "ego_status"]).to_pylist():
        if row["expert"] == "human":
            clip = prepared_clip(store, row["clip_id"], digest)
            assert clip is not None
            status = torch.tensor([[0.0] * 4 + row["ego_status"]], dtype=torch.float32)
            batch = Batch((), status, *[torch.zeros(1)] * 5)
            plans.append(planner.plan(batch).numpy())
            scores = score_trajectories(clip, plans[-1])
            expected.append([scores.pdm_score[0], *(getattr(scores, name)[0] for name in OF_ONE_PLAN)])
    assert len(expected) == 5 and len({row[0] for row in expected}) > 1
    found = validated(planner, made, tmp_path / "bank")
    assert list(found) == ["epdms", *OF_ONE_PLAN, "ade_m", "fde_m"]
    np.testing.assert_allclose(list(found.values())[:-2], np.mean(expected, axis=0), rtol=1e-12)
    assert validated(planner, made, tmp_path / "bank") == found
    assert list(make_validation(DataSettings(val=str(made)), planner, CPU, 1)(planner)) == ["ade_m", "fde_m"]


def test_on_a_benchmark_they_are_what_evaluate_gives_a_logged_frame(tmp_path: Path) -> None:
    folder, planner = write_benchmark_folder(tmp_path / "hard"), Steered(ToySettings(), {})
    benchmark, rows = BenchmarkFolder(str(folder)), []
    for clip_id in ("a", "b"):
        lone = prepare_lone(clip_id, benchmark.scene(clip_id), Rules())
        status = torch.tensor([[0.0] * 4 + benchmark.sample(lone.key)["ego_status"].tolist()])
        plan = planner.plan(Batch((), status.float(), *[torch.zeros(1)] * 5)).double().numpy()
        rows.append(score_lone(lone, {lone.key: at_ten_hz(plan)[0]}, None)[0].scores.unfiltered)
    found, means = validated(planner, folder, tmp_path / "bank"), dict(zip(COLUMNS, np.mean(rows, axis=0)))
    for name in OF_ONE_PLAN:
        assert found[name] == pytest.approx(means[name], rel=1e-12), name
    assert found["epdms"] == pytest.approx(means["score"], rel=1e-12)


def test_a_bank_is_written_once_goes_on_after_a_kill_and_stands_for_what_a_run_has_lost(
    own: Path, tmp_path: Path
) -> None:
    planner, folder = Steered(ToySettings(), {}), tmp_path / "bank"
    with patch.object(bank, "SHARD", 2):
        found = validated(planner, own, folder)
        heads = sorted(folder.glob("*.json"))
        assert len(heads) == 3
        heads[1].unlink()  # as a kill leaves it, but for the order
        written = {path: path.stat().st_mtime_ns for path in folder.iterdir() if path.stem != heads[1].stem}
        assert validated(planner, own, folder) == found
        assert validated(planner, own, tmp_path / "together", workers=2) == found
        for path in folder.iterdir():
            assert path.read_bytes() == (tmp_path / "together" / path.name).read_bytes()
        assert written == {path: path.stat().st_mtime_ns for path in written}
    shutil.rmtree(own / "cache")
    assert validated(planner, own, folder) == found
    with pytest.raises(FileNotFoundError, match=r"run: its run keeps no scene of clip \w+, .*bank=<a folder"):
        validated(planner, own, tmp_path / "another")
    (bank_of_one := tmp_path / "one").mkdir()
    for path in folder.glob(f"{heads[0].stem}.*"):
        shutil.copy(path, bank_of_one)
    with pytest.raises(Damaged, match="a bank of other clips"):
        validated(planner, own, bank_of_one)


def test_a_damaged_clip_is_told_and_no_reason_to_leave_a_sample_out(own: Path, tmp_path: Path) -> None:
    path = sorted((own / "cache" / "prepared").iterdir())[0]
    path.write_bytes(path.read_bytes()[:-9])
    with pytest.raises(DamagedFile, match=re.escape(path.name)):
        validated(Steered(ToySettings(), {}), own, tmp_path / "bank")


def test_samples_that_cannot_be_scored_are_told_and_the_others_are(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    planner, pack = Steered(ToySettings(), {}), bank.pack_scene
    clip_ids = SceneBank(_banked(planner, made, tmp_path / "all")).clip_ids

    def without(ids: tuple[str, ...], folder: Path) -> dict[str, float]:
        def packs(clip: Any) -> bytes:
            return pack(clip if clip.clip_id not in ids else replace(clip, centerline=clip.centerline[[0, 0]]))

        with patch.object(bank, "pack_scene", packs):
            return validated(planner, made, folder)

    found = without(clip_ids[:2], tmp_path / "some")
    assert "note: 2 of 5 samples of data.val have no score, such as " in capsys.readouterr().out
    assert SceneBank(tmp_path / "some").left_out.keys() == {*clip_ids[:2]} and 0.0 <= found["epdms"] <= 1.0
    with pytest.raises(ValueError, match=r"5 of 5 samples of data\.val have no score"):
        without(clip_ids, tmp_path / "none")


def _banked(planner: Toy, table: Path, folder: Path) -> Path:
    validated(planner, table, folder)
    return folder


class StopsAt(Callback):
    """A user's."""

    def __init__(self, epdms: float) -> None:
        self.epdms = epdms

    def on_validation_end(self, step: int, planner: Any, measured: Mapping[str, float]) -> str | None:
        return f"epdms {self.epdms} is enough" if measured["epdms"] >= self.epdms else None


def test_a_training_prints_it_keeps_the_best_and_ends_by_it(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Plans stay as they are: the first validation is the best, and two more are waited for."""
    words = ["planner=custom", f"planner.name={Steered.name}", "planner.training.batch_size=2", "workers=1"]
    words += [f"data.real=[{made}]", f"data.val=[{made}]", "steps=20", "validate_every=0.5ep", "checkpoint_every=1ep"]
    asked = [*words, "keep_best=epdms", "patience=2", f"out={tmp_path / 'out'}"]
    for times in (1, 2):  # the second finds it ended
        assert main(asked) == 0, capsys.readouterr().err
        said = capsys.readouterr().out
        assert "ended after step 3 of 20: 2 validations without a better epdms; best so far: epdms " in said
        assert f"best epdms: {tmp_path / 'out' / 'checkpoints' / '00000001'}\n" in said
        assert said.count("validation after step ") == (3 if times == 1 else 0)
    with (tmp_path / "out" / VALIDATION).open() as file:
        rows = list(csv.DictReader(file))
    assert [row["step"] for row in rows] == ["1", "2", "3"] and 0.0 < float(rows[0]["epdms"]) < 1.0
    assert main([*asked, "resume=further"]) == 0 and read_record(tmp_path / "out")["step"] == 4
    target = f"callbacks.mine._target_={StopsAt.__module__}.StopsAt"
    other = [*words, target, "callbacks.mine.epdms=0.1", f"bank={tmp_path / 'out' / 'bank'}", f"out={tmp_path / 'own'}"]
    assert main(other) == 0, capsys.readouterr().err
    assert read_record(tmp_path / "own")[ENDED] == "epdms 0.1 is enough"
    assert newest_checkpoint(tmp_path / "own").name == "00000001" and not (tmp_path / "own" / "bank").exists()
