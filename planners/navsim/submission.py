"""The file that NAVSIM's leaderboard takes: a pickle of NAVSIM's own classes, written where they are not installed.

Keys, nesting and types are those of run_create_submission_pickle.py (autonomousvision/navsim @ 0a380a9,
navsim/planning/script), and `run_pdm_score_from_submission.py` scores it. In the pickle the two classes here go by the
names of the public ones, with the public ones' fields.
"""

from collections.abc import Mapping
from dataclasses import dataclass

from factory.exports.navsim.pickles import dumps
from tasks.world.arrays import Array

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


PUBLIC_NAMES: Mapping[type, str] = {
    Trajectory: "navsim.common.dataclasses Trajectory",
    TrajectorySampling: "nuplan.planning.simulation.trajectory.trajectory_sampling TrajectorySampling",
}


@dataclass(frozen=True)
class Team:
    """Whose submission it is, by the leaderboard's form."""

    team_name: str
    authors: str
    email: str
    institution: str
    country: str


def submission_bytes(team: Team, first_stage: Mapping[str, Array], second_stage: Mapping[str, Array]) -> bytes:
    """The file's content. Stages: token -> (8 or 40, 3) float32 poses of 4 s; the second is empty where there is none.

    Raises ValueError for plans of different lengths.
    """
    counts = {len(plan) for plan in (*first_stage.values(), *second_stage.values())}
    if len(counts) != 1:
        raise ValueError(f"plans of {sorted(counts)} poses: a submission has one or more, all of one length")
    (count,) = counts
    sampling = TrajectorySampling(count, HORIZON_S, HORIZON_S / count)
    first, second = (
        {token: Trajectory(plan, sampling) for token, plan in stage.items()} for stage in (first_stage, second_stage)
    )
    content = {
        "team_name": team.team_name,
        "authors": team.authors,
        "email": team.email,
        "institution": team.institution,
        "country / region": team.country,
        "first_stage_predictions": [first],
        "second_stage_predictions": [second],
    }
    return dumps(content, PUBLIC_NAMES)
