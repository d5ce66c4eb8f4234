"""Several logs of one place: which other drives lead through a block, and the block with what they saw.

A block of one log has few photos of each thing at 2 Hz. Where other logs lead through the same place its scene is made
of their photos and sweeps too. They are put onto the block's clock one after the other, `DRIVES_APART_S` between them,
so that each has its own traffic, light and pose corrections; what the drives share is the street. What is theirs is
named <log id>/<name>.
"""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from tasks.world.agents import AgentTracks
from tasks.world.arrays import Array, Ints
from tasks.world.camera import Camera, SensorFile
from tasks.world.clip import DRIVES_APART_S, OTHER_LOG, STEP_S, Block

NEAR_M = 12.0  # between two drives on one street, on lanes of either direction
LEAST_M = 20.0  # of another drive beside the block's, or it is left out
SAMPLE_STEPS = 5  # a place of a drive is kept every 0.5 s
BROKEN_STEPS = 20  # as long may another drive be farther away in between
LONGEST_STEPS = 200  # of another drive, as of blocks


@dataclass(frozen=True)
class DrivenPath:
    """Where a log's ego was, and in which world."""

    world: str  # name of the frame; logs with the same name share it
    steps: Ints  # (K,) ascending
    places: Array  # (K, 2) [m]


@dataclass(frozen=True)
class Traversal:
    """Steps start..stop-1 of a log, which lead through a block of another."""

    log_id: str
    start: int
    stop: int


@dataclass(frozen=True)
class OtherDrive:
    """What a traversal has."""

    log_id: str
    agents: AgentTracks
    cameras: tuple[Camera, ...]
    images: tuple[SensorFile, ...]  # timed since its first step
    sweeps: tuple[SensorFile, ...]


def path_of(world: str, ego_states: Array) -> DrivenPath:
    """The path of an ego (S, >= 2), NaN where it has no drive."""
    steps = np.arange(0, len(ego_states), SAMPLE_STEPS)
    steps = steps[np.isfinite(ego_states[steps, :2]).all(axis=1)]
    return DrivenPath(world, steps, np.asarray(ego_states[steps, :2], np.float64))


def traversals(paths: Mapping[str, DrivenPath], log_id: str, start: int, stop: int, most: int) -> tuple[Traversal, ...]:
    """The other drives along steps start..stop-1 of a log, `most` at most: those that go along with it farthest.

    Of each log the one stretch that goes along farthest, in either direction.
    """
    mine = paths[log_id]
    inside = (mine.steps >= start) & (mine.steps < stop)
    if not inside.any():
        return ()
    here = cKDTree(mine.places[inside])
    found = []
    for other_id, other in paths.items():
        if other_id == log_id or other.world != mine.world or not len(other.steps):
            continue
        away, _ = here.query(other.places, distance_upper_bound=NEAR_M)
        near = np.flatnonzero(np.isfinite(away))
        if not len(near):
            continue
        length, first, last = max(
            (_length(other.places[run[0] : run[-1] + 1]), -int(other.steps[run[0]]), int(other.steps[run[-1]]))
            for run in np.split(near, np.flatnonzero(np.diff(other.steps[near]) > BROKEN_STEPS) + 1)
        )
        if length >= LEAST_M:
            found.append((-length, Traversal(other_id, -first, min(last + 1, -first + LONGEST_STEPS))))
    return tuple(traversal for _, traversal in sorted(found, key=lambda row: (row[0], row[1].log_id))[:most])


def digest_with(digest: str, others: Sequence[Traversal], digest_of: Callable[[str], str]) -> str:
    """The content digest of a clip whose own log has `digest` and whose block is made of `others` as well.

    digest_of: the content digest of a log by its id.
    """
    if not others:
        return digest
    told = [f"{other.log_id}@{other.start}:{other.stop}={digest_of(other.log_id)}" for other in others]
    return hashlib.sha256("\x1f".join([digest, *told]).encode()).hexdigest()


def joined(block: Block, others: Sequence[OtherDrive]) -> Block:
    """The block with what the other drives saw."""
    agents, images, sweeps, cameras = [block.agents], list(block.images), list(block.sweeps), list[Camera]()
    first = [0]
    for other in others:
        first.append(first[-1] + agents[-1].n_steps + round(DRIVES_APART_S / STEP_S))
        agents.append(replace(other.agents, track_ids=tuple(_theirs(other, name) for name in other.agents.track_ids)))
        images += _later(other, other.images, first[-1])
        sweeps += _later(other, other.sweeps, first[-1])
        cameras += [replace(camera, name=_theirs(other, camera.name)) for camera in other.cameras]
    return replace(
        block,
        agents=_one_after_the_other(agents, first),
        images=tuple(images),
        sweeps=tuple(sweeps),
        own_s=(block.agents.n_steps - 1) * STEP_S + DRIVES_APART_S / 2,
        other_cameras=tuple(cameras),
    )


def _theirs(other: OtherDrive, name: str) -> str:
    return f"{other.log_id}{OTHER_LOG}{name}"


def _later(other: OtherDrive, files: Sequence[SensorFile], first: int) -> list[SensorFile]:
    return [replace(f, sensor=_theirs(other, f.sensor), time_s=f.time_s + first * STEP_S) for f in files]


def _one_after_the_other(parts: Sequence[AgentTracks], first: Sequence[int]) -> AgentTracks:
    """Tracks that each begin at step `first` of all; nobody is there before and after."""
    n_steps, n = first[-1] + parts[-1].n_steps, sum(map(len, parts))
    boxes, velocities = np.full((n_steps, n, 5), np.nan), np.full((n_steps, n, 2), np.nan)
    valid, center_z = np.zeros((n_steps, n), bool), np.full((n_steps, n), np.nan)
    column = 0
    for part, at in zip(parts, first, strict=True):
        rows, columns = slice(at, at + part.n_steps), slice(column, column + len(part))
        boxes[rows, columns], velocities[rows, columns] = part.boxes, part.velocities
        valid[rows, columns], center_z[rows, columns] = part.valid, part.center_z
        column += len(part)
    return AgentTracks(
        tuple(track_id for part in parts for track_id in part.track_ids),
        tuple(kind for part in parts for kind in part.kinds),
        boxes,
        velocities,
        valid,
        center_z,
        np.concatenate([part.heights for part in parts]),
    )


def _length(places: Array) -> float:
    return float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())
