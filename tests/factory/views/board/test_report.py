"""A run as one HTML file: the dashboard's answers inside, nothing fetched, no markup out of data."""

import json
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest

from factory.commands.table import COMMANDS
from factory.store.samples import FACTS, Store
from factory.views.board.report import FILE, N_LOOKS, N_SAMPLES, PER_EXPERT, varied_sample_ids
from tasks.caches import json_with_checksum
from tests.factory.views.board.runs import EVIL, counted, run, told

main = COMMANDS["report"].load()


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with hostile names, pictures and failures, and what it remembered for its report."""
    folder = tmp_path_factory.mktemp("run")
    run(folder, 2)
    remembered = {"facts": {EVIL: EVIL}, "left_out": {"Skipped logs": {EVIL: EVIL}}}
    (folder / FACTS).write_text(json_with_checksum(remembered))
    assert main([f"out={folder}"]) == 0
    return folder


@pytest.fixture(scope="module")
def text(out: Path) -> str:
    return (out / FILE).read_text()


class Tags(HTMLParser):
    """What is markup, outside of scripts."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))


def kept(text: str) -> dict[str, Any]:
    found = re.search(r'<script type="application/json" id="kept">(.*?)</script>', text, re.S)
    assert found is not None
    return dict(json.loads(found[1]))


@pytest.mark.slow
def test_its_numbers_are_the_tables(out: Path, text: str) -> None:
    assert told(kept(text)["answers"]["/api/overview"]) == counted(out)


def test_it_holds_the_answers_to_what_its_pages_ask(out: Path, text: str) -> None:
    answers, pictures = kept(text)["answers"], kept(text)["pictures"]
    looks, shown = answers[f"/api/samples?size={N_LOOKS}&simulated=1"], answers["/api/samples"]
    ids = [item["attempt_id"] for item in shown["items"]]
    assert shown["total"] == len(Store(out).samples) and len(ids) == min(N_SAMPLES, shown["total"])
    assert {item["attempt_id"] for item in looks["items"]} <= set(ids)
    for attempt_id in ids:
        whole = answers[f"/api/samples/{attempt_id}"]
        assert {whole["newer"], whole["older"]} <= {*ids, None}
        named = [f"{attempt_id}/{image['index']}.jpg" for image in whole["images"]]
        assert named and set(named) | {f"{attempt_id}/bev.jpg", f"{attempt_id}/front.jpg"} <= set(pictures)
        assert all(image["time_s"] == 0.0 for image in whole["images"])
    assert answers["/api/failed?page=1"]["total"] == counted(out)["failed"] > 0


def test_it_fetches_nothing_and_data_is_no_markup(text: str) -> None:
    found = Tags(text).found
    links = [(tag, attrs) for tag, attrs in found if {"src", "href", "srcset", "action"} & set(attrs)]
    assert all(str(attrs["href"]).startswith("#") for _, attrs in links), links
    assert [tag for tag, _ in found if tag in ("img", "link", "iframe")] == []
    policy = next(attrs["content"] for tag, attrs in found if attrs.get("http-equiv") == "Content-Security-Policy")
    assert policy is not None and "default-src 'none'" in policy and "connect-src" not in policy
    style = re.search(r"<style>(.*?)</style>", text, re.S)
    assert style is not None and "url(" not in style[1] and "@import" not in style[1]
    assert EVIL not in text and text.count("<script") == 3


def test_its_samples_are_spread_and_do_not_depend_on_the_order_of_rows() -> None:
    rows = [
        {"attempt_id": f"{i:03d}", "expert": f"e{i % 2}", "clip_id": f"c{i % 7}", "round": i % 3} for i in range(900)
    ]

    def chosen(rows: list[dict[str, Any]]) -> list[str]:
        table = pa.table({name: [row[name] for row in rows] for name in rows[0]})
        return varied_sample_ids(table.set_column(1, "expert", table["expert"].dictionary_encode()))

    first = chosen(rows)
    assert chosen(rows[::-1]) == first == chosen(rows[: 2 * PER_EXPERT])
    seen = [rows[int(attempt_id)] for attempt_id in first[:7]]
    assert len({row["clip_id"] for row in seen}) == 7 and len({(row["expert"], row["round"]) for row in seen}) == 6


@pytest.mark.slow
def test_it_goes_where_it_is_asked_to_and_says_what_is_missing(
    out: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([f"out={out}", f"to={tmp_path / 'sent.html'}"]) == 0
    assert capsys.readouterr().out.strip() == str(tmp_path / "sent.html")
    answers = kept((tmp_path / "sent.html").read_text())["answers"]
    assert told(answers["/api/overview"]) == counted(out)
    for bad, said in ((f"out={tmp_path}", "no store at"), ("outt=x", "outt"), (f"out={out} to={tmp_path}", "to=")):
        assert main(bad.split()) == 2
        assert said in capsys.readouterr().err


def test_a_run_without_samples_has_a_report(tmp_path: Path) -> None:
    Store(tmp_path).begin_run([])
    assert main([f"out={tmp_path}"]) == 0
    assert kept((tmp_path / FILE).read_text())["answers"]["/api/samples"]["items"] == []
