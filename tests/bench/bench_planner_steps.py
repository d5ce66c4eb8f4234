"""What a training of the published planners takes: measured steps, counted operations, and the hours they come to.

    python -m tests.bench.bench_planner_steps [planners=ltf_public,...] [batch=1] [repeats=2]
    python -m tests.bench.bench_planner_steps device=cuda batch=64      your GPU's own hours, in bf16
    python -m tests.bench.bench_planner_steps shapes=true planners=gtrs_dense_public     counts alone, in seconds

The presets at their full size around random batches in memory: forward, backward and the optimiser's step; planning one
scene; the bytes that stay between forward and backward, which a batch multiplies. Operations (two for a multiplication
with its addition) are counted by torch.utils.flop_counter, those of attention as matrix products. The first table is
measured and counted. The second is measured on a GPU, and without one arithmetic on published peaks: no measurement.
With shapes=true nothing is computed, so that V2-99 takes no minutes of a CPU; the losses of LTF and DiffusionDrive
match boxes outside of torch, and cannot be counted so.
"""

import math
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from factory.config.compose import compose, fill
from planners.data.batch import Batch, Needs
from planners.models.backbones import set_recompute
from planners.models.planner import Planner, planner_class
from planners.models.settings import settings_of
from planners.training.optim import TrainingSettings, build_optimiser
from planners.training.train import PlannerEntry
from tasks.subscores import LABELLED
from tasks.world.vocabulary import kinematic_trajectories
from tests.bench.timing import memory_mb

PUBLIC = ("ltf_public", "diffusiondrive_public", "gtrs_dense_public", "gtrs_dense_v2_99_public")
REAL = 103_288  # tokens of navtrain
SIMULATED = 236_000  # of five rounds of SimScale's release with planner-based experts, as its table counts them
SEEN = {"real": REAL, "real and simulated": REAL + SIMULATED}
GPUS = 8
PEAKS = {"H100 SXM": 989.0, "H20": 148.0}  # TFLOP/s of dense bf16, as NVIDIA publishes them
SHARE = 0.3  # of the peak that a training reaches: an assumption, `share=` is another
VOCABULARY_SIZE = 16384  # the paper's


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


@dataclass(frozen=True)
class Measured:
    """Of one planner; operations and bytes are a sample's."""

    name: str
    training: TrainingSettings
    parameters: int
    forward_flop: float
    step_flop: float
    step_s: tuple[float, float]  # of one sample in a batch: by the clock, CPU; NaN where only counted
    plan_s: tuple[float, float]
    state_gb: float  # weights, gradients, optimiser
    held_gb: dict[str, float]  # between forward and backward, by precision
    peak_gb: float


def main(
    names: Sequence[str], device: torch.device, batch: int, repeats: int, gpus: int, share: float, shapes: bool
) -> None:
    """Prints both tables."""
    on_gpu = device.type == "cuda"
    where = torch.cuda.get_device_name(device) if on_gpu else f"CPU, {torch.get_num_threads()} threads, fp32"
    print(f"{where}; batches of {batch}, best of {repeats}; 2048 x 512; a scene is planned alone\n")
    titles = "planner | M parameters | forward, step [TFLOP] | step of a sample [s, CPU s] | scene planned [s, CPU s]"
    print(
        f"| {titles} | weights, gradients, optimiser [GB] | kept for backward, a sample [GB]: fp32, bf16, recomputed |"
        " peak [GB] |"
    )
    print("|---" * 8 + "|")
    found = []
    for name in names:
        found.append(counted_alone(name, batch) if shapes else measured(name, device, batch, repeats))
        print(line(found[-1]), flush=True)
    print()
    if on_gpu:
        print(f"measured, {gpus} of this GPU at the rate of one, nothing waiting for pictures or for each other:\n")
        hours(found, {where: [1.0 / one.step_s[0] for one in found]}, gpus)
    else:
        print(f"arithmetic, {gpus} GPUs at {100 * share:.0f} % of their published peak in bf16:\n")
        rates = {gpu: [share * 1e12 * peak / one.step_flop for one in found] for gpu, peak in PEAKS.items()}
        hours(found, rates, gpus)


def hours(found: Sequence[Measured], rates: dict[str, list[float]], gpus: int) -> None:
    """The second table: samples a second of one GPU, and hours of all of them for the published epochs."""
    seen = " | ".join(f"hours, {name} ({n:,})" for name, n in SEEN.items())
    print(f"| planner | GPU | samples / s, one | epochs, batch | {seen} |")
    print("|---" * (4 + len(SEEN)) + "|")
    for i, one in enumerate(found):
        for gpu, per_second in rates.items():
            epochs = one.training.epochs
            taken = " | ".join(f"{n * epochs / (gpus * per_second[i]) / 3600:.1f}" for n in SEEN.values())
            batch = one.training.batch_size
            print(f"| `{one.name}` | {gpu} | {per_second[i]:.0f} | {epochs}, {batch} | {taken} |", flush=True)


def line(one: Measured) -> str:
    """A row of the first table."""
    step, plan = (", ".join(map(number, pair)) for pair in (one.step_s, one.plan_s))
    held = ", ".join(f"{gb:.2f}" for gb in one.held_gb.values())
    return (
        f"| `{one.name}` | {one.parameters / 1e6:.1f} | {one.forward_flop / 1e12:.2f}, {one.step_flop / 1e12:.2f} "
        f"| {step} | {plan} | {one.state_gb:.2f} | {held} | {number(one.peak_gb)} |"
    )


def number(value: float) -> str:
    """Three digits; NaN: not measured."""
    return "-" if math.isnan(value) else f"{value:.3g}"


def measured(name: str, device: torch.device, batch: int, repeats: int) -> Measured:
    """Builds a preset and runs it."""
    k = VOCABULARY_SIZE
    planner, entry = made(name, k)
    assert entry.training is not None
    planner.to(device)
    data = random_batch(batch, planner.needs, k).to(device)
    scene = random_batch(1, planner.needs_to_plan, k).to(device)
    optimiser = build_optimiser(entry.training, planner)
    on_gpu = device.type == "cuda"

    def loss() -> Tensor:
        planner.train()
        optimiser.zero_grad(set_to_none=True)
        with torch.autocast(device.type, torch.bfloat16, enabled=on_gpu):
            return torch.stack([term.float() for term in planner(data).values()]).sum()

    def step() -> None:
        loss().backward()
        optimiser.step()

    def plan() -> None:
        planner.eval()
        with torch.no_grad(), torch.autocast(device.type, torch.bfloat16, enabled=on_gpu):
            planner.plan(scene)

    forward_flop, step_flop = operations(loss)
    if on_gpu:
        torch.cuda.reset_peak_memory_stats()
    step_s = timed(step, repeats, on_gpu)
    peak_gb = torch.cuda.max_memory_allocated() / 1e9 if on_gpu else memory_mb("VmHWM") * 2**20 / 1e9
    plan_s = timed(plan, repeats, on_gpu)
    return Measured(
        name,
        entry.training,
        sum(p.numel() for p in planner.parameters()),
        forward_flop / batch,
        step_flop / batch,
        (step_s[0] / batch, step_s[1] / batch),
        plan_s,
        state_gb(planner, optimiser),
        held(planner, data, device),
        peak_gb,
    )


def counted_alone(name: str, batch: int) -> Measured:
    """Operations and bytes of a preset, from the shapes of what it would compute."""
    k = VOCABULARY_SIZE
    planner, entry = made(name, k)
    assert entry.training is not None
    data = random_batch(batch, planner.needs, k)
    with FakeTensorMode(allow_non_fake_inputs=True) as fake:

        def shape(value: Any) -> Any:
            if isinstance(value, Tensor):
                return fake.from_tensor(value)
            return {key: shape(one) for key, one in value.items()} if isinstance(value, Mapping) else value

        data = replace(data, **{f.name: shape(getattr(data, f.name)) for f in fields(data)})
        for module in planner.modules():
            for key, weight in module.named_parameters(recurse=False):
                setattr(module, key, torch.nn.Parameter(fake.from_tensor(weight), weight.requires_grad))
            for key, buffer in module.named_buffers(recurse=False):
                setattr(module, key, fake.from_tensor(buffer))
        planner.train()
        optimiser = build_optimiser(entry.training, planner)
        flop = operations(lambda: torch.stack([term.float() for term in planner(data).values()]).sum())
        optimiser.step()
        return Measured(
            name,
            entry.training,
            sum(p.numel() for p in planner.parameters()),
            flop[0] / batch,
            flop[1] / batch,
            (math.nan, math.nan),
            (math.nan, math.nan),
            state_gb(planner, optimiser),
            held(planner, data, torch.device("cpu")),
            math.nan,
        )


def operations(loss: Callable[[], Tensor]) -> tuple[float, float]:
    """Of the forward pass to the loss, and of forward and backward pass together."""
    with FlopCounterMode(display=False) as counted, sdpa_kernel(SDPBackend.MATH):
        ahead = loss()
        forward = counted.get_total_flops()
        ahead.backward()  # type: ignore[no-untyped-call]
        return forward, counted.get_total_flops()


def state_gb(planner: Planner, optimiser: torch.optim.Optimizer) -> float:
    """Weights, gradients, and what the optimiser keeps."""
    tensors = [*planner.parameters(), *planner.buffers()]
    tensors += [p.grad for p in planner.parameters() if p.grad is not None]
    tensors += [value for state in optimiser.state.values() for value in state.values() if isinstance(value, Tensor)]
    return sum(tensor.numel() * tensor.element_size() for tensor in tensors) / 1e9


def timed(call: Callable[[], None], repeats: int, on_gpu: bool) -> tuple[float, float]:
    """Seconds by the clock and of CPU of the quickest call."""
    walls, cpus = [], []
    for _ in range(repeats):
        wall, cpu = time.perf_counter(), time.process_time()
        call()
        if on_gpu:
            torch.cuda.synchronize()
        walls.append(time.perf_counter() - wall)
        cpus.append(time.process_time() - cpu)
    return min(walls), min(cpus)


def held(planner: Planner, data: Batch, device: torch.device) -> dict[str, float]:
    """GB a sample that autograd keeps for the backward pass, beside weights: every storage once."""
    weights = {t.untyped_storage()._cdata for t in (*planner.parameters(), *planner.buffers())}
    found = {}
    for name, precision, again in (("fp32", None, False), ("bf16", torch.bfloat16, False), ("recomputed", None, True)):
        set_recompute(planner, again)
        kept: dict[int, torch.UntypedStorage] = {}  # held, so that no other takes its place

        def keep(tensor: Tensor, kept: dict[int, torch.UntypedStorage] = kept) -> Tensor:
            storage = tensor.untyped_storage()
            if storage._cdata not in weights:
                kept[storage._cdata] = storage
            return tensor

        planner.train()
        with (
            torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor),
            torch.autocast(device.type, precision, enabled=precision is not None),
        ):
            terms = planner(data)
        found[name] = sum(storage.nbytes() for storage in kept.values()) / len(data) / 1e9
        del terms
    set_recompute(planner, False)
    return found


if __name__ == "__main__":
    given = dict(word.split("=", 1) for word in sys.argv[1:])
    main(
        given.get("planners", ",".join(PUBLIC)).split(","),
        torch.device(given.get("device", "cpu")),
        int(given.get("batch", 1)),
        int(given.get("repeats", 2)),
        int(given.get("gpus", GPUS)),
        float(given.get("share", SHARE)),
        given.get("shapes") == "true",
    )
