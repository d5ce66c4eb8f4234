"""The card of a run's data set: valid front matter, the tables' own numbers, and true when a run did not finish."""

import time
from pathlib import Path
from typing import Any

import pytest
import yaml

from factory.commands.table import COMMANDS
from factory.config.arguments import Refused
from factory.exits import COMPLETE, INTERRUPTED
from factory.graph.execute import Execution
from factory.store.funnel import funnel_of
from factory.store.samples import Store
from factory.views.board.overview import overview
from factory.views.board.watch import Watch
from factory.views.card import FILE, card, write_card
from factory.views.status import open_store, status_lines
from tasks.caches import json_with_checksum
from tests.factory.toy import ToyWork, executed, refs

report_main = COMMANDS["report"].load()


def front_matter(text: str) -> dict[str, Any]:
    _, block, _ = text.split("---\n", 2)
    found = yaml.safe_load(block)
    assert isinstance(found, dict)
    return found


def table_rows(text: str, heading: str) -> list[list[str]]:
    """The cells of the first table behind a heading."""
    section = text.split(f"\n## {heading}\n", 1)[1].split("\n## ", 1)[0]
    lines = [line for line in section.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines[2:]]


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    work = ToyWork()
    executed(work, refs(4), ["recovery", "human"], 2, Store(folder), Execution("local", command=["rounds=2"]))
    return folder


def test_the_front_matter_is_yaml_and_names_the_files_and_the_licence(out: Path) -> None:
    store = Store(out)
    found = front_matter(card(store))
    licences = set(store.samples.read(["licence"])["licence"].to_pylist())
    assert found["license"] == "other" and found["license_name"] == "; ".join(sorted(licences))
    assert found["size_categories"] == ["n<1K"] and "autonomous-driving" in found["tags"]
    (config,) = found["configs"]
    matched = {path.relative_to(out).as_posix() for path in out.glob(config["data_files"])}
    assert matched == {f"samples/{path}" for path in store.samples.live_files()}


def test_the_tables_of_the_card_are_those_of_the_run(out: Path) -> None:
    store = Store(out)
    text = card(store)
    rows = store.samples.read(["dataset", "licence", "split", "log_id", "clip_id"]).to_pylist()
    came = table_rows(text, "Where it comes from")
    assert sum(int(row[-1]) for row in came) == len(rows) and f"{len(rows)} samples from 4 clips" in text
    for dataset, licence, split, logs, clips, n in came:
        own = [row for row in rows if (row["dataset"], row["licence"], row["split"]) == (dataset, licence, split)]
        assert [len({row[key] for row in own}) for key in ("log_id", "clip_id")] == [int(logs), int(clips)]
        assert len(own) == int(n)
    funnel = [[r.expert, str(r.round), str(r.accepted)] for r in funnel_of(store).rows]
    assert [[expert, round_, accepted] for expert, round_, _, accepted, *_ in table_rows(text, "Acceptance")] == funnel
    assert "python -m factory.run rounds=2\n" in text and store.runs()[-1]["settings_hash"] in text


def test_a_card_says_that_a_run_was_interrupted_and_the_next_that_it_is_complete(tmp_path: Path) -> None:
    store = Store(tmp_path)
    stopped = executed(ToyWork(), refs(3), ["human"], 1, store, Execution("local", minutes=0.0))
    assert stopped.exit_code == INTERRUPTED
    write_card(store)
    assert "The run is interrupted" in (text := (tmp_path / FILE).read_text()) and front_matter(text)
    assert executed(ToyWork(), refs(3), ["human"], 1, store).exit_code == COMPLETE
    write_card(store)
    assert "The run is complete." in (tmp_path / FILE).read_text()
    (tmp_path / "last_run.json").unlink()  # as after a kill
    assert "The run is not finished" in card(store)
    assert executed(ToyWork(), refs(3), ["human"], 1, store).exit_code == COMPLETE
    assert "The run is complete." in card(store), "though nothing was left to do"


@pytest.mark.parametrize("name", ["current_run.json", "last_run.json"])
def test_a_damaged_record_of_the_newest_run_is_no_state_of_it(tmp_path: Path, name: str) -> None:
    store = Store(tmp_path)
    executed(ToyWork(), refs(2), ["human"], 1, store)
    (tmp_path / name).write_bytes((tmp_path / name).read_bytes()[:-9])
    assert f"The run is of unknown state ({name} not readable)" in card(store)
    assert f"newest run    run status unknown: {name} not readable" in "\n".join(status_lines(store))
    state = overview(Watch(store).snapshot(), "here", time.time())["state"]
    assert name in state["word"] and not state["live"]


def test_a_run_is_shown_from_its_plan_on(tmp_path: Path) -> None:
    store = Store(tmp_path)
    with pytest.raises(Refused, match="no store at"):
        open_store(str(tmp_path))
    store.record_plan({"human": 2}, ["c0"])
    planned = open_store(str(tmp_path))
    assert "plans       1 rows" in "\n".join(status_lines(planned))
    shown = overview(Watch(planned).snapshot(), "here", time.time())
    assert (shown["planned"]["planned"], shown["planned"]["pending"], shown["counts"]["samples"]) == (2, 2, 0)


def test_files_that_no_commit_names_are_not_offered(tmp_path: Path) -> None:
    store = Store(tmp_path)
    executed(ToyWork(), refs(1), ["human"], 1, store)
    assert "configs" in front_matter(card(store))
    (path,) = store.samples.live_files()
    (tmp_path / "samples" / path).with_name("part-0.parquet").write_bytes((tmp_path / "samples" / path).read_bytes())
    text = card(store)
    assert "configs" not in front_matter(text) and "1 files under `samples` belong to no commit" in text


def test_a_readme_of_the_user_s_own_stays(out: Path, tmp_path: Path) -> None:
    store = Store(tmp_path)
    executed(ToyWork(), refs(1), ["human"], 1, store)
    (tmp_path / FILE).write_text("# Mine\n")
    assert "stays as it is" in write_card(store)
    assert (tmp_path / FILE).read_text() == "# Mine\n"


def test_the_report_command_writes_the_card_again(out: Path) -> None:
    store = Store(out)
    write_card(store)
    text = (out / FILE).read_text()
    (out / FILE).unlink()
    assert report_main([f"out={out}"]) == 0 and (out / FILE).read_text() == text


def test_no_markup_comes_out_of_data(out: Path) -> None:
    evil = "<script>alert(1)</script> | x\n---\nlicense: mit"
    store = Store(out)
    told = {"facts": {evil: evil}}
    store.location.write("report.json", json_with_checksum(told).encode())
    text = card(store)
    assert "<script" not in text and front_matter(text)["license"] == "other"
    assert [len(row) for row in table_rows(text, "How it was made")] == [2], "a bar in a cell is escaped"
