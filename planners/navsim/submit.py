"""`python -m planners submit planner=<training> split=<.yaml> ...`: a submission to NAVSIM's leaderboard.

    python -m planners submit planner=runs/ltf logs=navsim_logs/test sensors=sensor_blobs/test \\
        root=navhard_two_stage split=.../train_test_split/navhard_two_stage.yaml out=submission.pkl \\
        team_name=ours authors="A. Author, B. Author" email=a@b.org institution=ours country=ours

Every scene of the split is planned from what NAVSIM shows an agent, and the file is what its own script
run_create_submission_pickle.py writes with our agent. NAVSIM is not needed. A file is whole or is not there: where one
scene cannot be planned, the error names it and nothing is written.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from factory.config.arguments import Refused
from factory.datasets.navsim.log import Frame, read_frames, read_scene_pickle
from factory.datasets.navsim.pickles import dumps
from factory.datasets.navsim.reader import SceneFilter, Selection, log_files, read_selection, scene_frames
from factory.datasets.navsim.window import cameras_with_pictures, sensor_files
from factory.graph.progress import RateBar
from factory.readers.base import BadClip
from factory.stages.sensors import decode_image
from factory.wording import one_line
from planners.data.batch import one_hot_command
from planners.evaluation.submission import SAMPLING, TRAJECTORY
from planners.navsim.agent import HISTORY
from planners.navsim.serve import AgentObservation, AgentPlanner, CameraObservation
from tasks.kernels.compiled import write_whole
from tasks.world.arrays import Array
from tasks.world.frames import to_local

SCENES, BLOBS = "synthetic_scene_pickles", "sensor_blobs"  # of navhard_two_stage and its like


@dataclass(frozen=True)
class ObservedScene:
    """One scene up to now."""

    token: str  # of the frame at now
    frames: tuple[Frame, ...]  # HISTORY, now the last
    sensors: Path | None  # folder of their pictures
    file: str  # that they were read from

    def observation(self, cameras: Sequence[str]) -> AgentObservation:
        """What an agent is shown, with these cameras at now, left to right. Raises BadClip."""
        now = self.frames[-1]
        history = to_local(now.pose, np.stack([frame.pose for frame in self.frames]))
        status = np.concatenate([one_hot_command(now.command), now.dynamic_state])
        return AgentObservation(history.astype(np.float32), status.astype(np.float32), self._views(cameras))

    def _views(self, names: Sequence[str]) -> tuple[CameraObservation, ...]:
        if not names:
            return ()
        assert self.sensors is not None
        own = {camera.name.lower(): camera for camera in self.frames[-1].cameras}
        if lacking := [name for name in names if name not in own]:
            raise BadClip(self.file, f"token {self.token}", f"the frame names no picture of {', '.join(lacking)}")
        now = replace(self.frames[-1], cameras=tuple(own[name] for name in names))
        images, _ = sensor_files([now], self.sensors)
        if not images:
            raise BadClip(str(self.sensors / now.cameras[0].path), "image", f"missing, of token {self.token}")
        return tuple(
            CameraObservation(
                replace(camera, name=camera.name.lower()), decode_image(Path(image.uri).read_bytes(), image.uri, camera)
            )
            for camera, image in zip(cameras_with_pictures(now, images, self.file), images)
        )


@dataclass(frozen=True)
class SplitScenes:
    """All scenes that a split names; none is open yet."""

    logged: Mapping[Path, tuple[int, ...]]  # log -> its frames at now
    final_tokens: frozenset[str]  # of the last frames of these scenes
    synthetic: tuple[Path, ...]
    scene_filter: SceneFilter
    sensors: Path | None
    not_scenes: int  # tokens that are in a log, where the filter's own rules make no scene of them

    def __len__(self) -> int:
        return sum(map(len, self.logged.values())) + len(self.synthetic)

    def first_stage(self) -> Iterator[ObservedScene]:
        """Log by log, one open at a time. Raises BadClip."""
        for path, windows in self.logged.items():
            frames = read_frames(path).frames
            for now in windows:
                yield ObservedScene(frames[now].token, frames[now - HISTORY + 1 : now + 1], self.sensors, str(path))

    def second_stage(self) -> Iterator[ObservedScene | None]:
        """Scene by scene; None for one that the public loader leaves out. Raises BadClip."""
        chosen = self.scene_filter
        for path in self.synthetic:
            scene = read_scene_pickle(path, as_shown=True)
            if scene.token != path.stem:
                raise BadClip(str(path), "scene_metadata.initial_token", f"is {scene.token}, the file's name another")
            of_another_log = chosen.log_names is not None and scene.log_name not in chosen.log_names
            named = chosen.synthetic_scene_tokens
            wanted = scene.original_scene in self.final_tokens if named is None else scene.token in named
            left_out = of_another_log or not wanted
            blobs = path.parent.parent / BLOBS
            yield None if left_out else ObservedScene(scene.token, scene.frames, blobs, str(path))


def scenes_of_split(selection: Selection, logs: Path, sensors: Path | None, root: Path | None) -> SplitScenes:
    """The scenes of a split among these folders; root: of the second stage, as import navhard takes it.

    What an agent is asked to plan, as the public loader chooses it: rules of navsim/common/dataloader.py:19-173
    (autonomousvision/navsim @ 0a380a9). Only what an agent is shown is read: no map, no future, no annotation.
    Raises ValueError where what the split names is not there, BadClip for a log that is broken.
    """
    chosen = selection.scene_filter
    if chosen.num_history_frames != HISTORY:
        raise ValueError(
            f"{selection.name}: num_history_frames is {chosen.num_history_frames}; planners take {HISTORY}"
        )
    files, names = log_files(logs), chosen.log_names or ()
    if lacking := sorted(set(names) - files.keys()):
        raise ValueError(
            f"logs={logs}: {len(lacking)} of the split's {len(names)} logs are not here, such as {lacking[0]}"
        )
    logged: dict[Path, tuple[int, ...]] = {}
    final: set[str] = set()
    there: set[str] = set()
    for path, table, frames in scene_frames(chosen, files):
        there.update(table.tokens.tolist())
        if frames:
            logged[path] = tuple(frames)
            final.update(table.tokens[np.array(frames) + chosen.num_future_frames].tolist())
    tokens = frozenset(chosen.tokens or ())
    if absent := tokens - there:
        problem = f"{len(absent)} of the split's {len(tokens)} tokens are in no log here: {min(absent)}, ..."
        raise ValueError(f"logs={logs}: {problem}")
    found = sum(map(len, logged.values()))
    not_scenes = 0 if chosen.tokens is None or chosen.max_scenes is not None else len(tokens) - found
    return SplitScenes(logged, frozenset(final), _second_stage(selection, root), chosen, sensors, not_scenes)


def _second_stage(selection: Selection, root: Path | None) -> tuple[Path, ...]:
    chosen = selection.scene_filter
    tokens = dict.fromkeys(chosen.reactive_synthetic_initial_tokens or ()) if chosen.include_synthetic_scenes else {}
    if not tokens:
        return ()
    if root is None:
        raise ValueError(f"root=... is missing: {selection.name} has {len(tokens)} scenes of a second stage")
    paths = [root / SCENES / f"{token}.pkl" for token in tokens]
    if lacking := [path for path in paths if not path.is_file()]:
        raise ValueError(
            f"{lacking[0]}: no such file; {len(lacking)} of the {len(paths)} scenes of the second stage are missing"
        )
    return tuple(paths)


HORIZON_S = 4.0


@dataclass(frozen=True)
class TrajectorySampling:
    """nuPlan's: both counts and times, whichever of them it was made of."""

    num_poses: int
    time_horizon: float  # s
    interval_length: float  # s


@dataclass(frozen=True)
class Trajectory:
    """NAVSIM's."""

    poses: Array  # (P, 3) float32 x, y [m], heading [rad] in the ego frame at now
    trajectory_sampling: TrajectorySampling


PUBLIC_NAMES: Mapping[type, str] = {Trajectory: TRAJECTORY, TrajectorySampling: SAMPLING}


def submission_bytes(
    team: Mapping[str, str], first_stage: Mapping[str, Array], second_stage: Mapping[str, Array]
) -> bytes:
    """The file's content. Stages: token -> (8, 3) float32 poses of 4 s; the second is empty where there is none.

    A pickle of NAVSIM's own classes, written where they are not installed: keys, nesting and types are those of
    run_create_submission_pickle.py (autonomousvision/navsim @ 0a380a9, navsim/planning/script), and
    `run_pdm_score_from_submission.py` scores it. The two classes here go by the names of the public ones, with the
    public ones' fields. Raises ValueError for plans of different lengths.
    """
    counts = {len(plan) for plan in (*first_stage.values(), *second_stage.values())}
    if len(counts) != 1:
        raise ValueError(f"plans of {sorted(counts)} poses: a submission has one or more, all of one length")
    (count,) = counts
    sampling = TrajectorySampling(count, HORIZON_S, HORIZON_S / count)
    first, second = (
        {token: Trajectory(plan, sampling) for token, plan in stage.items()} for stage in (first_stage, second_stage)
    )
    return dumps({**team, "first_stage_predictions": [first], "second_stage_predictions": [second]}, PUBLIC_NAMES)


N_POSES = 8  # 0.5 s apart


@dataclass(frozen=True)
class Request:
    """The command line."""

    planner: str  # a training's folder, a+b, constant_velocity, or my.module:MyPlanner; it reads pictures, status alone
    split: str  # a split or scene filter, the path of its .yaml: one stage (navtest) or two (navhard_two_stage)
    logs: str  # navsim_logs/<split>
    team_name: str  # this and the next four: as the leaderboard's form has them
    authors: str
    email: str
    institution: str
    country: str
    sensors: str | None = None  # sensor_blobs/<split>, for a planner that looks at pictures
    root: str | None = None  # synthetic_scene_pickles and sensor_blobs of a second stage
    out: str = "submission.pkl"  # the file; the leaderboard wants it to be called so
    device: str = "cpu"  # as the agent takes it, cameras and undistort too: docs/training.md
    cameras: tuple[str, ...] = ()
    undistort: bool = False


def main(request: Request) -> None:
    """Plan every scene and write the file. Raises Refused."""
    try:
        logs, sensors, root = (_folder(key, getattr(request, key)) for key in ("logs", "sensors", "root"))
        assert logs is not None
        pilot = AgentPlanner(request.planner, request.cameras, request.undistort, request.device)
        if pilot.cameras and request.sensors is None:
            raise Refused(f"sensors=... is missing: planner={request.planner} looks at {', '.join(pilot.cameras)}")
        scenes = scenes_of_split(read_selection(request.split), logs, sensors, root)
        with RateBar("scenes planned", len(scenes)) as progress:
            first = _planned(scenes.first_stage(), pilot, progress, 0)
            second = _planned(scenes.second_stage(), pilot, progress, len(first))
        team = {name: getattr(request, name) for name in ("team_name", "authors", "email", "institution")}
        team["country / region"] = request.country
        write_whole(Path(request.out), submission_bytes(team, first, second))
    except (BadClip, ValueError, OSError, RuntimeError) as error:  # RuntimeError: a device that is not there
        raise Refused(one_line(error)) from error
    print(f"{len(first):,} + {len(second):,} plans of the first and second stage: {request.out}")
    if left_out := len(scenes) + scenes.not_scenes - len(first) - len(second):
        print(f"{left_out:,} tokens of the split are no scenes by its own rules, and NAVSIM's script plans none there")


def _planned(
    stage: Iterable[ObservedScene | None], pilot: AgentPlanner, progress: RateBar, before: int
) -> dict[str, Array]:
    """Token -> plan. Raises BadClip."""
    plans: dict[str, Array] = {}
    for done, scene in enumerate(stage, start=before + 1):
        if scene is not None:
            try:
                plans[scene.token] = pilot.plan(scene.observation(pilot.cameras), N_POSES)
            except ValueError as error:
                raise BadClip(scene.file, f"token {scene.token}", str(error)) from error
        progress.show(done)
    return plans


def _folder(key: str, path: str | None) -> Path | None:
    """Raises ValueError where it is not there."""
    if path is None:
        return None
    folder = Path(path)
    if not folder.is_dir():
        raise ValueError(f"{key}={path}: no such folder")
    return folder
