"""One function of many items: the same results in every executor, few in hand, ended by signals and errors alike."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from factory.graph.parallel import IN_HAND, WorkerDied, parallel_map
from factory.graph.steps import TaskStopped
from factory.store.location import BadLocation, Location
from tests.factory.items import Elsewhere, OddItem, squared
from tests.factory.test_exits import child_of, has_begun
from tests.factory.test_exits import until as once

ROOT = Path(__file__).resolve().parents[3]
HERE: dict[str, Any] = {}
TWO: dict[str, Any] = {"workers": 2}
RAY: dict[str, Any] = {"executor": "ray", "workers": 2}
EXECUTORS = [
    pytest.param(HERE, id="here"),
    pytest.param(TWO, id="processes", marks=pytest.mark.slow),
    pytest.param(RAY, id="ray", marks=[pytest.mark.ray, pytest.mark.slow]),
]
WORKERS = EXECUTORS[1:]


def counted(n: int, begun: list[int]) -> Iterator[int]:
    for i in range(n):
        begun.append(i)
        yield i


@pytest.fixture(scope="module", autouse=True)
def two_cpus(request: pytest.FixtureRequest) -> Iterator[None]:
    """One cluster for those of this module's tests that need one: starting it takes seven seconds."""
    if not any(item.get_closest_marker("ray") for item in request.session.items if item.path == request.path):
        yield
        return
    from factory.graph.on_ray.graph import ray

    ray.init(address="local", num_cpus=2, include_dashboard=False, log_to_driver=False)
    yield
    ray.shutdown()


@pytest.mark.parametrize("how", EXECUTORS)
def test_every_item_has_its_result(how: dict[str, Any]) -> None:
    assert sorted(parallel_map(squared, range(20), **how)) == [i * i for i in range(20)]
    assert list(parallel_map(squared, [], **how)) == []


@pytest.mark.parametrize("how", EXECUTORS)
def test_few_items_are_in_hand_however_many_there_are(how: dict[str, Any]) -> None:
    begun: list[int] = []
    with closing(parallel_map(squared, counted(1000, begun), **how)) as results:
        for done in range(1, 6):
            next(results)
            assert done <= len(begun) <= done + IN_HAND * how.get("workers", 1)


@pytest.mark.parametrize("how", EXECUTORS)
def test_after_a_signal_what_is_in_hand_still_comes_and_nothing_new_begins(how: dict[str, Any]) -> None:
    for number in (signal.SIGINT, signal.SIGTERM) if how is HERE else (signal.SIGTERM,):
        before = signal.getsignal(number)
        begun: list[int] = []
        results = parallel_map(squared, counted(100, begun), **how)
        came = [next(results)]
        os.kill(os.getpid(), number)
        with pytest.raises(TaskStopped):
            came.extend(results)
        assert 0 < len(came) < 20 and len(begun) - len(came) == 1, "one was looked at to see whether any was left"
        assert signal.getsignal(number) == before


@pytest.mark.parametrize("how", EXECUTORS)
def test_a_signal_behind_the_last_item_halts_nothing(how: dict[str, Any]) -> None:
    results = parallel_map(squared, [3], **how)
    assert next(results) == 9
    os.kill(os.getpid(), signal.SIGTERM)
    assert list(results) == []


@pytest.mark.parametrize("how", EXECUTORS)
def test_what_an_item_raises_is_raised_as_it_is(how: dict[str, Any]) -> None:
    with pytest.raises(OddItem) as raised:
        list(parallel_map(partial(squared, odd=3), range(6), **how))
    assert str(raised.value) == "3 is odd" and type(raised.value) is OddItem


@pytest.mark.parametrize("how", WORKERS)
def test_a_worker_that_dies_is_told_with_its_item(how: dict[str, Any]) -> None:
    with pytest.raises(WorkerDied, match=r"^3: its worker died \(.*\); run the same command again"):
        list(parallel_map(partial(squared, deadly=3), [3], **how))


@pytest.mark.slow
@pytest.mark.ray
def test_a_folder_that_a_node_does_not_see_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The second node is this one again; what it reads is another machine's folder, where nothing is."""
    from factory.graph.on_ray import graph

    node = graph.nodes_of_cluster()
    monkeypatch.setattr(graph, "nodes_of_cluster", lambda having="": node * 2)
    assert list(parallel_map(squared, [3], **RAY, to=Location(str(tmp_path)))) == [9]
    with pytest.raises(BadLocation, match=rf"^to={tmp_path} is not the same folder on nodes .*storage that all"):
        list(parallel_map(squared, [3], **RAY, to=Elsewhere(str(tmp_path))))
    assert not list(tmp_path.iterdir()), "the trial file is taken away"
    assert graph.ray.is_initialized(), "a cluster that was there stays"


@pytest.mark.slow
def test_workers_end_with_a_driver_that_is_killed(tmp_path: Path) -> None:
    code = (
        "import sys; from pathlib import Path; from factory.graph.parallel import parallel_map; "
        "from tests.factory.items import noted; "
        f"list(parallel_map(noted, [Path({str(tmp_path)!r}, str(i)) for i in range(2)], workers=2))"
    )
    driver = subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, env=os.environ | {"PYTHONPATH": str(ROOT)})
    until(lambda: len(list(tmp_path.glob("[01]"))) == 2, 60.0)
    workers = [int(path.read_text()) for path in tmp_path.glob("[01]")]
    driver.kill()
    driver.wait()
    until(lambda: not any(map(alive, workers)), 20.0)


@pytest.mark.slow
def test_workers_that_are_just_starting_do_not_hear_what_a_terminal_sends_to_all() -> None:
    code = (
        "from factory.graph.parallel import parallel_map; from factory.graph.steps import TaskStopped; "
        "from tests.factory.items import squared\n"
        "try:\n    list(parallel_map(squared, range(100), workers=2))\nexcept TaskStopped:\n    print('halted')"
    )
    how: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, start_new_session=True, **how) as driver:
        once(lambda: has_begun(child_of(driver, "spawn_main")), driver)
        os.killpg(driver.pid, signal.SIGINT)
        assert driver.communicate(timeout=60) == ("halted\n", "")


SHORT = """
import resource, sys
from factory.config.arguments import run_command
from factory.graph.parallel import parallel_map
from tests.factory.items import squared
name, more = sys.argv[1], int(sys.argv[2])
held = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize() if name == "RLIMIT_AS" else 0
resource.setrlimit(getattr(resource, name), (held + more, resource.RLIM_INFINITY))
sys.exit(run_command((), lambda _: print(sum(parallel_map(squared, range(9), workers=2))), str))
"""


@pytest.mark.slow
@pytest.mark.parametrize("limit", [("RLIMIT_STACK", 2**40), *(("RLIMIT_AS", 2**n) for n in (20, 23, 24, 25))])
def test_where_memory_for_a_thread_is_refused_one_line_says_so(limit: tuple[str, int]) -> None:
    """In a worker, whose threads ask for such a stack; here, where so much room lets one begin, two, then all."""
    done = subprocess.run([sys.executable, "-c", SHORT, *map(str, limit)], cwd=ROOT, capture_output=True, timeout=60)
    line = b"error: out of memory or threads: can't start new thread; give it more and run the same command again\n"
    ended = done.returncode, done.stdout, done.stderr
    assert ended == (2, b"", line) or (ended == (0, b"204\n", b"") and limit[0] == "RLIMIT_AS")


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def until(is_so: Any, seconds: float) -> None:
    end = time.monotonic() + seconds
    while not is_so():
        assert time.monotonic() < end, "in vain"
        time.sleep(0.05)
