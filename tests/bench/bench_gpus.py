"""How busy the task graph keeps eight GPUs: its schedule on claimed, virtual ones, with stages that only wait.

    python -m tests.bench.bench_gpus                          64 cores and 8 GPUs in name, 60 blocks of navtest's mix
    python -m tests.bench.bench_gpus cpus=32 blocks=100 fit_s=10

A GPU is a lock that whoever fits or draws on it holds meanwhile, so that what two ask of it takes as long as both. A
block is prepared for `prepare_s` on a core, fitted for `fit_s` on a GPU and measured for `finish_s`; of each of its
clips a sample is drawn for `draw_s`, and driven and labelled beside. `idle` is the share of the time that the GPUs
wait: in all, and while there are blocks to begin, which in a run of navtrain's 15,000 blocks is nearly always.
"""

import fcntl
import os
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from factory.config.arguments import run_request_command
from factory.exits import COMPLETE
from factory.graph.execute import Execution, execute
from factory.graph.local import Claims
from factory.graph.on_ray.graph import ray  # with the environment that keeps it on loopback
from factory.graph.steps import AcceptedDrive, BlockReport, PreparedClip, SampleColumns, Spent, StopCheck, never_stop
from factory.readers.base import ClipRef
from factory.store.samples import Store
from tasks.render.splatting.gsplat_backend import own_place
from tests.factory.toy import PICTURES, ToyWork, any_row

# Blocks of navtest (20 s, begun every 10 s) with 1, 2, ... of its 12,146 clips: of the log and start time of each row
# of a published table of scores.
BLOCKS_BY_CLIPS = (162, 145, 157, 160, 168, 146, 138, 118, 86, 91, 64, 65, 61, 54, 23, 34, 23, 15, 13, 19, 3)


@dataclass(frozen=True)
class Request:
    """The command line."""

    cpus: int = 64
    gpus: int = 8
    gpu_share: float = 0.1
    blocks: int = 60
    prepare_s: float = 20.0
    fit_s: float = 6.0
    finish_s: float = 2.0
    draw_s: float = 0.3
    drive_s: float = 0.3
    seed: int = 0

    def __post_init__(self) -> None:
        if min(self.cpus, self.gpus, self.blocks) < 1:
            raise ValueError("cpus, gpus and blocks: at least 1 each")


@dataclass(frozen=True)
class VirtualGpuWork(ToyWork):
    """Stages that wait, on a core or on one of so many GPUs."""

    request: Request = Request()
    folder: str = ""

    def block(self, ref: ClipRef) -> str | None:
        return ref.log_id

    def reconstruct(self, ref: ClipRef, threads: int, stopped: StopCheck = never_stop) -> BlockReport:
        began = time.time()
        time.sleep(self.request.prepare_s)
        with self._gpu(f"fit {began}"):
            time.sleep(self.request.fit_s)
        time.sleep(self.request.finish_s)
        return BlockReport({"reconstruct": Spent(time.time() - began)}, from_cache=False, psnr_db=28.0)

    def drive(self, prepared: PreparedClip, candidate: int, expert: str) -> AcceptedDrive:
        time.sleep(self.request.drive_s)
        name = f"{prepared.clip_id}:{expert}:{candidate}"
        return AcceptedDrive(
            (name, any_row() | {"clip_id": prepared.clip_id, "content_digest": prepared.content_digest})
        )

    def drawn(self, driven: AcceptedDrive) -> SampleColumns:
        with self._gpu("draw"):
            time.sleep(self.request.draw_s)
        row = driven.payload[1]  # type: ignore[index]
        return SampleColumns({key: row[key] for key in PICTURES} | {"tags": []})

    @contextmanager
    def _gpu(self, what: str) -> Iterator[None]:
        """This process's GPU, alone; when it was held is noted."""
        place = own_place() % self.request.gpus
        with open(Path(self.folder, f"gpu-{place}"), "a") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            began = time.time()
            yield
            file.write(f"{began} {time.time()} {os.getpid()} {what}\n")


def main(request: Request) -> None:
    """Print what the GPUs did."""
    rng = np.random.default_rng(request.seed)
    share = np.array(BLOCKS_BY_CLIPS) / sum(BLOCKS_BY_CLIPS)
    sizes = rng.choice(len(share), request.blocks, p=share) + 1
    refs = [ClipRef("virtual", f"log{block:04d}", 1000 * k) for block, n in enumerate(sizes) for k in range(n)]
    memory = 4e9 * request.cpus  # of a node with such GPUs
    ray.init(
        address="local",
        num_cpus=request.cpus,
        num_gpus=request.gpus,
        _memory=memory,
        include_dashboard=False,
        log_to_driver=False,
    )
    try:
        for gpu in (0.0, request.gpu_share):  # processes of either kind, which take seconds to start
            ray.get([_warm.options(num_gpus=gpu).remote(request.cpus) for _ in range(request.cpus)])
        with tempfile.TemporaryDirectory() as folder:
            work = VirtualGpuWork(threshold=0.0, request=request, folder=folder)
            how = Execution("ray", claims=Claims(gpu_share=request.gpu_share))
            began = time.time()
            summary = execute(work, refs, ["pdm_closed"], 1, Store(Path(folder, "out")), how, say=lambda line: None)
            took_s = time.time() - began
            if summary.exit_code != COMPLETE:
                raise RuntimeError(f"the run ended with {summary.exit_code}: {summary.message}")
            held = [_held(Path(folder, f"gpu-{place}")) for place in range(request.gpus)]
    finally:
        ray.shutdown()
    processes = len({pid for of in held for _, _, pid, _ in of})
    print(
        f"{request.cpus} cores, {request.gpus} GPUs, {request.blocks} blocks, {len(refs)} clips: {took_s:.0f} s, "
        f"fitted and drawn by {processes} processes"
    )
    for text, first, last in (("in all", began, began + took_s), ("with blocks to begin", *_steady(held))):
        idle = [1.0 - _overlap_s(of, first, last) / (last - first) for of in held]
        each = " ".join(f"{100.0 * share:.0f}" for share in idle)
        print(f"  {text:<22}{last - first:6.0f} s   idle {100.0 * np.mean(idle):5.1f} %   of each: {each}")


Held = list[tuple[float, float, str, str]]


def _held(path: Path) -> Held:
    """When a GPU was held, from, to, by which process and what for."""
    rows = [line.split(" ", 3) for line in (path.read_text().splitlines() if path.exists() else [])]
    return [(float(first), float(last), pid, what) for first, last, pid, what in rows]


def _steady(held: Sequence[Held]) -> tuple[float, float]:
    """From when each GPU was first held to when the last block was begun."""
    begun = max(float(what.split()[1]) for of in held for _, _, _, what in of if what.startswith("fit"))
    return max((of[0][0] for of in held if of), default=begun), begun


def _overlap_s(held: Held, first: float, last: float) -> float:
    return sum(max(0.0, min(end, last) - max(start, first)) for start, end, _, _ in held)


@ray.remote(num_cpus=1)
def _warm(processes: int) -> None:
    """Until so many of them have come, two a second."""
    import factory.graph.steps  # noqa: F401

    time.sleep(0.5 * processes)


if __name__ == "__main__":
    sys.exit(run_request_command(main, sys.argv[1:]))
