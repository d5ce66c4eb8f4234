"""A small benchmark of one street: logged frames, and follow-ups of drives that went elsewhere; in memory, on disk."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from factory.stages.benchmark import BENCHMARK_FILE
from factory.stages.rows import sample_row
from factory.store.location import Location, SceneFiles, write_shard
from factory.store.samples import Store
from factory.store.schema import COLUMNS, SAMPLES, sample_rows_to_table
from planners.evaluation.frames import ClipScenes, FrameKey, FramePair
from tasks.attempt import drive_and_judge
from tasks.experts.protocol import Plan
from tasks.hard_scenes import BEFORE_STEPS, BenchmarkClip
from tasks.rollout.simulate import TrafficSettings, simulate
from tasks.world.clip import NOW, STEP_S, Clip, Scene, scene_of_clip
from tasks.world.frames import HEADING, VX, X, to_world
from tests.tasks.streets import street_clip

HORIZON = np.arange(1, 41) * STEP_S
DRIVES = ((7.0, 0.0), (8.0, 0.5))  # speed [m/s], metres aside


def earlier(clip: Clip) -> Clip:
    """The street's clip 0.5 s before: everything drives at a steady speed."""
    states, agents = clip.ego_states.copy(), clip.agents
    states[:, X] -= BEFORE_STEPS * STEP_S * states[:, VX]
    boxes = agents.boxes.copy()
    boxes[..., :2] -= BEFORE_STEPS * STEP_S * agents.velocities
    return replace(clip, ego_states=states, agents=replace(agents, boxes=boxes))


def straight(speed_mps: float, aside_m: float = 0.0) -> np.ndarray:
    """(40, 3) a plan at a steady speed that ends `aside_m` to the left, ego frame."""
    share = HORIZON / HORIZON[-1]
    aside = aside_m * share**2 * (3.0 - 2.0 * share)
    along = speed_mps * HORIZON
    slope = np.gradient(aside, along) if speed_mps else np.zeros(40)
    return np.column_stack([along, aside, np.arctan(slope)])


def benchmark_clip(clip: Clip | None = None) -> BenchmarkClip:
    """A clip with a follow-up after each of DRIVES."""
    clip = street_clip() if clip is None else clip
    rollouts = []
    for i, drive in enumerate(DRIVES):
        poses = to_world(clip.ego_states[NOW, : HEADING + 1], straight(*drive))
        rollouts.append((i, simulate(scene_of_clip(clip), poses, TrafficSettings())))
    return BenchmarkClip(clip, earlier(clip), tuple(rollouts))


def clip_scenes(clip: Clip | None = None) -> ClipScenes:
    """Its frames."""
    stored = benchmark_clip(clip)
    return ClipScenes(
        stored.clip.clip_id,
        FramePair(stored.stage_one(), stored.stage_one(before=True)),
        {i: FramePair(stored.stage_two(i), stored.stage_two(i, before=True)) for i, _ in stored.follow_ups},
    )


def same_plan_everywhere(scenes: ClipScenes, poses: np.ndarray) -> dict[FrameKey, np.ndarray]:
    """One plan from every frame."""
    return dict.fromkeys(frames_of(scenes), poses)


def frames_of(scenes: ClipScenes) -> dict[FrameKey, Scene]:
    """Every frame of a clip."""
    frames = dict(zip(FrameKey.logged(scenes.clip_id), (scenes.logged.now, scenes.logged.before)))
    for i, pair in scenes.follow_ups.items():
        frames.update(zip(FrameKey.follow_up(scenes.clip_id, i), (pair.now, pair.before)))
    return frames


class StreetBenchmark:
    """Frames of several streets in memory, with the rows that the factory would store of them."""

    def __init__(self, clip_ids: tuple[str, ...] = ("a", "b"), digest: str = "street", source: str = "none") -> None:
        self.digest, self.source, self.asked = digest, source, 0
        self._scenes = {clip_id: clip_scenes(replace(street_clip(), clip_id=clip_id)) for clip_id in clip_ids}
        frames = {key: scene for scenes in self._scenes.values() for key, scene in frames_of(scenes).items()}
        self.keys = tuple(frames)
        self.tokens: dict[FrameKey, str] = {}
        self.one_stage = False
        self._rows = {key: sample(key, scene) for key, scene in frames.items()}

    def log_of(self, clip_id: str) -> str:
        return f"log-{clip_id}"

    def image_source(self, key: FrameKey) -> str:
        return self.source

    def stream(self, columns: Sequence[str]) -> Iterator[tuple[FrameKey, dict[str, Any]]]:
        for key in reversed(self.keys):
            self.asked += 1
            yield key, {name: self._rows[key][name] for name in dict.fromkeys([*columns, "expert"])}

    def sample(self, key: FrameKey) -> dict[str, Any]:
        return self._rows[key]

    def scenes(self, clip_id: str) -> ClipScenes:
        return self._scenes[clip_id]

    def scene(self, clip_id: str) -> Scene:
        return self._scenes[clip_id].logged.now

    def before_of(self, clip_id: str) -> str | None:
        return None


def sample(key: FrameKey, scene: Scene) -> dict[str, Any]:
    """The row of a frame."""
    plan = Plan(to_world(scene.ego_state[: HEADING + 1], straight(8.0)))
    judged = drive_and_judge(scene, plan, TrafficSettings(mode="replay"))
    row = dict.fromkeys(COLUMNS) | sample_row(scene.clip, None, judged)
    return row | {
        "attempt_id": f"{key.clip_id}-{key.kind}-{key.candidate_index}",
        "clip_id": key.clip_id,
        "expert": key.kind,
        "expert_digest": key.kind,
        "round": max(key.candidate_index, 0),
        "candidate_index": key.candidate_index,
        "vocabulary_digest": "",
        "settings_hash": "0",
        "stage_versions": "{}",
        "image_source": "none",
    }


def write_benchmark_folder(out: Path, clip_ids: tuple[str, ...] = ("a", "b")) -> Path:
    """The same streets as `python -m factory.run preset=hard_benchmark` would leave them."""
    location, clips, shards = Location.parse(out), [], []
    for clip_id in clip_ids:
        stored = benchmark_clip(replace(street_clip(), clip_id=clip_id))
        SceneFiles(location.child("scenes")).store(stored)
        clips.append({"clip_id": clip_id, "log_id": f"log-{clip_id}", "follow_ups": [i for i, _ in stored.follow_ups]})
        for key, scene in frames_of(clip_scenes(stored.clip)).items():
            shards.append(write_shard(location.child("samples"), SAMPLES, sample_rows_to_table([sample(key, scene)])))
    Store(location).samples.commit(shards)
    location.write(BENCHMARK_FILE, json.dumps({"format": 1, "clips": clips, "left_out": []}).encode())
    return out
