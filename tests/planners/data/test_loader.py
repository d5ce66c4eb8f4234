"""Batches: the same whatever reads them, equal shares for ranks, resumed exactly; what is wrong is named."""

import json
import pickle
import threading
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch

from planners.data.batch import Batch, ImageLayout, Needs
from planners.data.files import SampleFile
from planners.data.index import Dataset, DataSettings, open_data
from planners.data.loader import Loader
from planners.data.mix import MixSettings, make_order
from tests.factory.store.test_store_s3 import BUCKET, s3
from tests.planners.samples import FRONT_YAWS, grey_pictures, labels, pictures, sample, write_table

__all__ = ["s3"]

PICTURE = ImageLayout(width=48, height=12)
NEEDS = Needs(image=PICTURE, labels="vocabulary-1")
BATCH = 8


def rows(n_real: int = 20, n_sim: int = 44) -> list[dict[str, Any]]:
    """Real and simulated samples whose pictures are of the grey 3 x number."""
    found = [sample(i, **grey_pictures(3 * i)) for i in range(n_real)]
    for i in range(n_real, n_real + n_sim):
        found.append(sample(i, "recovery" if i % 2 else "pdm_closed", i % 3, **grey_pictures(3 * i)))
    return found


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("loader") / "out"
    write_table(path, rows(), shard_rows=10, group_rows=4)
    return str(path)


def opened(out: str) -> Dataset:
    return open_data(DataSettings(real=out, sim=out))


@pytest.fixture(scope="module")
def data(out: str) -> Dataset:
    return opened(out)


def small_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every loader made from here on has windows of about ten samples, and reads them anew."""

    def tiny(samples: Any, mix: MixSettings, batch_size: int, seed: int) -> Any:
        large = type(samples)(samples.simulated, samples.group, samples.size * 0 + 2**19 // 10)
        return make_order(large, MixSettings(mix.sim_ratio, mix.imitation, 1), batch_size, seed)

    monkeypatch.setattr("planners.data.loader.make_order", tiny)


@pytest.fixture(params=["in memory", "in windows"])
def windows(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if request.param == "in windows":
        small_windows(monkeypatch)


def numbers(batch: Batch) -> list[int]:
    return [int(key.removeprefix("attempt")) for key in batch.attempt_ids]


def assert_same(a: Batch, b: Batch) -> None:
    """To the byte."""
    assert a.attempt_ids == b.attempt_ids
    for field in fields(Batch)[1:]:
        one, other = getattr(a, field.name), getattr(b, field.name)
        if isinstance(one, torch.Tensor):
            assert torch.equal(one, other) and one.dtype == other.dtype, field.name
        elif one is not None:
            assert all(torch.equal(one[name], other[name]) for name in {*one, *other}), field.name


def joined(parts: list[Batch]) -> Batch:
    """The batches of all ranks as one."""
    ids = tuple(key for part in parts for key in part.attempt_ids)
    tensors: dict[str, Any] = {}
    for field in fields(Batch)[1:]:
        values = [getattr(part, field.name) for part in parts]
        if isinstance(values[0], torch.Tensor):
            tensors[field.name] = torch.cat(values)
        elif values[0] is not None:
            tensors[field.name] = {name: torch.cat([value[name] for value in values]) for name in values[0]}
    return Batch(attempt_ids=ids, **tensors)


@pytest.mark.slow
@pytest.mark.usefixtures("windows")
@pytest.mark.parametrize("ratio", ["natural", 0.3])
def test_any_number_of_workers_and_ranks_reads_the_same_batches(data: Dataset, ratio: Any) -> None:
    mix = MixSettings(sim_ratio=ratio)
    for epoch in (0, 1):
        expected = list(Loader(data, NEEDS, mix, BATCH, workers=1).epoch(epoch))
        assert len(expected) == Loader(data, NEEDS, mix, BATCH).n_batches(epoch) > 2
        for workers in (2, 4):
            for a, b in zip(expected, Loader(data, NEEDS, mix, BATCH, workers=workers).epoch(epoch), strict=True):
                assert_same(a, b)
        ranks = [Loader(data, NEEDS, mix, BATCH, rank, 2, workers=1 + rank).epoch(epoch) for rank in (0, 1)]
        for whole, *parts in zip(expected, *ranks, strict=True):
            assert_same(whole, joined(parts))


@pytest.mark.usefixtures("windows")
def test_every_sample_comes_with_what_is_its_own(data: Dataset) -> None:
    seen = []
    for batch in Loader(data, NEEDS, MixSettings(imitation="real"), BATCH).epoch(0):
        assert batch.status[:, 4].int().tolist() == numbers(batch)
        assert batch.image is not None and batch.image.shape == (BATCH, 3, 12, 48)
        grey = 3.0 * torch.tensor(numbers(batch))
        assert (batch.image.float().mean(dim=(1, 2, 3)) - grey).abs().max() < 2.0
        assert batch.simulated.tolist() == [number >= 20 for number in numbers(batch)]
        assert torch.equal(batch.imitate, ~batch.simulated)
        seen += numbers(batch)
    assert sorted(seen) == list(range(64))


@pytest.mark.parametrize(("imitation", "real", "simulated"), [("all", 1, 1), ("real", 1, 0), ("none", 0, 0)])
def test_which_plans_are_labels_is_a_setting(data: Dataset, imitation: Any, real: int, simulated: int) -> None:
    batch = next(Loader(data, Needs(), MixSettings(imitation=imitation), 64, workers=1).epoch(0))
    assert batch.image is None and batch.labels is None
    assert (batch.imitate == torch.where(batch.simulated, simulated, real).bool()).all()


@pytest.mark.usefixtures("windows")
def test_a_resumed_loader_goes_on_to_the_byte(data: Dataset) -> None:
    mix = MixSettings(sim_ratio=0.5)
    n = Loader(data, NEEDS, mix, BATCH).n_batches(0)
    for stop in (1, n):
        first = Loader(data, NEEDS, mix, BATCH)
        running = first.epoch(0)
        for _ in range(stop):
            next(running)
        state = json.loads(json.dumps(first.state()))
        running.close()  # type: ignore[attr-defined]
        expected = [batch for epoch in (0, 1) for batch in Loader(data, NEEDS, mix, BATCH).epoch(epoch)][stop:]
        second = Loader(data, NEEDS, mix, BATCH, workers=1)
        second.resume(state)
        assert (second.state()["epoch"], second.state()["batch"]) == divmod(stop, n)
        rest = [batch for epoch in range(state["epoch"], 2) for batch in second.epoch(epoch)]
        for a, b in zip(expected, rest, strict=True):
            assert_same(a, b)
        assert second.state()["epoch"] == 2


def test_a_resume_with_other_data_or_settings_is_refused_by_name(data: Dataset, out: str) -> None:
    state = Loader(data, Needs(), MixSettings(), BATCH).state()
    for other, message in (
        (Loader(data, Needs(), MixSettings(sim_ratio=0.5), BATCH), r"mix\.sim_ratio: natural -> 0\.5"),
        (Loader(data, Needs(), MixSettings(), 16), "batch_size: 8 -> 16"),
        (Loader(data, Needs(), MixSettings(), BATCH, seed=1), "seed: 0 -> 1"),
        (Loader(open_data(DataSettings(real=out)), Needs(), MixSettings(), BATCH), "64 then, 20 now"),
    ):
        with pytest.raises(ValueError, match=message):
            other.resume(state)
    with pytest.raises(ValueError, match="state of version 0"):
        Loader(data, Needs(), MixSettings(), BATCH).resume(state | {"version": 0})
    resumed = Loader(data, Needs(), MixSettings(), BATCH)
    resumed.resume(state | {"epoch": 3, "batch": 1})
    with pytest.raises(ValueError, match="resumed in epoch 3, not 0"):
        resumed.epoch(0)


def test_batches_that_do_not_divide_are_refused(data: Dataset) -> None:
    with pytest.raises(ValueError, match="9 samples does not divide among 2 processes"):
        Loader(data, Needs(), MixSettings(), 9, 0, 2)
    with pytest.raises(ValueError, match="64 samples are less than one batch of 66"):
        Loader(data, Needs(), MixSettings(), 66)


def counted_reads(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """A list that grows by one for every row group that is read."""
    reads: list[int] = []
    opening = SampleFile.open

    def watched(file: SampleFile, check_pages: bool = True) -> pq.ParquetFile:
        parquet = opening(file, check_pages)
        reading = parquet.read_row_group
        parquet.read_row_group = lambda group, **how: (reads.append(group), reading(group, **how))[1]
        return parquet

    monkeypatch.setattr(SampleFile, "open", watched)
    return reads


def n_groups(data: Dataset) -> int:
    return len(np.unique(np.stack([data.rows.file, data.rows.group]), axis=1).T)


def test_a_loader_that_was_read_goes_to_another_process_and_reads_the_same_there(data: Dataset) -> None:
    loader = Loader(data, NEEDS, MixSettings(), BATCH)
    read = [numbers(batch) for batch in loader.epoch(0)]
    assert [numbers(batch) for batch in pickle.loads(pickle.dumps(loader)).epoch(0)] == read


def test_a_loader_that_is_left_leaves_no_thread_behind(data: Dataset) -> None:
    before = threading.active_count()
    loader = Loader(data, NEEDS, MixSettings(), BATCH)
    running = loader.epoch(0)
    next(running)
    assert threading.active_count() > before
    running.close()  # type: ignore[attr-defined]
    assert threading.active_count() == before
    assert len(list(loader.epoch(0))) == 8, "it can be asked again, from the start"


def test_a_picture_that_cannot_be_decoded_is_named_with_its_table(tmp_path: Path) -> None:
    views = dict.fromkeys(FRONT_YAWS, b"no picture")
    write_table(tmp_path, [sample(i, **(pictures(views) if i == 5 else grey_pictures(9))) for i in range(8)])
    data = open_data(DataSettings(real=str(tmp_path)))
    with pytest.raises(ValueError, match=rf"{tmp_path}: sample attempt00005: .*not a JPEG"):
        list(Loader(data, NEEDS, MixSettings(), 8, workers=2).epoch(0))


def test_damaged_labels_are_named(tmp_path: Path) -> None:
    write_table(tmp_path, [sample(i, **(labels(i, 20) | {"label_progress": bytes(44)})) for i in range(2)])
    data = open_data(DataSettings(real=str(tmp_path)))
    with pytest.raises(ValueError, match=rf"{tmp_path}: sample attempt0000.*checksum"):
        list(Loader(data, Needs(labels="vocabulary-1"), MixSettings(), 2).epoch(0))


def test_what_is_seen_is_said_in_plain_lines(data: Dataset) -> None:
    text = Loader(data, Needs(), MixSettings(sim_ratio=0.8, imitation="real"), BATCH).text()
    for line in (
        "real: 20 samples of 20 clips",
        "simulated: 44 samples of 44 clips",
        "an epoch is a pass over the 20 real samples: 12 batches of 8, 0.8 of every batch are simulated",
        "and 76 times a simulated one, 1.73 passes over 44 samples",
        "plans to imitate: real",
    ):
        assert line in text, text
    assert "a pass over all 64 samples: 8 batches of 8" in Loader(data, Needs(), MixSettings(), BATCH).text()


@pytest.mark.slow
def test_tables_in_a_bucket_and_on_disk_are_mixed(
    s3: Iterator[dict[str, str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from factory.store.location import Location

    options: Any = s3
    url = f"s3://{BUCKET}/loader/out"
    both = rows(6, 10)
    write_table(Location.parse(url, options), both[6:], shard_rows=4, group_rows=2)
    write_table(tmp_path, both[:6])
    data = open_data(DataSettings(real=str(tmp_path), sim=url, storage_options=options))
    reads = counted_reads(monkeypatch)
    loader = Loader(data, NEEDS, MixSettings(), 16)
    for epoch in range(2):
        (batch,) = loader.epoch(epoch)
        assert sorted(numbers(batch)) == list(range(16))
        assert batch.status[:, 4].int().tolist() == numbers(batch)
    assert len(reads) == n_groups(data), "once"
