"""`python -m planners serve planner=<training>`: plans for NAVSIM's own evaluation, whose agent starts this.

planners.navsim.agent.FactoryAgent asks on standard input and reads the plans on standard output.
Nobody starts it by hand; what it prints goes to standard error.
"""

import os
import sys
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from factory.config.arguments import Refused
from planners.navsim.agent import receive, send
from planners.navsim.pilot import Pilot, seen_of


@dataclass(frozen=True)
class Request:
    """The command line."""

    planner: str  # a training's folder, a+b, constant_velocity, or my.module:MyPlanner; it reads pictures, status alone
    device: str = "cpu"  # or cuda
    cameras: tuple[str, ...] = ()  # NAVSIM's in the places of those it was trained on, left to right: [cam_l0,cam_f0]
    undistort: bool = False  # for a planner that was trained on pinhole pictures


def main(request: Request) -> None:
    """Answer until nobody asks any more. Raises Refused for a planner that cannot plan there."""
    with suppress(BrokenPipeError):  # who asked has gone
        answer_all(request)


def answer_all(request: Request) -> None:
    """The same. Raises BrokenPipeError where nobody waits for an answer."""
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # whatever prints must not come between the answers
    try:
        pilot = Pilot(request.planner, request.cameras, request.undistort, request.device)
    except (ValueError, OSError, RuntimeError) as error:  # RuntimeError: a device that is not there
        send(answers, {"error": str(error)})
        raise Refused(str(error)) from error
    send(answers, {"cameras": np.array(pilot.cameras, dtype=str)})
    while (question := receive(sys.stdin.buffer)) is not None:
        try:
            poses = pilot.plan(seen_of(question, pilot.cameras), int(question["n_poses"]))
        except ValueError as error:
            send(answers, {"error": str(error)})
        else:
            send(answers, {"poses": poses})
