"""The training command, used as its users do: on a table, killed, gone on with, and asked for what cannot be."""

import csv
import os
import shlex
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from factory.run import main as run_factory
from planners.__main__ import main as planners
from planners.drive.settings import settings_of as drive_settings
from planners.evaluation.evaluate import settings_of as evaluate_settings
from planners.training.callbacks import LOSSES, VALIDATION
from planners.training.checkpoint import load_planner, newest_checkpoint, read_record
from planners.training.train import main
from tests.pages import commands
from tests.planners.samples import sample, write_table

ROOT = Path(__file__).resolve().parents[3]
STATUS_PLANNER = ("planner=custom", "planner.name=tests.planners.toy:Toy", "planner.training.batch_size=4")


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("train") / "out"
    rows: list[dict[str, Any]] = [sample(i) for i in range(8)]
    rows += [sample(i, "recovery", i % 2) for i in range(8, 24)]
    write_table(path, rows, shard_rows=10, group_rows=4)
    return str(path)


def command(table: str, out: Path, *more: str, sim: bool = True) -> list[str]:
    data = [f"data.real=[{table}]", f"data.sim=[{table}]"] if sim else [f"data.real=[{table}]"]
    return [*STATUS_PLANNER, *data, "planner.training.epochs=3", "log_every=1", f"out={out}", *more]


def test_it_trains_and_says_what_with(table: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert (
        main(
            command(
                table, tmp_path, f"data.val=[{table}]", "mix.imitation=real", "validate_every=10", "keep_best=ade_m"
            )
        )
        == 0
    )
    said = capsys.readouterr().out
    worth = list(csv.DictReader((tmp_path / VALIDATION).open()))
    lines = [line for line in said.splitlines() if line.startswith("validation after step ")]
    for line, row in zip(lines, worth, strict=True):
        assert f"step {row['step']}: ade_m {float(row['ade_m']):.4f}, fde_m {float(row['fde_m']):.4f}; " in line
    first, last = (float(row["ade_m"]) for row in worth)
    best = "the best so far" if last < first else f"best so far: ade_m {first:.4f} after step 10"
    assert lines[0].endswith("; the best so far") and lines[1].endswith(best)
    watch, score = (shlex.split(line.partition(": ")[2]) for line in said.splitlines()[-2:])
    assert drive_settings(watch[4:]).planner == evaluate_settings(score[4:]).planner == str(tmp_path / "best")
    assert "real: 8 samples" in said and "recovery: 16" in said and "18 steps; begins" in said
    assert f"best ade_m: {tmp_path}" in said
    record = read_record(tmp_path)
    assert record["step"] == 18
    assert record["trained"]["mix"]["imitation"] == "real"
    assert record["backbones"] == {}
    assert len((tmp_path / LOSSES).read_text().splitlines()) == 1 + 18
    assert list((tmp_path / "tensorboard").iterdir())
    last = (tmp_path / VALIDATION).read_text().splitlines()
    assert last[0] == "step,ade_m,fde_m" and [line.split(",")[0] for line in last[1:]] == ["10", "18"]


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder in which `make demo` wrote runs/demo: three clips of it, seen and drawn small."""
    home = tmp_path_factory.mktemp("demo")
    small = ["clips.settings.width=96", "clips.settings.height=54", "render.width=80", "render.height=45"]
    small += ["render.fit.iterations=20", "render.fit.start_gaussians=2000", "render.fit.most_gaussians=2500"]
    small += ["render.fit.start_every=2", "render.fit.stereo_photos=2", "render.psnr_min=0"]
    small += ["render.gate.enabled=false", "vocabulary.k=64", "rounds=1", "limit=3"]
    small += ["clips.settings.lidar_beams=16", "clips.settings.lidar_azimuths=180", "clips.settings.steps_per_photo=5"]
    assert run_factory(["preset=demo", "executor=local", *small, f"out={home / 'runs/demo'}"]) == 0
    return home


def documented(page: str) -> list[str]:
    """A page's first command that trains, of the demo's table and of a planner for a CPU."""
    words = next(list(one.words) for one in commands(page) if one.words[:4] == ("python", "-m", "planners", "train"))
    own = {"/data/samples": "runs/demo", "planner=ltf": "planner=ltf_small"}
    for there, here in own.items():
        words = [here if word == there else word.replace(f"[{there}]", f"[{here}]") for word in words]
    return words[1:]


def noted(said: str) -> list[str]:
    return [line for line in said.splitlines() if line.startswith("note: ")]


@pytest.mark.slow
@pytest.mark.parametrize("page", ["README.md", "docs/training.md"])
def test_the_documented_first_trainings_take_the_demo_s_table(
    page: str, demo: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of nine samples: the batch is as large as there are. Of three: below, by two processes."""
    monkeypatch.chdir(demo)
    words = documented(page)[2:]
    assert planners([*words, "steps=2"]) == 0, capsys.readouterr().err
    (note,) = noted(capsys.readouterr().out)
    (out,) = (word.removeprefix("out=") for word in words if word.startswith("out="))
    record = read_record(demo / out)
    assert note.startswith("note: planner.training.batch_size=32 -> 9: "), note
    assert (record["step"], record["trained"]["planner.training"]["batch_size"]) == (2, 9)


@pytest.mark.slow
def test_two_processes_of_torchrun_share_the_batch_that_the_demo_s_samples_fill(demo: Path) -> None:
    """Three samples: a batch of two, one for each, which one of the processes notes."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", "2", "--master-port", str(port)]
    words = [*torchrun, *documented("docs/extend.md"), "steps=2", "device=cpu", "out=runs/two"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(words, cwd=demo, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0 and "find_unused_parameters" not in done.stderr, done.stderr
    (note,), record = noted(done.stdout), read_record(demo / "runs/two")
    assert note.startswith("note: planner.training.batch_size=64 -> 2: "), note
    assert (record["step"], record["trained"]["planner.training"]["batch_size"]) == (2, 2)
    assert record["trained"]["processes"] == 2


def test_a_loss_that_is_not_known_yet_is_a_dash(
    table: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("factory.graph.progress.LINE_EVERY_S", 0.0)
    assert main([*command(table, tmp_path), "steps=3", "log_every=2"]) == 0
    shown = [line.rpartition("loss ")[2] for line in capsys.readouterr().err.splitlines() if line.startswith("steps")]
    assert shown[0] == "-" and all(float(loss) > 0.0 for loss in shown[1:]) and len(shown) == 3


@pytest.mark.parametrize(
    ("more", "batch"),
    [
        (("planner.training.batch_size=64", "accumulate=4"), 24),
        (("planner.training.batch_size=63", "accumulate=7"), 21),
        (("planner.training.batch_size=64", "mix.sim_ratio=0.5"), 16),
        (("planner.training.batch_size=64", "mix.sim_ratio=0.9"), 64),
        (("planner.training.batch_size=64", "data.sim=[]"), 8),
        (("planner.training.batch_size=8",), 8),
    ],
)
def test_a_batch_is_no_larger_than_the_data_fills(
    table: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], more: tuple[str, ...], batch: int
) -> None:
    assert main([*command(table, tmp_path), *more, "steps=1", "workers=1"]) == 0, capsys.readouterr().err
    asked = int(more[0].rpartition("=")[2])
    notes = [line for line in capsys.readouterr().out.splitlines() if line.startswith("note: ")]
    assert len(notes) == (asked != batch) and all(f"batch_size={asked} -> {batch}:" in note for note in notes)
    assert read_record(tmp_path)["trained"]["planner.training"]["batch_size"] == batch


def test_a_training_that_goes_on_keeps_the_batch_that_it_began_with(
    table: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = [*command(table, tmp_path), "planner.training.batch_size=63", "resume=further", "workers=1"]
    assert main([*asked, "steps=1", "accumulate=7"]) == 0
    assert main([*asked, "steps=2", "accumulate=3"]) == 0, capsys.readouterr().err
    assert read_record(tmp_path)["trained"]["planner.training"]["batch_size"] == 21


def test_a_planner_is_trained_further_from_the_weights_of_another_training(
    table: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    assert main(command(table, first)) == 0
    further = ("seed=5", "steps=1", f"init_from={first}", "planner.training.learning_rate=1e-9")
    assert main(command(table, second, *further, sim=False)) == 0
    assert f"weights to begin with: {newest_checkpoint(first)}" in capsys.readouterr().out
    begun, learnt = (load_planner(folder).state_dict() for folder in (second, first))
    for name, weights in learnt.items():
        torch.testing.assert_close(begun[name], weights, rtol=0.0, atol=1e-8)
    assert main(command(table, tmp_path / "alone", "steps=1", sim=False)) == 0
    arrays = {f: load_planner(tmp_path / f).arrays["mean_plan"] for f in ("first", "second", "alone")}
    np.testing.assert_array_equal(arrays["second"], arrays["first"])  # what it was built around stays, on other data
    assert not np.array_equal(arrays["alone"], arrays["first"])
    assert main(command(table, second, *further[:2], further[3], sim=False)) == 2
    assert "init_from" in capsys.readouterr().err
    assert main(command(table, tmp_path / "third", f"init_from={first}", "+planner.settings.hidden=9")) == 2
    assert "(9, " in capsys.readouterr().err
    assert not (tmp_path / "third").exists()


@pytest.mark.slow
def test_a_training_goes_further_where_it_is_asked_to_and_the_record_says_from_where(
    table: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole, further = tmp_path / "whole", tmp_path / "further"
    assert main(command(table, whole, "steps=5", "accumulate=2")) == 0
    assert main(command(table, further, "steps=3", "accumulate=2")) == 0
    more = command(table, further, "steps=5", "accumulate=2")
    assert main(more) == 2
    assert "steps 3 -> 5" in (said := capsys.readouterr().err) and "resume=further" in said
    assert main([*more, "resume=further"]) == 0
    assert (further / LOSSES).read_text() == (whole / LOSSES).read_text()  # a constant rate asks for no end
    assert main(command(table, further, "steps=7", "resume=further")) == 0
    record = read_record(further)
    assert record["earlier"] == [{"until_step": 3, "steps": 3}, {"until_step": 5, "steps": 5, "accumulate": 2}]
    assert "earlier" not in read_record(whole) and record["trained"]["steps"] == 7
    for refused, why in (
        ("steps=4", "has done 7 steps"),
        ("seed=5", "seed 0 -> 5"),
        ("+planner.settings.hidden=9", "planner.settings {'hidden': 8"),
        ("data.max_round=0", "samples "),
    ):
        assert main(command(table, further, refused, "resume=further")) == 2
        assert why in (said := capsys.readouterr().err) and "or resume=further" not in said


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (("plannr=ltf",), "plannr"),
        (("planner.training.epoch=3",), "epoch"),
        (("data.sim=[]", "mix.sim_ratio=0.5"), "sim_ratio"),
        (("data.real=[nowhere]", "data.sim=[]"), "nowhere"),
        (("planner.name=tests.planners.toy:Toyy",), "tests.planners.toy has no Toyy; did you mean Toy?"),
        (("planner.name=nowhere:Toy",), "planner.name: nowhere:Toy: there is no module nowhere"),
        (
            ("planner.training.batch_size=100", "accumulate=50"),
            "samples does not divide into 1 processes times accumulate=50 parts: lower accumulate",
        ),
        (("accumulate=3",), "does not divide into 1 processes times accumulate=3 parts: 6 does"),
        (("device=cuda",), "device=cuda"),
        (("keep_best=ade_m",), "name data.val"),
        (("patience=2",), "patience=2: name keep_best"),
        (("bank=here",), "bank=here: name data.val"),
        (("validate_every=2 epochs",), "validate_every=2 epochs: must be steps, at least 0, or epochs as 2ep"),
        (("checkpoint_every=0ep",), "checkpoint_every=0ep: must be"),
        (("callbacks.mine._target_=tests.planners.toy.Toyy",), "callbacks.mine: "),
        (("callbacks.mine._target_=tests.planners.toy.ToySettings",), "ToySettings is no planners.training.callbacks"),
        (("init_from=nowhere",), "nowhere: no checkpoint"),
        (("planner=gtrs_dense_small",), "vocabulary"),
    ],
)
def test_what_cannot_be_trained_is_refused_before_anything_is_written(
    table: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], more: tuple[str, ...], said: str
) -> None:
    arguments = [a for a in command(table, tmp_path / "out") if a.split("=")[0] not in {m.split("=")[0] for m in more}]
    if any(m.startswith("planner=") for m in more):
        arguments = [a for a in arguments if not a.startswith("planner.")]
    assert main([*arguments, *more]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
