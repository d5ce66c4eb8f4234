"""The agent's process: it starts, plans, says what is wrong, and ends; NAVSIM itself where it is at hand."""

import ast
import io
import os
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

from planners.navsim import agent
from planners.navsim.agent import LENGTH, RemotePlanner, agent_input_arrays, receive, send
from planners.navsim.serve import FRONT, AgentPlanner, observation_of
from tests.planners.navsim.agent_inputs import agent_input
from tests.planners.navsim.trained import made, saved

REPOSITORY = Path(__file__).resolve().parents[3]
IN_NAVSIM_S_PYTHON = ("tasks", "factory", "planners", "planners/navsim")  # and of the last what follows
ITS_OWN = ("planners/navsim/agent.py", "planners/navsim/agent.py")


def test_messages_come_back_as_they_were_sent() -> None:
    pipe = io.BytesIO()
    sent = {"image": np.arange(24, dtype=np.uint8).reshape(2, 4, 3), "n_poses": 8, "error": "none", "cameras": FRONT}
    send(pipe, sent)
    send(pipe, {"second": np.eye(2)})
    pipe.seek(0)
    first = receive(pipe)
    assert first is not None and first.keys() == sent.keys()
    np.testing.assert_array_equal(first["image"], sent["image"])
    assert str(first["error"]) == "none" and int(first["n_poses"]) == 8 and tuple(first["cameras"]) == FRONT
    np.testing.assert_array_equal((receive(pipe) or {})["second"], np.eye(2))
    assert receive(pipe) is None


@pytest.mark.parametrize("data", [b"warning", LENGTH.pack(100) + b"short", LENGTH.pack(1 << 40)])
def test_what_is_no_message_is_told(data: bytes) -> None:
    with pytest.raises(ValueError, match="cut off, or something else"):
        receive(io.BytesIO(data))


@pytest.mark.slow
def test_a_process_of_its_own_plans_the_same_and_ends_with_its_owner(tmp_path: Path) -> None:
    folder, given = saved(made("ltf_small"), tmp_path), agent_input(FRONT)
    remote = RemotePlanner(folder, sys.executable)
    assert remote.cameras == FRONT
    here = AgentPlanner(folder)
    for n_poses in (8, 40):
        expected = here.plan(observation_of(agent_input_arrays(given, FRONT), FRONT), n_poses)
        plan = remote.plan(given, n_poses)
        np.testing.assert_allclose(plan, expected, atol=1e-5)  # it has other threads than this process
        assert plan.shape == (n_poses, 3) and plan.dtype == np.float32
    given.cameras[-1].cam_f0.image = np.zeros((90, 160, 3), np.float32)
    with pytest.raises(RuntimeError, match="cam_f0: a picture is"):
        remote.plan(given, 8)
    assert remote.plan(agent_input(FRONT), 8).shape == (8, 3), "a question that is refused ends nothing"
    process = remote._process
    remote.close()
    assert process.wait(timeout=20) == 0
    with pytest.raises(RuntimeError, match="was closed"):
        remote.plan(agent_input(FRONT), 8)


@pytest.mark.slow
def test_why_it_cannot_plan_is_said_before_the_first_scene(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="neither a folder nor one of"):
        RemotePlanner(str(tmp_path / "gone"), sys.executable)


def test_a_python_without_the_planners_is_told() -> None:
    with pytest.raises(RuntimeError, match="ended with code"):
        RemotePlanner("constant_velocity", "/bin/false")


def test_what_runs_in_navsim_s_python_is_of_its_version_and_needs_numpy_alone() -> None:
    files = [f"{package}/__init__.py" for package in IN_NAVSIM_S_PYTHON] + list(ITS_OWN)
    for file in files:
        text = (REPOSITORY / file).read_text()
        tree = ast.parse(text, feature_version=(3, 9))
        if file in ITS_OWN:
            assert "from __future__ import annotations" in text, f"{file}: 3.9 has no X | None"
            named = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
            ours = {name for name in named if name and name.startswith(("planners", "factory", "tasks"))}
            assert ours <= {"planners.navsim.agent"}


def test_the_agent_s_file_names_every_setting_of_it() -> None:
    tree = ast.parse((REPOSITORY / "planners/navsim/agent.py").read_text())
    (made,) = [node for node in ast.walk(tree) if isinstance(node, ast.ClassDef) and node.name == "FactoryAgent"]
    (begin,) = [node for node in made.body if isinstance(node, ast.FunctionDef) and node.name == "__init__"]
    content = yaml.safe_load((REPOSITORY / "deploy/navsim/agent/factory_agent.yaml").read_text())
    assert content["_target_"] == f"{agent.__name__}.FactoryAgent"
    assert [key for key in content if not key.startswith("_")] == [arg.arg for arg in begin.args.args[1:]]
    sampling = content["trajectory_sampling"]
    assert (sampling["time_horizon"] / sampling["interval_length"], sampling["interval_length"]) in agent.SAMPLINGS


def test_without_navsim_only_the_agent_itself_is_missing() -> None:
    with pytest.raises(AttributeError, match="no attribute Agent"):
        agent.Agent  # noqa: B018
    if "NAVSIM_PYTHON" not in os.environ:
        with pytest.raises(ModuleNotFoundError, match="navsim"):
            agent.FactoryAgent  # noqa: B018
