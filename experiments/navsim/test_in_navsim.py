"""NAVSIM takes the agent and the submission: `NAVSIM_PYTHON=<python with NAVSIM> pytest experiments/navsim`."""

import io
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from factory.exits import COMPLETE
from planners.navsim.agent import agent_input_arrays
from planners.navsim.serve import FRONT, AgentPlanner, observation_of
from tests.pages import REPOSITORY
from tests.planners.navsim.agent_inputs import agent_input
from tests.planners.navsim.test_submit import files as files  # the fixture
from tests.planners.navsim.test_submit import submit
from tests.planners.navsim.trained import made, saved

NAVSIM_PYTHON = os.environ.get("NAVSIM_PYTHON", "")
pytestmark = pytest.mark.skipif(not NAVSIM_PYTHON, reason="NAVSIM_PYTHON names no interpreter that has NAVSIM")

AGENT = """
import pickle, sys
import numpy as np
from hydra.utils import instantiate
from navsim.agents.abstract_agent import AbstractAgent
from navsim.common.dataclasses import AgentInput, Camera, Cameras, EgoStatus, Trajectory
stored = np.load(sys.argv[1])
checkpoint, python = sys.argv[2:]
config = {"_target_": "planners.navsim.agent.FactoryAgent", "_convert_": "all", "checkpoint": checkpoint}
agent = instantiate({**config, "python": python})
assert isinstance(agent, AbstractAgent) and not agent.requires_scene
sensors = agent.get_sensor_config()
assert sensors.get_sensors_at_iteration(3) == ["cam_f0", "cam_l0", "cam_r0"]
assert not any(sensors.get_sensors_at_iteration(i) for i in (0, 1, 2, 4, 11))
agent.initialize()
names = ["cam_f0", "cam_l0", "cam_l1", "cam_l2", "cam_r0", "cam_r1", "cam_r2", "cam_b0"]
keys = ["image", "rotation", "translation", "intrinsics", "distortion"]
cameras = {n: Camera(*(stored[f"{n}.{k}"] for k in keys)) if f"{n}.image" in stored else Camera() for n in names}
status = stored["status"]
egos = [EgoStatus(pose, status[4:6], status[6:], status[:4].astype(int)) for pose in stored["history"]]
plan = agent.compute_trajectory(AgentInput(egos, [Cameras(**cameras)] * 4, []))
assert isinstance(plan, Trajectory) and plan.trajectory_sampling.num_poses == 8
again = pickle.loads(pickle.dumps({"first_stage_predictions": [{"token": plan}]}))
np.save(sys.stdout.buffer, again["first_stage_predictions"][0]["token"].poses)
"""


def test_navsim_s_own_code_takes_the_agent(tmp_path: Path) -> None:
    folder, given = saved(made("ltf_small"), tmp_path / "training"), agent_input(FRONT)
    arrays = agent_input_arrays(given, FRONT)
    np.savez(tmp_path / "seen.npz", **arrays)
    path = os.pathsep.join([str(REPOSITORY), *filter(None, [os.environ.get("NAVSIM_PATH")])])
    command = [NAVSIM_PYTHON, "-c", AGENT, str(tmp_path / "seen.npz"), folder, sys.executable]
    done = subprocess.run(command, env=os.environ | {"PYTHONPATH": path}, capture_output=True, timeout=200)
    assert done.returncode == 0, done.stderr.decode()
    expected = AgentPlanner(folder).plan(observation_of(arrays, FRONT), 8)
    np.testing.assert_allclose(np.load(io.BytesIO(done.stdout)), expected, atol=1e-5)


SUBMISSION = """
import pickle, sys
from navsim.common.dataclasses import Trajectory
from nuplan.planning.simulation.trajectory.trajectory_sampling import TrajectorySampling as Sampling
content = pickle.load(open(sys.argv[1], "rb"))
plans = [*content["first_stage_predictions"][0].values(), *content["second_stage_predictions"][0].values()]
for plan in plans:
    plan.__post_init__()
    plan.trajectory_sampling.__post_init__()
    assert type(plan) is Trajectory and plan.trajectory_sampling == Sampling(time_horizon=4, interval_length=0.5)
print(len(plans))
"""


def test_navsim_s_own_code_takes_the_file(files: Path) -> None:
    assert submit(files, "constant_velocity") == COMPLETE
    command = [NAVSIM_PYTHON, "-c", SUBMISSION, str(files / "submission.pkl")]
    env = os.environ | {"PYTHONPATH": os.environ.get("NAVSIM_PATH", "")}
    done = subprocess.run(command, env=env, capture_output=True, timeout=200)
    assert done.returncode == 0 and done.stdout == b"5\n", done.stderr.decode()
