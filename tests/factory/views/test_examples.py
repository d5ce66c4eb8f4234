"""Examples for a report: spread over a run, the same in any order and with or without the cache."""

import shutil
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from factory.config.run import load_config
from factory.setup.settings import Run, assemble
from factory.store.reader import SampleTable, decode_stored_image
from factory.store.samples import Store
from factory.views.board.gallery import Pictures
from factory.views.board.watch import Watch
from factory.views.examples import (
    PER_VALUE,
    Again,
    Row,
    few_of_each,
    rejected_examples,
    rejected_rows,
    spread,
    strips_of,
)
from factory.views.sample_picture import encoded, fitted, sample_sheet
from tests.factory.toy import ToyWork, executed, refs


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Store:
    found = Store(tmp_path_factory.mktemp("out"))
    executed(ToyWork(), refs(3), ["recovery", "human"], 2, found)
    return found


def test_examples_are_spread_and_do_not_depend_on_the_order_of_rows() -> None:
    rows = [{"id": f"{i:03d}", "reason": "nc" if i < 90 else f"r{i}", "clip": i % 7} for i in range(100)]

    def chosen(rows: list[dict[str, Any]]) -> list[str]:
        return [row["id"] for row in spread(rows, lambda r: (r["reason"], r["clip"]), lambda r: str(r["id"]))[:6]]

    first = chosen(rows)
    assert chosen(rows[::-1]) == first
    assert len({row["reason"] for row in rows if row["id"] in first}) == 6
    assert len({row["clip"] for row in rows if row["id"] in first}) == 6


def test_spread_needs_no_more_than_few_of_each() -> None:
    rows = [{"attempt_id": f"{i * 7919 % 900:03d}", "reason": f"r{i % 3}", "clip": i % 11} for i in range(900)]
    table = pa.table({name: [row[name] for row in rows] for name in rows[0]})
    table = table.set_column(1, "reason", table["reason"].dictionary_encode())

    def chosen(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
        return spread(rows, lambda r: (r["reason"], r["clip"]), lambda r: str(r["attempt_id"]))

    few = few_of_each(table, "reason")
    assert len(few) == 3 * PER_VALUE and chosen(few) == chosen(rows)


def test_rejected_rows_are_simulated_attempts_that_are_no_sample(store: Store) -> None:
    found = {row["attempt_id"]: row for row in rejected_rows(store)}
    expected = [r for r in store.outcomes.read().to_pylist() if r["kind"] == "rejected" and r["candidate_index"] >= 0]
    assert found and sorted(found) == sorted(row["attempt_id"] for row in expected)
    for row in expected:
        assert found[row["attempt_id"]].items() <= row.items()


def test_an_image_that_is_none_says_so(store: Store) -> None:
    captions = [picture.caption for strip in seen(store) for picture in strip["rows"]["now"]]
    assert captions and all(
        "not a JPEG or PNG picture" in caption for caption in captions
    )  # the toy's are random bytes


def test_a_store_without_samples_has_no_strips(tmp_path: Path) -> None:
    assert seen(Store(tmp_path)) == []


def seen(store: Store) -> list[dict[str, Any]]:
    shot = Watch(store).now()
    return strips_of(store, shot.samples, partial(Pictures(store).row, shot))


def test_a_picture_keeps_its_aspect_and_survives_coding() -> None:
    wide = np.full((100, 400, 3), (200, 40, 90), np.uint8)
    tile = fitted(wide, 200, 100)
    assert tile.shape == (100, 200, 3)
    assert (tile[30:70] == wide[0, 0]).all() and not (tile[:20] == wide[0, 0]).all()
    back = decode_stored_image({"jpeg": encoded(wide), "camera": "front", "time_s": 0.0})
    assert np.abs(back.astype(int) - wide).max() <= 4


def test_a_sample_s_sheet_holds_the_world_and_its_cameras(store: Store) -> None:
    sample = SampleTable(store.location.uri)[0]
    assert sample_sheet(sample)[:720, :720].std() > 0
    assert sample_sheet({**sample, "images": None}).shape == (720, 720 + 400, 3)


@pytest.mark.slow
def test_rejected_examples_are_the_same_with_and_without_the_cache(tmp_path: Path, shared_root: Path) -> None:
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
    executed(run.work, run.index.refs[:1], run.config.experts, 9, store)
    rows = [row for row in store.outcomes.read().to_pylist() if row["kind"] == "rejected"]
    first = drawn(store, run, rows)
    assert first and not any("not reproducible" in picture.detail for picture in first)
    shutil.rmtree(tmp_path / "cache" / "prepared")
    assert drawn(Store(tmp_path), run, rows) == first


def drawn(store: Store, run: Run, rows: list[Row]) -> list[Any]:
    known = {ref.clip_id: ref for ref in run.index.refs}
    return rejected_examples(rows, Again(store, run.work, known).picture)
