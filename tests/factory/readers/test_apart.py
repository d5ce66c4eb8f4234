"""A file that brings its reader down, or never ends, costs its own clips and nothing else."""

import os
import signal
import time
from pathlib import Path

import pytest

from factory.datasets.scenarionet.reader import ScenarioNetReader
from factory.readers.apart import ProcessFunction, read_each
from factory.readers.base import BadClip
from tests.factory.datasets.scenarionet.scenarionet_scenarios import nuscenes, save


def pid_of(_: int) -> int:
    return os.getpid()


def killed(number: int) -> None:
    os.kill(os.getpid(), number)


def doubled(value: int) -> int:
    return 2 * value


def refused(file: str) -> None:
    raise BadClip(file, "field", "is wrong")


def hungry(n_bytes: int) -> int:
    return len(bytes(n_bytes))


@pytest.mark.slow
def test_one_process_answers_all_and_another_follows_one_that_died() -> None:
    first = ProcessFunction(pid_of)(0, "a")
    assert first != os.getpid() and [ProcessFunction(doubled)(n, "a") for n in range(3)] == [0, 2, 4]
    assert ProcessFunction(pid_of)(0, "a") == first
    for number in (signal.SIGSEGV, signal.SIGKILL):
        with pytest.raises(BadClip, match=f"b: file: its reader was killed by {number.name} over it"):
            ProcessFunction(killed)(number, "b")
    assert ProcessFunction(pid_of)(0, "a") not in (first, os.getpid())


@pytest.mark.slow
def test_what_never_ends_is_given_up_and_what_is_raised_is_raised() -> None:
    with pytest.raises(BadClip, match=r"c: file: reading it was given up after 0\.2 s"):
        ProcessFunction(time.sleep)(60.0, "c", limit_s=0.2)
    with pytest.raises(BadClip, match="d: field: is wrong"):
        ProcessFunction(refused)("d", "d")
    with pytest.raises(BadClip, match="e: file: reading it takes more memory than there is for it"):
        ProcessFunction(hungry)(2**40, "e")
    assert ProcessFunction(doubled)(4, "a") == 8


class FatalReader(ScenarioNetReader):
    """Dies of the file that is named fatal."""

    def drive(self, path: Path) -> object:  # type: ignore[override]
        if "fatal" in path.name:
            os.kill(os.getpid(), signal.SIGSEGV)
        return super().drive(path)


@pytest.mark.slow
def test_a_fatal_log_of_a_folder_is_broken_and_the_others_are_clips(tmp_path: Path) -> None:
    for name in ("sd_a.pkl", "sd_fatal.pkl", "sd_z.pkl"):
        save(nuscenes(), tmp_path, name)
    index = FatalReader(tmp_path).index()
    assert {ref.log_id for ref in index.refs} == {"sd_a", "sd_z"}
    ((ref, said),) = index.broken.items()
    assert ref.log_id == "sd_fatal" and said == (
        f"{tmp_path / 'sd_fatal.pkl'}: file: its reader was killed by SIGSEGV over it"
    )
    assert ScenarioNetReader(tmp_path).index().refs[0] in index.refs


def number_in(path: Path) -> tuple[int, int]:
    """Who read it, and what is in it."""
    if path.read_text() == "fatal":
        os.kill(os.getpid(), signal.SIGSEGV)
    return os.getpid(), int(path.read_text())


@pytest.mark.slow
def test_many_files_are_read_by_several_processes_and_come_in_their_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: 3)
    paths = [tmp_path / f"{i:02}" for i in range(60)]
    for i, path in enumerate(paths):
        path.write_text({7: "fatal", 31: "no number"}.get(i, str(i)))
    found = list(read_each(number_in, paths, apart=True))
    bad = {i: str(one) for i, one in enumerate(found) if isinstance(one, BadClip)}
    assert sorted(bad) == [7, 31] and "was killed by SIGSEGV" in bad[7] and str(paths[31]) in bad[31]
    good = {i: one for i, one in enumerate(found) if not isinstance(one, BadClip)}
    assert all(number == i for i, (_, number) in good.items())
    assert len({pid for pid, _ in good.values()} - {os.getpid()}) > 1
    alone = list(read_each(number_in, [paths[0], paths[31]], apart=False))
    assert alone[0] == (os.getpid(), 0) and isinstance(alone[1], BadClip)
