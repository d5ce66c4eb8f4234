"""`python -m tests.bench.bench_planners`: what a training step of every planner costs.

    python -m tests.bench.bench_planners device=cuda                the paper's settings, bf16
    python -m tests.bench.bench_planners size=small                 the small settings, one thread of a CPU
    python -m tests.bench.bench_planners device=cuda batch=8 planners=ltf,gtrs_dense

Random batches in memory: forward, backward and the optimiser's step; planning beside it. On a CPU it is CPU time.
Memory is the most that PyTorch held on a GPU, or the process. Nothing is read from disk, see bench_decoding for that.
"""

import sys
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from factory.config.compose import compose, fill
from planners.data.batch import Batch, Needs
from planners.models.planner import Planner, planner_class, settings_of
from planners.training.optim import build_optimiser
from planners.training.train import PlannerEntry
from tasks.subscores import LABELLED
from tasks.world.vocabulary import kinematic_trajectories
from tests.bench.timing import cpu_milliseconds, memory_mb, milliseconds

PAPER = ("ego_mlp", "ltf", "diffusiondrive", "gtrs_dense", "gtrs_dense_v2_99")
SMALL = ("ego_mlp_small", "ego_mlp_bev_small", "ltf_small", "diffusiondrive_small", "gtrs_dense_small")
VOCABULARY = {"paper": 16384, "small": 1024}


def random_batch(size: int, needs: Needs, k: int) -> Batch:
    """A batch of what a planner reads; values as a sample has them, content of none."""
    rng = torch.Generator().manual_seed(0)

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(size, *shape, generator=rng)

    plan = torch.cumsum(uniform(40, 3) * torch.tensor([1.0, 0.1, 0.01]), dim=1)
    shape = (needs.image.height, needs.image.width) if needs.image is not None else (0, 0)
    image = torch.randint(0, 256, (size, 3, *shape), dtype=torch.uint8, generator=rng)
    classes = (len(needs.bev.times_s), *needs.bev.shape) if needs.bev is not None else ()
    return Batch(
        attempt_ids=tuple(map(str, range(size))),
        status=uniform(8),
        history=uniform(4, 3),
        plan_2hz=plan[:, 4::5],
        plan_10hz=plan,
        simulated=torch.zeros(size, dtype=torch.bool),
        imitate=torch.ones(size, dtype=torch.bool),
        image=image.contiguous(memory_format=torch.channels_last) if needs.image is not None else None,
        bev=torch.randint(0, 7, (size, *classes), dtype=torch.uint8, generator=rng) if needs.bev is not None else None,
        agents=10.0 * uniform(needs.n_agents, 5) if needs.n_agents else None,
        agents_valid=uniform(needs.n_agents) > 0.5 if needs.n_agents else None,
        labels={name: (uniform(k) > 0.5).float() for name in LABELLED} if needs.labels is not None else None,
    )


def made(name: str, k: int) -> tuple[Planner, PlannerEntry]:
    """A planner of conf/planner around made-up anchors and a kinematic vocabulary."""
    entry = fill(PlannerEntry, compose("train", [f"planner={name}"])["planner"], "planner")
    vocabulary = kinematic_trajectories(k, seed=0)
    arrays: dict[str, np.ndarray[Any, Any]] = {"vocabulary": vocabulary, "anchors": vocabulary[:20, 4::5, :2]}
    return planner_class(entry.name)(settings_of(entry), arrays), entry


def row(name: str, size: str, device: torch.device, batch: int | None) -> str:
    """One line of the table."""
    k = VOCABULARY[size]
    planner, entry = made(name, k)
    assert entry.training is not None
    planner.to(device)
    n = batch or (32 if size == "small" else 16)
    data = random_batch(n, planner.needs, k).to(device)
    optimiser = build_optimiser(entry.training, planner)
    on_gpu = device.type == "cuda"

    def wait() -> None:
        if on_gpu:
            torch.cuda.synchronize()

    def step() -> None:
        planner.train()
        optimiser.zero_grad(set_to_none=True)
        with torch.autocast(device.type, torch.bfloat16, enabled=on_gpu):
            loss = torch.stack([term.float() for term in planner(data).values()]).sum()
        loss.backward()
        optimiser.step()
        wait()

    def plan() -> None:
        planner.eval()
        with torch.no_grad(), torch.autocast(device.type, torch.bfloat16, enabled=on_gpu):
            planner.plan(data)
        wait()

    clock = milliseconds if on_gpu else cpu_milliseconds
    step_ms, plan_ms = clock(step, 5), clock(plan, 5)
    held_mb = torch.cuda.max_memory_allocated() / 2**20 if on_gpu else memory_mb("VmHWM")
    if on_gpu:
        torch.cuda.reset_peak_memory_stats()
    millions = sum(p.numel() for p in planner.parameters()) / 1e6
    trained, planned = 1e3 * n / step_ms, 1e3 * n / plan_ms
    return f"{name:<22}{millions:9.2f}{n:7}{step_ms:10.1f}{trained:11.1f}{planned:11.1f}{held_mb / 1024:9.2f}"


def main(argv: Sequence[str]) -> None:
    """Prints the table."""
    given = dict(argument.split("=", 1) for argument in argv)
    device = torch.device(given.get("device", "cpu"))
    size = given.get("size", "paper")
    names = given["planners"].split(",") if "planners" in given else (PAPER if size == "paper" else SMALL)
    batch = int(given["batch"]) if "batch" in given else None
    where = torch.cuda.get_device_name(device) if device.type == "cuda" else f"CPU, {torch.get_num_threads()} threads"
    print(f"{where}; {size} settings; {'bf16' if device.type == 'cuda' else 'fp32'}")
    print(f"{'planner':<22}{'M params':>9}{'batch':>7}{'step ms':>10}{'train/s':>11}{'plan/s':>11}{'GiB':>9}")
    for name in names:
        print(row(name, size, device, batch), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
