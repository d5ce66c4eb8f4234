"""A trained planner as an agent of NAVSIM: `_target_: planners.navsim.agent.FactoryAgent`.

NAVSIM pins Python 3.9, numpy 1.23 and its own PyTorch, which the planners do not run on. So the agent only hands on
what it is shown, to a second process of the planners' own Python (`python -m planners serve`), and nothing is
installed in NAVSIM's: this checkout on PYTHONPATH is enough. Plans come back as 32-bit floats, unchanged.

`FactoryAgent` is made when it is first asked for: it is a subclass of NAVSIM's AbstractAgent, and without NAVSIM this
module is imported as well.

Question and answer are arrays by name through a pipe: a length, then an .npz, in which nothing runs.
"""

from __future__ import annotations

import io
import os
import struct
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import lru_cache
from importlib import import_module
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

LENGTH = struct.Struct("<Q")
MOST_BYTES = 1 << 30  # eight pictures of 1920 x 1080 take 50 MB


def send(pipe: BinaryIO, arrays: Mapping[str, Any]) -> None:
    """Write one message."""
    body = io.BytesIO()
    np.savez(body, **arrays)
    pipe.write(LENGTH.pack(body.tell()))
    pipe.write(body.getbuffer())
    pipe.flush()


def receive(pipe: BinaryIO) -> dict[str, Any] | None:
    """The next message; None where the other side has gone. Raises ValueError for what is no message."""
    head = pipe.read(LENGTH.size)
    if not head:
        return None
    (length,) = LENGTH.unpack(head) if len(head) == LENGTH.size else (MOST_BYTES + 1,)
    body = pipe.read(length) if length <= MOST_BYTES else b""
    if len(body) != length:
        raise ValueError("a message was cut off, or something else was written in between")
    with np.load(io.BytesIO(body), allow_pickle=False) as arrays:
        return {name: arrays[name] for name in arrays.files}


CAMERAS = ("cam_f0", "cam_l0", "cam_l1", "cam_l2", "cam_r0", "cam_r1", "cam_r2", "cam_b0")
HISTORY = 4  # frames up to now, 0.5 s apart
SAMPLINGS = ((8, 0.5), (40, 0.1))  # poses, s between them


class RemotePlanner:
    """A planner in a process of its own, which ends with this object or this process."""

    def __init__(
        self, checkpoint: str, python: str, device: str = "cpu", cameras: Sequence[str] = (), undistort: bool = False
    ) -> None:
        """Starts it and waits until it can plan. Raises RuntimeError with its reason where it cannot."""
        checkout = str(Path(__file__).resolve().parents[2])
        words = [f"planner={checkpoint}", f"device={device}", f"undistort={str(undistort).lower()}"]
        words += [f"cameras={','.join(cameras)}"] if cameras else []
        self._process = subprocess.Popen(  # noqa: S603 - the user's own command
            [python, "-m", "planners", "serve", *words],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": checkout},  # NAVSIM's own path holds packages of another Python
        )
        self.cameras = tuple(str(name) for name in self._answer()["cameras"])  # that it looks at, left to right

    def plan(self, agent_input: Any, n_poses: int) -> Any:
        """(n_poses, 3) float32 x, y, heading in the ego frame at now, of NAVSIM's AgentInput.

        Raises ValueError for an input that is not what the planner was trained on, RuntimeError where it fails.
        """
        question = agent_input_arrays(agent_input, self.cameras)
        with suppress(BrokenPipeError):  # it has ended, and _answer says how
            send(self._pipe(self._process.stdin), {**question, "n_poses": n_poses})
        return self._answer()["poses"]

    def close(self) -> None:
        """End the process."""
        self._process.communicate()

    def _answer(self) -> dict[str, Any]:
        answer = receive(self._pipe(self._process.stdout))
        if answer is None:
            raise RuntimeError(f"the planner's process ended with code {self._process.wait()}; see what it printed")
        if "error" in answer:
            raise RuntimeError(str(answer["error"]))
        return answer

    @staticmethod
    def _pipe(pipe: Any) -> Any:
        if pipe is None or pipe.closed:
            raise RuntimeError("the planner's process was closed")
        return pipe


def agent_input_arrays(agent_input: Any, cameras: Sequence[str]) -> dict[str, Any]:
    """What a planner reads of an AgentInput, as arrays: history (4, 3), status (8,), and of each camera five.

    Raises ValueError where it has another history, no picture of a camera at now, or poses that are not local.
    """
    statuses = agent_input.ego_statuses
    if len(statuses) != HISTORY:
        raise ValueError(
            f"a history of {len(statuses)} frames; planners were trained on {HISTORY} (num_history_frames)"
        )
    now = statuses[-1]
    if now.in_global_frame:
        raise ValueError("ego poses in the global frame: an agent is given them in that of the ego at now")
    status = [now.driving_command, now.ego_velocity, now.ego_acceleration]
    arrays = {
        "history": np.stack([np.asarray(one.ego_pose, np.float32) for one in statuses]),
        "status": np.concatenate([np.asarray(part, np.float32).reshape(-1) for part in status]),
    }
    for name in cameras:
        camera = getattr(agent_input.cameras[-1], name)
        if camera.image is None:
            raise ValueError(f"no picture of {name} at now: load what get_sensor_config() asks for")
        arrays[f"{name}.image"] = camera.image
        arrays[f"{name}.rotation"] = camera.sensor2lidar_rotation
        arrays[f"{name}.translation"] = camera.sensor2lidar_translation
        arrays[f"{name}.intrinsics"] = camera.intrinsics
        arrays[f"{name}.distortion"] = camera.distortion
    return arrays


def __getattr__(name: str) -> Any:
    if name == "FactoryAgent":
        return _agent_class()
    raise AttributeError(f"module {__name__} has no attribute {name}")


@lru_cache(maxsize=1)
def _agent_class() -> Any:
    abstract: Any = import_module("navsim.agents.abstract_agent").AbstractAgent
    types: Any = import_module("navsim.common.dataclasses")
    trajectory_sampling: Any = import_module(
        "nuplan.planning.simulation.trajectory.trajectory_sampling"
    ).TrajectorySampling

    class FactoryAgent(abstract):
        """See the module. One JPEG a camera and frame is loaded: those that the planner looks at, at now."""

        requires_scene = False

        def __init__(
            self,
            checkpoint: str,
            python: str = sys.executable,
            device: str = "cpu",
            cameras: Sequence[str] | None = None,
            undistort: bool = False,
            trajectory_sampling: Any = trajectory_sampling(time_horizon=4, interval_length=0.5),  # noqa: B008
        ) -> None:
            """checkpoint: a training's folder, a+b, or what else `python -m planners evaluate planner=` takes.

            python: the interpreter that has the planners installed, by default NAVSIM's own; device: where they plan.
            cameras: NAVSIM's cameras in the places of those that the planner was trained on, left to right; by
            default those of the same names, or cam_l0, cam_f0, cam_r0 where it was trained on front cameras by their
            direction. undistort: show it pinhole pictures, for a planner that was trained on such.
            trajectory_sampling: 8 poses 0.5 s apart, or 40 poses 0.1 s apart.
            """
            super().__init__(trajectory_sampling)
            asked = trajectory_sampling.num_poses, trajectory_sampling.interval_length
            if asked not in SAMPLINGS:
                raise ValueError(
                    f"trajectory_sampling of {asked[0]} poses {asked[1]} s apart; planners give {SAMPLINGS}"
                )
            self._start = lambda: RemotePlanner(checkpoint, python, device, tuple(cameras or ()), undistort)
            self._planner: RemotePlanner | None = None

        def name(self) -> str:
            """Inherited, see superclass."""
            return "FactoryAgent"

        def initialize(self) -> None:
            """Start the planner's process. Raises RuntimeError where it cannot plan from what NAVSIM shows."""
            if self._planner is None:
                self._planner = self._start()

        def get_sensor_config(self) -> Any:
            """The planner's cameras at now. Scripts ask before or after they initialize."""
            self.initialize()
            assert self._planner is not None
            wanted = {name: [HISTORY - 1] if name in self._planner.cameras else False for name in CAMERAS}
            return types.SensorConfig(**wanted, lidar_pc=False)

        def compute_trajectory(self, agent_input: Any) -> Any:
            """The plan, as NAVSIM's Trajectory."""
            self.initialize()
            assert self._planner is not None
            sampling = self._trajectory_sampling
            return types.Trajectory(self._planner.plan(agent_input, sampling.num_poses), sampling)

    FactoryAgent.__qualname__ = "FactoryAgent"
    return FactoryAgent
