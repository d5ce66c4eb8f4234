"""What experts' labels are like: `python -m experiments.experts.compare clips=av2 ... experts=[recovery,pdm_closed]`

By the words of `python -m factory.run`. Every candidate of every clip, or the first `candidates=`, is driven by every
expert, whatever `rounds` says. EC compares an expert's plan from a candidate's end with the one it makes half a second
before it on the way there, both as the tracker drives them: as the benchmark's follow-up frames do. Of human drives,
which are never refused, those count as accepted that have full marks.
"""

import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np

from factory.config.run import load_config
from factory.graph.steps import HUMAN_CANDIDATE, PreparedClip
from factory.pipeline import Drive, FactoryWork, perturbed_clip_of
from factory.setup.settings import assemble
from tasks.attempt import perturbed_scene, verdict
from tasks.experts.protocol import Plan
from tasks.hard_scenes import BEFORE_STEPS
from tasks.reward.comfort import extended_comfort
from tasks.reward.epdms import score_with_ec
from tasks.rollout.lqr import track
from tasks.stages import Rejected
from tasks.world.arrays import Array
from tasks.world.clip import HORIZON_STEPS, STEP_S, Scene, random_stream, scene_of_clip
from tasks.world.frames import AX, YAW_RATE

COLUMNS = {
    "tried": "plans tried",
    "plan": "a plan %",
    "accepted": "accepted %",
    "clips": "clips with one %",
    "hc": "all: HC %",
    "ec": "all: EC %",
    "kept_ec": "accepted: EC %",
    "ep": "EP",
    "epdms14": "EPDMS without EC",
    "epdms": "EPDMS with EC",
    "rough": "roughness",
    "ms": "ms a plan",
}


JERK_MPS3, YAW_ACCEL_RADPS2 = 0.5, 0.1  # at which one weighs as much as the other: extended comfort's limits


def roughness(states: Array) -> Array:
    """(K,) of driven states (K, T, 11): RMS over time of longitudinal jerk and yaw acceleration, in units of the above.

    The first jerk is that from the ego's acceleration now; its yaw rate now is left out, for logs leave it unknown.
    """
    jerk = np.diff(states[..., AX], axis=-1) / STEP_S
    yaw_accel = np.diff(states[..., 1:, YAW_RATE], axis=-1) / STEP_S
    squares = (jerk / JERK_MPS3) ** 2, (yaw_accel / YAW_ACCEL_RADPS2) ** 2
    rough: Array = np.sqrt(squares[0].mean(axis=-1) + squares[1].mean(axis=-1))
    return rough


@dataclass
class Sums:
    """Of one expert."""

    tried: int = 0
    ms: list[float] = field(default_factory=list)
    all: list[dict[str, float]] = field(default_factory=list)  # of every drive
    kept: list[dict[str, float]] = field(default_factory=list)  # of those that are accepted
    clips: dict[str, bool] = field(default_factory=dict)  # clip -> whether one is accepted

    def row(self) -> dict[str, float]:
        """The numbers of COLUMNS."""

        def mean(rows: Sequence[dict[str, float]], key: str, factor: float = 1.0) -> float:
            values = [row[key] for row in rows if np.isfinite(row[key])]
            return factor * float(np.mean(values)) if values else np.nan

        return {
            "tried": self.tried,
            "plan": 100.0 * len(self.all) / self.tried,
            "accepted": 100.0 * len(self.kept) / self.tried,
            "clips": 100.0 * float(np.mean(list(self.clips.values()))),
            "hc": mean(self.all, "hc", 100.0),
            "ec": mean(self.all, "ec", 100.0),
            "kept_ec": mean(self.kept, "ec", 100.0),
            "ep": mean(self.kept, "ep"),
            "epdms14": mean(self.kept, "epdms14"),
            "epdms": mean(self.kept, "epdms"),
            "rough": mean(self.kept, "rough"),
            "ms": float(np.median(self.ms)),
        }


def states_before(work: FactoryWork, prepared: PreparedClip, candidate: int, name: str) -> Array | None:
    """(1, 41, 11) the plan of half a second earlier as the tracker drives it; None where there was none."""
    payload, expert = perturbed_clip_of(prepared), work.experts[name]
    if candidate == HUMAN_CANDIDATE:
        now = scene_of_clip(payload.clip)
        step = now.step - BEFORE_STEPS
        before = replace(now, step=step, ego_history=payload.clip.ego_states[: step + 1])
    else:
        rollout = payload.candidates[candidate].rollout
        before = perturbed_scene(payload.clip, rollout, HORIZON_STEPS - BEFORE_STEPS)
    plan = expert.plan(before, random_stream(work.seed, prepared.clip_id, f"expert.{name}", candidate))
    return None if isinstance(plan, Rejected) else _driven(before, plan)


def _driven(scene: Scene, plan: Plan) -> Array:
    return track(scene.ego_state, np.asarray(plan.poses)[None])


def told(work: FactoryWork, prepared: PreparedClip, candidate: int, name: str, drive: Drive) -> dict[str, float] | None:
    """What is counted of a drive; None where the expert has no plan."""
    judged = drive.judged
    if judged is None:
        return None
    states = judged.rollout.ego_states[None]
    before = states_before(work, prepared, candidate, name)
    ec = np.nan if before is None else float(extended_comfort(states, before, 0.5).ec[0])
    scores = judged.scores
    return {
        "hc": float(scores.hc[1]),
        "ec": ec,
        "ep": float(scores.ep[1]),
        "epdms14": float(scores.pdm_score[1]),
        "epdms": float(score_with_ec(scores, np.array([np.nan, ec]))[1]),
        "rough": float(roughness(states)[0]),
    }


def measure(work: FactoryWork, prepared: PreparedClip, most: int | None, sums: dict[str, Sums]) -> None:
    """Every candidate of a clip, or the first `most`, by every expert."""
    for name in work.names:
        once, found = work.once(name), sums[name]
        found.clips.setdefault(prepared.clip_id, False)
        for candidate in [HUMAN_CANDIDATE] if once else range(len(prepared.candidates))[:most]:
            seconds: dict[str, float] = defaultdict(float)

            @contextmanager
            def timed(stage: str, spent: dict[str, float] = seconds) -> Iterator[None]:
                start = time.process_time()
                yield
                spent[stage] += time.process_time() - start

            drive = work.trace(prepared, candidate, name, timed)
            if drive.rejected is not None and drive.rejected.reason == "route_ended":
                continue  # nobody is asked there
            found.tried += 1
            found.ms.append(1e3 * seconds["expert"])
            row = told(work, prepared, candidate, name, drive)
            if row is None:
                continue
            found.all.append(row)
            if drive.rejected is None and (not once or verdict(drive.sampled.scores, work.gate) is None):
                found.kept.append(row)
                found.clips[prepared.clip_id] = True


def most_candidates(words: Sequence[str]) -> tuple[int | None, list[str]]:
    """What `candidates=` says, None where nothing, and the words that are the run's."""
    own = [word for word in words if word.startswith("candidates=")]
    return int(own[-1].partition("=")[2]) if own else None, [word for word in words if word not in own]


def main(words: Sequence[str]) -> int:
    """Drives, and prints the table."""
    most, given = most_candidates(words)
    sums: dict[str, Sums] = defaultdict(Sums)
    with tempfile.TemporaryDirectory() as folder:
        run = assemble(load_config([*given, "executor=local", "render=none", "reward.labels=none", f"out={folder}"]))
        run.work.warm(draws=False)
        for ref in run.index.refs[: run.config.limit]:
            prepared = run.work.prepare(ref)
            if not isinstance(prepared, Rejected):
                measure(run.work, prepared, most, sums)
                print(".", end="", file=sys.stderr, flush=True)
    print("", file=sys.stderr)
    print("| expert |", " | ".join(COLUMNS.values()), "|")
    print("|---" * (len(COLUMNS) + 1) + "|")
    for name, found in sums.items():
        row = found.row()
        cells = [f"{row[key]:.0f}" if key in ("tried", "ms") else f"{row[key]:.3g}" for key in COLUMNS]
        print(f"| {name} |", " | ".join(cells), "|")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
