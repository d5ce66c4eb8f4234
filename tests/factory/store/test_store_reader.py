"""Reading samples: no Ray, no Hydra, little I/O; and verify, which reads everything."""

import json
import pickle
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path

import cv2
import numpy as np
import pytest

from factory.commands.table import COMMANDS, dispatch
from factory.exits import BAD_CONFIG
from factory.store.reader import SampleTable, image_of, labels_of
from factory.store.samples import Store
from factory.store.schema import LABEL_COLUMNS
from tasks.caches import json_with_checksum
from tasks.reward.label_bytes import VocabularyLabels
from tests.factory.toy import ToyWork, executed, refs, row_of, stream


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    path = tmp_path_factory.mktemp("reader") / "out"
    executed(ToyWork(), refs(3), ["recovery", "human"], 2, Store(path))
    yield path


def test_samples_are_the_same_by_place_key_iteration_and_table(out: Path) -> None:
    samples = SampleTable(out)
    assert len(samples) == len(SampleTable(out / "samples")) == 9
    by_key = {sample["attempt_id"]: sample for sample in samples}
    scores = samples.table(["stage2_score", "attempt_id"])
    for i, key in enumerate(samples.attempt_ids):
        for one in (samples[i], samples[key], by_key[key]):
            assert one["attempt_id"] == key
            assert np.array_equal(one["agent_boxes"], by_key[key]["agent_boxes"], equal_nan=True)
            assert one["stage2_score"] == scores["stage2_score"][i].as_py()
    assert samples.sample(0, ["round", "label_2hz"]).keys() == {"round", "label_2hz"}
    assert samples.schema.field("label_10hz").metadata[b"frame"] == b"ego at now"


def test_a_table_that_was_pickled_is_the_snapshot_that_was_opened(tmp_path: Path) -> None:
    def grown(n: int) -> None:
        executed(ToyWork(), refs(n), ["recovery", "human"], 2, Store(tmp_path))

    grown(1)
    table = SampleTable(tmp_path)
    expected = [table[i] for i in range(len(table))]  # files are open
    grown(3)
    assert len(SampleTable(tmp_path)) > len(table)
    there = pickle.loads(pickle.dumps(table))
    assert [repr(row) for row in map(there.sample, range(len(there)))] == [repr(row) for row in expected]
    assert tuple(there.table(["attempt_id"])["attempt_id"].to_pylist()) == table.attempt_ids


def test_the_tables_metadata_names_version_and_licences_those_of_later_commits_too(tmp_path: Path) -> None:
    for n in (1, 3):
        executed(ToyWork(), refs(n), ["recovery", "human"], 2, Store(tmp_path))
    properties = Store(tmp_path).samples.properties
    named = set(properties["factory.licences"].split("; "))
    assert named == set(SampleTable(tmp_path).table(["licence"])["licence"].to_pylist()) and len(named) > 1
    assert properties["factory.schema_version"] == "7"


def test_a_table_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=str(tmp_path)):
        SampleTable(tmp_path)
    with pytest.raises(FileNotFoundError):
        SampleTable(tmp_path / "nowhere")


@pytest.mark.parametrize("is_sealed", [True, False], ids=["sealed", "as the first versions wrote it"])
def test_tables_of_another_version_are_refused_in_one_line_and_left_as_they_are(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], is_sealed: bool
) -> None:
    executed(ToyWork(), refs(1), ["human"], 1, Store(tmp_path))
    record = {"schema_version": 4, "runs": json.loads((tmp_path / "run.json").read_text())["runs"]}
    (tmp_path / "run.json").write_text(json_with_checksum(record) if is_sealed else json.dumps(record))
    shutil.rmtree(tmp_path / "samples" / "_commits")  # a repair would make them again
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    words = ["run executor=local", "plan executor=local", "verify", "verify repair=true"]
    words += ["status", "failed", "retry", "clean", "compact", "report", "lineage sample=0", "show sample=0"]
    for command in words:
        name, *more = command.split()
        capsys.readouterr()
        where = str(tmp_path) if name == "verify" else f"out={tmp_path}"
        assert dispatch([name, where, *more], COMMANDS, "") == BAD_CONFIG, name
        (line,) = capsys.readouterr().err.splitlines()
        assert line == (
            f"error: {tmp_path}: schema_version 4, this version reads and writes 7: make the tables again, "
            "by the command that made them with another out="
        )
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_vocabulary_labels_come_back_from_the_table(out: Path) -> None:
    seen = set[tuple[float, ...]]()
    for sample in SampleTable(out).iterate((*LABEL_COLUMNS, "clip_id", "expert", "candidate_index")):
        made_by = stream(sample["clip_id"], "attempt", sample["expert"], sample["candidate_index"])
        made_by.random()  # the attempt's chance to be accepted
        wrote, labels = labels_of(row_of(made_by)), labels_of(sample, vocabulary="vocabulary-1")
        for field in fields(VocabularyLabels):
            assert np.array_equal(getattr(labels, field.name), getattr(wrote, field.name)), field.name
        seen.add(tuple(labels.pdm_score()))
    assert len(seen) == 9, "every sample has labels of its own"


def test_labels_that_cannot_be_read_say_why() -> None:
    sample = row_of(stream("labels")) | {"attempt_id": "a7"}
    with pytest.raises(ValueError, match="sample a7 has labels of vocabulary vocabulary-1, not of another"):
        labels_of(sample, vocabulary="another")
    with pytest.raises(ValueError, match=r"sample a7 has no vocabulary labels.*reward\.labels=none"):
        labels_of(sample | dict.fromkeys(LABEL_COLUMNS))
    damaged = bytearray(sample["label_progress"])  # type: ignore[arg-type]
    damaged[3] ^= 8
    with pytest.raises(ValueError, match=r"sample a7: label_progress: .*checksum"):
        labels_of(sample | {"label_progress": bytes(damaged)})


def test_the_reader_imports_neither_ray_nor_hydra_nor_torch_and_loads_no_kernels_for_labels(out: Path) -> None:
    code = (
        "import sys; from factory.store.reader import SampleTable, labels_of; labels_of(SampleTable(sys.argv[1])[0]);"
        "sys.exit(bool({'ray', 'hydra', 'torch', 'cv2', 'numba', 'shapely', 'scipy'} & set(sys.modules)))"
    )
    assert subprocess.run([sys.executable, "-c", code, str(out)], check=False).returncode == 0


def test_one_image_is_decoded_as_rgb() -> None:
    red = np.zeros((20, 30, 3), np.uint8)
    red[..., 0] = 250
    jpeg = cv2.imencode(".jpg", red[..., ::-1])[1].tobytes()
    sample = {"images": [{"camera": "front", "time_s": -0.5, "jpeg": jpeg}], "image_source": "render"}
    image = image_of(sample, "front", -0.5)
    assert image.shape == (20, 30, 3) and image[..., 0].min() > 200 and image[..., 2].max() < 50
    with pytest.raises(KeyError, match="front"):
        image_of(sample, "front", 0.0)
    with pytest.raises(KeyError, match="source none"):
        image_of({"images": None, "image_source": "none"}, "front", 0.0)
