"""Samples of the hand-made street with pictures of eight cameras, whose colours say camera and instant."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from factory.datasets.navsim.export import ExportSummary, export
from factory.datasets.navsim.frames import ExportSettings
from factory.datasets.town.settings import MOUNTS
from factory.stages.rows import sample_row
from factory.store.samples import Store
from tasks.attempt import drive_and_judge, drive_under_log_replay, perturbed_scene
from tasks.experts.pdm_closed import PdmClosed
from tasks.experts.protocol import Human
from tasks.rollout.simulate import TrafficSettings
from tasks.world.clip import Clip, scene_of_clip
from tests.planners.samples import camera, jpeg, labels, plain, sample
from tests.tasks.streets import moved, perturbed, street_clip

RNG = np.random.default_rng(0)  # nothing here draws from it
ORIGIN = np.array([664_400.25, 3_997_000.5, 0.7])  # where the street begins: far out, and turned
TOKENS = ("0a678d2136b35b56", "231d0b185aab533d")  # of the log's frames at T and at T+H
YAWS = {name: float(np.deg2rad(mount[0])) for name, mount in MOUNTS.items()}
SIZE = (32, 18)
INSTANTS_S = tuple(np.arange(-1.5, 4.01, 0.5))
K = 20  # trajectories of the labels


def street() -> Clip:
    """Far from the map's origin, as UTM coordinates are, and on a place that the public code knows."""
    clip = replace(moved(street_clip(), ORIGIN), frame_tokens=TOKENS, log_id="2021.05.12_veh-35_00005_00204")
    return replace(clip, road_map=replace(clip.road_map, location="us-nv-las-vegas-strip"))


@cache
def driven() -> tuple[dict[str, Any], dict[str, Any]]:
    """The human's row, and the row of PDM-Closed after a perturbation, without pictures and bookkeeping."""
    clip = street()
    candidate = perturbed(clip).candidates[0]
    scene = perturbed_scene(clip, candidate.rollout)
    judged = drive_and_judge(scene, PdmClosed().plan(scene, RNG), TrafficSettings())
    human = drive_under_log_replay(scene_of_clip(clip), Human(), RNG)
    return sample_row(clip, None, human), sample_row(clip, candidate, judged)


def colour(name: str, time_s: float) -> tuple[int, int, int]:
    """Of a camera at an instant."""
    return 20 + 25 * list(YAWS).index(name), 30 + 18 * round(2.0 * time_s + 3.0), 128


def pictures(
    names: Sequence[str] = tuple(YAWS), times_s: Sequence[float] = INSTANTS_S, size: tuple[int, int] = SIZE
) -> dict[str, Any]:
    """The columns of pictures."""
    return {
        "cameras": [camera(name, YAWS[name], *size) for name in names],
        "images": [
            {
                "camera": name,
                "time_s": float(time_s),
                "ego_pose": np.eye(4).reshape(16),
                "jpeg": jpeg(plain(colour(name, time_s), *size)),
            }
            for time_s in times_s
            for name in names
        ],
        "image_source": "render",
        "psnr": 28.0,
    }


def exported(number: int, expert: str, round_: int = 0, **columns: Any) -> Mapping[str, Any]:
    """A whole row: of the human, or of a simulated drive in a round, with pictures and labels."""
    human, simulated = driven()
    row = sample(number, expert, round_) | (human if expert == "human" else simulated) | pictures()
    return row | labels(number, K) | {"split": "train"} | columns


def quiet(run: Path, to: Path, settings: ExportSettings = ExportSettings(), **more: Any) -> ExportSummary:  # noqa: B008
    """The export of a run in this process, without a word."""
    return export(Store(run).samples, to, settings, say=lambda line: None, **more)


def tree(folder: Path) -> dict[str, str]:
    """Path -> SHA-256 of every file."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}
