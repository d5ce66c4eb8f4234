"""The vocabulary command: artefacts from train clips, and files that are refused."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from factory.commands.prepare import VocabularyRequest, build_from_logs
from factory.commands.table import COMMANDS
from factory.config.arguments import Refused, parse
from factory.config.run import VocabularyChoice
from factory.readers.base import BadClip, ClipIndex, ClipRef
from factory.setup.settings import choose_vocabulary
from factory.setup.vocabulary import (
    build_recovery_table,
    build_vocabulary,
    load_recovery_table,
    load_vocabulary,
    save_recovery_table,
    train_windows,
)
from tasks.experts.recovery import RecoveryTable
from tasks.world.clip import CLIP_STEPS, Clip
from tasks.world.vocabulary import Vocabulary, kinematic_trajectories
from tests.tasks.streets import street_clip

main = COMMANDS["vocabulary"].load()


class DriveReader:
    """Logs of 20 s on a spiral, windows every second; `splits` says which log is what."""

    name = "drives"

    def __init__(self, splits: dict[str, str], broken: Sequence[str] = ()) -> None:
        self.splits, self.broken = splits, broken

    def index(self) -> ClipIndex:
        return ClipIndex(tuple(ClipRef("drives", log, 1000 * second) for log in self.splits for second in range(10)))

    def read(self, ref: ClipRef) -> Clip:
        if ref.log_id in self.broken:
            raise BadClip("poses.feather", "tx_m", "NaN")
        t = ref.start_ms / 1000.0 + 0.1 * np.arange(CLIP_STEPS)
        states = np.zeros((CLIP_STEPS, 11))
        states[:, 0], states[:, 1], states[:, 2] = 6.0 * t + 0.1 * t**2, 0.05 * t**2, 0.02 * t
        return replace(
            street_clip(),
            clip_id=ref.clip_id,
            dataset="drives",
            log_id=ref.log_id,
            split=self.splits[ref.log_id],
            start_s=ref.start_ms / 1000.0,
            ego_states=states,
        )


def test_only_train_logs_are_read_and_every_instant_once() -> None:
    windows = train_windows(DriveReader({"a": "train", "b": "val", "c": "test"}))
    assert windows.logs == ("a",)
    # starts 0.0, 0.5 .. 14.5 s of one log: the last clip begins at 9 s and holds windows up to 5.5 s into it
    assert len(windows.trajectories) == 30
    assert len(np.unique(windows.trajectories.reshape(30, -1).round(9), axis=0)) == 30
    assert windows.clips_of_split == {"train": 10, "val": 10, "test": 10}


def test_without_a_train_log_there_is_no_vocabulary_and_it_says_so() -> None:
    windows = train_windows(DriveReader({"b": "val"}))
    with pytest.raises(ValueError, match=r"no train log, the clips are 10 val$"):
        build_vocabulary(windows, 5, 0)
    with pytest.raises(ValueError, match="needs train logs or a vocabulary file: no train log, the"):
        build_recovery_table([windows], [])
    assert len(build_recovery_table([windows], [Vocabulary(kinematic_trajectories(7, 0))])) == 7


def test_a_broken_log_is_named_and_the_others_are_used(tmp_path: Path) -> None:
    settings = VocabularyRequest(table=str(tmp_path / "t.npz"))
    lines = build_from_logs(settings, DriveReader({"a": "train", "x": "train"}, broken=["x"]))
    assert len(load_recovery_table(tmp_path / "t.npz")) == 30
    assert sum("poses.feather: tx_m: NaN" in line for line in lines) == 10


def test_both_artefacts_come_back_with_their_digests(tmp_path: Path) -> None:
    np.save(tmp_path / "human.npy", kinematic_trajectories(20, 0).astype(np.float32))
    settings = VocabularyRequest(
        out=str(tmp_path / "deep/voc.npy"),
        k=8,
        table=str(tmp_path / "table.npz"),
        vocabularies=(str(tmp_path / "human.npy"),),
    )
    reader = DriveReader({"a": "train"})
    build_from_logs(settings, reader)
    first = (tmp_path / "deep/voc.npy").read_bytes()
    vocabulary, table = load_vocabulary(tmp_path / "deep/voc.npy"), load_recovery_table(tmp_path / "table.npz")
    assert len(vocabulary) == 8
    assert len(table) == 50
    described = json.loads((tmp_path / "deep/voc.json").read_text())
    assert described["digest"] == vocabulary.digest
    assert described["train_logs"] == ["a"]
    assert json.loads((tmp_path / "table.json").read_text())["vocabularies"] == {
        "human.npy": load_vocabulary(tmp_path / "human.npy").digest
    }
    build_from_logs(settings, reader)
    assert (tmp_path / "deep/voc.npy").read_bytes() == first
    assert load_recovery_table(tmp_path / "table.npz").digest == table.digest
    assert not list(tmp_path.rglob("*.part"))


def test_a_file_with_objects_in_it_is_never_unpickled(tmp_path: Path) -> None:
    np.save(tmp_path / "evil.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
    with pytest.raises(ValueError, match=r"evil\.npy: not readable as a numpy file: Object arrays"):
        load_vocabulary(tmp_path / "evil.npy")


def test_damaged_and_foreign_files_are_refused_by_name(tmp_path: Path) -> None:
    table = RecoveryTable(kinematic_trajectories(20, 0))
    save_recovery_table(tmp_path / "t.npz", table, {})
    whole = (tmp_path / "t.npz").read_bytes()
    (tmp_path / "cut.npz").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "empty.npy").write_bytes(b"")
    np.savez(tmp_path / "swapped.npz", trajectories=table.trajectories[::-1], digest=np.array(table.digest))
    for name, load, message in (
        ("cut.npz", load_recovery_table, "not readable"),
        ("missing.npz", load_recovery_table, "not readable"),
        ("empty.npy", load_vocabulary, "not readable"),
        ("t.npz", load_vocabulary, "expected one .npy array"),
        ("swapped.npz", load_recovery_table, "build it again"),
    ):
        with pytest.raises(ValueError, match=f"{name}: .*{message}"):
            load(tmp_path / name)


def test_the_first_entries_of_a_vocabulary_can_be_asked_for(tmp_path: Path) -> None:
    np.save(tmp_path / "v.npy", kinematic_trajectories(10, 0))
    assert len(load_vocabulary(tmp_path / "v.npy", first=4)) == 4
    with pytest.raises(ValueError, match="the first 11 of 10"):
        load_vocabulary(tmp_path / "v.npy", first=11)


def test_the_command_line_separates_clips_from_its_own_settings() -> None:
    clips = ("clips=av2", "clips.root=/logs")
    found = parse(VocabularyRequest, [*clips, "k=16", "out=v.npy", "vocabularies=[a.npy,b.npy]", "every_s=0.2"])
    assert found == VocabularyRequest(out="v.npy", k=16, vocabularies=("a.npy", "b.npy"), every_s=0.2, settings=clips)
    for wrong, message in (
        (["k=3"], "nothing to build"),
        (["out=v.npz"], r"must end in \.npy"),
        (["out=v.npy", "tabel=3"], "did you mean table"),
        (["out=v.npy", "kk=3"], "kk: there is no such setting"),
        (["out=v.npy", "k=many"], "k=many: must be a whole number"),
        (["out"], "expected key=value"),
    ):
        with pytest.raises(Refused, match=message):
            parse(VocabularyRequest, wrong)


def test_the_kinematic_vocabulary_is_written_as_a_run_has_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "labels.npy"
    assert main(["kinematic=true", "k=16", f"out={file}"]) == 0
    assert load_vocabulary(file).digest == choose_vocabulary(VocabularyChoice(k=16)).digest
    assert main(["kinematic=true", "table=t.npz"]) == 2
    assert "kinematic=true makes a vocabulary" in capsys.readouterr().err
