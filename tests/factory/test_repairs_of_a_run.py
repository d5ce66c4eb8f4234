"""What was repaired in a run's logs is seen in its rows and on its pages; `repairs=refuse` makes it a failure."""

import time
from collections.abc import Sequence
from pathlib import Path

import pytest

from examples.csv_logs import write_log
from factory.commands.table import COMMANDS
from factory.config.run import load_config
from factory.exits import BAD_CONFIG, COMPLETE, COMPLETE_WITH_FAILURES
from factory.run import main as run_main
from factory.setup.settings import assemble
from factory.store.samples import Store
from factory.views.board.overview import overview
from factory.views.board.watch import Watch
from tests.factory.repaired_logs import CROSSING, GAP, IMPOSSIBLE, SECOND_GAP, WHOLE

LINE = (
    "2 objects in 1 clip repaired, 1 left out: outlines of crossings 1, gaps filled 1, impossible values 1 (left out)"
)
COUNTS = [
    {"what": "crossing", "repaired": 1, "left_out": 0},
    {"what": "gap", "repaired": 1, "left_out": 0},
    {"what": "impossible", "repaired": 0, "left_out": 1},
]


def words(root: Path, *more: str) -> list[str]:
    reader = ["clips=custom", "clips._target_=tests.factory.repaired_logs.RepairedReader", f"+clips.root={root}"]
    return [*reader, "+clips.stride_s=5.0", "experts=[human]", "reward.labels=none", "render=none", *more]


def run(root: Path, out: Path, *more: str) -> int:
    return run_main([*words(root, *more), "executor=local", "graph.isolated=never", f"out={out}"])


def command(name: str, *arguments: str) -> int:
    return int(COMMANDS[name].load()(list(arguments)))


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two logs of one clip each, the second of which is whole."""
    folder = tmp_path_factory.mktemp("logs")
    write_log(folder / "street")
    write_log(folder / WHOLE)
    return folder


@pytest.fixture(scope="module")
def out(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    assert run(root, folder) == COMPLETE
    return folder


def rows_by_log(rows: Sequence[dict[str, object]]) -> dict[str, object]:
    return {str(row.pop("log_id")): row for row in rows}


@pytest.mark.slow
def test_samples_have_the_counts_and_lists_of_candidates_the_records_too(out: Path) -> None:
    store = Store(out)
    samples = rows_by_log(store.samples.read(["log_id", "repairs"]).to_pylist())
    assert samples == {"street": {"repairs": COUNTS}, WHOLE: {"repairs": []}}
    lists = rows_by_log(store.candidates.read(["log_id", "repairs", "repair_records"]).to_pylist())
    records = [vars(repair) for repair in (CROSSING, GAP, SECOND_GAP, IMPOSSIBLE)]
    assert repr(lists["street"]) == repr({"repairs": COUNTS, "repair_records": records})
    assert lists[WHOLE] == {"repairs": [], "repair_records": []}


@pytest.mark.slow
def test_status_card_dashboard_and_report_have_one_line(out: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert not command("status", f"out={out}")
    assert LINE in capsys.readouterr().out.splitlines()
    assert f"In their logs: {LINE}.\n" in (out / "README.md").read_text()
    assert overview(Watch(Store(out)).snapshot(), "here", time.time())["repaired"] == LINE
    assert LINE in (out / "report.html").read_text()


@pytest.mark.slow
def test_the_same_command_again_leaves_its_pages_and_makes_those_again_that_are_not_of_its_rows(
    root: Path, tmp_path: Path
) -> None:
    pages = [tmp_path / "report.html", tmp_path / "README.md"]
    assert run(root, tmp_path) == COMPLETE
    made = [page.stat().st_mtime_ns for page in pages]
    assert run(root, tmp_path) == COMPLETE and made == [page.stat().st_mtime_ns for page in pages]
    (tmp_path / "report.json").write_text("{")  # not readable: nothing says what they are of
    assert run(root, tmp_path) == COMPLETE
    again = [page.stat().st_mtime_ns for page in pages]
    assert all(later > first for later, first in zip(again, made))
    pages[1].unlink()
    assert run(root, tmp_path) == COMPLETE and pages[1].is_file()


@pytest.mark.slow
def test_a_sample_says_what_was_repaired_in_its_clip(
    out: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    told = "outlines of crossings 1, gaps filled 1, impossible values 1 (left out)"
    for row in Store(out).samples.read(["attempt_id", "log_id"]).to_pylist():
        assert not command("show", f"out={out}", f"sample={row['attempt_id']}", f"to={tmp_path}")
        assert (f"repaired      {told}" in capsys.readouterr().out.splitlines()) == (row["log_id"] == "street")
        assert not command("lineage", f"out={out}", f"sample={row['attempt_id']}")
        assert (f"  repaired          {told}" in capsys.readouterr().out.splitlines()) == (row["log_id"] == "street")


@pytest.mark.slow
def test_explain_tells_each_repair_of_its_clip(root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    refs = assemble(load_config([*words(root), "executor=local"])).index.refs
    for ref in refs:
        explained = [*words(root)[:-3], "render=none", f"clip={ref.clip_id}", "expert=human", f"to={tmp_path}"]
        assert not command("explain", *explained)
        lines = capsys.readouterr().out.splitlines()
        assert any(line.startswith("repaired: ") for line in lines) == (ref.log_id == "street")
        assert ("    van at 4.0 s: length -1.30 m -> left out" in lines) == (ref.log_id == "street")
        assert ("    pc_1: a bow tie of 62 m2 -> a ring of 429 m2" not in lines) == (ref.log_id == WHOLE)
        refused = command("explain", *explained, "repairs=refuse")
        assert refused == (COMPLETE_WITH_FAILURES if ref.log_id == "street" else COMPLETE)


@pytest.mark.slow
def test_a_run_that_refuses_repairs_fails_those_clips_and_one_that_makes_them_reads_them(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(root, tmp_path, "repairs=refuse") == COMPLETE_WITH_FAILURES
    store = Store(tmp_path)
    assert store.samples.read(["log_id"])["log_id"].to_pylist() == [WHOLE]
    (failed,) = store.outcomes.read(["error_kind", "error"]).to_pylist()
    assert failed["error_kind"] == "input"
    assert "repairs: 4 repairs, the first (crossing): pc_1: a bow tie" in failed["error"]
    assert "repairs=make, the default" in failed["error"]
    capsys.readouterr()
    assert run(root, tmp_path) == BAD_CONFIG, "rows of two settings in one place"
    assert "repairs: refuse -> make" in capsys.readouterr().err
    assert run(root, tmp_path, "on_change=redo", "retry_failed=true") == COMPLETE
    assert sorted(Store(tmp_path).samples.read(["log_id"])["log_id"].to_pylist()) == ["street", WHOLE]


@pytest.mark.slow
def test_clips_that_another_run_kept_with_their_repairs_are_refused_as_well(root: Path, tmp_path: Path) -> None:
    assert run(root, tmp_path) == COMPLETE
    assert run(root, tmp_path, "repairs=refuse", "on_change=redo") == COMPLETE_WITH_FAILURES
    (failed,) = Store(tmp_path).outcomes.read(["log_id", "error_kind"]).to_pylist()
    assert failed == {"log_id": "street", "error_kind": "input"}


def test_settings_and_prepared_clips_of_the_two_ways_are_told_apart(root: Path) -> None:
    simulated = ["experts=[pdm_closed]", "executor=local"]
    make, refuse = (assemble(load_config(words(root, *simulated, *more))) for more in ([], ["repairs=refuse"]))
    assert make.work.identity.settings["repairs"] == "make" and refuse.work.identity.settings["repairs"] == "refuse"
    assert make.work.identity.settings_hash != refuse.work.identity.settings_hash
    assert make.work.identity.prepare_digest != refuse.work.identity.prepare_digest
    assert make.index.refs == refuse.index.refs, "a clip is refused when it is read"
