"""A planner before NAVSIM's cameras, and its process (`python -m planners serve`), which NAVSIM's agent starts.

planners.navsim.agent.FactoryAgent asks on standard input and reads the plans on standard output.
What else the process prints goes to standard error.
"""

import os
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from factory.config.arguments import Refused
from factory.config.compose import ConfigError
from factory.wording import one_line
from planners.data.batch import COMMANDS, Batch, ImageLayout, Needs
from planners.data.decode import BatchBuffer, StoredRows
from planners.data.images import chosen_cameras, stitch_pixels
from planners.evaluation.planner_names import find_planner, needs_of
from planners.evaluation.planning import check_plan, plan_batch
from planners.navsim.agent import CAMERAS, HISTORY, receive, send
from tasks.render.views import undistorted
from tasks.trajectories import at_ten_hz
from tasks.world.arrays import Array, Bytes
from tasks.world.clip import HORIZON_STEPS, Camera

# A planner before NAVSIM's cameras: which of them it looks at, and what it plans from what they show.

FRONT = ("cam_l0", "cam_f0", "cam_r0")  # the front camera and its neighbours, left to right


@dataclass(frozen=True)
class CameraObservation:
    """What one camera shows at now."""

    camera: Camera
    image: Bytes  # (height, width, 3) RGB

    def __post_init__(self) -> None:
        size = self.camera.height, self.camera.width, 3
        if self.image.shape != size or self.image.dtype != np.uint8:
            raise ValueError(f"{self.camera.name}: a picture is {size} of uint8, not {self.image.shape}")


@dataclass(frozen=True)
class AgentObservation:
    """What NAVSIM shows an agent at one moment."""

    history: Array  # (4, 3) x, y [m], heading [rad] at -1.5 .. 0 s in the ego frame at now
    status: Array  # (8,) command one-hot (COMMANDS), vx, vy [m/s], ax, ay [m/s2]
    views: tuple[CameraObservation, ...] = ()  # left to right

    def __post_init__(self) -> None:
        for name, shape in (("history", (HISTORY, 3)), ("status", (len(COMMANDS) + 4,))):
            array = getattr(self, name)
            if array.shape != shape or not np.isfinite(array).all():
                raise ValueError(f"{name} must be {shape} finite numbers, got {array.shape}")
        if sorted(self.status[: len(COMMANDS)].tolist()) != [0.0, 0.0, 0.0, 1.0]:
            raise ValueError(f"driving_command {self.status[: len(COMMANDS)]}: one of {', '.join(COMMANDS)} must be 1")


def load_for_agent(
    planner: str, device: str, shown_by: str, changed: Mapping[str, Any] | None = None
) -> tuple[Any, Needs]:
    """A planner that plans from cameras, status and command alone, on its device, and what it needs to plan.

    Raises ConfigError for one that wants more than `shown_by` shows an agent, and for a device that is not there.
    """
    import torch
    from torch import nn

    try:
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:  # the latter of a PyTorch without CUDA
        raise ConfigError(f"device={device}: {one_line(error)}") from error
    who = find_planner(planner, changed=changed)
    if who.privileged is not None:
        raise ConfigError(f"planner={planner} plans from the log itself, which {shown_by} shows no agent")
    made = who.made()
    asked = needs_of(made)
    if asked is None:
        raise ConfigError(f"planner={planner} takes samples; for {shown_by} it must take batches (plan(batch), needs)")
    needs: Needs = replace(getattr(made, "needs_to_plan", asked), labels=None)
    if needs.bev is not None or needs.n_agents:
        raise ConfigError(f"planner={planner} looks at a raster of map and agents, which {shown_by} shows no agent")
    return made.to(device) if isinstance(made, nn.Module) else made, needs


class AgentPlanner:
    """Someone who plans from what NAVSIM shows."""

    def __init__(self, planner: str, cameras: Sequence[str] = (), undistort: bool = False, device: str = "cpu") -> None:
        """planner: see planners.evaluation.planner_names; the rest: see planners.navsim.agent.

        Raises ConfigError for a planner that wants what NAVSIM shows no agent, and for cameras that it has not.
        """
        made, needs = load_for_agent(planner, device, "NAVSIM")
        if needs.command != "navsim":
            raise ConfigError(f"planner={planner} was trained on commands by {needs.command}, and NAVSIM gives its own")
        self._made, self._needs, self._undistort, self._device = made, needs, undistort, device
        self._by_direction = needs.image is not None and not (cameras or needs.image.cameras)
        self.cameras = agent_cameras(needs.image, cameras)

    def plan(self, seen: AgentObservation, n_poses: int) -> Array:
        """(8 or 40, 3) float32 poses, 4 s. Raises ValueError where a plan is none, or the cameras look elsewhere."""
        batch = self.batch_of(seen).to(self._device)
        plan = plan_batch(self._made, batch)[0]
        check_plan(plan, "NAVSIM")
        if len(plan) != n_poses:
            plan = at_ten_hz(plan[None])[0] if n_poses == HORIZON_STEPS else plan[4::5]
        return plan.astype(np.float32)

    def batch_of(self, seen: AgentObservation) -> Batch:
        """The batch of one that a row of the same content makes."""
        views = seen.views
        if self._by_direction:
            assert self._needs.image is not None
            names = [view.camera.name for view in views]
            axes = np.array([view.camera.ego_from_camera[:2, 2] for view in views])
            if chosen_cameras(names, axes, self._needs.image) != FRONT:
                raise ValueError(f"{', '.join(FRONT)} do not look left, ahead and right: name others by cameras=")
        images = [undistorted(view.image, view.camera) if self._undistort else view.image for view in views]
        buffer = BatchBuffer(1, self._needs, 0)
        buffer.fill(0, ObservationRow(seen, partial(stitch_pixels, images)), 0)
        nobody = np.zeros(1, bool)
        return buffer.batch(["navsim"], nobody, nobody)


def agent_cameras(layout: ImageLayout | None, given: Sequence[str] = ()) -> tuple[str, ...]:
    """NAVSIM's cameras for a planner's picture, left to right: those given, else of its names, else by direction.

    Raises ConfigError for a camera that NAVSIM has not, naming what to say.
    """
    if layout is None:
        if given:
            raise ConfigError("cameras: the planner looks at no picture")
        return ()
    trained = layout.cameras
    if given and trained and len(given) != len(trained):
        raise ConfigError(f"cameras: {len(given)}, in the places of {len(trained)}: {', '.join(trained)}")
    names = tuple(name.lower() for name in given or trained or FRONT)
    unknown = [name for name in names if name not in CAMERAS]
    if unknown:
        whose = "" if given else " that the planner was trained on (give cameras=, left to right, in their places)"
        raise ConfigError(f"NAVSIM has no camera {', '.join(unknown)}{whose}; it has {', '.join(CAMERAS)}")
    return names


def observation_of(arrays: Mapping[str, Any], cameras: Sequence[str]) -> AgentObservation:
    """What `planners.navsim.agent.agent_input_arrays` wrote. NAVSIM's lidar frame is the ego's. Raises ValueError."""
    views = []
    for name in cameras:
        image = arrays[f"{name}.image"]
        if image.ndim != 3:
            raise ValueError(f"{name}: a picture of shape {image.shape}")
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = arrays[f"{name}.rotation"], arrays[f"{name}.translation"]
        intrinsics, distortion = (np.asarray(arrays[f"{name}.{k}"], np.float64) for k in ("intrinsics", "distortion"))
        camera = Camera(name, image.shape[1], image.shape[0], intrinsics, distortion, pose)
        views.append(CameraObservation(camera, image))
    return AgentObservation(arrays["history"], arrays["status"], tuple(views))


class ObservationRow(StoredRows):
    """What was seen, as the loader's rows are read; zeros for the plans, which nobody knows."""

    def __init__(self, seen: AgentObservation, draw: Callable[[ImageLayout, Bytes], None]) -> None:
        """draw: writes the wide picture of a layout into (layout.height, layout.width, 3)."""
        status = seen.status
        self._draw = draw
        self._seen = {
            "command": COMMANDS[int(np.argmax(status[: len(COMMANDS)]))],
            "ego_status": status[len(COMMANDS) :],
            "ego_history_2hz": seen.history,
        }

    def value(self, column: str, row: int) -> Any:
        return 0.0 if column.startswith("label_") else self._seen[column]

    def picture(self, row: int, layout: ImageLayout, out: Bytes, keep: bool = False) -> None:
        self._draw(layout, out)


def _next_question() -> dict[str, Any] | None:
    """None where nobody asks any more. Raises Refused for what is none."""
    try:
        return receive(sys.stdin.buffer)
    except ValueError as error:
        raise Refused(f"standard input: {error}; start planners serve again") from error


def answer_agent(planner: str, device: str, cameras: Sequence[str], undistort: bool) -> None:
    """Answer until nobody asks any more. Raises Refused for a planner that cannot plan there, and half a question."""
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # whatever prints must not come between the answers
    with suppress(BrokenPipeError):  # who asked has gone
        try:
            pilot = AgentPlanner(planner, cameras, undistort, device)
        except (ValueError, OSError) as error:
            send(answers, {"error": str(error)})
            raise Refused(str(error)) from error
        send(answers, {"cameras": np.array(pilot.cameras, dtype=str)})
        while (question := _next_question()) is not None:
            try:
                poses = pilot.plan(observation_of(question, pilot.cameras), int(question["n_poses"]))
            except ValueError as error:
                send(answers, {"error": str(error)})
            else:
                send(answers, {"poses": poses})
