"""Attention layers: queries that are the same for every sample need not be repeated."""

import torch

from planners.models.layers import Decoder


def test_one_set_of_queries_stands_for_as_many_as_there_are_memories() -> None:
    torch.manual_seed(0)
    decoder = Decoder(width=8, heads=2, feedforward=16, layers=2).double()
    memory = torch.randn(3, 5, 8, dtype=torch.float64)
    once = torch.randn(1, 7, 8, dtype=torch.float64, requires_grad=True)
    repeated = once.detach().expand(3, -1, -1).clone().requires_grad_()
    answer, expected = decoder(once, memory), decoder(repeated, memory)
    torch.testing.assert_close(answer, expected)
    assert answer.shape == (3, 7, 8)
    weights = torch.randn_like(answer)
    (answer * weights).sum().backward()
    (expected * weights).sum().backward()
    assert once.grad is not None and repeated.grad is not None
    torch.testing.assert_close(once.grad, repeated.grad.sum(dim=0, keepdim=True))
