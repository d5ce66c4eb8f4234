"""Compiled kernels: the cache follows their sources and constants; nothing in them depends on threads or fast maths."""

import ast
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from factory.graph.steps import NotReady
from factory.stages.warm import compile_kernels, compiling_ahead
from tasks.kernels.compiled import cache_dir, kernel_sources, remove_unused_caches, sources_digest

REPOSITORY = Path(__file__).resolve().parents[3]


@pytest.mark.slow
def test_every_source_that_compiles_something_is_in_the_digest() -> None:
    """Found another way: by the names that the syntax tree imports."""
    listed = set(kernel_sources())
    for package in ("tasks", "factory"):
        for path in (REPOSITORY / package).rglob("*.py"):
            nodes = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.ImportFrom)]
            compiles = any(
                node.module in ("numba", "tasks.kernels.compiled")
                and {"njit", "jit", "kernel", "inlined", "inner_kernel", "hidden_kernel", "numpy_division_kernel"}
                & {a.name for a in node.names}
                for node in nodes
            )
            assert not compiles or path in listed, path


def test_every_source_that_a_kernel_s_file_takes_a_constant_from_is_in_the_digest() -> None:
    """The text is searched for them; here the syntax tree is asked."""
    listed = set(kernel_sources())
    for path in listed:
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.ImportFrom) and any(alias.name.isupper() for alias in node.names):
                source = REPOSITORY.joinpath(*(node.module or "").split(".")).with_suffix(".py")
                assert not source.is_file() or source in listed, (path, source)


def test_no_kernel_may_add_in_another_order_on_another_machine() -> None:
    for path in kernel_sources():
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.keyword):
                assert node.arg not in ("fastmath", "parallel"), path
            if isinstance(node, ast.Name | ast.Attribute):
                assert getattr(node, "id", getattr(node, "attr", "")) != "prange", path


@pytest.fixture
def small_house(tmp_path: Path) -> Path:
    """A kernel that takes one constant from another file, beside a file that has nothing to do with it."""
    (tmp_path / "tasks").mkdir()
    (tmp_path / "factory").mkdir()
    (tmp_path / "tasks" / "speed.py").write_text("from tasks.units import (\n  a,\n  STEP_S,\n)\nLIMIT = 3.0\n")
    (tmp_path / "tasks" / "units.py").write_text("STEP_S = 0.1\n")
    (tmp_path / "tasks" / "words.py").write_text("HELLO = 'hello'\n")
    (tmp_path / "factory" / "fast.py").write_text(
        "from tasks.kernels.compiled import kernel\nfrom tasks.speed import LIMIT\nfrom tasks.words import greet\n"
    )
    return tmp_path


@pytest.mark.parametrize("edited", ["factory/fast.py", "tasks/speed.py", "tasks/units.py"])
def test_an_edit_of_a_kernel_or_of_a_constant_it_uses_starts_a_new_cache(small_house: Path, edited: str) -> None:
    before = sources_digest(small_house)
    assert sources_digest(small_house) == before
    with (small_house / edited).open("a") as file:
        file.write("# edited\n")
    assert sources_digest(small_house) != before


def test_an_edit_elsewhere_keeps_the_cache(small_house: Path) -> None:
    before = sources_digest(small_house)
    with (small_house / "tasks" / "words.py").open("a") as file:
        file.write("# edited\n")
    assert sources_digest(small_house) == before


def test_the_cache_lies_in_the_user_s_cache_folder_named_by_the_digest(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", "/somewhere")
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    assert cache_dir() == Path("/somewhere/driving-data-factory") / f"kernels-{sources_digest()}"


SQUARED = """
from tasks.kernels.compiled import kernel

@kernel
def squared(x):
    return x * x
"""
CALL_IT = """
from {module} import squared
assert squared({argument}) == 9
print(sum(squared.stats.cache_hits.values()), sum(squared.stats.cache_misses.values()))
"""


def copy_with_one_kernel(folder: Path) -> Path:
    """The project's decorator and one kernel, as a job's upload would lie in a folder of its own."""
    for name in ("__init__", "caches", "kernels/__init__", "kernels/compiled"):
        target = folder / "tasks" / f"{name}.py"
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(REPOSITORY / "tasks" / f"{name}.py", target)
    (folder / "tasks" / "squares.py").write_text(SQUARED)
    return folder


def calling(project: Path, argument: str, module: str = "tasks.squares", **environment: str) -> "subprocess.Popen[str]":
    env = {key: value for key, value in os.environ.items() if key not in ("NUMBA_CACHE_DIR", "PYTHONPATH")}
    env |= {"PYTHONPATH": str(project)} | environment
    command = [sys.executable, "-c", CALL_IT.format(argument=argument, module=module)]
    return subprocess.Popen(command, env=env, cwd=project, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE)


def hits_and_misses(project: Path, argument: str = "3.0", **environment: str) -> str:
    said, error = calling(project, argument, **environment).communicate()
    return said.strip() + error


@pytest.mark.slow
@pytest.mark.parametrize("named_by", ["NUMBA_CACHE_DIR", "XDG_CACHE_HOME"])
def test_a_copy_of_the_project_elsewhere_compiles_nothing_again(tmp_path: Path, named_by: str) -> None:
    where = {named_by: str(tmp_path / "cache")}
    first, second = (copy_with_one_kernel(tmp_path / name) for name in ("upload_1", "upload_2"))
    assert hits_and_misses(first, **where) == "0 1"
    assert hits_and_misses(second, **where) == "1 0"
    with (second / "tasks" / "squares.py").open("a") as file:
        file.write("LIMIT = 3.0\n")
    assert hits_and_misses(second, **where) == "0 1"


ARRAY_THEN_NUMBER = """
import sys
import numpy as np
from tasks.squares import squared
assert squared(np.full(3, 3.0)).tolist() == [9.0] * 3  # an array of numba's
loaded = "numba.np.arraymath" in sys.modules
assert squared(complex(sys.argv[1])) == complex(sys.argv[1]) ** 2
print(loaded, sum(squared.stats.cache_misses.values()))
"""


@pytest.mark.slow
def test_a_kernel_from_the_cache_runs_without_what_compiling_needs(tmp_path: Path) -> None:
    """Numba's types and rules take every process 0.4 s; one that compiles after all loads them then."""
    project = copy_with_one_kernel(tmp_path / "project")
    env = dict(os.environ) | {"PYTHONPATH": str(project), "NUMBA_CACHE_DIR": str(tmp_path / "cache")}

    def said() -> str:
        command = [sys.executable, "-c", ARRAY_THEN_NUMBER, "2j"]
        return subprocess.run(command, env=env, cwd=project, text=True, check=True, capture_output=True).stdout.strip()

    assert said() == "True 2"
    assert said() == "False 0"
    for kept in (tmp_path / "cache").rglob("*.kernel"):
        if b"complex" in kept.read_bytes():
            kept.unlink()
    assert said() == "False 1"


@pytest.mark.slow
def test_a_user_s_kernel_whose_file_goes_by_two_names_is_found_under_each(tmp_path: Path) -> None:
    """What is kept names its module, which the next process need not be able to import."""
    project, where = copy_with_one_kernel(tmp_path / "project"), {"XDG_CACHE_HOME": str(tmp_path / "cache")}
    (project / "mine").mkdir()
    (project / "mine" / "cubes.py").write_text(SQUARED)
    folders = {"mine.cubes": project, "cubes": project / "mine"}  # by name, what it is imported from
    for found in ("0 1", "1 0"):
        for module, folder in folders.items():
            path = os.pathsep.join(map(str, dict.fromkeys((folder, project))))
            assert hits_and_misses(project, module=module, PYTHONPATH=path, **where) == found


@pytest.mark.slow
def test_processes_that_compile_one_function_for_other_types_at_once_keep_both(tmp_path: Path) -> None:
    """Numba's own index keeps what was written last, and may name the other's machine code."""
    project, where = copy_with_one_kernel(tmp_path / "project"), {"XDG_CACHE_HOME": str(tmp_path / "cache")}
    arguments = ("3", "3.0", "3.0 + 0j")
    together = [calling(project, argument, **where) for argument in arguments]
    assert [process.communicate()[0].strip() for process in together] == ["0 1"] * 3
    assert [hits_and_misses(project, argument, **where) for argument in arguments] == ["1 0"] * 3


def kept_kernels(caches: Path, name: str, days_unused: float) -> Path:
    folder = caches / name
    (folder / "tasks").mkdir(parents=True)
    (folder / "tasks" / "f.kernel").write_bytes(b"code")
    aged(folder, days_unused)
    return folder


def aged(folder: Path, days_unused: float) -> None:
    at = time.time() - days_unused * 86_400.0
    os.utime(folder, (at, at))


def test_kernels_that_nobody_has_used_for_a_month_are_removed_and_nothing_else(tmp_path: Path) -> None:
    unused = [
        kept_kernels(tmp_path, "kernels-0123456789abcdef", 31.0),
        kept_kernels(tmp_path, "kernels-fedcba9876543210-01234567", 31.0),  # of a removal that was killed
    ]
    kept = [
        kept_kernels(tmp_path, "kernels-00000000000000aa", 29.0),
        kept_kernels(tmp_path, "kernels-6.1", 400.0),  # somebody else's
        kept_kernels(tmp_path, "towns", 400.0),
    ]
    remove_unused_caches(tmp_path)
    assert not [folder for folder in unused if folder.exists()]
    assert all((folder / "tasks" / "f.kernel").is_file() for folder in kept)
    assert sorted(tmp_path.iterdir()) == sorted(kept)


def test_several_that_remove_at_once_do_not_trip_over_each_other(tmp_path: Path) -> None:
    for k in range(40):
        kept_kernels(tmp_path, f"kernels-{k:016x}", 31.0)
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(remove_unused_caches, [tmp_path] * 8))
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_kernels_in_use_stay_when_those_of_other_sources_are_begun(tmp_path: Path) -> None:
    """Used a month ago and again now: the process that loads them says so; what no process loads is gone."""
    project, cache = copy_with_one_kernel(tmp_path / "project"), tmp_path / "cache"
    where = {"NUMBA_CACHE_DIR": str(cache)}
    assert hits_and_misses(project, **where) == "0 1"
    (used,) = cache.iterdir()
    unused = kept_kernels(cache, "kernels-0123456789abcdef", 31.0)
    aged(used, 31.0)
    assert hits_and_misses(project, **where) == "1 0"
    assert unused.exists()  # no folder was begun
    with (project / "tasks" / "squares.py").open("a") as file:
        file.write("LIMIT = 3.0\n")
    assert hits_and_misses(project, **where) == "0 1"
    assert used.exists() and not unused.exists() and len(list(cache.iterdir())) == 2


def test_without_room_for_the_cache_a_kernel_works_and_says_what_helps(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    said = hits_and_misses(copy_with_one_kernel(tmp_path / "project"), XDG_CACHE_HOME=str(tmp_path / "file"))
    assert said.startswith("0 1")
    assert said.count("RuntimeWarning: compiled kernels cannot be kept in") == 1
    assert "name a folder with free space in NUMBA_CACHE_DIR" in said


def test_compiling_ahead_leaves_the_refusal_to_whoever_needs_the_kernels(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file"))
    with compiling_ahead(["judge"]), pytest.raises(NotReady, match="cannot be kept"):
        compile_kernels(["judge"])


def test_compiling_ahead_ends_with_the_run_that_began_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing of a refused run goes on working: its part's process is gone, and the part is not compiled."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    with compiling_ahead(["judge"]):
        assert within(20.0, lambda: bool(compiling(tmp_path)))
    assert within(20.0, lambda: not compiling(tmp_path))
    assert not list(tmp_path.glob("*/compiled-*"))


def compiling(cache: Path) -> list[Path]:
    """The processes that a part into this cache has been given to."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):  # another user's, or just ended
            if f"NUMBA_CACHE_DIR={cache}".encode() in (process / "environ").read_bytes().split(b"\0"):
                found.append(process)
    return found


def within(seconds: float, holds: Callable[[], bool]) -> bool:
    ends = time.monotonic() + seconds
    while not holds() and time.monotonic() < ends:
        time.sleep(0.05)
    return holds()


@pytest.mark.slow
def test_a_part_is_compiled_again_once_a_file_of_it_is_gone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As a cleaner of old files would leave the cache."""
    compile_kernels(["judge"])
    copy = tmp_path / cache_dir().name
    shutil.copytree(cache_dir(), copy)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    kept = {path: path.stat().st_mtime_ns for path in copy.rglob("*.kernel")}
    gone = next(path for path in kept if path.name.startswith("changes_along_rows"))
    gone.unlink()
    compile_kernels(["judge"])
    now = {path: path.stat().st_mtime_ns for path in copy.rglob("*.kernel")}
    assert {path for path in now if now[path] != kept.get(path)} == {gone}


def test_a_kernel_gives_the_bytes_of_its_own_python() -> None:
    """No reordered sums: compiled and interpreted addition agree to the last bit."""
    from tasks.kernels.compiled import kernel

    def total(values: np.ndarray) -> float:
        out = 0.0
        for value in values:
            out += value * value
        return out

    values = np.random.default_rng(0).normal(size=10_001)
    assert kernel(total)(values) == total(values)
