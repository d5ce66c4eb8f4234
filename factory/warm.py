"""Compiles every kernel once, into the on-disk cache, before workers start: `python -m factory.warm`."""

import tempfile
from pathlib import Path

import numpy as np

from tasks.render.warm import compile_kernels as compile_render_kernels
from tasks.rollout.simulate import TrafficSettings, simulate
from tasks.world.agents import AgentKind, AgentTracks
from tasks.world.clip import CLIP_STEPS, NOW, Clip, scene_of_clip
from tasks.world.lanes import Lane, RoadMap, Route


def compile_kernels() -> None:
    """Runs the traffic and the render room on the smallest scene that reaches all of their kernels."""
    scene = scene_of_clip(tiny_clip())
    ahead = np.stack([np.arange(1, 41) * 0.5, np.zeros(40), np.zeros(40)], axis=1)
    simulate(scene, ahead, TrafficSettings())
    compile_render_kernels()


def compile_town_kernels() -> None:
    """Writes the smallest log of the synthetic town into a folder that is thrown away."""
    from factory.clips.synthetic.write import TownSettings, write_town

    settings = TownSettings(cameras=("ring_front_center",), width=16, height=16, lidar_beams=1, lidar_azimuths=8)
    with tempfile.TemporaryDirectory() as folder:
        write_town(Path(folder), 1, 0, settings, threads=1)


def tiny_clip() -> Clip:
    """A straight road with the ego and one car ahead, both at 5 m/s."""
    steps = np.arange(CLIP_STEPS)
    way = np.arange(-50.0, 151.0, 1.0)
    centre = np.stack([way, np.zeros_like(way), np.zeros_like(way)], axis=1)
    ring = np.array([[-50.0, -2.0], [150.0, -2.0], [150.0, 2.0], [-50.0, 2.0], [-50.0, -2.0]])
    lane = Lane("lane", ring, centre, is_intersection=False, drives_cars=True)
    ego = np.zeros((CLIP_STEPS, 11))
    ego[:, 0], ego[:, 3] = (steps - NOW) * 0.5, 5.0
    pose = np.tile(np.eye(4), (CLIP_STEPS, 1, 1))
    pose[:, 0, 3] = ego[:, 0]
    boxes = np.zeros((CLIP_STEPS, 1, 5))
    boxes[:, 0] = np.stack([ego[:, 0] + 20.0, *np.zeros((2, CLIP_STEPS)), *np.full((2, CLIP_STEPS), [[4.5], [2.0]])], 1)
    car = AgentTracks(
        track_ids=("car",),
        kinds=(AgentKind.VEHICLE,),
        boxes=boxes,
        velocities=np.tile([5.0, 0.0], (CLIP_STEPS, 1, 1)),
        valid=np.ones((CLIP_STEPS, 1), bool),
        center_z=np.full((CLIP_STEPS, 1), 0.75),
        heights=np.array([1.5]),
    )
    return Clip(
        clip_id="warm",
        dataset="warm",
        log_id="warm",
        split="train",
        start_s=0.0,
        ego_states=ego,
        world_from_ego=pose,
        agents=car,
        road_map=RoadMap({"lane": lane}, (), (), {"lane": "rb_lane"}),
        route=Route(("lane",), ("rb_lane",), frozenset({"lane"})),
        centerline=centre,
    )


if __name__ == "__main__":
    compile_kernels()
    compile_town_kernels()
