"""Samples for any training loop: as the table has them and planners take them, once each, whatever reads them."""

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import distributed
from torch.testing._internal.distributed.fake_pg import FakeStore
from torch.utils.data import DataLoader, Subset

from factory.store.reader import SampleTable, image_of
from factory.store.schema import COLUMNS, SCHEMA
from planners import SampleDataset
from planners.data.batch import ImageLayout, Needs
from planners.data.index import DataSettings, open_data
from planners.data.loader import Loader
from planners.data.mix import MixSettings
from tests.factory.installs import REPOSITORY, SMALL, as_if_installed
from tests.planners.samples import grey_pictures, labels, sample, write_table

LAYOUT = ImageLayout(width=48, height=12)
RAGGED = ["agent_boxes", "lane_polygons", "light_states", "agent_heights"]
LABELLED = ["label_subscores", "label_progress", "label_vocabulary", "label_traffic", "label_reference_progress_m"]


def row(number: int) -> dict[str, Any]:
    """Of 0, 1, 2 ... agents and lanes, lanes of 1, 2 ... points; without labels where the number is even."""
    n = number % 4
    rng = np.random.default_rng(number)
    own = {
        "agent_boxes": rng.uniform(1, 9, (n, 56, 5)).astype(np.float32),
        "agent_heights": np.arange(1, n + 1, dtype=np.float32),
        "lane_polygons": [rng.uniform(1, 9, (points + 1, 2)).astype(np.float32) for points in range(n)],
        "light_states": np.full((n, 56), 3, np.int8),
    }
    given = labels(number, 21) if number % 2 else dict.fromkeys(LABELLED)
    return sample(number, "human" if number % 3 else "recovery", **own, **grey_pictures(5 * number), **given)


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("dataset") / "out"
    write_table(path, [row(number) for number in range(41)], shard_rows=9, group_rows=4)
    return path


def numbers(samples: Any) -> list[int]:
    return [int(one["attempt_id"].removeprefix("attempt")) for one in samples]


@pytest.mark.filterwarnings("error")
def test_a_sample_has_what_the_table_has_in_tensors_that_can_be_written_to(out: Path) -> None:
    table, data = SampleTable(out), SampleDataset(out, ["status", *SCHEMA.names], ["left"])
    assert len(data) == len(table) == 41 and data["attempt00003"]["attempt_id"] == "attempt00003"
    for i in (0, 3):
        stored, one = table[i], data[i]
        one["status"] += 1.0
        assert torch.equal(one["image"].pop("left"), torch.tensor(image_of(stored, "left", 0.0)).permute(2, 0, 1))
        for name in set(SCHEMA.names) - {"command", "cameras", "images"}:
            tensors = one[name] if isinstance(one[name], list) else [one[name]]
            values = stored[name] if isinstance(stored[name], list) else [stored[name]]
            for tensor, value in zip(tensors, values, strict=True):
                if isinstance(tensor, torch.Tensor):
                    expected = np.full(COLUMNS[name].shape, np.nan) if value is None else value
                    np.testing.assert_array_equal(tensor.numpy(), expected, name)
                    assert str(tensor.dtype) == f"torch.{COLUMNS[name].dtype}", name
                    tensor.zero_()
                else:
                    assert tensor == value, name
        assert one["cameras"][0]["intrinsics"].tolist() == stored["cameras"][0]["intrinsics"].tolist()
        assert data[i]["label_2hz"].any(), "the next reading is not what was written to"


def test_command_status_and_picture_are_those_that_planners_are_given(out: Path) -> None:
    data = SampleDataset(out, ["attempt_id", "status", "command"], LAYOUT)
    given = open_data(DataSettings(real=str(out), sim=str(out)))
    (batch,) = Loader(given, Needs(image=LAYOUT), MixSettings(), batch_size=41).epoch(0)
    ours = data.collate([data[key] for key in batch.attempt_ids])
    assert torch.equal(ours["status"], batch.status) and torch.equal(ours["command"], batch.status[:, :4])
    assert batch.image is not None and torch.equal(ours["image"], batch.image)


def test_ragged_columns_are_padded_and_masked(out: Path) -> None:
    data = SampleDataset(out, [*RAGGED, "agent_ids", "vocabulary_index"])
    samples = [data[i] | {"own": i} for i in (1, 3, 0, 2)]
    batch = data.collate(samples)
    assert batch["own"].tolist() == [1, 3, 0, 2] and isinstance(batch["vocabulary_index"], list)
    assert batch["agent_ids"] == [one["agent_ids"] for one in samples]
    assert batch["agent_heights"].tolist() == [[1, 0, 0], [1, 2, 3], [0, 0, 0], [1, 2, 0]]
    assert batch["agent_boxes"].shape == (4, 3, 56, 5) and batch["light_states"].dtype == torch.int8
    assert batch["lane_polygons"].shape == (4, 3, 3, 2)
    assert batch["lane_polygons_mask"][3].tolist() == [[True, False, False], [True, True, False], [False] * 3]
    for name in RAGGED:
        whole, mask = batch[name], batch[f"{name}_mask"]
        for i, one in enumerate(samples):
            flat = torch.cat(list(one[name])) if isinstance(one[name], list) and one[name] else one[name]
            assert torch.equal(whole[i][mask[i]], flat) if len(flat) else not mask[i].any()
        assert not whole[~mask].any()
    without = data.collate([data[0], data[4]])
    assert without["lane_polygons"].shape == (2, 0, 0, 2) and without["agent_boxes"].shape == (2, 0, 56, 5)


@pytest.mark.slow
@pytest.mark.parametrize("start", ["fork", "spawn", "forkserver"])
def test_workers_read_the_snapshot_that_was_opened_however_they_start(start: Any, tmp_path: Path) -> None:
    write_table(tmp_path, [row(number) for number in range(9)])
    data = SampleDataset(tmp_path, ["status", "lane_polygons", "attempt_id"], LAYOUT)
    here = data.collate([data[8], data[0]])  # files are open
    write_table(tmp_path, [sample(99)])
    assert len(SampleTable(tmp_path)) == 10 and len(data) == 9
    (there,) = DataLoader(Subset(data, [8, 0]), 2, False, None, None, 1, data.collate, multiprocessing_context=start)
    assert repr(there) == repr(here) and torch.equal(there["image"], here["image"])


@pytest.mark.slow
@pytest.mark.parametrize("start", ["fork", "spawn"])
def test_workers_share_a_ranks_part_of_each_epoch_however_they_start(start: Any, out: Path) -> None:
    with a_rank(1, 2):
        stream = SampleDataset(out, ["attempt_id"]).stream(seed=3)
        how = {"num_workers": 2, "multiprocessing_context": start, "persistent_workers": True}
        loader = DataLoader(stream, collate_fn=list, **how)
        for epoch in (0, 1):
            stream.set_epoch(epoch)
            ids, here = numbers(one for (one,) in loader), numbers(stream)
            assert ids[::2] + ids[1::2] == here and len(here) == 20  # workers take turns


@contextmanager
def a_rank(rank: int, world: int) -> Iterator[None]:
    """Inside, this process is one of several, as torch.distributed tells; they do not talk to each other."""
    distributed.init_process_group("fake", rank=rank, world_size=world, store=FakeStore())
    try:
        yield
    finally:
        distributed.destroy_process_group()


def test_a_stream_gives_every_sample_once_and_ranks_as_many(out: Path) -> None:
    data = SampleDataset(out, ["attempt_id"])
    assert numbers(data.stream()) == numbers(SampleTable(out).iterate(["attempt_id"]))
    for world, seed in ((1, 0), (2, None), (3, 5), (16, 5)):
        found = []
        for rank in range(world):
            with a_rank(rank, world):
                found.append(numbers(data.stream(seed)))
        assert {len(part) for part in found} == {41 // world}
        together = [number for part in found for number in part]
        assert len(set(together)) == len(together) >= 41 - world
        assert found[-1] == numbers(data.stream(seed, rank=world - 1, world=world))
    with a_rank(1, 2):
        assert len(list(data.stream(rank=0, world=1))) == 41


def test_the_seed_and_the_epoch_give_a_streams_order(out: Path) -> None:
    data = SampleDataset(out, ["attempt_id"])
    stream, again, other = data.stream(0), data.stream(0), data.stream(1)
    first = numbers(stream)
    stream.set_epoch(1)
    orders = {tuple(order) for order in (first, numbers(stream), numbers(other), numbers(data.stream()))}
    assert numbers(again) == first and len(orders) == 4
    assert all(sorted(order) == list(range(41)) for order in orders)


def test_what_cannot_be_had_is_said_in_one_sentence(out: Path, tmp_path: Path) -> None:
    for wrong, said in (
        ({"columns": ["label_2hz", "labels"]}, "columns: .*out has no column labels"),
        ({"columns": "statuss"}, r"columns: .* has no column statuss; did you mean status\?"),
        ({"pictures": ["front", "back"]}, "pictures: sample attempt00000: no image of camera 'back' at 0.0 s; there"),
        ({"pictures": replace(LAYOUT, cameras=("back",))}, "pictures: sample attempt00000: no camera back"),
    ):
        with pytest.raises(ValueError, match=said):
            SampleDataset(out, **wrong)
    write_table(tmp_path, [row(0), sample(1)])
    with pytest.raises(ValueError, match=r"pictures: 1 of 2 samples of .* have none .*: make the table with render="):
        SampleDataset(tmp_path, pictures=["front"])
    with pytest.raises(FileNotFoundError, match="no table of samples"):
        SampleDataset(tmp_path / "nowhere")
    with pytest.raises(ValueError, match="rank=2, world=2"):
        SampleDataset(out).stream(rank=2, world=2)


def test_planners_alone_import_no_pytorch_and_without_it_say_so(tmp_path: Path) -> None:
    def ran(code: str, path: str) -> subprocess.CompletedProcess[str]:
        env = os.environ | {"PYTHONPATH": path}
        return subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, check=False)

    assert ran("import sys, planners; sys.exit('torch' in sys.modules)", str(REPOSITORY)).returncode == 0
    without = ran("from planners import SampleDataset", f"{as_if_installed(SMALL, tmp_path)}{os.pathsep}{REPOSITORY}")
    assert without.stderr.splitlines()[-1].startswith("ModuleNotFoundError: planners need PyTorch: pip install")
