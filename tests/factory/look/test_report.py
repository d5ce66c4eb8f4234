"""The page says what the tables say, escapes whatever comes from data, and fetches nothing."""

import re
import shutil
from collections import Counter, defaultdict
from dataclasses import dataclass, replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from factory.clips.reader import ClipRef
from factory.execute import execute
from factory.look.report import FILE, RunFacts, gather, spread, write_report
from factory.look.report_page import PAPER_CLIP_PERCENT, Picture, page
from factory.look.report_plot import EndPoint, scatter
from factory.look.sample_picture import decoded, encoded, fitted, sample_sheet
from factory.store.reader import SampleTable
from factory.store.samples import Store
from factory.work import AttemptResult, Dropped, PreparedClip
from tasks.perturb import PerturbSettings
from tasks.stages import Rejected
from tests.factory.toy import ToyWork

EVIL = "<script>alert('x')</script>\"><img src=http://evil/x onerror=alert(1)>&amp;"
EXPERTS = ["recovery", "pdm_closed", "human"]
TAGS = (
    "html head meta title style body main header section details summary div span p h1 h2 h3 dl dt dd table thead "
    "tbody tr th td b i small pre figure figcaption img svg rect line path circle text"
)


@dataclass(frozen=True)
class EvilWork(ToyWork):
    """Rejects with hostile words."""

    def attempt(self, prepared: PreparedClip, candidate: int, expert: str) -> AttemptResult:
        result = super().attempt(prepared, candidate, expert)
        if isinstance(result, Dropped):
            return replace(result, rejected=Rejected("reward", f"nc{EVIL}", EVIL))
        return result


class Page(HTMLParser):
    """Tags, attributes and the cells of every table by its class."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.tags: Counter[str] = Counter()
        self.attributes: list[tuple[str, str, str]] = []
        self.tables: dict[str, list[list[str]]] = defaultdict(list)
        self.words: list[str] = []
        self._table = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags[tag] += 1
        self.attributes += [(tag, name, value or "") for name, value in attrs]
        if tag == "table":
            self._table = dict(attrs).get("class") or ""
        if tag == "tr":
            self.tables[self._table].append([])
        if tag in ("td", "th"):
            self.tables[self._table][-1].append("")

    def handle_endtag(self, tag: str) -> None:
        if tag == "table":
            self._table = ""

    def handle_data(self, data: str) -> None:
        self.words.append(data)
        if self._table and self.tables[self._table] and self.tables[self._table][-1]:
            self.tables[self._table][-1][-1] += data


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Store:
    """Seven clips of two logs with hostile names: one fails, one stands, one has no candidate, one attempt raises."""
    logs = (f"good{EVIL}", f"bad{EVIL}")
    refs = [ClipRef("toy", logs[i % 2], 1000 * i) for i in range(7)]
    trouble = {
        f"{logs[1]}:1000": "bad",
        f"{logs[0]}:2000": "standing",
        f"{logs[1]}:3000": "no_candidates",
        f"{logs[0]}:4000:recovery:1": "bug",
    }
    store = Store(tmp_path_factory.mktemp("out"))
    summary = execute(EvilWork(trouble=trouble), refs, EXPERTS, 2, store, "local", say=lambda line: None)
    assert summary.exit_code == 3
    return store


@pytest.fixture(scope="module")
def text(store: Store) -> str:
    facts = RunFacts(
        facts={f"fact{EVIL}": EVIL},
        filtered_windows={EVIL: 3},
        skipped_logs={EVIL: EVIL},
        broken_logs={EVIL: EVIL},
        settings={EVIL: EVIL},
    )
    return page(gather(store, facts, lambda row: Picture(None, row["reason"], row["detail"], "rejected"), no_log))


def no_log(clip_id: str) -> None:
    return None


def test_nothing_from_data_becomes_markup(text: str) -> None:
    found = Page(text)
    assert set(found.tags) <= set(TAGS.split())
    assert not [name for _, name, _ in found.attributes if name.startswith("on")]
    shown = "".join(found.words)
    for place in (f"good{EVIL}", f"bad{EVIL}", f"reward.nc{EVIL}", f"fact{EVIL}"):
        assert place in shown


def test_the_page_fetches_nothing(text: str) -> None:
    found = Page(text)
    links = [value for _, name, value in found.attributes if name in ("src", "href", "srcset", "action", "data")]
    assert links and all(value.startswith("data:image/jpeg;base64,") for value in links)
    style = re.search(r"<style>(.*?)</style>", text, re.S)
    assert style is not None and "url(" not in style[1] and "@import" not in style[1]


def test_the_funnel_on_the_page_counts_what_the_tables_hold(store: Store, text: str) -> None:
    rows = Page(text).tables["funnel"][1:]
    accepted = Counter((r["expert"], r["round"]) for r in store.samples.read(["expert", "round"]).to_pylist())
    assert {(r[0], int(r[1])): int(r[3]) for r in rows if int(r[3])} == accepted
    attempts = [o for o in store.outcomes.read().to_pylist() if o["expert"] and o["kind"] != "exhausted"]
    assert sum(int(r[2]) for r in rows) == len(store.samples) + len(attempts)
    for name, round_number, *_, paper in rows:
        published = PAPER_CLIP_PERCENT.get(name)
        assert paper == (f"{published[int(round_number)]} %" if published else "-")


def test_reasons_and_failures_on_the_page_are_those_of_the_outcomes(store: Store, text: str) -> None:
    tables = Page(text).tables
    outcomes = store.outcomes.read().to_pylist()
    n_rejected = sum(o["kind"] == "rejected" and bool(o["expert"]) for o in outcomes)
    counts = {row[0]: int(row[-1]) for row in tables["reasons"][1:]}
    assert counts[f"reward.nc{EVIL}"] == n_rejected > 0
    assert counts["failed.bugthe code raised"] == 1
    failed = [o for o in outcomes if o["kind"] == "failed"]
    assert sorted(row[-1] for row in tables["failed"][1:]) == sorted(o["error"] for o in failed)
    assert any("toy.feather: tx_m: holds NaN" in row[-1] for row in tables["failed"])
    assert {row[0].split("ego")[0] for row in tables["clips"][1:]} >= {["clip.", "_standing"][0]}


def test_every_candidate_has_one_mark_in_the_plot(store: Store, text: str) -> None:
    report = gather(store, RunFacts(), lambda row: None, no_log)
    listed = store.candidates.read(["clip_id", "candidates"]).to_pylist()
    taken = {
        (r["clip_id"], r["candidate_index"]) for r in store.samples.read(["clip_id", "candidate_index"]).to_pylist()
    }
    assert len(report.end_points) == sum(len(row["candidates"]) for row in listed)
    n_accepted = sum((row["clip_id"], c["index"]) in taken for row in listed for c in row["candidates"])
    assert sum(point.fate == "accepted" for point in report.end_points) == n_accepted > 0
    marks = [value for tag, name, value in Page(text).attributes if name == "class" and value.startswith("mark ")]
    in_keys = len({point.fate for point in report.end_points} | {"accepted", "rejected", "untried"})
    assert len(marks) == len(report.end_points) + in_keys


def test_a_thinned_plot_still_counts_every_candidate() -> None:
    points = [EndPoint(0.1, 0.1, (0, 0), "accepted" if i % 2 else "untried") for i in range(10)]
    assert "10 candidates, 5 accepted" in scatter(points, points[::5], PerturbSettings())


def test_the_grid_is_interleaved_and_ends_at_the_gates() -> None:
    found = Page(scatter([], [], PerturbSettings()))
    assert found.tags["rect"] == 41  # of 9 x 9 cells, those with an even sum


def test_an_image_that_is_none_says_so(text: str) -> None:
    assert "cannot be decoded" in text  # the toy's images are random bytes


def test_examples_are_spread_and_do_not_depend_on_the_order_of_rows() -> None:
    rows = [{"id": f"{i:03d}", "reason": "nc" if i < 90 else f"r{i}", "clip": i % 7} for i in range(100)]

    def chosen(rows: list[dict[str, Any]]) -> list[str]:
        return [row["id"] for row in spread(rows, lambda r: (r["reason"], r["clip"]), lambda r: str(r["id"]))[:6]]

    first = chosen(rows)
    assert chosen(rows[::-1]) == first
    assert len({row["reason"] for row in rows if row["id"] in first}) == 6
    assert len({row["clip"] for row in rows if row["id"] in first}) == 6


def test_an_empty_store_makes_a_page(tmp_path: Path) -> None:
    text = page(gather(Store(tmp_path), RunFacts(), lambda row: None, no_log))
    assert "There are no candidates." in text and "No sample of this store has images." in text


def test_the_status_is_the_newest_run_s(store: Store, text: str) -> None:
    assert "complete, with failed attempts" in text
    assert "interrupted" not in text


def test_a_picture_keeps_its_aspect_and_survives_coding() -> None:
    wide = np.full((100, 400, 3), (200, 40, 90), np.uint8)
    tile = fitted(wide, 200, 100)
    assert tile.shape == (100, 200, 3)
    assert (tile[30:70] == wide[0, 0]).all() and not (tile[:20] == wide[0, 0]).all()
    back = decoded({"jpeg": encoded(wide), "camera": "front", "time_s": 0.0})
    assert np.abs(back.astype(int) - wide).max() <= 4


def test_a_sample_s_sheet_holds_the_world_and_its_cameras(store: Store) -> None:
    sample = SampleTable(store.location.uri)[0]
    assert sample_sheet(sample)[:720, :720].std() > 0
    assert sample_sheet({**sample, "images": None}).shape == (720, 720 + 400, 3)


def test_rejected_examples_are_the_same_with_and_without_the_cache(tmp_path: Path, shared_root: Path) -> None:
    from factory.settings import assemble, load_config

    run = assemble(
        load_config(
            [
                "clips=av2",
                f"clips.root={shared_root}/data/av2/sensor/val",
                f"vocabulary.file={shared_root}/data/vocabulary/human_8192x40x3.npy",
                "vocabulary.k=512",
                "experts=[recovery]",
                "rounds=9",
                f"out={tmp_path}",
            ]
        )
    )
    store = Store(tmp_path)
    execute(run.work, run.index.refs[:1], run.config.experts, 9, store, "local", say=lambda line: None)
    line = write_report(store, run)
    first = (tmp_path / FILE).read_text()
    assert str(tmp_path / FILE) in line
    assert first.count('<figure class="rejected">') >= 1 and first.count('<figure class="accepted">') >= 1
    assert "not reproducible" not in first
    shutil.rmtree(tmp_path / "cache" / "prepared")
    write_report(Store(tmp_path), run)
    assert (tmp_path / FILE).read_text() == first
