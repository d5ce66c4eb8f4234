"""The commands of docs/tutorials/cluster.md on a head node of its own: runs and jobs find it, resume, and leave
the heavy folders at home."""

import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import pytest

from factory.exits import BAD_CONFIG
from factory.stages.warm import compile_kernels, part_marker
from factory.store.reader import SampleTable
from tasks.caches import without_checksum
from tasks.kernels.compiled import cache_dir
from tests.pages import commands

pytestmark = [pytest.mark.ray, pytest.mark.slow]

REPOSITORY = Path(__file__).resolve().parents[2]
RAY = (sys.executable, "-m", "ray.scripts.scripts")
PAGE = commands("docs/tutorials/cluster.md")
START_HEAD, STATUS, TOKEN = (
    next([*RAY, *one.words[1:]] for one in PAGE if one.words[0] == "ray" and words in str(one))
    for words in ("start --head", "status", "get-auth-token")
)
RUN, SUBMIT = ([*one.words] for one in PAGE if "factory.run" in one.words)
LISTENERS = (
    "--port",
    "--dashboard-port",
    "--dashboard-agent-listen-port",
    "--dashboard-agent-grpc-port",
    "--runtime-env-agent-port",
    "--metrics-export-port",
    "--ray-client-server-port",
)
UPLOADED = ("factory", "tasks", "planners", "conf", "pyproject.toml", ".rayignore", ".gitignore")
PARTS = ["judge", "plan", "drive"]  # of factory.stages.warm
SMALL = ("clips.n_clips=1", "clips.settings.cameras=[]", "clips.settings.lidar_beams=0", "render=none")
SMALL_JOB = ("rounds=5", *SMALL, "vocabulary.k=64", "experts=[human]")
LEFT_AT_HOME = (  # what lies in a checkout that was worked with
    "runs/demo/samples/shard.parquet",
    ".venv/lib/library.py",
    ".git/objects/pack",
    ".mypy_cache/cache.json",
    ".hypothesis/examples",
    "factory/__pycache__/run.pyc",
    "build/lib/factory.py",
    "tests/test_something.py",
)


@dataclass(frozen=True)
class Head:
    """A running head node."""

    address: str  # of the dashboard
    folder: Path  # of its sessions, and home of its user
    environment: dict[str, str]
    gcs: str  # host:port that nodes join and drivers connect to

    def submit(self, checkout: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
        """As the page has it, with the job's own arguments; waits for the job's end."""
        words = SUBMIT[1 : SUBMIT.index("rounds=5")]
        command = [*RAY, *(self.address if word == "http://<head>:8265" else word for word in words), *arguments]
        return subprocess.run(command, cwd=checkout, env=self.environment, capture_output=True, text=True, timeout=250)


def free_ports(count: int) -> list[int]:
    with ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(count)]
        for each in sockets:
            each.bind(("127.0.0.1", 0))
        return [each.getsockname()[1] for each in sockets]


def running_head() -> Iterator[Head]:
    """`ray start --head` on loopback, with a token of its own; ended by its pid (`ray stop` would end every Ray)."""
    environment = {
        key: value for key, value in os.environ.items() if not key.startswith(("RAY_", "NUMBA_", "PYTHONPATH"))
    }
    environment |= {
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
        "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0",
        "RAY_USAGE_STATS_ENABLED": "0",
        "RAY_AUTH_MODE": "token",
        "OMP_NUM_THREADS": "1",
    }
    folder = Path(tempfile.mkdtemp(prefix="ray-", dir="/tmp"))  # short: Ray's sockets lie below it
    environment |= {"HOME": str(folder), "XDG_CACHE_HOME": str(folder / "cache")}
    ports = free_ports(len(LISTENERS))
    listeners = [text for flag, port in zip(LISTENERS, ports) for text in (flag, str(port))]
    subprocess.run(TOKEN, env=environment, check=True, capture_output=True)
    command = [*START_HEAD, "--block", "--node-ip-address=127.0.0.1", "--dashboard-host=127.0.0.1"]
    command += ["--include-dashboard=true", "--num-cpus=2", f"--temp-dir={folder}", *listeners]
    with open(folder / "head.log", "w") as log:
        process = subprocess.Popen(command, env=environment, stdout=log, stderr=subprocess.STDOUT, cwd=folder)
    head = Head(f"http://127.0.0.1:{ports[1]}", folder, environment, f"127.0.0.1:{ports[0]}")
    try:
        _wait_until_it_answers(head, process)
        yield head
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait(60)
        shutil.rmtree(folder, ignore_errors=True)


head = pytest.fixture(running_head, scope="module", name="head")


def _wait_until_it_answers(head: Head, process: "subprocess.Popen[bytes]") -> None:
    command = [*RAY, "job", "list", "--address", head.address]
    for _ in range(60):
        assert process.poll() is None, (head.folder / "head.log").read_text()
        if subprocess.run(command, env=head.environment, capture_output=True).returncode == 0:
            return
        time.sleep(1.0)
    raise AssertionError((head.folder / "head.log").read_text())


def checkout(root: Path) -> Path:
    """The project as a user has it who has already worked with it: with results, environment and caches beside it."""
    root.mkdir()
    for name in UPLOADED:
        source = REPOSITORY / name
        if source.is_dir():
            shutil.copytree(source, root / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(source, root / name)
    for name in LEFT_AT_HOME:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(b"\0" * 1_000_000)
    return root


def give_compiled_kernels(head: Head) -> Path:
    """What a run without images needs, as a first job leaves it in the user's cache; compiled once for all tests."""
    compile_kernels(PARTS)
    cache = head.folder / "cache" / "driving-data-factory" / cache_dir().name
    for part in PARTS:
        listing = part_marker(part)
        for name in (listing.name, *without_checksum(listing.read_bytes(), listing.name).decode().splitlines()):
            (cache / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(cache_dir() / name, cache / name)
    return cache


def test_the_command_as_it_stands_makes_the_table_from_one_copy_of_the_project_and_goes_on_from_another(
    head: Head, tmp_path: Path
) -> None:
    first, second = checkout(tmp_path / "first"), checkout(tmp_path / "second")
    cache = give_compiled_kernels(head)
    made = head.submit(first, *SMALL_JOB)
    assert made.returncode == 0, made.stdout + made.stderr
    assert "succeeded" in made.stdout
    out = head.folder / "driving-data-factory" / "runs" / "synthetic"
    assert len(SampleTable(out)) == 1

    packages = list(head.folder.glob("session_*/runtime_resources/working_dir_files/_ray_pkg_*/"))
    assert packages, "the uploaded working directory is unpacked there"
    arrived = {p.relative_to(package).as_posix() for package in packages for p in package.rglob("*") if p.is_file()}
    assert {"factory/run.py", "tasks/perturb.py", "conf/run.yaml"} <= arrived
    assert not set(LEFT_AT_HOME) & arrived

    compiled = {path: path.stat().st_mtime_ns for path in cache.glob("**/*.kernel")}
    (second / "README.md").write_text("another upload")
    again = head.submit(second, *SMALL_JOB, "experts=[human,recovery]")
    assert again.returncode == 0, again.stdout + again.stderr
    assert "found 1 attempts done" in again.stdout
    assert len(SampleTable(out)) > 1
    assert (
        len({path.name for path in head.folder.glob("session_*/runtime_resources/working_dir_files/_ray_pkg_*/")}) == 2
    )
    assert "compiling kernels" not in made.stdout + again.stdout
    assert {path: path.stat().st_mtime_ns for path in cache.glob("**/*.kernel")} == compiled, "nothing is compiled"


def test_a_run_finds_the_cluster_as_the_page_says(head: Head, tmp_path: Path, shared_root: Path) -> None:
    give_compiled_kernels(head)
    environment = head.environment | {"RAY_ADDRESS": head.gcs}
    for _ in range(30):  # a head that answers may know nothing of itself yet
        status = subprocess.run(STATUS, env=environment, capture_output=True, text=True).stdout
        if "/2.0 CPU" in status:
            break
        time.sleep(1.0)
    assert len(re.findall(r"^ 1 node_[0-9a-f]+$", status, re.M)) == 1 and "/2.0 CPU" in status
    given = {"clips.root": str(shared_root / "data" / "scenarionet" / "nuscenes"), "out": str(tmp_path / "out")}
    given |= {"limit": "1", "experts": "[human]", "render": "none"}
    words = [*(word for word in RUN[1:] if word.partition("=")[0] not in given), *map("=".join, given.items())]
    ran = subprocess.run(
        [sys.executable, *words], cwd=REPOSITORY, env=environment, capture_output=True, text=True, timeout=200
    )
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert len(SampleTable(tmp_path / "out")) == 1


@pytest.mark.parametrize(
    ("mode", "words"),  # train reads its data only once it is on the cluster
    [
        ("disabled", ("factory", "run", *SMALL, "executor=ray")),
        ("token", ("planners", "train", "planner=ego_mlp_small", "data.real=[a]", "data.sim=[b]", "executor=ray")),
    ],
)
def test_a_cluster_that_wants_its_token_says_so_first(
    head: Head, tmp_path: Path, mode: str, words: tuple[str, ...]
) -> None:
    environment = head.environment | {"RAY_ADDRESS": head.gcs, "HOME": str(tmp_path), "RAY_AUTH_MODE": mode}
    command = [sys.executable, "-m", *words, f"out={tmp_path / 'out'}"]
    ran = subprocess.run(command, cwd=REPOSITORY, env=environment, capture_output=True, text=True, timeout=200)
    (line,) = (line for line in ran.stderr.splitlines() if line.startswith("error: "))
    assert ran.returncode == BAD_CONFIG and line.startswith("error: this command lacks the token of the Ray cluster")
