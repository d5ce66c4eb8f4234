"""In a real browser: the numbers on the page are the tables', pictures load, the console stays empty."""

import re
import shutil
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from factory.commands.table import COMMANDS
from factory.store.samples import Store
from factory.views.board.server import Answer, Board, Server
from factory.views.pictures import BEV_LEGEND
from tests.factory.views.board.runs import EVIL, counted, run

report_main = COMMANDS["report"].load()

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium on the PATH"),
]
Dump = Callable[..., str]
COUNTED = ("samples", "clips", "failed")
SAY = """new MutationObserver(() => (document.body.dataset.said += ` ${document.querySelector("output")?.textContent}`))
  .observe(document.body, { subtree: true, childList: true })"""


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    run(folder, 1)
    return folder


@pytest.fixture(scope="module")
def dump(out: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Dump]:
    """Address -> the page's elements once it has come to rest; a word on the console fails."""
    profile = tmp_path_factory.mktemp("profile")
    with Server(Board(Store(out), look_every_s=0.0), "127.0.0.1", 0) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()

        def dumped(address: str, width: int = 1440, at: str = "") -> str:
            base = at or f"http://127.0.0.1:{server.server_address[1]}/"
            command = [
                str(CHROMIUM),
                "--headless=new",
                "--no-sandbox",
                "--disable-gpu",
                "--enable-logging=stderr",
                f"--user-data-dir={profile}",
                f"--window-size={width},6000",
                "--virtual-time-budget=10000",
                "--dump-dom",
                f"{base}{address}",
            ]
            done = subprocess.run(command, capture_output=True, text=True, timeout=200)
            assert "CONSOLE" not in done.stderr, done.stderr
            assert "data-ready" in done.stdout, done.stdout
            return done.stdout

        yield dumped
        server.shutdown()


def tiles(page: str) -> dict[str, str]:
    return dict(re.findall(r'data-count="(\w+)"[^>]*><b>([^<]*)</b>', page))


def test_the_overview_shows_the_tables_also_after_more_was_committed(out: Path, dump: Dump) -> None:
    for rounds in (1, 2):
        run(out, rounds)
        page, wanted = dump("#/"), counted(out)
        shown = tiles(page)
        assert {name: int(shown[name]) for name in COUNTED} == {name: wanted[name] for name in COUNTED}
        totals = re.findall(r'data-reason="([^"]*)".*?</tr>', page)
        assert set(totals) == set(wanted["reasons"])
        head = r'<tr><th scope="row">(\w+)(?:<small>[^<]*</small>)?</th>'
        rows = re.findall(head + 3 * r'<td class="n(?: roomy)?">(\d+)</td>', page)
        accepted = {(expert, int(number)): int(n) for expert, number, _, n in rows if int(n)}
        assert accepted == wanted["accepted"]
        simulated = min(6, wanted["simulated"])
        assert page.count("data-loaded") == 2 * simulated and "no picture" not in page


@pytest.mark.parametrize("width", [390, 1280])
def test_what_is_asked_first_stands_first_and_details_are_folded(out: Path, dump: Dump, width: int) -> None:
    page = dump("#/", width)
    titles = re.findall(r"<h2>([^<]*)</h2>", page)
    assert titles[:3] == ["Accepted", "Why the rest was not", "What it looks like"]
    assert page.rindex("<section>") < page.index("<details") and "<details open" not in page
    rows = [re.sub(r"<th.*?</th>", "", row) for row in re.findall(r"<tr.*?</tr>", page)]
    said = [re.findall(r">([^<>]+)<", row) for row in rows]
    assert [row for row in said if row and all(re.fullmatch(r"0|0\.0\s%|0 s|-", text) for text in row)] == []
    legend = re.findall(r'<i class="key" style="background: ([^;]*);"></i>([^<]*)', page)
    assert {name: tuple(map(int, re.findall(r"\d+", rgb))) for rgb, name in legend} == BEV_LEGEND
    drawn = set(re.findall(r'class="(tried|made|untried-cell|accepted-cell)"', page))
    assert drawn and drawn <= set(re.findall(r'<i class="key ([\w-]+)"', page))
    assert ("paper" in re.findall(r'<i class="key ([\w-]+)"', page)) or 'title="paper' not in page


def test_the_player_says_that_its_picture_loads(out: Path, tmp_path: Path) -> None:
    class SlowBoard(Board):
        def answer(self, target: str) -> Answer:
            time.sleep(2.0 if "bev.jpg" in target else 0.0)
            found = super().answer(target)
            waits = found.body.replace(b"<main", b"<img src=/picture/x/bev.jpg><main")  # as the browser does for it
            return replace(found, body=waits + SAY.encode() if target == "/static/app.js" else waits)

    shown = Store(out).samples.read(["attempt_id"])["attempt_id"][0]
    with Server(SlowBoard(Store(out)), "127.0.0.1", 0) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        address = f"http://127.0.0.1:{server.server_address[1]}/#/sample/{shown}"
        options = ["--headless=new", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path}", "--dump-dom"]
        page = subprocess.run([str(CHROMIUM), *options, address], capture_output=True, text=True, timeout=200).stdout
        server.shutdown()
    assert re.search(r'data-said="[^"]*0\.0 s: loading[^"]*"', page) and "<output>0.0 s: now</output>" in page


def test_the_gallery_and_a_sample_show_their_pictures_and_nothing_from_data_is_markup(out: Path, dump: Dump) -> None:
    run(out, 2)
    page = dump("#/gallery?expert=recovery")
    ids = re.findall(r'data-id="(\w+)"', page)
    rows = Store(out).samples.read(["attempt_id", "clip_id", "expert"]).to_pylist()
    wanted = [row for row in rows if row["expert"] == "recovery"]
    assert sorted(ids) == sorted(r["attempt_id"] for r in wanted)
    assert page.count("data-loaded") == 2 * len(ids)
    fell = {o["clip_id"] for o in Store(out).outcomes.read().to_pylist() if o["expert"] == "recovery" and o["reason"]}
    shown = next(r["attempt_id"] for r in wanted if r["clip_id"] in fell)
    page = dump(f"#/sample/{shown}")
    assert page.count("data-loaded") == len(Store(out).samples.read(["images"])["images"][0])
    assert 'data-score="nc"' in page and 'data-kind="rejected"' in page
    assert EVIL not in dump("#/failed") and "a bug in a stage" in dump("#/failed")


def test_a_report_is_the_same_page_in_one_file(out: Path, dump: Dump) -> None:
    run(out, 2)
    assert report_main([f"out={out}"]) == 0
    at, wanted = f"file://{out / 'report.html'}", counted(out)
    page = dump("#/", at=at)
    shown = tiles(page)
    assert {name: int(shown[name]) for name in COUNTED} == {name: wanted[name] for name in COUNTED}
    assert page.count("data-loaded") == 2 * min(6, wanted["simulated"]) and "no picture" not in page
    page = dump("#/gallery", at=at)
    ids = re.findall(r'data-id="(\w+)"', page)
    assert ids and page.count("data-loaded") == 2 * len(ids)
    assert 'data-score="nc"' in dump(f"#/sample/{ids[0]}", at=at)
    assert "a bug in a stage" in dump("#/failed", at=at)


def test_a_wrong_address_says_so(dump: Dump) -> None:
    assert "there is no page nowhere" in dump("#/nowhere")
