"""Benches at their smallest: they run, and print the rows that README and docs quote."""

import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
import torch

from factory.datasets.town.settings import TownSettings
from factory.datasets.town.town import write_logs
from tests.bench import (
    bench_bank,
    bench_decoding,
    bench_label_ends,
    bench_labels,
    bench_planner_steps,
    bench_render,
    bench_reward,
    bench_rollout,
    bench_run,
    bench_scale,
    bench_sizes,
    bench_store,
    bench_traffic,
    bench_traversals,
    bench_validation,
)
from tests.tasks.rollout.test_navsim_traffic import recorded

pytestmark = pytest.mark.slow


def test_every_step_on_a_stored_table_is_measured(tmp_path: Path) -> None:
    out = tmp_path / "out"
    bench_store.write(out, attempts=120, commits=2)
    for name, step in bench_store.STEPS.items():
        cpu_s, seconds, mb = bench_store.measured(step, out).split()
        assert float(mb) > 0.0 and float(cpu_s) >= 0.0 <= float(seconds), name


@pytest.mark.ray
@pytest.mark.long
def test_a_run_of_waiting_stages_is_made_and_then_found(capsys: pytest.CaptureFixture[str]) -> None:
    bench_scale.main(bench_scale.Request(nodes="1", attempts=64, wait_ms=0, row_kb=0))
    head, row = (line.split() for line in capsys.readouterr().out.splitlines()[-2:])
    assert head[:3] == ["nodes", "found", "attempts"]
    assert row[:2] == ["1", "0"] and int(row[2]) >= 40


def test_a_driver_keeps_simulated_nodes_at_work(capsys: pytest.CaptureFixture[str]) -> None:
    how = bench_scale.Request(nodes="1,2", cpus=2, attempts=80, wait_ms=500, row_kb=0, simulated=True)
    bench_scale.main(how)
    rates = [float(line.split()[3]) for line in capsys.readouterr().out.splitlines() if line.startswith("    ")][-2:]
    assert 2.0 < rates[0] <= 4.4 and 1.5 < rates[1] / rates[0] < 2.3


def test_a_run_s_parts_come_to_its_whole(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    blind = ("clips.settings.cameras=[]", "clips.settings.lidar_beams=0", f"clips.cache_dir={tmp_path}")
    small = ("clips.n_clips=1", "rounds=1", "vocabulary.k=64", "experts=[human]", "reward.labels=none")
    bench_run.main(["turns=1", "clips=synthetic", "render=none", *blind, *small])
    rows = [line.strip("| ").split(" | ") for line in capsys.readouterr().out.splitlines()[2:]]
    cost = {name.strip(): float(cpu_s) for name, cpu_s in rows}
    parts = cost["imports"] + cost["start-up"] + cost["tasks and tables"] + cost["end"]
    assert parts == pytest.approx(cost["whole"], abs=0.03) and cost["again"] > 0.0
    assert cost[bench_run.SAMPLES] == pytest.approx(3600.0 / cost["whole"], rel=0.01)  # of the clip's one sample


ONE_TOWN = ("clips=synthetic", "clips.n_clips=1", "clips.settings.cameras=[]", "clips.settings.lidar_beams=0")
LONG = pytest.mark.long
STEPS_OF = partial(bench_planner_steps.main, ["gtrs_dense_public"], torch.device("cpu"), 1, 1, 8, 0.3, True)


@pytest.mark.parametrize(
    ("bench", "rows", "says"),
    [
        pytest.param(lambda at: bank_of_few(at), 1, "2,000 scenes opened", id="bank", marks=LONG),
        pytest.param(lambda at: bench_decoding.main(2, 1, 3, 128, 32), 5, "a kept picture: 0.01 MB", id="decoding"),
        pytest.param(lambda at: STEPS_OF(), 3, "`gtrs_dense_public` | H100 SXM", id="planner_steps", marks=LONG),
        pytest.param(lambda at: bench_label_ends.main([*ONE_TOWN, "experts=[human]"]), 1, "| human |", id="label_ends"),
        pytest.param(lambda at: bench_render.main(None, 1, 500, 1), 2, "| seeded | 500 |", id="render"),
        pytest.param(lambda at: bench_reward.main(at, (2,)), 1, "| synthetic town | 2 |", id="reward"),
        pytest.param(lambda at: rollout_of_a_town(at), 4, "| idm |", id="rollout"),
        pytest.param(
            lambda at: traversals_of_a_town(at), 6, "| a drive that was not seen |", id="traversals", marks=LONG
        ),
        pytest.param(lambda at: bench_validation.main(["ego_mlp"], 1, 1), 1, "| `ego_mlp` |", id="validation"),
    ],
)
def test_a_bench_prints_its_rows(
    bench: Callable[[Path], None], rows: int, says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bench(tmp_path)
    printed = capsys.readouterr().out
    lines = [line for line in printed.splitlines() if line.startswith("| ")]
    heads = printed.count("\n|---")
    assert len(lines) - heads >= rows and says in printed, printed


def bank_of_few(folder: Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        for name in ("B", "TOGETHER"):
            patch.setattr(bench_bank, name, 4)
        bench_bank.main(folder, (4,), 2000, 1)


def traversals_of_a_town(folder: Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        small = ("width=64", "height=36", "iterations=2", "hz=2", "start_gaussians=2000")
        patch.setattr(sys, "argv", ["bench_traversals", f"out={folder}", *small])
        bench_traversals.main()


def rollout_of_a_town(folder: Path) -> None:
    write_logs(folder, range(1), 0, TownSettings(cameras=(), lidar_beams=0))
    bench_rollout.main(folder)


def test_labels_of_a_real_log_are_made_and_read(shared_root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bench_labels.main(shared_root, n_random=2, k=256, clips=1)
    said = capsys.readouterr().out
    assert "2 samples, K = 256" in said and said.count("\n| ") == 6, said


@LONG
def test_a_block_of_eight_cameras_is_measured_by_size(
    shared_root: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    small = ("sizes=48x27", "iterations=1", "start_gaussians=500", "stereo_photos=0")
    monkeypatch.setattr(sys, "argv", ["bench_sizes", str(shared_root / "data/openscene_0101"), *small])
    bench_sizes.main()
    (row,) = (line.split(" | ") for line in capfd.readouterr().out.splitlines() if line.startswith("| 48x27"))
    assert int(row[1]) > 100 and len(row) == 8


def test_the_bench_of_traffic_finds_no_difference_from_a_recorded_answer() -> None:
    one, answer = next(recorded())
    theirs = {name.removeprefix("public_"): values for name, values in answer.items()} | {"seconds": 1.0}
    cells = bench_traffic.line(one, theirs).split(" | ")
    assert float(cells[3]) < 1e-9 and float(cells[4]) < 1e-9 and cells[5] == "0"
