"""A disk that fills up ends a run with exit code 4, loses nothing that was committed, and the same command goes on."""

import errno
import re
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pyarrow.compute as pc
import pytest

from factory.config.arguments import INPUT_ERRORS, run_command
from factory.exits import BAD_CONFIG, COMPLETE, INTERRUPTED
from factory.files import AS_ANOTHER, DiskFull, naming_disk_errors, why_disk_full, why_unusable
from factory.graph.execute import Execution, RunSummary, execute, rerun_on_new_clusters
from factory.graph.on_ray.graph import ray  # with the environment that keeps it on loopback
from factory.graph.steps import failure_from_error
from factory.run import main as run_main
from factory.store.samples import Store
from factory.store.verify import verify
from tasks.caches import user_cache
from tests.factory.tables import assert_same_rows, assert_same_tables, tables_of
from tests.factory.toy import COLD, ColdWork, DyingWork, ToyWork, executed, refs

LARGE = "64m"
TOWN = ["clips.n_clips=5", "clips.settings.cameras=[]", "clips.settings.lidar_beams=0", "render=none"]
TOWN += ["vocabulary.k=128", "rounds=2", "executor=local", "shard_seconds=0.001"]  # 8 MB, the pages 0.5 of them
FULL = r"the disk is full: [\d,]+ bytes are needed, [\d,]+ are free; free disk space and run the same"
ONE_LINE = rf"(?:error: )?{{out}}/\S+: {FULL}"


def mount(folder: Path, *options: str) -> bool:
    command = ["mount", "-t", "tmpfs", *options, "tmpfs", str(folder)]
    return subprocess.run(command, capture_output=True).returncode == 0


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of its own, of 64 MB until it is made smaller."""
    folder = tmp_path / "disk"
    folder.mkdir()
    if not mount(folder, "-o", f"size={LARGE}"):
        pytest.skip("a small disk is a tmpfs, and only root may mount one")
    yield folder
    subprocess.run(["umount", "--lazy", str(folder)], check=True)  # a failed test may hold a file open


def resize(folder: Path, size: str) -> None:
    subprocess.run(["mount", "-o", f"remount,size={size}", str(folder)], check=True)


def run(out: Path) -> RunSummary:
    work = ToyWork(threshold=0.4)
    return executed(work, refs(8), ["recovery", "human"], 2, Store(out), Execution("local", shard_seconds=0.0))


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> set[str]:
    out = tmp_path_factory.mktemp("undisturbed")
    assert run(out).exit_code == COMPLETE
    return set(Store(out).samples)


@pytest.mark.parametrize("size", ["64k", pytest.param("192k", marks=pytest.mark.slow), "512k"])
def test_wherever_the_disk_is_full_the_same_command_goes_on(disk: Path, undisturbed: set[str], size: str) -> None:
    out = disk / "out"
    resize(disk, size)
    stopped = run(out)
    assert stopped.exit_code == INTERRUPTED
    assert str(out) in stopped.message and "bytes are needed" in stopped.message, stopped.message
    assert "\n" not in stopped.message and "run the same command again" in stopped.message
    resize(disk, LARGE)
    committed = set(Store(out).samples)
    assert committed < undisturbed and (committed or size != "512k")
    assert not list(out.rglob("*.tmp")), "half a file takes space from the next run"
    if Store(out).samples.version is not None:
        assert verify(Store(out)).damage == ()
        assert "failed" not in Store(out).outcomes.read(["kind"])["kind"].to_pylist(), (
            "a full disk is no failed attempt"
        )
    assert run(out).exit_code == COMPLETE
    assert set(Store(out).samples) == undisturbed
    assert verify(Store(out)).damage == ()


@pytest.fixture(scope="module")
def whole_town(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the command makes where nothing disturbs it."""
    out = tmp_path_factory.mktemp("town") / "out"
    assert run_main([*TOWN, f"out={out}"]) == COMPLETE
    return out


@pytest.mark.slow
def test_a_whole_run_on_a_disk_that_fills_says_so_once_and_goes_on(
    disk: Path, whole_town: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = [*TOWN, f"out={disk / 'out'}"]
    resize(disk, "4700k")
    assert run_main(command) == INTERRUPTED
    told = [line for line in capsys.readouterr().err.splitlines() if "full" in line]
    assert len(told) == 1 and re.match(ONE_LINE.format(out=re.escape(str(disk / "out"))), told[0]), told
    resize(disk, LARGE)
    whole, _, _ = tables_of(whole_town)
    committed, _, _ = tables_of(disk / "out")
    assert len(committed) > 0
    assert_same_rows(committed, whole.filter(pc.is_in(whole["attempt_id"], committed["attempt_id"])))
    assert verify(Store(disk / "out")).damage == ()
    assert run_main(command) == COMPLETE
    assert_same_tables(disk / "out", whole_town)


def test_a_disk_without_room_for_a_row_group_is_refused_at_once(disk: Path) -> None:
    assert why_unusable(str(disk / "deep" / "out")) == ""
    resize(disk, "1m")
    said = why_unusable(str(disk / "deep" / "out"))
    assert "the disk is full: 4,194,304 bytes are needed, 1,04" in said
    assert list(disk.iterdir()) == [], "nothing is left behind"


def test_what_a_full_disk_said_is_found_behind_other_errors_and_in_delta_s_words(tmp_path: Path) -> None:
    full = r"x: the disk is full: 1,234 bytes are needed, [\d,]+ are free"
    with pytest.raises(DiskFull, match=full), naming_disk_errors(tmp_path / "x", 1234):
        raise OSError("Generic LocalFileSystem error: No space left on device (os error 28)")
    with pytest.raises(PermissionError), naming_disk_errors(tmp_path, 1):
        raise PermissionError(13, "Permission denied")
    try:
        try:
            raise OSError(28, "No space left on device", "/a/file")
        except OSError as error:
            raise RuntimeError("a plug-in's own words") from error
    except RuntimeError as error:
        assert failure_from_error(error).disk_full == why_disk_full(error) == "/a/file: the disk is full"
    assert failure_from_error(ValueError("else")).disk_full == ""


def test_a_library_s_own_error_of_a_full_disk_is_named_by_the_path() -> None:
    """As safetensors has it, and PyTorch, which raises of what the file raised."""
    for first in (Exception("I/O error: No space left on device (os error 28)"), OSError(errno.ENOSPC, "No space")):
        with pytest.raises(DiskFull, match="/a/file: the disk is full: 7"), naming_disk_errors("/a/file", 7):
            try:
                raise first
            except OSError as error:
                raise RuntimeError("unexpected pos 704 vs 598") from error


@pytest.mark.parametrize("refused", [(), INPUT_ERRORS])
@pytest.mark.parametrize("number, helps", [(28, "free disk space"), (30, AS_ANOTHER), (13, AS_ANOTHER)])
def test_every_command_says_how_to_go_on_where_a_disk_refuses_once(
    number: int, helps: str, refused: tuple[type[Exception], ...], capsys: pytest.CaptureFixture[str]
) -> None:
    def does(argv: object) -> int:
        raise OSError(number, "refused", "/a/file")

    assert run_command([], does, str, refused, elsewhere=", or so") == BAD_CONFIG
    assert re.fullmatch(f"error: .*/a/file.*; {helps}, or so\n", capsys.readouterr().err)


UNMAPPED = "libtorch_cpu.so: failed to map segment from shared object"


@pytest.mark.parametrize("error", [MemoryError(), MemoryError("Unable to allocate 7 TiB"), ImportError(UNMAPPED)])
def test_every_command_names_memory_where_that_is_refused(error: Exception, capsys: pytest.CaptureFixture[str]) -> None:
    def does(argv: object, raised: Exception = error) -> int:
        raise raised

    assert run_command([], does, str) == BAD_CONFIG
    assert re.fullmatch("error: out of memory or threads: .+\n", capsys.readouterr().err)
    with pytest.raises(ImportError):  # a folder that nothing may be run from
        run_command([], lambda argv: does(argv, ImportError(f"{UNMAPPED}: Operation not permitted")), str)


def test_a_full_disk_under_the_user_s_cache_is_told_with_its_path_and_is_no_wrong_setting(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(*given: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("factory.datasets.town.reader.write_town", full)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(user_cache()))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    assert run_main([*TOWN, f"out={tmp_path / 'out'}"]) == INTERRUPTED
    (told,) = [line for line in capsys.readouterr().err.splitlines() if "space" in line]
    assert str(tmp_path / "cache/driving-data-factory/towns") in told and "run the same command again" in told


@pytest.mark.parametrize("isolated", [False, True])
def test_a_machine_that_is_ill_while_kernels_are_compiled_is_no_bug_and_no_wrong_setting(
    tmp_path: Path, isolated: bool
) -> None:
    stopped_before_any_row(tmp_path / "out", ColdWork(number=errno.ENOSPC), COLD, Execution("local", isolated=isolated))


def stopped_before_any_row(out: Path, work: ToyWork, says: str, how: Execution) -> None:
    summary = execute(work, refs(1), ["human"], 1, Store(out), how)
    assert summary.exit_code == INTERRUPTED and not [*out.rglob("*.parquet")]
    assert says in summary.message and "run the same command again" in summary.message


@pytest.mark.ray
@pytest.mark.slow
def test_nor_is_it_one_on_ray_where_the_worker_may_die_of_it_as_well(tmp_path: Path) -> None:
    ray.init(address="local", num_cpus=1, include_dashboard=False, log_to_driver=False)
    try:
        stopped_before_any_row(tmp_path / "ill", ColdWork(number=errno.ENOSPC), COLD, Execution("ray", 1))
        says = "could not get its kernels ready"
        stopped_before_any_row(tmp_path / "dead", DyingWork(), says, Execution("ray", 1))
    finally:
        ray.shutdown()


@pytest.fixture
def without_ray(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[Path], tuple[RunSummary, list[str]]]:
    """A run whose cluster does not begin, with the folder of Ray's files: how it ended, and what was said."""

    def timed_out(*given: object, **options: object) -> None:
        raise RuntimeError("Timed out waiting for file gcs_server_port")

    def ended(files: Path) -> tuple[RunSummary, list[str]]:
        monkeypatch.setenv("RAY_TMPDIR", str(files))
        out, told = tmp_path / "out", list[str]()
        how = Execution("ray")
        summary = rerun_on_new_clusters(
            lambda: executed(ToyWork(), refs(1), ["human"], 1, Store(out), how), told.append
        )
        assert summary.exit_code == INTERRUPTED and not out.exists()
        return summary, told

    monkeypatch.setattr("ray.init", timed_out)
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    return ended


def test_ray_that_cannot_begin_ends_the_run_with_one_line_that_says_how_full_its_place_is(
    tmp_path: Path, without_ray: Callable[[Path], tuple[RunSummary, list[str]]]
) -> None:
    summary, told = without_ray(tmp_path)
    assert [line.rpartition("; ")[2] for line in told] == [f"a new cluster is started, {i} of 3" for i in (1, 2, 3)]
    said = (
        rf"Ray did not begin on this machine \(Timed out .*\); its files lie in {tmp_path}, where [\d,]+ bytes are free"
    )
    assert re.fullmatch(f"{said}; run the same command again to go on", summary.message), summary.message


def test_ray_without_space_for_its_files_is_not_begun_again(
    disk: Path, without_ray: Callable[[Path], tuple[RunSummary, list[str]]]
) -> None:
    """Each new cluster would wait for half a minute for what it cannot write."""
    resize(disk, "64k")
    summary, told = without_ray(disk)
    assert not told
    assert f"its files lie in {disk}: the disk is full, 65,536 bytes are free; free disk space" in summary.message
