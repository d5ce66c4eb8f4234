"""Illness of the machine: a result that cannot be kept is still a result, and no clip is blamed for a disk."""

import errno
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from factory.exits import COMPLETE, COMPLETE_WITH_FAILURES, INTERRUPTED
from factory.files import PlaceRefused, machine_fault_of, raising_place_refused, why_not_written
from factory.graph.steps import AcceptedDrive, PreparedClip, RejectedAttempt, failure_from_error
from factory.store.samples import ErrorKind
from tests.factory.graph.runs import run
from tests.factory.tables import assert_same_tables, tables_of
from tests.factory.toy import ToyWork


def failed_in(out: Path) -> list[tuple[str, int]]:
    """Kind of error and runs that count, of every failed row."""
    return [(o["error_kind"], o["tries"]) for o in tables_of(out)[1] if o["kind"] == "failed"]  # type: ignore[index]


@dataclass(frozen=True)
class IllWork(ToyWork):
    """Drives of these clips find the machine ill."""

    ill: tuple[str, ...] = ()  # starts of the names of attempts, as the toy's journal has them
    number: int = errno.EIO

    def drive(self, prepared: PreparedClip, candidate: int, expert: str) -> AcceptedDrive | RejectedAttempt:
        name = f"{prepared.payload['name']}:{expert}:{candidate}"  # type: ignore[index]
        if name.startswith(self.ill):
            raise OSError(self.number, os.strerror(self.number), "/mnt/share/log")
        return super().drive(prepared, candidate, expert)


def test_a_result_that_cannot_be_kept_is_still_a_result(tmp_path: Path, plain: Callable[..., Path]) -> None:
    """The cache is a file where a folder should be, as root may write to any folder."""
    out = tmp_path / "out"
    (out / "cache").mkdir(parents=True)
    (out / "cache/prepared").write_text("no folder")
    summary = run(out)
    assert summary.exit_code == COMPLETE and summary.executed.uncached == 4
    note = summary.notes[-1]
    assert "4 prepared clips could not be kept" in note and str(out / "cache/prepared") in note
    assert_same_tables(out, plain())


@pytest.mark.slow
def test_an_ill_machine_never_counts_against_a_clip(tmp_path: Path, plain: Callable[..., Path]) -> None:
    ill = IllWork(ill=("log0:0:recovery:0", "log1:1000:recovery:0"))
    for _ in range(4):  # one more than would be quarantined
        assert run(tmp_path / "out", ill).exit_code == COMPLETE_WITH_FAILURES
        assert failed_in(tmp_path / "out") == [("machine", 0)] * 2
    assert run(tmp_path / "out").exit_code == COMPLETE, "the next run tries it again by itself"
    assert_same_tables(tmp_path / "out", plain())


@pytest.mark.slow
def test_what_counted_before_an_illness_counts_after_it(tmp_path: Path) -> None:
    ill, dying = IllWork(ill=("log0:0:recovery:0",)), ToyWork(trouble={"log0:0:recovery:0": "disk"})
    seen = []
    for work in (dying, ill, dying, ill, dying):
        run(tmp_path / "out", work)
        seen += failed_in(tmp_path / "out")
    assert seen == [("system", 1), ("machine", 1), ("system", 2), ("machine", 2), ("poison", 3)]


def test_illness_after_illness_stops_the_run_with_its_reason(tmp_path: Path, plain: Callable[..., Path]) -> None:
    summary = run(tmp_path / "out", IllWork(ill=("log",), number=errno.EROFS))
    assert summary.exit_code == INTERRUPTED
    assert "failed 6 tasks in a row" in summary.message and "Read-only file system: '/mnt/share/log'" in summary.message
    assert "\n" not in summary.message and "run the same command again" in summary.message
    assert run(tmp_path / "out").exit_code == COMPLETE
    assert_same_tables(tmp_path / "out", plain())


def test_a_place_of_the_run_s_own_that_refuses_is_the_machine_s(tmp_path: Path) -> None:
    with pytest.raises(PlaceRefused, match="cannot be written: Permission denied"), raising_place_refused(tmp_path):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), "x")
    with pytest.raises(OSError, match="Input/output") as found, raising_place_refused(tmp_path):
        raise OSError(errno.EIO, os.strerror(errno.EIO), "x")
    assert not isinstance(found.value, PlaceRefused)


@pytest.mark.parametrize(
    "error",
    [
        OSError(errno.EIO, "Input/output error"),
        OSError(errno.ESTALE, "Stale file handle"),
        OSError(errno.EMFILE, "Too many open files"),
        OSError("When reading key 'a' in bucket 'b': AWS Error ACCESS_DENIED during GetObject operation: no"),
        OSError("Generic S3 error: Error performing PUT: 503 Slow Down"),
        OSError("Generic LocalFileSystem error: No space left on device (os error 28)"),
        ConnectionResetError("by the peer"),
        TimeoutError("no answer"),
    ],
)
def test_the_machine_s_errors_are_told_by_number_or_by_what_stores_say(error: OSError) -> None:
    assert failure_from_error(error).kind is ErrorKind.MACHINE
    wrapped = RuntimeError("a plug-in's own words")
    wrapped.__cause__ = error
    assert machine_fault_of(wrapped) == str(error)


@pytest.mark.parametrize(
    "error",
    [
        FileNotFoundError(errno.ENOENT, "No such file or directory", "log.feather"),
        PermissionError(errno.EACCES, "Permission denied", "log.feather"),
        OSError("Couldn't deserialize thrift: TProtocolException: Invalid data"),
        OSError("When reading key 'a': AWS Error NO_SUCH_KEY during GetObject operation"),
    ],
)
def test_a_file_that_is_damaged_or_missing_is_no_illness(error: OSError) -> None:
    assert failure_from_error(error).kind is ErrorKind.SYSTEM


def test_memory_is_the_machine_s_only_where_little_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    """A clip that asks for terabytes says nothing of the machine."""
    monkeypatch.setattr("factory.files._free_memory_share", lambda: 0.5)
    assert failure_from_error(MemoryError("Unable to allocate 7.28 TiB")).kind is ErrorKind.SYSTEM
    monkeypatch.setattr("factory.files._free_memory_share", lambda: 0.02)
    assert failure_from_error(MemoryError("Unable to allocate 1.00 MiB")).kind is ErrorKind.MACHINE


def test_errors_that_stand_behind_one_another_in_a_ring_are_looked_at_once() -> None:
    """As where an error that was kept is raised again while the one that it caused is handled."""
    kept, caused = ValueError("no such folder"), ValueError("no table")
    kept.__context__, caused.__context__ = caused, kept
    assert machine_fault_of(kept) == "" and why_not_written(kept) == ("", "")
    caused.__context__ = PermissionError(errno.EACCES, "Permission denied", "/out")
    assert why_not_written(kept)[1]
