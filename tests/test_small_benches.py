"""Benches at their smallest: they run, and print the rows that README and docs quote."""

from pathlib import Path

import pytest

from tests.bench import bench_run, bench_scale, bench_store

pytestmark = pytest.mark.slow


def test_every_step_on_a_stored_table_is_measured(tmp_path: Path) -> None:
    out = tmp_path / "out"
    bench_store.write(out, attempts=120, commits=2)
    for name, step in bench_store.STEPS.items():
        cpu_s, seconds, mb = bench_store.measured(step, out).split()
        assert float(mb) > 0.0 and float(cpu_s) >= 0.0 <= float(seconds), name


@pytest.mark.ray
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
