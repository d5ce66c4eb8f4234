"""The ego at the twelve frames of a log: poses in the plane and in space, velocities, accelerations, yaw rates."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from factory.exports.navsim.names import N_FRAMES, NOW_FRAME
from factory.store.schema import AGENT_STEPS, NOW_INDEX
from tasks.render.views import pose_on_ground
from tasks.world.arrays import Array
from tasks.world.clip import HORIZON_STEPS, STEP_S
from tasks.world.frames import to_local, to_world
from tasks.world.vehicle import AX, AY, EGO_STATE_SIZE, HEADING, VX, VY, YAW_RATE

STEPS_PER_FRAME = 5
INSTANTS = np.arange(0, AGENT_STEPS, STEPS_PER_FRAME)  # of a row's 56 steps
DRIVEN = slice(HORIZON_STEPS - NOW_INDEX, HORIZON_STEPS, STEPS_PER_FRAME)  # of perturbed_states, before now
MOTION = (
    *("ego_history_10hz", "label_10hz", "now_pose", "world_from_ego", "perturbed_states", "ego_status"),
    *("parent_states", "images"),
)


@dataclass(frozen=True)
class FrameMotion:
    """The ego at N_FRAMES instants; velocity and acceleration in ego axes, at the rear axle."""

    poses: Array  # (12, 3) x, y [m], heading [rad], world
    local: Array  # (12, 3) the same in the frame of the ego at now
    global_from_ego: Array  # (12, 4, 4) m
    quaternions: Array  # (12, 4) w, x, y, z of its rotation
    dynamics: Array  # (12, 4) vx, vy [m/s], ax, ay [m/s2]
    yaw_rates: Array  # (12,) rad/s


def frame_motion(row: Mapping[str, Any]) -> FrameMotion:
    """Of a row with the columns MOTION: what it holds exactly where it does, else from its poses at 10 Hz."""
    local = np.concatenate([row["ego_history_10hz"], row["label_10hz"]]).astype(np.float64)  # (56, 3)
    dynamics, yaw_rates = (derived[INSTANTS] for derived in derivatives(local))
    poses = to_world(np.asarray(row["now_pose"]), local[INSTANTS])
    poses[NOW_FRAME] = row["now_pose"]
    dynamics[NOW_FRAME] = row["ego_status"]
    driven = row["perturbed_states"]  # null of human rows and of imported ones, whose own log is the drive
    if driven is not None:
        before = np.asarray(driven)[DRIVEN]  # float64, of the very drive
        poses[:NOW_FRAME], dynamics[:NOW_FRAME] = before[:, : HEADING + 1], before[:, [VX, VY, AX, AY]]
        yaw_rates[: NOW_FRAME + 1] = np.append(before[:, YAW_RATE], driven[-1, YAW_RATE])
    else:  # that log at T is now, and at T+H the last frame
        logged = np.asarray(row["parent_states"])[:, [VX, VY, AX, AY]]
        dynamics[[NOW_FRAME, N_FRAMES - 1]] = logged
    matrices, quaternions = in_space(poses, known_poses(row))
    return FrameMotion(poses, to_local(poses[NOW_FRAME], poses), matrices, quaternions, dynamics, yaw_rates)


def derivatives(poses: Array) -> tuple[Array, Array]:
    """Of poses (S, 3) at 10 Hz: (S, 4) vx, vy, ax, ay in the axes of each pose, and (S,) yaw rates.

    Velocities are differences over one step to either side, at both ends the slope of the parabola through three
    frames. Accelerations are second differences over a frame to either side, nearer to an end those of the nearest
    step: a log at 2 Hz is straight between its frames, and over single steps its speed would change in one of them.
    """
    xy, heading = poses[:, :2], np.unwrap(poses[:, 2])
    velocity, yaw_rate = np.gradient(xy, STEP_S, axis=0), np.gradient(heading, STEP_S)
    n, frame_s = STEPS_PER_FRAME, STEPS_PER_FRAME * STEP_S
    velocity[0] = (4.0 * xy[n] - 3.0 * xy[0] - xy[2 * n]) / (2.0 * frame_s)
    velocity[-1] = (3.0 * xy[-1] - 4.0 * xy[-1 - n] + xy[-1 - 2 * n]) / (2.0 * frame_s)
    acceleration = np.zeros_like(xy)
    acceleration[n:-n] = (xy[2 * n :] - 2.0 * xy[n:-n] + xy[: -2 * n]) / frame_s**2
    c, s = np.cos(heading)[:, None], np.sin(heading)[:, None]
    turned = [np.hstack([c * v[:, :1] + s * v[:, 1:], c * v[:, 1:] - s * v[:, :1]]) for v in (velocity, acceleration)]
    turned[1][:n], turned[1][-n:] = turned[1][n], turned[1][-n - 1]
    return np.hstack(turned), yaw_rate


def known_poses(row: Mapping[str, Any]) -> Array:
    """(P, 4, 4) every 3-D pose of the ego that the row holds: at now, and of its pictures; level at 0 m without any."""
    found = [] if row["world_from_ego"] is None else [np.asarray(row["world_from_ego"])]
    found += [np.asarray(image["ego_pose"]).reshape(4, 4) for image in row["images"] or ()]
    return np.stack(found) if found else np.eye(4)[None]


def in_space(poses: Array, known: Array) -> tuple[Array, Array]:
    """Planar poses (F, 3) as (F, 4, 4) matrices and (F, 4) quaternions w, x, y, z, on the plane of the nearest `known`.

    The heading is what the public code reads as such, pyquaternion's `yaw_pitch_roll[0]`: the rotation is one about x,
    then y, then z, whose last angle it is. On a slope that is not quite the direction of the forward axis in the plane.
    """
    states = np.zeros((len(poses), EGO_STATE_SIZE))
    states[:, : HEADING + 1] = poses
    matrices = pose_on_ground(known, states)
    up = matrices[:, :3, 2]
    pitch, roll = np.arcsin(np.clip(up[:, 0], -1.0, 1.0)), np.arctan2(-up[:, 1], up[:, 2])
    rotation = Rotation.from_euler("XYZ", np.column_stack([roll, pitch, poses[:, HEADING]]))
    matrices[:, :3, :3] = rotation.as_matrix()
    return matrices, rotation.as_quat(canonical=True)[:, [3, 0, 1, 2]]
