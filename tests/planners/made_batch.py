"""Batches out of nothing, for planners that are asked for one step or made to learn a few samples by heart."""

import torch
from torch import Tensor

from planners.data.batch import Batch, Needs


def made_batch(needs: Needs, n: int, seed: int = 0) -> Batch:
    """n samples of what is needed. The plan is told by the picture and the raster alone: the status is always the same.

    Plans are arcs of 0 .. 10 m/s and -0.05 .. 0.05 1/m; the picture of each is a patchwork of its own.
    """
    made = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=made)

    speed, curvature = uniform(n, 1) * 10.0, uniform(n, 1) * 0.1 - 0.05
    image = bev = agents = there = None
    if needs.image is not None:
        patches = (uniform(n, 3, 2, 8) * 255).to(torch.uint8)
        image = patches.repeat_interleave(needs.image.height // 2, 2).repeat_interleave(needs.image.width // 8, 3)
    if needs.bev is not None:
        rows, columns = needs.bev.shape
        cells = (uniform(n, len(needs.bev.times_s), 4, 4) * 8).to(torch.uint8)
        bev = cells.repeat_interleave(rows // 4, 2).repeat_interleave(columns // 4, 3)
    if needs.n_agents:
        agents = uniform(n, needs.n_agents, 5) * torch.tensor([30.0, 30.0, 3.0, 5.0, 2.0])
        agents[..., 1] -= 15.0
        there = uniform(n, needs.n_agents) < 0.5
    return Batch(
        tuple(f"{seed}-{i}" for i in range(n)),
        status=torch.tensor([0.0, 1.0, 0.0, 0.0, 5.0, 0.0, 0.1, 0.0]).expand(n, 8),
        history=torch.zeros(n, 4, 3),
        plan_2hz=_arcs(speed, curvature, 0.5, 8),
        plan_10hz=_arcs(speed, curvature, 0.1, 40),
        simulated=torch.zeros(n, dtype=torch.bool),
        imitate=torch.ones(n, dtype=torch.bool),
        image=image,
        bev=bev,
        agents=agents,
        agents_valid=there,
    )


def _arcs(speed: Tensor, curvature: Tensor, dt_s: float, n: int) -> Tensor:
    heading = speed * curvature * torch.arange(1, n + 1) * dt_s
    return torch.stack([heading.sin() / curvature, (1 - heading.cos()) / curvature, heading], -1)
