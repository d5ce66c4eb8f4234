"""docs/queries.md keeps its word: its blocks run as they stand, on a run of this version."""

import contextlib
import io
import re
from pathlib import Path

import pytest

from factory.graph.execute import Execution, execute
from factory.store.samples import Store
from tests.factory.toy import ToyWork, refs

BLOCKS = re.findall(r"^```python\n(.*?)^```$", (Path(__file__).parents[1] / "docs/queries.md").read_text(), re.M | re.S)


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("queries")
    store = Store(folder / "runs" / "demo")
    execute(ToyWork(), refs(4), ["recovery", "human"], 2, store, Execution("local"), say=lambda line: None)
    return folder


def answers(block: str) -> str:
    told = io.StringIO()
    with contextlib.redirect_stdout(told):
        exec(compile(block, "docs/queries.md", "exec"), {})
    return told.getvalue()


@pytest.mark.parametrize(("engine", "block"), [("duckdb", BLOCKS[0]), ("polars", BLOCKS[1])], ids=("duckdb", "polars"))
def test_the_queries_run_as_written(home: Path, engine: str, block: str, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip(engine)
    monkeypatch.chdir(home)
    shown = answers(block)
    assert f"import {engine}" in block and shown.count("┌") >= 4 - (engine == "polars")
    store = Store(home / "runs" / "demo")
    if engine == "duckdb":
        n_human = store.samples.read(["expert"])["expert"].to_pylist().count("human")
        assert re.search(rf"human +│ +0 │ +{n_human} │", shown), shown
        assert "reward" in shown and "recovery" in shown
    else:
        lowest = min(store.samples.read(["attempt_id", "stage2_score"]).to_pylist(), key=lambda r: r["stage2_score"])
        assert lowest["attempt_id"] in shown
