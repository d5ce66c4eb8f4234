"""Folders of very many logs on a slow file system.

    python -m experiments.chaos.slow_logs [logs=100000] [read=200] [ms=2]

Small logs in the layouts of three data sets, linked `logs` times; each look at them takes `ms` longer (slow_files.c).
For each a line: calls a log and seconds until all are listed; calls a log, CPU with that of ended readers, and seconds
to find the clips of `read` of them; calls until a worker that was sent the reader has read a clip, and then another.
"""

import os
import pickle
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from factory.config.arguments import run_request_command
from factory.datasets.av2.reader import AV2Reader
from factory.datasets.navsim.reader import NavsimReader
from factory.datasets.scenarionet.reader import ScenarioNetReader
from tests.chaos.file_steps import compiler
from tests.factory.datasets.av2.test_av2 import write_log
from tests.factory.datasets.navsim import small
from tests.factory.datasets.scenarionet import scenarionet_scenarios

LINKS = 50_000  # of one file, where ext4 has 65,000 at most
SOURCE = Path(__file__).with_name("slow_files.c")
LOG = "SLOW_FILES_LOG"


@dataclass(frozen=True)
class Request:
    """The command line."""

    logs: int = 100_000
    read: int = 200  # of them
    ms: float = 2.0  # a call
    layout: str = ""  # this one alone, in this process
    root: str = ""  # where its logs lie


def av2(root: Path, n: int) -> None:
    for i in range(n):
        folder = root / "train" / f"log-{i:06}"
        if i % LINKS == 0:
            written = write_log(folder)
            continue
        for file in (path for path in written.rglob("*") if path.is_file()):
            path = folder / file.relative_to(written)
            path.parent.mkdir(parents=True, exist_ok=True)
            os.link(file, path)


def scenarionet(root: Path, n: int) -> None:
    for i in range(n):
        name = f"sd_nuscenes_x_scene-{i:06}.pkl"
        if i % LINKS == 0:
            written = scenarionet_scenarios.save(scenarionet_scenarios.nuscenes(), root, name)
        else:
            os.link(written, root / name)


def navsim(root: Path, n: int) -> None:
    small.write_city(root)
    first = small.write_log(root, small.road_frames())
    for i in range(1, n):
        os.link(first, first.with_name(f"log-{i:06}.pkl"))
        if i % LINKS == 0:
            first = first.with_name(f"log-{i:06}.pkl")
            first.write_bytes(first.read_bytes())


LAYOUTS: dict[str, tuple[Callable[[Path, int], None], Callable[[Path, tuple[str, ...]], Any]]] = {
    "scenarionet": (scenarionet, lambda root, only: ScenarioNetReader(root, only=only)),
    "av2": (av2, lambda root, only: AV2Reader(root, only=only)),
    "navsim": (
        navsim,
        lambda root, only: NavsimReader(
            root / "navsim_logs/mini", root / "maps", only=only, cache_dir=str(root.parent / "kept")
        ),
    ),
}


def main(request: Request) -> None:
    """Prints the table."""
    if request.layout:
        print(measured(request))
        return
    print(f"{'layout':<13}{'list: calls':>12}{'s':>8}{'index: calls':>14}{'CPU s':>8}{'s':>8}{'a clip: calls':>15}"
          f"{'another':>9}")  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder) / "slow_files.so"
        subprocess.run([str(compiler()), "-O1", "-shared", "-fPIC", "-o", library, SOURCE, "-ldl"], check=True)
        for layout, (make, _) in LAYOUTS.items():
            root = Path(folder) / layout
            make(root, request.logs)
            slow = {"LD_PRELOAD": str(library), "SLOW_FILES_BELOW": str(root), "SLOW_FILES_MS": str(request.ms)}
            given = vars(request) | {"layout": layout, "root": root}
            words = [f"{name}={value}" for name, value in given.items()]
            command = [sys.executable, "-m", "experiments.chaos.slow_logs", *words]
            said = subprocess.run(command, env=os.environ | slow, check=True, capture_output=True, text=True)
            print(said.stdout.strip(), flush=True)


def measured(request: Request) -> str:
    """A line of the table."""
    root, made = Path(request.root), LAYOUTS[request.layout][1]
    every, list_calls, list_s, _ = _met(root, lambda: dict(made(root, ()).logs()))
    chosen = made(root, tuple(list(every)[: request.read]))
    chosen.logs()
    index, index_calls, index_s, cpu_s = _met(root, chosen.index)
    worker = pickle.loads(pickle.dumps(chosen))
    first, last = index.refs[0], index.refs[-1]
    _, clip_calls, *_ = _met(root, lambda: (worker.digest(first), worker.read(first)))
    _, another_calls, *_ = _met(root, lambda: (worker.digest(last), worker.read(last)))
    return (f"{request.layout:<13}{list_calls / len(every):12.2f}{list_s:8.1f}{index_calls / request.read:14.1f}"
            f"{cpu_s:8.1f}{index_s:8.1f}{clip_calls:15d}{another_calls:9d}")  # fmt: skip


def _met(root: Path, do: Callable[[], Any]) -> tuple[Any, int, float, float]:
    """What it gives, with how many calls, seconds, CPU seconds of this process and those it has ended."""
    log = root.parent / "calls"
    log.unlink(missing_ok=True)
    os.environ[LOG], began, before = str(log), time.perf_counter(), _cpu_s()
    given = do()
    return given, len(log.read_text().splitlines()), time.perf_counter() - began, _cpu_s() - before


def _cpu_s() -> float:
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(each.ru_utime + each.ru_stime for each in used)


if __name__ == "__main__":
    sys.exit(run_request_command(main, sys.argv[1:]))
