"""How a public state dict is read and moved: nothing of a file runs, nothing is lost silently."""

import os
from collections import OrderedDict
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn

from factory.config.compose import ConfigError
from planners.models.diffusiondrive import sinusoids
from planners.models.layers import Decoder
from planners.published.import_planner import WeightMoves, _points_reordered, read_public_weights, unwrapped_weights


def lightning(path: Path, **more: Any) -> Path:
    """A file as Lightning writes it, of a model with one linear map."""
    weights = OrderedDict(
        {"agent.model._status_encoding.weight": torch.ones(2, 8), "agent.model.a.bias": torch.ones(2)}
    )
    state = {"callbacks": {}, "optimizer_states": [{"state": {}, "param_groups": [{"lr": 1e-4}]}]}
    torch.save({"epoch": 3, "global_step": 7, "state_dict": weights, **state, **more}, path)
    return path


def test_a_lightning_checkpoint_gives_the_model_s_own_names(tmp_path: Path) -> None:
    assert set(read_public_weights(lightning(tmp_path / "a.ckpt"))) == {"_status_encoding.weight", "a.bias"}


def test_nothing_of_a_file_runs(tmp_path: Path) -> None:
    class Code:
        def __reduce__(self) -> Any:
            return os.mkdir, (str(tmp_path / "ran"),)

    path = lightning(tmp_path / "a.ckpt", hyper_parameters=Code())
    with pytest.raises(ConfigError, match="cannot be read as a checkpoint of tensors and plain values"):
        read_public_weights(path)
    assert not (tmp_path / "ran").exists()


def test_what_is_no_checkpoint_is_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "a.ckpt").write_bytes(b"not a file of torch's")
    with pytest.raises(ConfigError, match="cannot be read") as caught:
        read_public_weights(tmp_path / "a.ckpt")
    assert "\n" not in str(caught.value)
    with pytest.raises(ConfigError, match="No such file"):
        read_public_weights(tmp_path / "absent.ckpt")
    for content, said in (
        ({"state_dict": {"a": 1}}, "holds no state_dict of tensors"),
        ([1], "holds no state_dict of tensors"),
        ({"state_dict": {"fc.weight": torch.ones(1)}}, "0 of its 1 weights are named"),
        (
            {"m._status_encoding.weight": torch.ones(1), "teacher.b": torch.ones(1)},
            "holds teacher.b beside the model m",
        ),
    ):
        with pytest.raises(ConfigError, match=said):
            unwrapped_weights(content, "it")


def test_a_decoder_of_torch_s_layers_moves_to_ours() -> None:
    torch.manual_seed(0)
    theirs = nn.TransformerDecoder(nn.TransformerDecoderLayer(16, 2, 32, 0.0, batch_first=True), 2)
    for parameter in theirs.parameters():
        nn.init.normal_(parameter, std=0.3)
    moves, ours = (
        WeightMoves({f"it.{name}": value for name, value in theirs.state_dict().items()}),
        Decoder(16, 2, 32, 2),
    )
    moves.move_decoder("it", "here")
    moves.check_complete()
    ours.load_state_dict({name.removeprefix("here."): value for name, value in moves.ours.items()})
    queries, memory = torch.randn(3, 5, 16), torch.randn(3, 7, 16)
    torch.testing.assert_close(ours(queries, memory), theirs(queries, memory), rtol=1e-5, atol=1e-5)


def test_what_nobody_moved_is_named_and_what_is_left_is_kept_apart() -> None:
    moves = WeightMoves({"a.x": torch.ones(1), "b": torch.ones(2), "c": torch.ones(3)}, "it")
    moves.set_aside("a.")
    moves.move("b", "ours.b", lambda x: 2 * x)
    with pytest.raises(ConfigError, match=r"^it holds c, of which"):
        moves.check_complete()
    with pytest.raises(ConfigError, match=r"^it lacks b:"):
        moves.move("b", "twice")
    with pytest.raises(ConfigError, match=r"^it lacks a\.\.\.\.:"):
        moves.set_aside("a.")
    assert torch.equal(moves.take_frozen("c"), torch.ones(3)) and set(moves.aside) == {"a.x", "c"}
    moves.check_complete()
    assert moves.came_from == {"ours.b": ("b",)} and moves.ours["ours.b"].tolist() == [2.0, 2.0]


def test_a_plan_s_points_are_told_in_the_public_order() -> None:
    """gen_sineembed_for_position: y before x, at each frequency a sine and then a cosine."""
    torch.manual_seed(0)
    points, weight = torch.randn(5, 8, 2), torch.randn(4, 8 * 64)
    rates = 2 * torch.pi / 10000.0 ** (torch.arange(16) / 16)
    angles = points.flip(-1)[..., None] * rates
    theirs = torch.stack([angles.sin(), angles.cos()], dim=-1).flatten(1)
    ours = sinusoids(points, 32, 2 * torch.pi).flatten(1)
    torch.testing.assert_close(ours @ _points_reordered(weight).T, theirs @ weight.T, rtol=1e-4, atol=1e-3)
