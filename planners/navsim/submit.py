"""`python -m planners submit planner=<training> split=<.yaml> ...`: a submission to NAVSIM's leaderboard.

    python -m planners submit planner=runs/ltf logs=navsim_logs/test sensors=sensor_blobs/test \\
        root=navhard_two_stage split=.../train_test_split/navhard_two_stage.yaml out=submission.pkl \\
        team_name=ours authors="A. Author, B. Author" email=a@b.org institution=ours country=ours

Every scene of the split is planned from what NAVSIM shows an agent, and the file is what its own script
run_create_submission_pickle.py writes with our agent. NAVSIM is not needed. A file is whole or is not there: where one
scene cannot be planned, the error names it and nothing is written.

planner=     a training's folder, a+b, constant_velocity, or my.module:MyPlanner; it looks at pictures and status alone
split=       a split or scene filter, the path of its .yaml: one stage (navtest) or two (navhard_two_stage)
logs=        navsim_logs/<split>
sensors=     sensor_blobs/<split>, for a planner that looks at pictures
root=        synthetic_scene_pickles and sensor_blobs of a second stage
out=         the file; the leaderboard wants it to be called submission.pkl
team_name=, authors=, email=, institution=, country=     as the leaderboard's form has them
fine=        true: 40 poses 0.1 s apart; without it 8 poses 0.5 s apart
device=, cameras=, undistort=     as the agent takes them (docs/training.md)
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from factory.config.arguments import Refused
from factory.graph.progress import Counter
from factory.readers.base import BadClip
from factory.readers.navsim.filters import read_selection
from factory.wording import one_line
from planners.navsim.pilot import Pilot
from planners.navsim.split import ShownScene, scenes_of
from planners.navsim.submission import Team, submission_bytes
from tasks.caches import user_cache
from tasks.kernels.compiled import write_whole
from tasks.world.arrays import Array

N_POSES, N_FINE_POSES = 8, 40


@dataclass(frozen=True)
class Request:
    """The command line."""

    planner: str
    split: str
    logs: str
    team_name: str
    authors: str
    email: str
    institution: str
    country: str
    sensors: str | None = None
    root: str | None = None
    out: str = "submission.pkl"
    fine: bool = False
    device: str = "cpu"
    cameras: tuple[str, ...] = ()
    undistort: bool = False


def main(request: Request) -> None:
    """Plan every scene and write the file. Raises Refused."""
    try:
        logs, sensors, root = (_folder(key, getattr(request, key)) for key in ("logs", "sensors", "root"))
        assert logs is not None
        pilot = Pilot(request.planner, request.cameras, request.undistort, request.device)
        if pilot.cameras and request.sensors is None:
            raise Refused(f"sensors=... is missing: planner={request.planner} looks at {', '.join(pilot.cameras)}")
        scenes = scenes_of(read_selection(request.split), logs, sensors, root, user_cache() / "navsim")
        n_poses = N_FINE_POSES if request.fine else N_POSES
        with Counter("scenes planned", len(scenes)) as progress:
            first = _planned(scenes.first_stage(), pilot, n_poses, progress, 0)
            second = _planned(scenes.second_stage(), pilot, n_poses, progress, len(first))
        team = Team(request.team_name, request.authors, request.email, request.institution, request.country)
        write_whole(Path(request.out), submission_bytes(team, first, second))
    except (BadClip, ValueError, OSError, RuntimeError) as error:  # RuntimeError: a device that is not there
        raise Refused(one_line(error)) from error
    print(f"{len(first):,} + {len(second):,} plans of the first and second stage: {request.out}")
    if left_out := len(scenes) + scenes.not_scenes - len(first) - len(second):
        print(f"{left_out:,} tokens of the split are no scenes by its own rules, and NAVSIM's script plans none there")


def _planned(
    stage: Iterable[ShownScene | None], pilot: Pilot, n_poses: int, progress: Counter, before: int
) -> dict[str, Array]:
    """Token -> plan. Raises BadClip."""
    plans: dict[str, Array] = {}
    for done, scene in enumerate(stage, start=before + 1):
        if scene is not None:
            try:
                plans[scene.token] = pilot.plan(scene.sighting(pilot.cameras), n_poses)
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
