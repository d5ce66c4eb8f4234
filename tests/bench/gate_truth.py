"""Pictures of simulated drives through the synthetic town, each beside what the painter of the town shows from there.

The drives are those that a run makes: candidates, experts, traffic that reacts. What a picture should show is painted
at the same pose with everybody where the simulation has them, so a label says how wrong a picture is, whatever any
gate thinks of it.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from factory.datasets.town.draw import TownRenderer, paint
from factory.datasets.town.drive import TownDrive
from factory.datasets.town.town import log_name, plan_log
from factory.graph.steps import PreparedClip
from factory.pipeline import FactoryWork, perturbed_clip_of
from factory.stages.imaging import GATE_STRIDE
from tasks.render.gate import (
    GateSettings,
    VehiclePhotos,
    box_mask,
    expected_likeness,
    large_vehicles,
    likeness_to_nearest_photo,
    masked_mean,
    measure_rendered_views,
    picture_fault,
    ssim_map,
    to_box_frame,
)
from tasks.render.scene.asset import Instant, Reach, RenderAsset
from tasks.render.scene.engine import render, render_instants
from tasks.render.scene.movers import PlacedAgents, agents_at_time
from tasks.render.views import VISIBLE_M
from tasks.world.arrays import F32, Array
from tasks.world.clip import HORIZON_STEPS, STEP_S, AgentKind, AgentTracks, Camera, Clip, Pinhole
from tasks.world.frames import pose_on_ground

NOTHING_LARGE = 1.0  # the likeness of a picture without any large vehicle
MOST_LOGS = 10_000


@dataclass(frozen=True)
class Simulated:
    """One accepted drive at the instants that the gate looks at."""

    clip: Clip
    expert: str
    candidate: int
    poses: Array  # (F, 4, 4) world_from_ego
    agents: AgentTracks  # of the clip's 96 steps
    steps: tuple[int, ...]  # (F,)


@dataclass(frozen=True)
class Shown:
    """One picture."""

    camera: str
    step: int
    eye: Pinhole
    world_from_ego: Array
    there: PlacedAgents
    picture: F32  # (H, W, 3) in [0, 1]
    truth: F32

    def label(self, share: float) -> tuple[float, float]:
        """Likeness to the truth of the vehicle that is least like it, of those whose outline covers a share of the
        picture, hidden or not; and that vehicle's share. (1, 0) where there is none."""
        similar = ssim_map(self.picture, self.truth)
        worst = (NOTHING_LARGE, 0.0)
        for kind, box in zip(self.there.kinds, self.there.boxes, strict=True):
            outline = box_mask(box, self.eye) if kind == AgentKind.VEHICLE else np.zeros(1, bool)
            if outline.mean() >= share:
                worst = min(worst, (masked_mean(similar, outline), float(outline.mean())))
        return worst


def drives(work: FactoryWork, prepared: PreparedClip, experts: Sequence[str], most: int) -> Iterator[Simulated]:
    """Drives that the reward accepts, `most` of each expert, before any picture of them is looked at."""
    payload = perturbed_clip_of(prepared)
    for expert in experts:
        found = 0
        for index in range(len(payload.candidates)):
            trace = work.trace(prepared, index, expert) if found < most else None
            if trace is None or trace.judged is None or trace.rejected is not None or trace.candidate is None:
                continue
            found += 1
            start, now = trace.candidate.rollout.start_step, trace.judged.scene.step
            steps = range(start, now + HORIZON_STEPS + 1, GATE_STRIDE)
            states = np.concatenate([trace.candidate.rollout.ego_states, trace.judged.rollout.ego_states[1:]])
            yield Simulated(
                payload.clip,
                expert,
                index,
                pose_on_ground(payload.clip.world_from_ego, states[[step - start for step in steps]]),
                trace.judged.scene.agents.overwritten(now, trace.judged.rollout.agents),
                tuple(steps),
            )


class Painted:
    """A log of the synthetic town in which others than in the log may drive."""

    def __init__(self, seed: int, log_id: str) -> None:
        """Raises StopIteration for a log that the seed does not have."""
        index = next(i for i in range(MOST_LOGS) if log_name(seed, i) == log_id)
        self.town, self.drive = plan_log(seed, index)

    def pictures(self, drive: Simulated, asset: RenderAsset, rig: Sequence[Camera], every: int) -> Iterator[Shown]:
        """What the rig, in the size it has, shows at every `every`-th of the drive's instants."""
        first, town = round(drive.clip.start_s / STEP_S), self.town
        played = _with(self.drive, drive.agents, first)
        renderer = TownRenderer(town.scenery, played, town.sun_azimuth, town.sun_elevation, town.sky_seed)
        for pose, step in list(zip(drive.poses, drive.steps, strict=True))[::every]:
            scene = renderer.scene_at(first + step)
            there = agents_at_time(drive.agents, step * STEP_S, pose[:2, 3], VISIBLE_M)
            eyes = [Pinhole(c.intrinsics, pose @ c.ego_from_camera, c.width, c.height) for c in rig]
            views = render(asset, eyes, there, affines=[asset.affine_of(c.name, step * STEP_S) for c in rig])
            for camera, eye, seen in zip(rig, eyes, views, strict=True):
                truth = _unit(paint(scene, replace(camera, distortion=np.zeros(5)), pose))
                yield Shown(camera.name, step, eye, pose, there, seen.rgb, truth)


def verdicts(
    shown: Shown, drive: Simulated, asset: RenderAsset, album: VehiclePhotos, settings: GateSettings
) -> tuple[str, float, float]:
    """What the gate says of a picture: the fault without regard to photos, "" for none; the likeness expected of the
    large vehicle that is to be least like its photos; and that of the one that beside a photo is least like it."""
    pose = shown.world_from_ego
    there = agents_at_time(drive.agents, shown.step * STEP_S, pose[:2, 3], settings.reach_m)
    affine = asset.affine_of(shown.camera, shown.step * STEP_S)
    instant = Instant([shown.eye], there, [affine], Reach(pose[:3, 3], settings.reach_m))
    (views,) = render_instants(asset, [instant])
    fault = picture_fault(measure_rendered_views(asset, instant, views, pose)[0], settings)
    least, beside = NOTHING_LARGE, NOTHING_LARGE
    for j, _ in large_vehicles(there, shown.eye, views[0], settings.vehicle_share):
        track_id, box = there.track_ids[j], there.boxes[j]
        least = min(least, expected_likeness(album, track_id, to_box_frame(shown.eye.world_from_camera[:3, 3], box)))
        beside = min(beside, likeness_to_nearest_photo(album, there, j, shown.eye, views[0]))
    return "" if fault is None else fault[0], least, beside


def _with(drive: TownDrive, agents: AgentTracks, first: int) -> TownDrive:
    """The log's drive with its tracks where `agents` are, from step `first` on."""
    column = {track_id: j for j, track_id in enumerate(agents.track_ids)}
    tracks = []
    for track in drive.tracks:
        j = column.get(track.track_id)
        if j is not None:
            poses = track.poses.copy()
            known = poses[first : first + agents.n_steps]
            known[:] = np.where(agents.valid[: len(known), j, None], agents.boxes[: len(known), j, :3], np.nan)
            track = replace(track, poses=poses)
        tracks.append(track)
    return replace(drive, tracks=tuple(tracks))


def _unit(rgb: NDArray[np.uint8]) -> F32:
    return rgb.astype(np.float32) / np.float32(255.0)
