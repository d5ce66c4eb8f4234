"""A copy changes nothing but where is read from, is made once, and again when it is damaged."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from planners.data.batch import BevLayout, Needs
from planners.data.files import LocalCopy
from planners.data.index import DataSettings, make_feed, open_data
from planners.data.loader import Loader, copies_of
from planners.data.mix import MixSettings
from tasks.world.clip import AgentKind
from tests.factory.store.test_store_s3 import s3
from tests.planners.data.test_loader import BATCH, NEEDS, assert_same, counted_reads, n_groups, out, rows, windows
from tests.planners.samples import FRONT_YAWS, jpeg, labels, pictures, plain, sample, write_table

__all__ = ["out", "s3", "windows"]


def loader(out: str, folder: Path | None, needs: Needs = NEEDS, mix: MixSettings | None = None, **more: Any) -> Loader:
    """Of one table; `more`: settings of the data."""
    settings = DataSettings(real=out, sim=out, copy=None if folder is None else str(folder), **more)
    return Loader(open_data(settings), needs, mix or MixSettings(), BATCH)


def copies(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "copy"


@pytest.mark.usefixtures("windows")
@pytest.mark.parametrize("ratio", ["natural", 0.3])
def test_batches_order_and_state_are_the_same_with_and_without(out: str, folder: Path, ratio: Any) -> None:
    mix = MixSettings(sim_ratio=ratio)
    without, with_copy = loader(out, None, mix=mix), loader(out, folder, mix=mix)
    assert without.state() == with_copy.state()
    for epoch in (0, 1):
        for a, b in zip(without.epoch(epoch), with_copy.epoch(epoch), strict=True):
            assert_same(a, b)
            assert without.state() == with_copy.state()
    stopped = loader(out, None, mix=mix)
    running = stopped.epoch(0)
    next(running), next(running)
    resumed = loader(out, folder, mix=mix)
    resumed.resume(stopped.state())
    for a, b in zip(running, resumed.epoch(0), strict=True):
        assert_same(a, b)


@pytest.mark.usefixtures("windows")
def test_rows_are_read_from_the_table_once_for_all_epochs_and_trainings(
    out: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reads = counted_reads(monkeypatch)
    for _ in range(2):
        one = loader(out, folder)
        for epoch in range(2):
            assert sum(1 for _ in one.epoch(epoch)) == 8
        assert len(reads) == n_groups(one.dataset)
    assert len(copies(folder)) == len(one.dataset.files)


def test_trainings_of_other_rows_share_the_copies(out: str, folder: Path) -> None:
    some: dict[str, Any] = {"experts": ("recovery",), "limit_sim": 12}
    for a, b in zip(loader(out, None, **some).epoch(0), loader(out, folder, **some).epoch(0), strict=True):
        assert_same(a, b)
    few = copies(folder)
    for a, b in zip(loader(out, None).epoch(0), loader(out, folder).epoch(0), strict=True):
        assert_same(a, b)
    assert few.items() < copies(folder).items() and len(copies(folder)) == len(loader(out, None).dataset.files)


def test_of_the_pictures_those_at_now_of_the_chosen_cameras_are_held(tmp_path: Path, folder: Path) -> None:
    shades = dict(zip(FRONT_YAWS, (10, 20, 30)))
    views = {name: jpeg(plain((shade, shade, shade))) for name, shade in shades.items()}
    write_table(tmp_path / "out", [sample(i, **pictures(views)) for i in range(BATCH)])
    assert NEEDS.image is not None
    front = replace(NEEDS, image=replace(NEEDS.image, cameras=("front",)), labels=None)
    data = open_data(DataSettings(real=str(tmp_path / "out"), copy=str(folder)))
    (batch,) = Loader(data, front, MixSettings(), BATCH).epoch(0)
    assert batch.image is not None and abs(float(batch.image.float().mean()) - 20.0) < 2.0
    (content,) = copies(folder).values()
    assert content.count(views["front"]) == BATCH and content.count(b"\xff\xd8\xff") == BATCH
    list(Loader(data, replace(NEEDS, labels=None), MixSettings(), BATCH).epoch(0))
    assert len(copies(folder)) == 2, "other cameras, another copy"


@pytest.mark.usefixtures("windows")
def test_a_copy_under_another_s_name_is_made_again(out: str, folder: Path) -> None:
    list(loader(out, folder).epoch(0))
    whole = copies(folder)
    for name, other in zip(whole, reversed(whole)):
        (folder / name).write_bytes(whole[other])
    assert len(whole) > 1 and copies(folder).items().isdisjoint(whole.items())
    for a, b in zip(loader(out, None).epoch(0), loader(out, folder).epoch(0), strict=True):
        assert_same(a, b)
    assert copies(folder) == whole


def test_labels_and_maps_are_copied_too(tmp_path: Path, folder: Path) -> None:
    needs = Needs(bev=BevLayout(cell_m=2.0, times_s=(0.0,)), n_agents=2, labels="vocabulary-1")
    made = sample(0)
    agents = {
        "agent_kinds": [str(AgentKind.VEHICLE)] * len(made["agent_kinds"]),
        "agent_boxes": np.nan_to_num(made["agent_boxes"], nan=1.0),
    }
    write_table(tmp_path / "out", [sample(i, **agents, **labels(i, 21)) for i in range(BATCH)])
    both = [
        Loader(open_data(DataSettings(real=str(tmp_path / "out"), copy=copy)), needs, MixSettings(), BATCH)
        for copy in (None, str(folder))
    ]
    for a, b in zip(both[0].epoch(0), both[1].epoch(0), strict=True):
        assert_same(a, b)


def test_those_who_want_the_same_copy_at_once_make_it_once(
    out: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As processes would: a lock belongs to an open file, not to a process."""
    data = open_data(DataSettings(real=out, copy=str(folder)))
    wanted = [copies_of(make_feed(data, NEEDS)) for _ in range(8)]
    reads = counted_reads(monkeypatch)

    def read(copies: dict[int, LocalCopy]) -> list[int]:
        return [copies[number].open().read_row_group(0).num_rows for number in sorted(copies)]

    with ThreadPoolExecutor(8) as pool:
        assert {tuple(counts) for counts in pool.map(read, wanted)} == {(4, 4)}
    assert len(reads) == n_groups(data)
    assert {path.suffix for path in folder.iterdir()} == {".arrow"}


def test_what_a_killed_process_left_is_written_anew(out: str, folder: Path) -> None:
    first = loader(out, folder)
    expected = list(first.epoch(0))
    whole = copies(folder)
    for name in whole:
        (folder / name).rename((folder / name).with_suffix(".draft"))
    for draft in folder.iterdir():
        draft.write_bytes(b"x" * 1000 + draft.read_bytes()[:-1000])
    for a, b in zip(expected, loader(out, folder).epoch(0), strict=True):
        assert_same(a, b)
    assert copies(folder) == whole


def test_a_damaged_copy_is_made_again_wherever_it_is_damaged(
    tmp_path: Path, folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    write_table(tmp_path / "out", rows(BATCH, 0))
    settings = DataSettings(real=str(tmp_path / "out"), copy=str(folder))
    (copy,) = copies_of(make_feed(open_data(settings), NEEDS)).values()
    expected = copy.open().read_row_group(0)
    whole = copy.path.read_bytes()
    read = len(whole) - whole.index(b"\nsha256\n")  # what stands behind the other row groups
    first = len(whole) - read - 200
    damaged = [whole[:at] + bytes([whole[at] ^ 1 << at % 8]) + whole[at + 1 :] for at in range(0, len(whole), 50)]
    damaged = [*damaged[:40], *damaged[40 :: max(1, len(damaged) // 40)], whole[:-100], whole[:first], whole[1:], b""]
    damaged += [whole[:at] + bytes([whole[at] ^ 4]) + whole[at + 1 :] for at in range(len(whole) - read, len(whole), 3)]
    for content in damaged:
        copy.path.unlink()
        copy.path.write_bytes(content)
        caplog.clear()
        groups = [copy.open().read_row_group(group) for group in range(copy.file.open().metadata.num_row_groups)]
        assert groups[0].equals(expected) and copy.path.read_bytes() == whole
        (line,) = caplog.messages
        assert line.startswith(f"{copy.path}: ") and line.endswith("it is made again")


def test_a_folder_that_cannot_be_written_is_named(out: str, folder: Path) -> None:
    folder.write_text("a file")
    with pytest.raises(OSError, match=rf"{out}.*while it was copied to {folder}"):
        list(loader(out, folder).epoch(0))
    with pytest.raises(ValueError, match=r"data\.copy=s3://bucket/x: must be a folder of this machine"):
        DataSettings(copy="s3://bucket/x")


def test_what_is_copied_is_said(out: str, folder: Path) -> None:
    one = loader(out, folder)
    n = len(one.dataset.files)
    assert f"0 of {n} files are copied to {folder}, the others when they are first read" in one.text()
    list(one.epoch(0))
    assert f"{n} of {n} files are copied to {folder}" in one.text()
    assert "copied" not in loader(out, None).text()
